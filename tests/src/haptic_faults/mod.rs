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
//! | `faulty_device` | the device with fault injection |
//! | `tissue` | the spring tissue and its contact models |
//! | `run` | one run in virtual time |
//! | `oracle` | the laws and their check per tick |
//! | `outcome` | the figures per class of fault |
//! | `run_plot` | one run as a table and a chart |
//!
//! [`HandLoop`]: palpate_client::realtime::HandLoop

pub mod fault;
pub mod faulty_device;
pub mod oracle;
pub mod outcome;
pub mod plan;
pub mod run;
pub mod run_plot;
#[cfg(test)]
mod tests;
pub mod tissue;

use nalgebra::Vector3;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{DeviceCaps, HapticDevice, Script, ScriptError};

use outcome::Outcome;
use plan::Plan;
use run::{Run, Setup, check_return, simulate};

fn desktop() -> Result<DeviceCaps, ScriptError> {
    let script = Script::resting_probe(Vector3::zeros(), 4e-3)?;
    Ok(SimHand::new(script, ScriptStart::not_yet()).caps().clone())
}

#[derive(Debug, Clone)]
pub struct SeedResult {
    pub plan: Plan,
    pub faulty: Run,
    pub fault_free: Run,
}

impl SeedResult {
    pub fn of(seed: u64, setup: &Setup) -> Result<Self, ScriptError> {
        let plan = Plan::of(seed, &desktop()?)?;
        let mut faulty = simulate(&plan, setup);
        let mut fault_free = simulate(&plan.without_faults(), setup);
        check_return(&plan, &mut faulty, &fault_free);
        // The laws hold without faults too.
        faulty.broken.append(&mut fault_free.broken);
        Ok(Self {
            plan,
            faulty,
            fault_free,
        })
    }
}

/// Runs `seeds` and reports progress; ends early when `report_progress` returns `false`.
pub fn all(
    seeds: std::ops::Range<u64>,
    setup: &Setup,
    report_progress: &mut dyn FnMut(u64, &Outcome) -> bool,
) -> Result<Outcome, ScriptError> {
    let mut outcome = Outcome::default();
    for seed in seeds {
        outcome.take(&SeedResult::of(seed, setup)?);
        if !report_progress(seed, &outcome) {
            break;
        }
    }
    outcome.settle();
    Ok(outcome)
}
