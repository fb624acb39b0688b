//! Discrete-event simulation of two sites and a server without a room.

use std::sync::Arc;

use palpate_protocol::compensation::{DelaySchedule, GroupDelay, MotionArrival};
use palpate_protocol::datagram::{Probe, Reply};
use palpate_protocol::operation::CompensationSettings;
use palpate_protocol::request::DelayReport;
use palpate_protocol::session::FUTURE_MAX;
use palpate_protocol::timeline::Source;
use palpate_protocol::{ParticipantId, ServerTime, Span, ToolSample};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::controller::{Baseline, Controller};
use super::predictor::Predictor;
use super::site::Site;
use crate::hand::Hand;
use crate::network::{Direction, Profile};
use crate::simulated_session::SiteClock;
use crate::simulated_session::links::{Arrived, Delivery, Links, Part, Payload};

const TICK_US: i64 = 1000;
const BATCH: usize = 4;
/// Interval between a site's delay reports, microseconds, as in the client.
const REPORT_US: i64 = 250_000;
/// Interval between clock probes, microseconds: before and after the clock lock.
const PROBE_US: [i64; 2] = [20_000, 100_000];
const RESEND_US: i64 = 100_000;
/// Size of a packet in bytes, for links with limited bandwidth.
const PACKET_BYTES: usize = 120;
const DRIFT_MAX: f64 = 50e-6;

#[derive(Debug)]
enum Packet {
    SamplesUp(Vec<ToolSample>),
    SamplesDown(Vec<ToolSample>),
    /// Predicted tool sample, and the time of the real sample it is based on.
    PredictedDown(ToolSample, ServerTime),
    ProbeUp(Probe),
    ReplyDown(Reply),
    ReportUp(DelayReport),
    ChangeDown(u32, ServerTime),
}

impl Payload for Packet {
    fn bytes(&self) -> usize {
        PACKET_BYTES
    }

    fn purpose(&self) -> (Part, u16) {
        let part = match self {
            Self::SamplesUp(_) | Self::SamplesDown(_) | Self::PredictedDown(..) => Part::Motion,
            Self::ProbeUp(_) | Self::ReplyDown(_) => Part::Clock,
            Self::ReportUp(_) => Part::Delays,
            Self::ChangeDown(..) => Part::Operations,
        };
        (part, 0)
    }
}

/// Both tools as both sites show them at one time.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    pub time_s: f64,
    /// Position of the first tool as shown by its own site and by the other site, metres.
    pub first: [[f64; 3]; 2],
    /// Position of the second tool, in the same order.
    pub second: [[f64; 3]; 2],
    pub stale: bool,
    pub delay_ms: f64,
    /// Age of the second tool's newest sample at the first site, milliseconds.
    pub age_ms: f64,
    /// Horizon of the server's prediction of the second tool for the first site, milliseconds.
    pub ahead_ms: f64,
}

impl Moment {
    /// Distance between the sites' shown positions, maximum over both tools, millimetres.
    pub fn apart_mm(&self) -> f64 {
        let apart = [self.first, self.second].map(|[own, other]| {
            let square: f64 = own.iter().zip(other).map(|(a, b)| (a - b).powi(2)).sum();
            square.sqrt() * 1e3
        });
        apart[0].max(apart[1])
    }
}

pub struct TwoSites {
    sites: [Site; 2],
    links: Links<Packet>,
    group: GroupDelay,
    measured: [Controller; 2],
    schedule: DelaySchedule,
    predictor: Option<Predictor>,
    probe_due_us: [i64; 2],
    report_due_us: [i64; 2],
    arrived: u64,
    now_us: i64,
}

impl TwoSites {
    pub fn new(
        settings: &CompensationSettings,
        baseline: Option<Baseline>,
        (profile, network_seed): (&Profile, u64),
        hands: [Arc<dyn Hand>; 2],
        seed: u64,
    ) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let sites = hands.map(|hand| {
            let offset_us = rng.random_range(-3_600_000_000..3_600_000_000);
            let drift = rng.random_range(-DRIFT_MAX..DRIFT_MAX);
            Site::new(hand, settings, baseline, SiteClock::new(offset_us, drift))
        });
        Self {
            sites,
            links: Links::new(&[profile; 2], network_seed, RESEND_US),
            group: GroupDelay::new(settings),
            measured: [0, 1].map(|_| Controller::new(settings.mode.cap(), baseline)),
            schedule: DelaySchedule::new(settings),
            predictor: None,
            probe_due_us: [0; 2],
            report_due_us: [REPORT_US; 2],
            arrived: 0,
            now_us: 0,
        }
    }

    /// Replaces the playout delay by the server's prediction. The horizon is the delay from the server to
    /// the receiving site.
    #[must_use]
    pub fn predicted(mut self) -> Self {
        self.predictor = Some(Predictor::default());
        self
    }

    /// Runs until `until_us` and reports every moment from `from_us` on.
    pub fn run(&mut self, from_us: i64, until_us: i64, moment: &mut dyn FnMut(Moment)) {
        while self.now_us < until_us {
            let now = self.now_us;
            self.now_us += TICK_US;
            while let Some(delivery) = self.links.pop_due(now) {
                self.receive(delivery);
            }
            for k in 0..2 {
                self.tick(k, now);
            }
            self.decide(now);
            if now >= from_us
                && let Some(shown) = self.shown(now)
            {
                moment(shown);
            }
        }
    }

    pub fn set_clock(&mut self, site: usize, by_us: i64) {
        self.sites[site].own_clock.step(by_us);
    }

    pub fn clock_steps(&self) -> [u64; 2] {
        [0, 1].map(|k| self.sites[k].clock.steps())
    }

    pub fn arrived(&self) -> u64 {
        self.arrived
    }

    fn shown(&mut self, now: i64) -> Option<Moment> {
        let [a, b] = &mut self.sites;
        let ([a_own, a_other], [b_own, b_other]) = (a.shown(now)?, b.shown(now)?);
        let here = a.server_time(now)?;
        let delay = a.schedule.delay_at(here);
        let known = match &self.predictor {
            None => a.views[1].newest()?,
            Some(_) => a.predicted_from?,
        };
        let age = here - known;
        Some(Moment {
            time_s: now as f64 * 1e-6,
            first: [a_own.pose.position_m, b_other.pose.position_m],
            second: [b_own.pose.position_m, a_other.pose.position_m],
            stale: [a_other, b_other]
                .iter()
                .any(|tool| tool.source == Source::Held),
            delay_ms: delay.as_millis_f64(),
            age_ms: age.as_millis_f64(),
            ahead_ms: (a.predicted_ahead).map_or(0.0, Span::as_millis_f64),
        })
    }

    fn tick(&mut self, k: usize, now: i64) {
        let site = &mut self.sites[k];
        if now >= self.probe_due_us[k] {
            let period = PROBE_US[usize::from(site.clock.map().is_some())];
            let probe = site.clock.probe(site.own_clock.at(now));
            let pause = site.clock.probe_pause(Span::from_micros(period));
            self.probe_due_us[k] = now + pause.as_micros();
            self.links
                .send_datagram(k, Direction::Up, now, Packet::ProbeUp(probe));
        }
        let site = &mut self.sites[k];
        let sampled = site.sample(now).is_some();
        if sampled && site.batch.len() == BATCH {
            let batch = std::mem::take(&mut site.batch);
            self.links
                .send_datagram(k, Direction::Up, now, Packet::SamplesUp(batch));
        }
        let site = &mut self.sites[k];
        if site.estimator.take_urgent() || now >= self.report_due_us[k] {
            self.report_due_us[k] = now + REPORT_US;
            if let Some(report) = site.estimator.report() {
                let parcel = Packet::ReportUp(report);
                self.links.send_segment(k, Direction::Up, now, parcel);
            }
        }
    }

    fn decide(&mut self, now: i64) {
        let own = self.measured.iter().filter_map(Controller::report);
        let own = own.filter(|r| self.group.can_bridge(r));
        if let Some(worst) = own.max_by_key(|r| r.wanted_us) {
            self.group.handle_report(ParticipantId::SERVER, worst);
        }
        let lead = self.group.lead();
        let at = ServerTime::from_micros(now);
        if let Some(change) = self.group.poll_change(at, lead) {
            (self.schedule).handle_change(change.delay_us, change.effective_at);
            for k in 0..2 {
                let parcel = Packet::ChangeDown(change.delay_us, change.effective_at);
                self.links.send_segment(k, Direction::Down, now, parcel);
            }
        }
    }

    fn receive(&mut self, delivery: Delivery<Packet>) {
        match delivery.arrived {
            Arrived::Datagram(parcel) => self.handle(delivery.seat, delivery.at_us, parcel),
            Arrived::Stream(parcels) => {
                for parcel in parcels {
                    self.handle(delivery.seat, delivery.at_us, parcel);
                }
            }
        }
    }

    /// Handles a parcel at the server from site `k`, or at site `k`.
    fn handle(&mut self, k: usize, at: i64, parcel: Packet) {
        let server_now = ServerTime::from_micros(at);
        match parcel {
            Packet::SamplesUp(samples) => {
                // As in the product's session, samples from a clock that was set are ignored.
                if samples.iter().any(|s| s.time > server_now + FUTURE_MAX) {
                    return;
                }
                if let Some(newest) = samples.last() {
                    let arrival = MotionArrival::on_time(newest.time, server_now);
                    self.measured[k].handle_arrival(arrival);
                }
                let parcel = match &mut self.predictor {
                    None => Some(Packet::SamplesDown(samples)),
                    Some(predictor) => predictor
                        .handle_samples(k, &samples, server_now)
                        .map(|(sample, newest)| Packet::PredictedDown(sample, newest)),
                };
                if let Some(parcel) = parcel {
                    self.links.send_datagram(1 - k, Direction::Down, at, parcel);
                }
            }
            Packet::PredictedDown(sample, newest) => {
                self.sites[k].handle_predicted(sample, newest, at);
            }
            Packet::SamplesDown(samples) => {
                self.arrived += samples.len() as u64;
                self.sites[k].handle_samples(&samples, at);
            }
            Packet::ProbeUp(probe) => {
                let reply = Reply {
                    id: probe.id,
                    client_sent: probe.client_sent,
                    server_received: server_now,
                    server_sent: server_now,
                };
                self.links
                    .send_datagram(k, Direction::Down, at, Packet::ReplyDown(reply));
            }
            Packet::ReplyDown(reply) => {
                let here = self.sites[k].own_clock.at(at);
                self.sites[k].clock.handle_reply(reply, here);
            }
            Packet::ReportUp(report) => {
                if let Some(predictor) = &mut self.predictor {
                    predictor.handle_report(k, report, server_now);
                }
                self.group
                    .handle_report(ParticipantId(k as u16 + 1), report);
            }
            Packet::ChangeDown(delay_us, effective_at) => {
                self.sites[k].handle_change(delay_us, effective_at, at);
            }
        }
    }
}
