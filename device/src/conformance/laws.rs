//! The laws, one function each; an error describes the violation.

use nalgebra::Vector3;

use super::{Bench, Verdict};
use crate::{DeviceFault, DeviceTime, ForceState, Rejection, Wrench, Written};

impl Bench<'_, '_> {
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

    fn at_motors(&mut self) -> Option<f64> {
        self.hooks.at_motors.as_mut().map(|look| look())
    }

    fn unplug(&mut self) {
        if let Some(unplug) = &mut self.hooks.unplug {
            unplug();
            self.is_unplugged = true;
        }
    }

    fn amiss(&mut self) -> Vec<String> {
        self.hooks
            .amiss
            .as_mut()
            .map_or_else(Vec::new, |look| look())
    }

    fn expect_zero_at_motors(&mut self) -> Verdict {
        let left = self.at_motors().unwrap_or_default();
        ensure(left == 0.0, || format!("the motors are left with {left} N"))
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

pub(super) fn caps_are_consistent(bench: &mut Bench<'_, '_>) -> Verdict {
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

pub(super) fn poses_are_metres(bench: &mut Bench<'_, '_>) -> Verdict {
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

pub(super) fn time_is_monotonic(bench: &mut Bench<'_, '_>) -> Verdict {
    let mut before = DeviceTime::from_micros(i64::MIN);
    for _ in 0..10 {
        let now = (bench.clock)();
        let time = bench.device.read(now).map_err(|e| e.to_string())?.time;
        ensure(time >= before, || format!("{time:?} after {before:?}"))?;
        before = time;
    }
    Ok(())
}

pub(super) fn off_is_zero(bench: &mut Bench<'_, '_>) -> Verdict {
    let now = (bench.clock)();
    let wrench = bench.gentle(0);
    let written = bench.device.write(now, wrench);
    ensure(written == Written::Rejected(Rejection::ForcesOff), || {
        format!("{written:?}")
    })?;
    bench.expect_rendered_zero()
}

pub(super) fn enabling_ramps(bench: &mut Bench<'_, '_>) -> Verdict {
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

pub(super) fn nan_is_zero(bench: &mut Bench<'_, '_>) -> Verdict {
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

pub(super) fn clamps(bench: &mut Bench<'_, '_>) -> Verdict {
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

pub(super) fn axes_agree(bench: &mut Bench<'_, '_>) -> Verdict {
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

pub(super) fn disabling_is_zero(bench: &mut Bench<'_, '_>) -> Verdict {
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

pub(super) fn no_motors_no_force(bench: &mut Bench<'_, '_>) -> Verdict {
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

/// The motors get the force that the device reports as rendered, within a delay of a twentieth of a second.
pub(super) fn motors_get_the_reported_force(bench: &mut Bench<'_, '_>) -> Verdict {
    let wrench = bench.gentle(2);
    bench.tick(bench.ticks_in(0.5), wrench)?;
    let said = bench.device.rendered().force.norm();
    let got = bench.at_motors().unwrap_or(said);
    ensure((got - said).abs() <= 1e-6 * said, || {
        format!("it says {said} N, and the motors got {got} N")
    })?;
    bench.tick(bench.ticks_in(0.05), Wrench::ZERO)?;
    bench.expect_zero_at_motors()
}

/// A plug pulled under force: within a second the driver reports it and removes the force on its side; it rejects
/// writes and does not enable forces again.
pub(super) fn unplugging_is_reported(bench: &mut Bench<'_, '_>) -> Verdict {
    let forced = bench.device.caps().dof_out > 0;
    let wrench = bench.gentle(1);
    if forced {
        bench
            .device
            .enable_forces(true)
            .map_err(|e| e.to_string())?;
        bench.tick(bench.ticks_in(1.0), wrench)?;
    }
    bench.unplug();
    let mut said = false;
    for _ in 0..bench.ticks_in(1.0) {
        let now = (bench.clock)();
        said = match bench.device.read(now) {
            Ok(sample) if sample.faults.forbid_force() => {
                bench.expect_rendered_zero()?;
                said
            }
            Ok(_) => said,
            Err(_) => true,
        };
        let written = bench.device.write(now, wrench);
        if said {
            let is_taken = forced && !matches!(written, Written::Rejected(_));
            ensure(!is_taken, || format!("{written:?} after it was gone"))?;
            break;
        }
    }
    ensure(said, || {
        "readings go on as if nothing had happened".to_owned()
    })?;
    bench.expect_rendered_zero()?;
    if forced {
        let state = bench.device.force_state();
        ensure(state == ForceState::Off, || format!("{state:?}"))?;
        let enabled = bench.device.enable_forces(true);
        ensure(enabled.is_err(), || "it can be switched on".to_owned())?;
    }
    Ok(())
}

pub(super) fn closing_is_final(bench: &mut Bench<'_, '_>) -> Verdict {
    if bench.device.caps().dof_out > 0 && !bench.is_unplugged {
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
    if !bench.is_unplugged {
        bench.expect_zero_at_motors()?;
    }
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

/// The maker's side reports no violation: frames and calls in order, no error left unread.
pub(super) fn no_violations(bench: &mut Bench<'_, '_>) -> Verdict {
    let amiss = bench.amiss();
    ensure(amiss.is_empty(), || amiss.join("; "))
}
