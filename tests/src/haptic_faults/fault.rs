//! The faults: kind, duration and severity.

use std::fmt;

use clap::ValueEnum;
use rand::RngExt;
use rand_pcg::Pcg64;
use serde::Serialize;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Class {
    /// The solver delivers no contact model for a while.
    SolverStall,
    /// The link to the session is lost and comes back.
    LinkLost,
    /// Contact models contain non-finite or absurdly large numbers.
    BadModels,
    /// Poses contain non-finite or absurdly large numbers.
    BadPoses,
    /// The device is unplugged in contact and plugged in again.
    Unplugged,
    Refused,
    /// The device renders less force than commanded.
    Clamped,
    Stopped,
    ClockAhead,
    ClockBack,
    /// Two to four of the other classes at once.
    Several,
}

impl Class {
    /// The class of a seed: seeds cycle through the classes.
    pub fn of_seed(seed: u64) -> Self {
        let all = Self::value_variants();
        all[(seed % all.len() as u64) as usize]
    }
}

impl fmt::Display for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The name in JSON.
        self.serialize(f)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BadModel {
    ForceNan,
    StiffnessInfinite,
    NormalZero,
    /// Force of the largest finite number.
    ForceMax,
    /// Force a thousand times too large, but of a plausible magnitude.
    ForceThousandfold,
    NormalAnywhere,
    FromTheFuture,
    /// External work that no other participant has done.
    WorkOfOthers,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BadPose {
    PositionNan,
    VelocityInfinite,
    FarAway,
    TurnNan,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    SolverStall,
    LinkLost,
    /// See [`Class::BadModels`]; every `every`-th model.
    BadModels {
        how: BadModel,
        every: u32,
    },
    BadPoses {
        how: BadPose,
        every: u32,
    },
    Unplugged {
        /// Whether its motors are off after plugging in, until they are enabled.
        forgets: bool,
    },
    Refused {
        every: u32,
    },
    Clamped {
        to_n: f64,
    },
    Stopped,
    /// The clock jumps by `by_us` µs; negative values put it back.
    Clock {
        by_us: i64,
    },
}

impl FaultKind {
    pub fn class(self) -> Class {
        match self {
            Self::SolverStall => Class::SolverStall,
            Self::LinkLost => Class::LinkLost,
            Self::BadModels { .. } => Class::BadModels,
            Self::BadPoses { .. } => Class::BadPoses,
            Self::Unplugged { .. } => Class::Unplugged,
            Self::Refused { .. } => Class::Refused,
            Self::Clamped { .. } => Class::Clamped,
            Self::Stopped => Class::Stopped,
            Self::Clock { by_us } if by_us < 0 => Class::ClockBack,
            Self::Clock { .. } => Class::ClockAhead,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    pub what: FaultKind,
    /// Begin, µs of the run.
    pub from_us: i64,
    pub until_us: i64,
}

impl Fault {
    /// A fault of a class (not [`Class::Several`]) that begins at `from_us`.
    pub(super) fn random(class: Class, from_us: i64, rng: &mut Pcg64) -> Self {
        let lasts_us = 1000
            * match class {
                Class::Stopped if rng.random_bool(0.3) => rng.random_range(500..=10_000),
                Class::Stopped => rng.random_range(50..=500),
                Class::LinkLost | Class::Unplugged => rng.random_range(10..=1_000),
                Class::ClockAhead | Class::ClockBack => 0,
                _ => rng.random_range(10..=500),
            };
        Self {
            what: what(class, rng),
            from_us,
            until_us: from_us + lasts_us,
        }
    }

    /// Whether the fault is active at `us`. A clock jump has no length.
    pub fn is_on(&self, us: i64) -> bool {
        (self.from_us..self.until_us).contains(&us)
    }
}

fn any<T: ValueEnum>(rng: &mut Pcg64) -> T {
    let all = T::value_variants();
    all[rng.random_range(0..all.len())].clone()
}

fn what(class: Class, rng: &mut Pcg64) -> FaultKind {
    let every = if rng.random_bool(0.6) {
        1
    } else {
        rng.random_range(2..=6)
    };
    match class {
        Class::SolverStall | Class::Several => FaultKind::SolverStall,
        Class::LinkLost => FaultKind::LinkLost,
        Class::BadModels => FaultKind::BadModels {
            how: any(rng),
            every,
        },
        Class::BadPoses => FaultKind::BadPoses {
            how: any(rng),
            every,
        },
        Class::Unplugged => FaultKind::Unplugged {
            forgets: rng.random_bool(0.7),
        },
        Class::Refused => FaultKind::Refused { every },
        Class::Clamped => FaultKind::Clamped {
            to_n: rng.random_range(0.0..3.0),
        },
        Class::Stopped => FaultKind::Stopped,
        Class::ClockAhead => FaultKind::Clock {
            by_us: jump_us(rng),
        },
        Class::ClockBack => FaultKind::Clock {
            by_us: -jump_us(rng),
        },
    }
}

/// Log-uniform from 2 ms to 10 s; 2 ms is hardly more than a late tick.
fn jump_us(rng: &mut Pcg64) -> i64 {
    10f64.powf(rng.random_range(3.3..7.0)) as i64
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let every = |n: u32| {
            if n == 1 {
                String::new()
            } else {
                format!(", one of {n}")
            }
        };
        match self.what {
            FaultKind::SolverStall => write!(f, "the solver stalls")?,
            FaultKind::LinkLost => write!(f, "the link is lost")?,
            FaultKind::BadModels { how, every: n } => {
                write!(f, "bad models ({how:?}{})", every(n))?;
            }
            FaultKind::BadPoses { how, every: n } => write!(f, "bad poses ({how:?}{})", every(n))?,
            FaultKind::Unplugged { forgets: true } => write!(f, "unplugged, motors off when back")?,
            FaultKind::Unplugged { forgets: false } => write!(f, "unplugged")?,
            FaultKind::Refused { every: n } => write!(f, "writes refused{}", every(n))?,
            FaultKind::Clamped { to_n } => write!(f, "clamped to {to_n:.1} N")?,
            FaultKind::Stopped => write!(f, "the process is stopped")?,
            FaultKind::Clock { by_us } => write!(f, "the clock jumps by {} ms", by_us / 1000)?,
        }
        let lasts_ms = (self.until_us - self.from_us) / 1000;
        if lasts_ms > 0 {
            write!(f, ", {lasts_ms} ms")?;
        }
        Ok(())
    }
}
