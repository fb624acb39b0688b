//! `haptic-faults`: no fault ever jerks the hand.
//!
//! A simulated hand presses into a tissue of springs while something breaks: the solver, the link, the
//! device, the process, the clock. What is run is the loop that users run ([`HandLoop`]), in virtual time; what is
//! looked at is what the device renders. In every run, whatever breaks:
//!
//! - the force changes by no more than the slew limit per tick, as written and as rendered;
//! - it is zero within 150 ms of the loss of its source (no usable contact model, no link, no reading);
//! - no number that is none reaches the device, and no force above the limit;
//! - what broke is counted, and when it is over the force comes back.
//!
//! A device that lets go by itself (it is unplugged, refuses, clamps, its own watchdog acts) makes a step that nobody
//! can prevent; held against us is what comes after. While the process is stopped no time counts: nobody could have
//! written anything.
//!
//! | file | |
//! | --- | --- |
//! | `fault` | what breaks |
//! | `plan` | what a seed stands for |
//! | `rig` | a device that breaks when it is told to |
//! | `tissue` | what is pressed, and contact models of it |
//! | `course` | one run in virtual time |
//! | `oracle` | who looks, and the laws |
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

/// A desktop device's abilities.
fn desktop() -> Result<DeviceCaps, ScriptError> {
    let script = Script::resting_probe(Vector3::zeros(), 4e-3)?;
    Ok(SimHand::new(script, ScriptStart::not_yet()).caps().clone())
}

/// A seed's plan, and its runs with and without faults.
#[derive(Debug, Clone)]
pub struct Trial {
    /// What it stands for.
    pub plan: Plan,
    /// With the faults.
    pub run: Run,
    /// The same hand, tissue and device without.
    pub without: Run,
}

impl Trial {
    /// Runs a seed.
    ///
    /// # Errors
    ///
    /// When the seed's hand can not go its way.
    pub fn of(seed: u64, setup: &Setup) -> Result<Self, ScriptError> {
        let plan = Plan::of(seed, &desktop()?)?;
        let mut faulty = run(&plan, setup);
        let mut without = run(&plan.without_faults(), setup);
        comes_back(&plan, &mut faulty, &without);
        // Without faults the laws hold as well.
        faulty.broken.append(&mut without.broken);
        Ok(Self {
            plan,
            run: faulty,
            without,
        })
    }
}

/// Runs `seeds`, and says how far it is; ends early when `told` says so by `false`.
///
/// # Errors
///
/// When a seed's hand can not go its way.
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
