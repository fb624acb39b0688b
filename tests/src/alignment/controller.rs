//! Delay controllers of a site: the product's, and baselines from the literature.

use palpate_protocol::compensation::{DelayEstimator, MotionArrival};
use palpate_protocol::request::DelayReport;
use palpate_protocol::{ServerTime, Span};

/// Time from one packet to the next: D covers the newest sample until then.
const PACKET_US: f64 = 4000.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Baseline {
    /// The delay manager of WebRTC's `NetEQ`: a quantile of the delay above the minimum of two seconds, from a histogram
    /// with a forgetting factor.
    NetEq,
    /// A Kalman filter of the age as a random walk; D is four standard deviations of the innovation above it.
    Kalman,
}

impl Baseline {
    pub const ALL: [Self; 2] = [Self::NetEq, Self::Kalman];

    pub fn name(self) -> &'static str {
        match self {
            Self::NetEq => "NetEQ",
            Self::Kalman => "Kalman",
        }
    }
}

#[derive(Debug)]
pub(super) enum Controller {
    Product(Box<DelayEstimator>),
    NetEq(NetEq),
    Kalman(Option<Kalman>),
}

impl Controller {
    pub(super) fn new(cap: Span, baseline: Option<Baseline>) -> Self {
        match baseline {
            None => Self::Product(Box::new(DelayEstimator::new(cap))),
            Some(Baseline::NetEq) => Self::NetEq(NetEq::default()),
            Some(Baseline::Kalman) => Self::Kalman(None),
        }
    }

    pub(super) fn handle_arrival(&mut self, arrival: MotionArrival) {
        let age_us = (arrival.arrived - arrival.generated).as_micros() as f64;
        match self {
            Self::Product(estimator) => {
                estimator.handle_arrival(arrival);
            }
            Self::NetEq(net_eq) => net_eq.handle_age(age_us, arrival.arrived),
            Self::Kalman(Some(filter)) => filter.handle_age(age_us),
            Self::Kalman(filter) => *filter = Some(Kalman::new(age_us)),
        }
    }

    pub(super) fn take_urgent(&mut self) -> bool {
        match self {
            Self::Product(estimator) => estimator.take_urgent(),
            Self::NetEq(_) | Self::Kalman(_) => false,
        }
    }

    pub(super) fn report(&self) -> Option<DelayReport> {
        let wanted_us = match self {
            Self::Product(estimator) => return estimator.report(),
            Self::NetEq(net_eq) => net_eq.delay_us()?,
            Self::Kalman(filter) => filter.as_ref()?.delay_us(),
        };
        Some(DelayReport {
            wanted_us: wanted_us as u32,
            ..DelayReport::default()
        })
    }
}

/// Width of a histogram class of `NetEQ`, one packet of audio, and their number.
const CLASS_US: f64 = 20_000.0;
const CLASSES: usize = 100;

/// `NetEQ` forgets 1 - 0.983 per packet of 20 ms; ours last 4 ms.
const FORGET: f64 = 0.996_58;
const QUANTILE: f64 = 0.95;
const MINIMUM_WINDOW: Span = Span::from_millis(2000);

#[derive(Debug)]
pub(super) struct NetEq {
    /// Recent ages with their times, without those that a later smaller one makes irrelevant.
    minima: std::collections::VecDeque<(ServerTime, f64)>,
    shares: Vec<f64>,
}

impl Default for NetEq {
    fn default() -> Self {
        Self {
            minima: std::collections::VecDeque::new(),
            shares: vec![0.0; CLASSES],
        }
    }
}

impl NetEq {
    fn handle_age(&mut self, age_us: f64, now: ServerTime) {
        while self.minima.back().is_some_and(|(_, us)| *us >= age_us) {
            self.minima.pop_back();
        }
        self.minima.push_back((now, age_us));
        while self
            .minima
            .front()
            .is_some_and(|(at, _)| now - *at > MINIMUM_WINDOW)
        {
            self.minima.pop_front();
        }
        let relative_us = age_us - self.minima[0].1;
        let class = ((relative_us / CLASS_US) as usize).min(CLASSES - 1);
        self.shares.iter_mut().for_each(|share| *share *= FORGET);
        self.shares[class] += 1.0 - FORGET;
    }

    fn delay_us(&self) -> Option<f64> {
        let minimum_us = self.minima.front()?.1;
        let mut left = QUANTILE * self.shares.iter().sum::<f64>();
        let class = self.shares.iter().position(|share| {
            left -= share;
            left <= 0.0
        });
        let above_us = (class.unwrap_or(CLASSES - 1) + 1) as f64 * CLASS_US;
        Some(minimum_us + above_us + PACKET_US)
    }
}

/// Growth of the variance of the mean age from packet to packet, µs².
const WALK: f64 = 1e3;

/// Weight of the newest innovation in their variance.
const INNOVATION: f64 = 0.01;
const DEVIATIONS: f64 = 4.0;

#[derive(Debug)]
pub(super) struct Kalman {
    mean_us: f64,
    /// Variance of the mean, and of the innovations, µs².
    variance: f64,
    innovations: f64,
}

impl Kalman {
    fn new(age_us: f64) -> Self {
        Self {
            mean_us: age_us,
            variance: WALK,
            innovations: 1e6,
        }
    }

    fn handle_age(&mut self, age_us: f64) {
        let innovation = age_us - self.mean_us;
        self.innovations += INNOVATION * (innovation * innovation - self.innovations);
        self.variance += WALK;
        let gain = self.variance / (self.variance + self.innovations);
        self.mean_us += gain * innovation;
        self.variance *= 1.0 - gain;
    }

    fn delay_us(&self) -> f64 {
        self.mean_us + DEVIATIONS * self.innovations.sqrt() + PACKET_US
    }
}
