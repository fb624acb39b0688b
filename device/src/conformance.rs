//! The suite that every backend passes, as code that runs against any device.
//!
//! The caller gives the clock, so that the same suite runs on virtual time (tests) and on real
//! hardware. It moves no further than a fifth of the continuous force, except for the one write
//! that must be clamped; hold the tool, or let it lie, while it runs on hardware.
//!
//! What it can not see from outside (that zero reaches the motors before the port is closed, that
//! a panic stays on this side of a C callback) each backend tests at its own port.

use std::fmt;

use nalgebra::Vector3;

use crate::{DeviceFault, DeviceTime, ForceState, HapticDevice, Rejection, Wrench, Written};

/// What the suite may expect.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// The tool is free and a force moves it, as a simulated hand's does. Without it the test of
    /// the axes is skipped: a held stylus may not move.
    pub moves_under_force: bool,
}

/// How one law came out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// It holds.
    Passed,
    /// It does not apply to this device.
    Skipped(&'static str),
    /// It is broken.
    Failed(String),
}

/// One law and how it came out.
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
    /// Every law in the order it was tried.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Whether no law is broken.
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

type Verdict = Result<(), String>;

/// The device under test and the clock it is tested with.
struct Bench<'a> {
    device: &'a mut dyn HapticDevice,
    clock: &'a mut dyn FnMut() -> DeviceTime,
}

/// Runs the suite and closes the device. `clock` gives the time of the next tick, once per call;
/// on hardware it waits for it.
pub fn run(
    device: &mut dyn HapticDevice,
    clock: &mut dyn FnMut() -> DeviceTime,
    options: Options,
) -> Report {
    let has_motors = device.caps().dof_out > 0;
    let mut bench = Bench { device, clock };
    let mut rows = Vec::new();
    let mut always = |law, verdict: Verdict| {
        let outcome = verdict.map_or_else(Outcome::Failed, |()| Outcome::Passed);
        rows.push(Row { law, outcome });
    };
    always(
        "caps are finite and consistent",
        caps_are_consistent(&bench),
    );
    always(
        "poses are metres, finite and of unit turn",
        poses_are_metres(&mut bench),
    );
    always(
        "the time of samples does not run backwards",
        time_is_monotonic(&mut bench),
    );
    if has_motors {
        always(
            "a write with forces off is rejected and renders zero",
            off_is_zero(&mut bench),
        );
        always(
            "enabling ramps up to what is written",
            enabling_ramps(&mut bench),
        );
        always(
            "a wrench that is not finite is rejected and renders zero",
            nan_is_zero(&mut bench),
        );
        always(
            "a wrench beyond the limit is clamped, not turned",
            clamps(&mut bench),
        );
        if options.moves_under_force {
            always(
                "a force moves the tool along its own axis",
                axes_agree(&mut bench),
            );
        }
        always(
            "disabling renders zero at once",
            disabling_is_zero(&mut bench),
        );
    } else {
        always(
            "without motors every wrench is refused, and a cue moves nothing",
            no_motors_no_force(&mut bench),
        );
    }
    always(
        "closing renders zero and ends every call",
        closing_is_final(&mut bench),
    );
    if !has_motors {
        rows.push(Row {
            law: "force laws",
            outcome: Outcome::Skipped("it renders no force"),
        });
    } else if !options.moves_under_force {
        let why = "the tool may be held";
        rows.push(Row {
            law: "a force moves the tool along its own axis",
            outcome: Outcome::Skipped(why),
        });
    }
    Report { rows }
}

impl Bench<'_> {
    /// `n` ticks with `wrench`; the last sample's position.
    fn tick(&mut self, n: usize, wrench: Wrench) -> Result<Vector3<f64>, String> {
        let mut position = Vector3::zeros();
        for _ in 0..n {
            let now = (self.clock)();
            position = self
                .device
                .read(now)
                .map_err(|e| e.to_string())?
                .pose
                .position;
            if let Written::Rejected(why) = self.device.write(now, wrench) {
                return Err(why.to_string());
            }
        }
        Ok(position)
    }

    /// A harmless force along `axis`, N.
    fn gentle(&self, axis: usize) -> Wrench {
        let mut force = Vector3::zeros();
        force[axis] = 0.2 * self.device.caps().continuous_force_n;
        Wrench::from_force(force)
    }

    /// Ticks in `s` seconds.
    fn ticks_in(&self, s: f64) -> usize {
        (self.device.caps().rate_hz * s) as usize
    }

    fn expect_rendered_zero(&self) -> Verdict {
        let rendered = self.device.rendered();
        ensure(rendered == Wrench::ZERO, || {
            format!("it renders {rendered:?}")
        })
    }
}

fn ensure(holds: bool, why: impl FnOnce() -> String) -> Verdict {
    if holds { Ok(()) } else { Err(why()) }
}

fn caps_are_consistent(bench: &Bench<'_>) -> Verdict {
    let c = bench.device.caps();
    let extent = c.workspace.max - c.workspace.min;
    ensure(extent.iter().all(|e| (1e-3..=20.0).contains(e)), || {
        format!("a workspace of {extent:?} m is not in metres")
    })?;
    ensure((1..=7).contains(&c.dof_in) && c.dof_out <= 7, || {
        format!("{} degrees of freedom in, {} out", c.dof_in, c.dof_out)
    })?;
    ensure((1.0..=10_000.0).contains(&c.rate_hz), || {
        format!("rate {} Hz", c.rate_hz)
    })?;
    if c.dof_out == 0 {
        return Ok(());
    }
    ensure(
        c.continuous_force_n > 0.0 && c.continuous_force_n <= c.max_force_n,
        || {
            format!(
                "{} N held, {} N for a moment",
                c.continuous_force_n, c.max_force_n
            )
        },
    )?;
    ensure(
        c.max_force_n <= 1000.0 && (0.0..=100.0).contains(&c.max_torque_nm),
        || {
            format!(
                "{} N and {} N·m are not a hand's",
                c.max_force_n, c.max_torque_nm
            )
        },
    )?;
    ensure((1.0..=1e6).contains(&c.max_stiffness_n_per_m), || {
        format!("stiffness {} N/m", c.max_stiffness_n_per_m)
    })
}

fn poses_are_metres(bench: &mut Bench<'_>) -> Verdict {
    let now = (bench.clock)();
    let sample = bench.device.read(now).map_err(|e| e.to_string())?;
    ensure(sample.is_finite(), || format!("{sample:?}"))?;
    let turn = sample.pose.orientation.quaternion().norm();
    ensure((turn - 1.0).abs() < 1e-6, || {
        format!("a quaternion of length {turn}")
    })?;
    let box_ = bench.device.caps().workspace;
    let p = sample.pose.position;
    ensure(box_.contains(&p), || {
        format!("{p:?} m is outside the workspace {box_:?}")
    })
}

fn time_is_monotonic(bench: &mut Bench<'_>) -> Verdict {
    let mut before = DeviceTime::from_micros(i64::MIN);
    for _ in 0..10 {
        let now = (bench.clock)();
        let time = bench.device.read(now).map_err(|e| e.to_string())?.time;
        ensure(time >= before, || format!("{time:?} after {before:?}"))?;
        before = time;
    }
    Ok(())
}

fn off_is_zero(bench: &mut Bench<'_>) -> Verdict {
    let now = (bench.clock)();
    let wrench = bench.gentle(0);
    let written = bench.device.write(now, wrench);
    ensure(written == Written::Rejected(Rejection::ForcesOff), || {
        format!("{written:?}")
    })?;
    bench.expect_rendered_zero()
}

fn enabling_ramps(bench: &mut Bench<'_>) -> Verdict {
    bench
        .device
        .enable_forces(true)
        .map_err(|e| e.to_string())?;
    let state = bench.device.force_state();
    ensure(state != ForceState::Off, || "forces stay off".to_owned())?;
    bench.expect_rendered_zero()?;
    let wrench = bench.gentle(0);
    let mut before = 0.0;
    for _ in 0..bench.ticks_in(3.0) {
        bench.tick(1, wrench)?;
        let rendered = bench.device.rendered().force.norm();
        ensure(
            rendered >= before - 1e-9 && rendered <= wrench.force.norm() + 1e-9,
            || {
                format!(
                    "{rendered} N after {before} N on the way to {} N",
                    wrench.force.norm()
                )
            },
        )?;
        before = rendered;
    }
    let state = bench.device.force_state();
    ensure(state == ForceState::On, || format!("{state:?} after 3 s"))?;
    bench.tick(1, Wrench::ZERO).map(|_| ())
}

fn nan_is_zero(bench: &mut Bench<'_>) -> Verdict {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for axis in 0..6 {
            let gentle = bench.gentle(2);
            bench.tick(1, gentle)?;
            let mut wrench = gentle;
            if axis < 3 {
                wrench.force[axis] = bad;
            } else {
                wrench.torque[axis - 3] = bad;
            }
            let now = (bench.clock)();
            let written = bench.device.write(now, wrench);
            ensure(written == Written::Rejected(Rejection::NotFinite), || {
                format!("{bad} in place {axis}: {written:?}")
            })?;
            bench.expect_rendered_zero()?;
        }
    }
    Ok(())
}

fn clamps(bench: &mut Bench<'_>) -> Verdict {
    let limit = bench.device.caps().max_force_n;
    let direction = Vector3::new(1.0, -2.0, 2.0) / 3.0;
    let now = (bench.clock)();
    let written = bench
        .device
        .write(now, Wrench::from_force(direction * (10.0 * limit)));
    let rendered = bench.device.rendered().force;
    bench.tick(1, Wrench::ZERO)?;
    let Written::Saturated { applied } = written else {
        return Err(format!("ten times the limit is {written:?}"));
    };
    let n = applied.force.norm();
    ensure(
        n <= limit * (1.0 + 1e-9) && rendered.norm() <= limit * (1.0 + 1e-9),
        || format!("{n} N applied, limit {limit} N"),
    )?;
    ensure((applied.force / n - direction).norm() < 1e-6, || {
        format!("the clamp turned the force to {:?}", applied.force)
    })
}

fn axes_agree(bench: &mut Bench<'_>) -> Verdict {
    let settle = bench.ticks_in(2.0);
    for axis in 0..3 {
        let rest = bench.tick(settle, Wrench::ZERO)?;
        let push = bench.gentle(axis);
        let moved = bench.tick(bench.ticks_in(0.1), push)? - rest;
        let across = (moved.norm_squared() - moved[axis] * moved[axis])
            .max(0.0)
            .sqrt();
        ensure(moved[axis] > 0.0 && across < 0.1 * moved[axis], || {
            format!("a force along axis {axis} moved the tool by {moved:?} m")
        })?;
    }
    bench.tick(settle, Wrench::ZERO).map(|_| ())
}

fn disabling_is_zero(bench: &mut Bench<'_>) -> Verdict {
    let wrench = bench.gentle(1);
    bench.tick(10, wrench)?;
    bench
        .device
        .enable_forces(false)
        .map_err(|e| e.to_string())?;
    let state = bench.device.force_state();
    ensure(state == ForceState::Off, || format!("{state:?}"))?;
    bench.expect_rendered_zero()
}

fn no_motors_no_force(bench: &mut Bench<'_>) -> Verdict {
    bench
        .device
        .enable_forces(true)
        .map_err(|e| e.to_string())?;
    for n in [1.0, f64::NAN] {
        let wrench = Wrench::from_force(Vector3::new(0.0, 0.0, n));
        let now = (bench.clock)();
        let before = bench.device.read(now).map_err(|e| e.to_string())?.pose;
        let written = bench.device.write(now, wrench);
        ensure(written == Written::Rejected(Rejection::NoMotors), || {
            format!("{written:?}")
        })?;
        bench.device.cue(now, &wrench);
        bench.expect_rendered_zero()?;
        let after = bench.device.read(now).map_err(|e| e.to_string())?.pose;
        ensure(before == after, || {
            format!("a cue moved the tool from {before:?} to {after:?}")
        })?;
    }
    Ok(())
}

fn closing_is_final(bench: &mut Bench<'_>) -> Verdict {
    if bench.device.caps().dof_out > 0 {
        bench
            .device
            .enable_forces(true)
            .map_err(|e| e.to_string())?;
        let wrench = bench.gentle(1);
        bench.tick(bench.ticks_in(1.0), wrench)?;
    }
    bench.device.close();
    bench.device.close();
    bench.expect_rendered_zero()?;
    let now = (bench.clock)();
    let written = bench.device.write(now, Wrench::ZERO);
    ensure(written == Written::Rejected(Rejection::Closed), || {
        format!("{written:?}")
    })?;
    let read = bench.device.read(now);
    ensure(read == Err(DeviceFault::Closed), || format!("{read:?}"))?;
    let enabled = bench.device.enable_forces(true);
    ensure(enabled == Err(DeviceFault::Closed), || {
        format!("{enabled:?}")
    })
}
