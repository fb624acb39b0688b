//! The oracle: checks every tick and names the broken law.

use std::fmt;

use palpate_device::Wrench;
use palpate_haptics::Chain;
use serde::Serialize;

use super::faulty_device::Write;

const ROUNDING: f64 = 1.0 + 1e-9;

/// Forces below this count as zero, N.
const ZERO_N: f64 = 1e-9;

/// Maximum time from the loss of the source to zero force, µs.
pub(super) const ZERO_WITHIN_US: i64 = 150_000;
const KEPT_MAX: usize = 8;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Law {
    WrittenStep,
    RenderedStep,
    ZeroInTime,
    FiniteWrites,
    ForceLimit,
    TimeGoesOn,
    Counted,
    ComesBack,
    Ends,
}

impl fmt::Display for Law {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::WrittenStep => "the written force steps from the force at the device",
            Self::RenderedStep => "the rendered force steps",
            Self::ZeroInTime => "the force outlives its source by more than 150 ms",
            Self::FiniteWrites => "a non-finite number was written",
            Self::ForceLimit => "the force is above its limit",
            Self::TimeGoesOn => "the device received a time stamp in the past",
            Self::Counted => "a fault was not counted",
            Self::ComesBack => "the force did not return",
            Self::Ends => "the loop did not end with zero force after a stop request",
        })
    }
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Broken {
    pub law: Law,
    pub at_ms: f64,
    pub detail: String,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Largest change of force per tick, N.
    pub step_n: f64,
    pub step_nm: f64,
    pub force_n: f64,
}

impl Bounds {
    pub fn of(chain: &Chain) -> Self {
        Self {
            step_n: chain.slew_step_n(),
            step_nm: chain.slew_step_nm(),
            force_n: chain.force_limit_n(),
        }
    }

    /// Whether the change from `from` to `to` is a step.
    fn is_step(&self, from: &Wrench, to: &Wrench) -> bool {
        let (df, dt) = (to.force - from.force, to.torque - from.torque);
        df.norm() > self.step_n * ROUNDING || dt.norm() > self.step_nm * ROUNDING + ZERO_N
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    pub at_us: i64,
    /// Run time without stops of the process, µs.
    pub running_us: i64,
    pub write: Write,
    /// Force that the device dropped by itself since the last write, N.
    pub cut_n: f64,
    /// Time since when the force has no source, on the scale of `running_us`.
    pub lost_since_us: Option<i64>,
}

#[derive(Debug, Clone, Copy)]
struct Loss {
    since_us: i64,
    /// Whether the force was nonzero at its beginning and has not reached zero since.
    is_felt: bool,
}

#[derive(Debug, Clone)]
pub struct Oracle {
    bounds: Bounds,
    last: Wrench,
    loss: Option<Loss>,
    /// Largest change between two ticks, without that of the device itself, N.
    pub max_delta_n: f64,
    /// Times from a loss of the source to zero force, ms.
    pub to_zero_ms: Vec<f64>,
    pub broken: Vec<Broken>,
}

impl Oracle {
    pub fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            last: Wrench::ZERO,
            loss: None,
            max_delta_n: 0.0,
            to_zero_ms: Vec::new(),
            broken: Vec::new(),
        }
    }

    pub fn report(&mut self, law: Law, at_us: i64, detail: String) {
        if self.broken.len() < KEPT_MAX {
            self.broken.push(Broken {
                law,
                at_ms: at_us as f64 * 1e-3,
                detail,
            });
        }
    }

    /// Checks a tick; returns the force change without that of the device itself, N.
    pub fn check(&mut self, observed: &Observation) -> f64 {
        let delta_n = self.check_steps(observed);
        let Write {
            commanded, after, ..
        } = observed.write;
        if !commanded.is_finite() {
            self.report(Law::FiniteWrites, observed.at_us, format!("{commanded:?}"));
        }
        for (what, n) in [
            ("commanded", commanded.force.norm()),
            ("rendered", after.force.norm()),
        ] {
            if n > self.bounds.force_n * ROUNDING {
                let detail = format!("{n:.3} N {what}, {:.3} are allowed", self.bounds.force_n);
                self.report(Law::ForceLimit, observed.at_us, detail);
            }
        }
        self.check_source(observed);
        self.last = after;
        delta_n
    }

    fn check_steps(&mut self, observed: &Observation) -> f64 {
        let Write {
            commanded,
            before,
            after,
            obeyed,
            is_on,
        } = observed.write;
        let describe = |what: &str, from: &Wrench, to: &Wrench| {
            format!(
                "{what} from {:.4?} to {:.4?} N: {:.4} N, {:.4} are allowed",
                from.force.as_slice(),
                to.force.as_slice(),
                (to.force - from.force).norm(),
                self.bounds.step_n
            )
        };
        // Ramping motors render only a share of the command, so the two are not comparable.
        if is_on && self.bounds.is_step(&before, &commanded) {
            let detail = describe("written", &before, &commanded);
            self.report(Law::WrittenStep, observed.at_us, detail);
            return (commanded.force - before.force).norm();
        }
        // A force drop by the device is exempt; later changes count again.
        let from = if observed.cut_n > 0.0 {
            before
        } else {
            self.last
        };
        if obeyed {
            let delta = (after.force - from.force).norm();
            self.max_delta_n = self.max_delta_n.max(delta);
            if self.bounds.is_step(&from, &after) {
                let detail = describe("rendered", &from, &after);
                self.report(Law::RenderedStep, observed.at_us, detail);
            }
            return delta;
        }
        if after.force.norm() > from.force.norm() + self.bounds.step_n * ROUNDING {
            let detail = describe("rendered", &from, &after);
            self.report(Law::RenderedStep, observed.at_us, detail);
        }
        0.0
    }

    fn check_source(&mut self, observed: &Observation) {
        let stands_n = observed.write.after.force.norm();
        let Some(since_us) = observed.lost_since_us else {
            self.loss = None;
            return;
        };
        // A source may return while another one is lost: a second loss with its own deadline.
        if self.loss.is_some_and(|loss| loss.since_us < since_us) {
            self.loss = None;
        }
        let loss = self.loss.get_or_insert(Loss {
            since_us,
            is_felt: stands_n > ZERO_N || self.last.force.norm() > ZERO_N,
        });
        loss.since_us = since_us;
        let for_us = observed.running_us - since_us;
        if stands_n <= ZERO_N {
            if std::mem::take(&mut loss.is_felt) {
                self.to_zero_ms.push(for_us as f64 * 1e-3);
            }
        } else if for_us > ZERO_WITHIN_US {
            let detail = format!("{stands_n:.4} N after {:.1} ms", for_us as f64 * 1e-3);
            self.report(Law::ZeroInTime, observed.at_us, detail);
        }
    }
}
