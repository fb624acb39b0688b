//! `haptic-faults`: no fault jerks the hand.
//!
//! A simulated hand presses into a spring tissue while a component fails: the solver, the link, the device, the
//! process, the clock. The runs use the force loop of the client ([`HandLoop`]) in virtual time and check the
//! force that the device renders. Four laws hold in every run:
//!
//! - Written and rendered forces change by at most the slew limit per tick.
//! - The force is zero within 150 ms of the loss of its source (no usable contact model, no link, no reading).
//! - No non-finite number and no force above the limit reaches the device.
//! - Every fault is counted, and the force returns after the fault.
//!
//! A force drop by the device itself (unplugged, rejecting, clamping, own watchdog) is exempt; the following
//! ticks are not. Time in which the process is stopped does not count.
//!
//! | file | |
//! | --- | --- |
//! | `fault` | classes and parameters of faults |
//! | `plan` | the run of a seed |
//! | `rig` | the device with fault injection |
//! | `tissue` | the spring tissue and its contact models |
//! | `course` | one run in virtual time |
//! | `oracle` | the laws and their check per tick |
//! | `outcome` | the figures per class of fault |
//! | `picture` | one run as a table and a chart |
//!
//! [`HandLoop`]: palpate_client::realtime::HandLoop

pub mod course;
pub mod fault;
pub mod oracle;
pub mod outcome;
pub mod picture;
pub mod plan;
pub mod rig;
#[cfg(test)]
mod tests;
pub mod tissue;

use nalgebra::Vector3;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{DeviceCaps, HapticDevice, Script, ScriptError};

use course::{Run, Setup, comes_back, run};
use outcome::Outcome;
use plan::Plan;

/// Capabilities of a desktop device.
fn desktop() -> Result<DeviceCaps, ScriptError> {
    let script = Script::resting_probe(Vector3::zeros(), 4e-3)?;
    Ok(SimHand::new(script, ScriptStart::not_yet()).caps().clone())
}

/// The plan of a seed, and its runs with and without faults.
#[derive(Debug, Clone)]
pub struct Trial {
    /// The plan.
    pub plan: Plan,
    /// The run with faults.
    pub run: Run,
    /// The run of the same hand, tissue and device without faults.
    pub without: Run,
}

impl Trial {
    /// Runs a seed.
    ///
    /// # Errors
    ///
    /// If the script of the seed is invalid.
    pub fn of(seed: u64, setup: &Setup) -> Result<Self, ScriptError> {
        let plan = Plan::of(seed, &desktop()?)?;
        let mut faulty = run(&plan, setup);
        let mut without = run(&plan.without_faults(), setup);
        comes_back(&plan, &mut faulty, &without);
        // The laws hold without faults too.
        faulty.broken.append(&mut without.broken);
        Ok(Self {
            plan,
            run: faulty,
            without,
        })
    }
}

/// Runs `seeds` and reports progress; ends early when `told` returns `false`.
///
/// # Errors
///
/// If the script of a seed is invalid.
pub fn all(
    seeds: std::ops::Range<u64>,
    setup: &Setup,
    told: &mut dyn FnMut(u64, &Outcome) -> bool,
) -> Result<Outcome, ScriptError> {
    let mut outcome = Outcome::default();
    for seed in seeds {
        outcome.take(&Trial::of(seed, setup)?);
        if !told(seed, &outcome) {
            break;
        }
    }
    outcome.settle();
    Ok(outcome)
}
