//! The conformance suite of all backends, as code that runs against any device.
//!
//! The caller supplies the clock, so the same suite runs on virtual time (tests) and on hardware. It uses at most a
//! fifth of the continuous force, except for the one write that must be clamped; hold the tool, or let it lie,
//! while it runs on hardware.
//!
//! [`Hooks`] observe the motors, where the caller has some: a mock of a device or its maker's library, or a force
//! gauge. Each backend tests at its own port the laws without a hook, such as a panic in a C callback.

mod laws;

use std::fmt;

use crate::{DeviceTime, HapticDevice};

/// Assumptions of the suite.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// The tool is free and a force moves it, as a simulated hand's does. Without it the test of
    /// the axes is skipped: a held stylus may not move.
    pub moves_under_force: bool,
}

/// Result of one law.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// It holds.
    Passed,
    /// It does not apply to this device.
    Skipped(&'static str),
    /// It is broken.
    Failed(String),
}

/// One law and its result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Row {
    /// The law.
    pub law: &'static str,
    /// How it came out.
    pub outcome: Outcome,
}

/// The table of results.
#[derive(Debug, Clone)]
pub struct Report {
    rows: Vec<Row>,
}

impl Report {
    /// The results in the order of the tests.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Whether no law is violated.
    pub fn passed(&self) -> bool {
        !self
            .rows
            .iter()
            .any(|r| matches!(r.outcome, Outcome::Failed(_)))
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Row { law, outcome } in &self.rows {
            match outcome {
                Outcome::Passed => writeln!(f, "passed   {law}")?,
                Outcome::Skipped(why) => writeln!(f, "skipped  {law}: {why}")?,
                Outcome::Failed(why) => writeln!(f, "FAILED   {law}: {why}")?,
            }
        }
        Ok(())
    }
}

/// Description of a violation, or the error of the device.
type Violation = Box<dyn std::error::Error>;

type Verdict = Result<(), Violation>;

/// Observation and faults outside the driver. All hooks are optional; laws that need a missing hook are left out.
#[derive(Default)]
pub struct Hooks<'a> {
    /// Pulls the plug, for good. It is called once, late, under force.
    pub unplug: Option<&'a mut dyn FnMut()>,
    /// The last force that the motors got, N.
    pub at_motors: Option<&'a mut dyn FnMut() -> f64>,
    /// Violations that the maker's side counted so far: calls out of order, frames left open, errors left unread.
    pub amiss: Option<&'a mut dyn FnMut() -> Vec<String>>,
}

/// The device under test and the clock it is tested with.
struct Bench<'a, 'h> {
    device: &'a mut dyn HapticDevice,
    clock: &'a mut dyn FnMut() -> DeviceTime,
    hooks: Hooks<'h>,
    is_unplugged: bool,
}

/// Runs the suite and closes the device. `clock` returns the time of the next tick, once per call; on hardware it
/// waits until then.
pub fn run(
    device: &mut dyn HapticDevice,
    clock: &mut dyn FnMut() -> DeviceTime,
    options: Options,
) -> Report {
    run_with(device, clock, options, Hooks::default())
}

/// The same, with hooks outside the driver.
pub fn run_with(
    device: &mut dyn HapticDevice,
    clock: &mut dyn FnMut() -> DeviceTime,
    options: Options,
    hooks: Hooks<'_>,
) -> Report {
    let has_motors = device.caps().dof_out > 0;
    let laws = laws_for(options, has_motors, &hooks);
    let mut bench = Bench {
        device,
        clock,
        hooks,
        is_unplugged: false,
    };
    let mut rows = Vec::new();
    for (law, applies, check) in laws {
        let outcome = match applies {
            Ok(()) => match check(&mut bench) {
                Ok(()) => Outcome::Passed,
                Err(why) => Outcome::Failed(why.to_string()),
            },
            Err("") => continue,
            Err(why) => Outcome::Skipped(why),
        };
        rows.push(Row { law, outcome });
    }
    if !has_motors {
        rows.push(Row {
            law: "force laws",
            outcome: Outcome::Skipped("it renders no force"),
        });
    }
    Report { rows }
}

/// A law in words, the reason for skipping it (no row where the reason is empty), and its test.
type Law = (
    &'static str,
    Result<(), &'static str>,
    fn(&mut Bench<'_, '_>) -> Verdict,
);

/// All laws in the order they are tried.
fn laws_for(options: Options, has_motors: bool, hooks: &Hooks<'_>) -> Vec<Law> {
    let when = |holds: bool, why| if holds { Ok(()) } else { Err(why) };
    // For a device without motors, one row covers all of them.
    let forced = when(has_motors, "");
    let moves = forced.and(when(options.moves_under_force, "the tool may be held"));
    vec![
        (
            "caps are finite and consistent",
            Ok(()),
            laws::caps_are_consistent,
        ),
        (
            "poses are metres, finite and of unit turn",
            Ok(()),
            laws::poses_are_metres,
        ),
        (
            "the time of samples does not run backwards",
            Ok(()),
            laws::time_is_monotonic,
        ),
        (
            "a write with forces off is rejected and renders zero",
            forced,
            laws::off_is_zero,
        ),
        (
            "enabling ramps up to the written wrench",
            forced,
            laws::enabling_ramps,
        ),
        (
            "a wrench that is not finite is rejected and renders zero",
            forced,
            laws::nan_is_zero,
        ),
        (
            "a wrench beyond the limit is clamped, not turned",
            forced,
            laws::clamps,
        ),
        (
            "a force moves the tool along its own axis",
            moves,
            laws::axes_agree,
        ),
        (
            "the motors get the reported force",
            forced.and(when(hooks.at_motors.is_some(), "")),
            laws::motors_get_the_reported_force,
        ),
        (
            "disabling renders zero at once",
            forced,
            laws::disabling_is_zero,
        ),
        (
            "without motors every wrench is refused, and a cue moves nothing",
            when(!has_motors, ""),
            laws::no_motors_no_force,
        ),
        (
            "a pulled plug ends the force and is reported",
            when(hooks.unplug.is_some(), ""),
            laws::unplugging_is_reported,
        ),
        (
            "closing renders zero and ends every call",
            Ok(()),
            laws::closing_is_final,
        ),
        (
            "the maker's side reports nothing amiss",
            when(hooks.amiss.is_some(), ""),
            laws::no_violations,
        ),
    ]
}
