//! Who looks at every tick, and says which law it broke.

use std::fmt;

use palpate_device::Wrench;
use palpate_haptics::Chain;
use serde::Serialize;

use super::rig::Write;

/// Numbers that are equal but for rounding.
const ROUNDING: f64 = 1.0 + 1e-9;

/// No force, N.
const ZERO_N: f64 = 1e-9;

/// After the loss of its source the force is zero within so long, µs.
pub(super) const ZERO_WITHIN_US: i64 = 150_000;

/// Broken laws that a run keeps; more say nothing new.
const KEPT_MAX: usize = 8;

/// What holds for a hand in any fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Law {
    /// What is written steps no further than the slew limit from what stands at the device.
    WrittenStep,
    /// What is rendered steps no further than the slew limit, unless the device itself lets go.
    RenderedStep,
    /// The force is zero within 150 ms of the loss of its source.
    ZeroInTime,
    /// No number that is none is written.
    FiniteWrites,
    /// The force stays within the limit.
    ForceLimit,
    /// The device is told no time before that of the call before.
    TimeGoesOn,
    /// What broke is counted.
    Counted,
    /// The force comes back when the fault is over.
    ComesBack,
    /// A stop takes the force away and ends the loop.
    Ends,
}

impl fmt::Display for Law {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::WrittenStep => "what is written steps from what stands at the device",
            Self::RenderedStep => "what the hand feels steps",
            Self::ZeroInTime => "the force outlives its source by more than 150 ms",
            Self::FiniteWrites => "a number that is none was written",
            Self::ForceLimit => "the force is above its limit",
            Self::TimeGoesOn => "the device was told a time that had passed",
            Self::Counted => "a fault was not counted",
            Self::ComesBack => "the force did not come back",
            Self::Ends => "a stop did not end with zero force",
        })
    }
}

/// A law that was broken.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Broken {
    /// Which.
    pub law: Law,
    /// When, ms of the run.
    pub at_ms: f64,
    /// How.
    pub detail: String,
}

/// What a tick may do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Largest change of force per tick, N.
    pub step_n: f64,
    /// Largest change of torque per tick, N·m.
    pub step_nm: f64,
    /// Largest force, N.
    pub force_n: f64,
}

impl Bounds {
    /// Those that a chain promises.
    pub fn of(chain: &Chain) -> Self {
        Self {
            step_n: chain.slew_step_n(),
            step_nm: chain.slew_step_nm(),
            force_n: chain.force_limit_n(),
        }
    }

    /// Whether `to` is a step from `from`.
    fn is_step(&self, from: &Wrench, to: &Wrench) -> bool {
        let (df, dt) = (to.force - from.force, to.torque - from.torque);
        df.norm() > self.step_n * ROUNDING || dt.norm() > self.step_nm * ROUNDING + ZERO_N
    }
}

/// One tick as it is looked at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// When, µs of the run.
    pub at_us: i64,
    /// When, µs of the run in which the process was not stopped.
    pub running_us: i64,
    /// The write.
    pub write: Write,
    /// What the device took away by itself since the last write, N.
    pub cut_n: f64,
    /// Since when the force has no source, in the time of `running_us`.
    pub lost_since_us: Option<i64>,
}

/// A stretch without a source.
#[derive(Debug, Clone, Copy)]
struct Loss {
    since_us: i64,
    /// Whether there was any force when it began, and none was seen to be zero since.
    is_felt: bool,
}

/// Looks at a run.
#[derive(Debug, Clone)]
pub struct Oracle {
    bounds: Bounds,
    last: Wrench,
    loss: Option<Loss>,
    /// Largest change between two ticks that was ours, N.
    pub max_delta_n: f64,
    /// From losses of the source to zero force, ms.
    pub to_zero_ms: Vec<f64>,
    /// The laws that were broken, the first ones.
    pub broken: Vec<Broken>,
}

impl Oracle {
    /// One that has seen nothing yet.
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

    /// Notes that a law was broken.
    pub fn accuse(&mut self, law: Law, at_us: i64, detail: String) {
        if self.broken.len() < KEPT_MAX {
            self.broken.push(Broken {
                law,
                at_ms: at_us as f64 * 1e-3,
                detail,
            });
        }
    }

    /// Looks at a tick; the change of force that was ours, N.
    pub fn look(&mut self, look: &Look) -> f64 {
        let delta_n = self.look_at_steps(look);
        let Write { asked, after, .. } = look.write;
        if !asked.is_finite() {
            self.accuse(Law::FiniteWrites, look.at_us, format!("{asked:?}"));
        }
        for (what, n) in [
            ("asked for", asked.force.norm()),
            ("rendered", after.force.norm()),
        ] {
            if n > self.bounds.force_n * ROUNDING {
                let detail = format!("{n:.3} N {what}, {:.3} are allowed", self.bounds.force_n);
                self.accuse(Law::ForceLimit, look.at_us, detail);
            }
        }
        self.look_at_source(look);
        self.last = after;
        delta_n
    }

    fn look_at_steps(&mut self, look: &Look) -> f64 {
        let Write {
            asked,
            before,
            after,
            obeyed,
            is_on,
        } = look.write;
        let say = |what: &str, from: &Wrench, to: &Wrench| {
            format!(
                "{what} from {:.4?} to {:.4?} N: {:.4} N, {:.4} are allowed",
                from.force.as_slice(),
                to.force.as_slice(),
                (to.force - from.force).norm(),
                self.bounds.step_n
            )
        };
        // Motors that come up render a share of what they are asked for, so the two can not be compared.
        if is_on && self.bounds.is_step(&before, &asked) {
            let detail = say("written", &before, &asked);
            self.accuse(Law::WrittenStep, look.at_us, detail);
            return (asked.force - before.force).norm();
        }
        // What the device lets go of by itself is its own. From there on it is ours again.
        let from = if look.cut_n > 0.0 { before } else { self.last };
        if obeyed {
            let delta = (after.force - from.force).norm();
            self.max_delta_n = self.max_delta_n.max(delta);
            if self.bounds.is_step(&from, &after) {
                let detail = say("rendered", &from, &after);
                self.accuse(Law::RenderedStep, look.at_us, detail);
            }
            return delta;
        }
        if after.force.norm() > from.force.norm() + self.bounds.step_n * ROUNDING {
            let detail = say("rendered", &from, &after);
            self.accuse(Law::RenderedStep, look.at_us, detail);
        }
        0.0
    }

    fn look_at_source(&mut self, look: &Look) {
        let stands_n = look.write.after.force.norm();
        let Some(since_us) = look.lost_since_us else {
            self.loss = None;
            return;
        };
        // One source may be back when another is lost: that is another loss, and has its own time.
        if self.loss.is_some_and(|loss| loss.since_us < since_us) {
            self.loss = None;
        }
        let loss = self.loss.get_or_insert(Loss {
            since_us,
            is_felt: stands_n > ZERO_N || self.last.force.norm() > ZERO_N,
        });
        loss.since_us = since_us;
        let for_us = look.running_us - since_us;
        if stands_n <= ZERO_N {
            if std::mem::take(&mut loss.is_felt) {
                self.to_zero_ms.push(for_us as f64 * 1e-3);
            }
        } else if for_us > ZERO_WITHIN_US {
            let detail = format!("{stands_n:.4} N after {:.1} ms", for_us as f64 * 1e-3);
            self.accuse(Law::ZeroInTime, look.at_us, detail);
        }
    }
}
