//! Artificial time compensation: every site shows an event stamped t at t + D.
//!
//! Each site measures the age of received motion (Lin 2007, chapter 6; the rule is
//! reconstructed):
//!
//! ```text
//! d = t_arrival - t_generated;   μ += α (d - μ);   ν += α (|d - μ| - ν)          α = 0.02
//! D*: level of the required delay, and quantile of its peaks, less the extrapolation (`requirement`)
//! prediction: the growth of the uplink age within 600 ms is added to the earlier reports of the participants
//! group: D = max over participants with D* <= cap, slewed by dD/dt in [-0.05, +0.25]
//! ```
//!
//! μ and ν are those of Ramjee, Kurose, Towsley and Schulzrinne (INFOCOM 1994, algorithm 1). Their
//! playout delay μ + 4ν covers nearly every packet and costs a third more delay than extrapolation needs;
//! it only judges demoted participants. Our α is ten times theirs, as packets arrive five times as often.
//! A participant beyond the cap does not change D: no delay bridges a stall that long, and a lasting one ends in
//! demotion.
//!
//! [`Prediction`] is the other reading of the source: the server predicts, and no site delays.
//!
//! [`DelayEstimator`] is one site's measurement, [`GroupDelay`] the server's decision. [`Demotion`]
//! selects participants whose estimate stays above the cap. [`DelaySchedule`] turns the decisions into
//! D: the same D at the same server time on every site, because it is a function of the operation log
//! alone.

mod demotion;
mod estimator;
mod group;
mod prediction;
mod requirement;
mod schedule;

use crate::Span;

pub use demotion::{
    DEMOTE_AFTER, Demotion, DemotionDecision, REPORT_OLD, RESTORE_AFTER, RESTORE_SHARE,
};
pub use estimator::{DelayEstimator, MotionArrival};
pub use group::{CHANGE_MIN, CHANGE_PART, CHANGE_PERIOD, DelayChange, GroupDelay, RAISE_PERIOD};
pub use prediction::{PREDICTION_MAX, Prediction};
pub use requirement::BRIDGE;
pub use schedule::{CATCH_UP, DelaySchedule};

/// Weight of the newest measurement in μ and ν: a memory of 50 packets, 0.2 s at 250 Hz.
pub const ALPHA: f64 = 0.02;

/// How fast D may shrink, seconds per second: a displayed tool moves at most 5 % faster.
pub const SLEW_DOWN: f64 = 0.05;

/// How fast D may grow, seconds per second: displayed motion slows down to three quarters.
pub const SLEW_UP: f64 = 0.25;

/// The largest D of the adaptive rule unless the host raises it. With a server in the middle an age is
/// uplink plus downlink: two participants at 120 ms from it need 240 ms plus their jitter, so that 200
/// ms would demote both in an intercontinental session. Beyond 400 ms two people no longer work on one
/// moment.
pub const CAP_DEFAULT: Span = Span::from_millis(400);

#[cfg(test)]
mod tests;
