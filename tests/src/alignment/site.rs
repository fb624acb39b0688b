//! A site: a clock, a hand and the shown tools.

use std::sync::Arc;

use palpate_protocol::clock::{ClockEstimate, ClockMap};
use palpate_protocol::compensation::{DelaySchedule, MotionArrival};
use palpate_protocol::operation::CompensationSettings;
use palpate_protocol::timeline::{Shown, Timeline};
use palpate_protocol::{ServerTime, Span, ToolSample};

use super::controller::{Baseline, Controller};
use crate::hand::Hand;
use crate::simulated_session::SiteClock;

pub(super) struct Site {
    pub hand: Arc<dyn Hand>,
    pub clock: ClockEstimate,
    pub estimator: Controller,
    pub schedule: DelaySchedule,
    /// Timelines of the own tool and the other site's tool.
    pub views: [Timeline; 2],
    pub batch: Vec<ToolSample>,
    /// Time of the real sample behind the newest prediction.
    pub predicted_from: Option<ServerTime>,
    pub predicted_ahead: Option<Span>,
    /// The local clock; `clock` estimates the server's time from it.
    pub own_clock: SiteClock,
}

impl Site {
    pub(super) fn new(
        hand: Arc<dyn Hand>,
        settings: &CompensationSettings,
        baseline: Option<Baseline>,
        own_clock: SiteClock,
    ) -> Self {
        Self {
            hand,
            clock: ClockEstimate::new(),
            estimator: Controller::new(settings.mode.cap(), baseline),
            schedule: DelaySchedule::new(settings),
            views: [Timeline::default(), Timeline::default()],
            batch: Vec::new(),
            predicted_from: None,
            predicted_ahead: None,
            own_clock,
        }
    }

    pub(super) fn server_time(&self, true_us: i64) -> Option<ServerTime> {
        let map: ClockMap = self.clock.map()?;
        Some(map.to_server(self.own_clock.at(true_us)))
    }

    /// Takes a sample of the hand; `None` before the clock lock.
    pub(super) fn sample(&mut self, true_us: i64) -> Option<()> {
        let time = self.server_time(true_us)?;
        let pose = self.hand.at(true_us as f64 * 1e-6);
        let sample = ToolSample {
            time,
            pose,
            ..ToolSample::default()
        };
        self.views[0].insert(sample);
        self.batch.push(sample);
        Some(())
    }

    pub(super) fn handle_samples(&mut self, samples: &[ToolSample], true_us: i64) {
        let (Some(newest), Some(now)) = (samples.last(), self.server_time(true_us)) else {
            return;
        };
        let arrival = MotionArrival::on_time(newest.time, now);
        self.estimator.handle_arrival(arrival);
        for sample in samples {
            self.views[1].insert(*sample);
        }
    }

    /// Receives the other tool as predicted from a sample at `from`. The delay estimator uses `from`,
    /// because the prediction should cancel the sample's age.
    pub(super) fn handle_predicted(&mut self, sample: ToolSample, from: ServerTime, true_us: i64) {
        let Some(now) = self.server_time(true_us) else {
            return;
        };
        let arrival = MotionArrival::on_time(from, now);
        self.estimator.handle_arrival(arrival);
        if self.predicted_from <= Some(from) {
            self.predicted_from = Some(from);
            self.predicted_ahead = Some(sample.time - from);
        }
        self.views[1].insert(sample);
    }

    pub(super) fn handle_change(&mut self, delay_us: u32, effective_at: ServerTime, true_us: i64) {
        match self.server_time(true_us) {
            Some(now) => (self.schedule).handle_late_change(delay_us, effective_at, now),
            None => self.schedule.handle_change(delay_us, effective_at),
        }
    }

    pub(super) fn shown(&mut self, true_us: i64) -> Option<[Shown; 2]> {
        let moment = self.schedule.shown_at(self.server_time(true_us)?);
        let [own, other] = &mut self.views;
        Some([own.at(moment)?, other.at(moment)?])
    }
}
