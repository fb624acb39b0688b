//! The laws, one function each; an error describes the violation.

use nalgebra::Vector3;

use super::{Bench, Verdict, Violation};
use crate::{DeviceFault, DeviceTime, ForceState, Rejection, Wrench, Written};

/// Returns a violation unless a condition holds.
macro_rules! ensure {
    ($holds:expr, $($why:tt)+) => {
        let holds: bool = $holds;
        if !holds {
            return Err(format!($($why)+).into());
        }
    };
}

impl Bench<'_, '_> {
    /// The time of the next tick.
    fn now(&mut self) -> DeviceTime {
        (self.clock)()
    }

    /// `n` ticks with `wrench`; the last sample's position.
    fn tick(&mut self, n: usize, wrench: Wrench) -> Result<Vector3<f64>, Violation> {
        let mut position = Vector3::zeros();
        for _ in 0..n {
            let now = self.now();
            position = self.device.read(now)?.pose.position;
            if let Written::Rejected(why) = self.device.write(now, wrench) {
                return Err(why.into());
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

    fn expect_zero_at_motors(&mut self) -> Verdict {
        let left = self.at_motors().unwrap_or_default();
        ensure!(left == 0.0, "the motors are left with {left} N");
        Ok(())
    }

    fn expect_rendered_zero(&self) -> Verdict {
        let rendered = self.device.rendered();
        ensure!(rendered == Wrench::ZERO, "it renders {rendered:?}");
        Ok(())
    }

    fn expect_off(&self) -> Verdict {
        let state = self.device.force_state();
        ensure!(state == ForceState::Off, "{state:?}");
        Ok(())
    }

    /// Writes `wrench`, which the device must reject for the reason `why` and render zero instead.
    fn expect_rejected(&mut self, wrench: Wrench, why: Rejection) -> Verdict {
        let now = self.now();
        let written = self.device.write(now, wrench);
        ensure!(written == Written::Rejected(why), "{wrench:?}: {written:?}");
        self.expect_rendered_zero()
    }
}

pub(super) fn caps_are_consistent(bench: &mut Bench<'_, '_>) -> Verdict {
    let c = bench.device.caps();
    let extent = c.workspace.max - c.workspace.min;
    ensure!(
        extent.iter().all(|e| (1e-3..=20.0).contains(e)),
        "a workspace of {extent:?} m is not in metres"
    );
    let (dof_in, dof_out, rate_hz) = (c.dof_in, c.dof_out, c.rate_hz);
    ensure!(
        (1..=7).contains(&dof_in) && dof_out <= 7,
        "{dof_in} degrees of freedom in, {dof_out} out"
    );
    ensure!((1.0..=10_000.0).contains(&rate_hz), "rate {rate_hz} Hz");
    if dof_out == 0 {
        return Ok(());
    }
    let (peak, continuous, torque) = (c.max_force_n, c.continuous_force_n, c.max_torque_nm);
    ensure!(
        continuous > 0.0 && continuous <= peak,
        "{continuous} N held, {peak} N for a moment"
    );
    ensure!(
        peak <= 1000.0 && (0.0..=100.0).contains(&torque),
        "{peak} N and {torque} N·m are not a hand's"
    );
    let stiffness = c.max_stiffness_n_per_m;
    ensure!(
        (1.0..=1e6).contains(&stiffness),
        "stiffness {stiffness} N/m"
    );
    Ok(())
}

pub(super) fn poses_are_metres(bench: &mut Bench<'_, '_>) -> Verdict {
    let now = bench.now();
    let sample = bench.device.read(now)?;
    ensure!(sample.is_finite(), "{sample:?}");
    let turn = sample.pose.orientation.quaternion().norm();
    ensure!((turn - 1.0).abs() < 1e-6, "a quaternion of length {turn}");
    let workspace = bench.device.caps().workspace;
    let p = sample.pose.position;
    ensure!(
        workspace.contains(&p),
        "{p:?} m is outside the workspace {workspace:?}"
    );
    Ok(())
}

pub(super) fn time_is_monotonic(bench: &mut Bench<'_, '_>) -> Verdict {
    let mut before = DeviceTime::from_micros(i64::MIN);
    for _ in 0..10 {
        let now = bench.now();
        let time = bench.device.read(now)?.time;
        ensure!(time >= before, "{time:?} after {before:?}");
        before = time;
    }
    Ok(())
}

pub(super) fn off_is_zero(bench: &mut Bench<'_, '_>) -> Verdict {
    bench.expect_rejected(bench.gentle(0), Rejection::ForcesOff)
}

pub(super) fn enabling_ramps(bench: &mut Bench<'_, '_>) -> Verdict {
    bench.device.enable_forces(true)?;
    let state = bench.device.force_state();
    ensure!(state != ForceState::Off, "forces stay off");
    bench.expect_rendered_zero()?;
    let wrench = bench.gentle(0);
    let asked = wrench.force.norm();
    let mut before = 0.0;
    for _ in 0..bench.ticks_in(3.0) {
        bench.tick(1, wrench)?;
        let rendered = bench.device.rendered().force.norm();
        ensure!(
            rendered >= before - 1e-9 && rendered <= asked + 1e-9,
            "{rendered} N after {before} N on the way to {asked} N"
        );
        before = rendered;
    }
    let state = bench.device.force_state();
    ensure!(state == ForceState::On, "{state:?} after 3 s");
    bench.tick(1, Wrench::ZERO).map(|_| ())
}

pub(super) fn nan_is_zero(bench: &mut Bench<'_, '_>) -> Verdict {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for axis in 0..6 {
            let mut wrench = bench.gentle(2);
            bench.tick(1, wrench)?;
            if axis < 3 {
                wrench.force[axis] = bad;
            } else {
                wrench.torque[axis - 3] = bad;
            }
            bench.expect_rejected(wrench, Rejection::NotFinite)?;
        }
    }
    Ok(())
}

pub(super) fn clamps(bench: &mut Bench<'_, '_>) -> Verdict {
    let limit = bench.device.caps().max_force_n;
    let direction = Vector3::new(1.0, -2.0, 2.0) / 3.0;
    let now = bench.now();
    let excessive = Wrench::from_force(direction * (10.0 * limit));
    let written = bench.device.write(now, excessive);
    let rendered = bench.device.rendered().force;
    bench.tick(1, Wrench::ZERO)?;
    let Written::Saturated { applied } = written else {
        return Err(format!("ten times the limit is {written:?}").into());
    };
    let (force, n) = (applied.force, applied.force.norm());
    ensure!(
        n <= limit * (1.0 + 1e-9) && rendered.norm() <= limit * (1.0 + 1e-9),
        "{n} N applied, limit {limit} N"
    );
    ensure!(
        (force / n - direction).norm() < 1e-6,
        "the clamp turned the force to {force:?}"
    );
    Ok(())
}

pub(super) fn axes_agree(bench: &mut Bench<'_, '_>) -> Verdict {
    let settle = bench.ticks_in(2.0);
    for axis in 0..3 {
        let rest = bench.tick(settle, Wrench::ZERO)?;
        let push = bench.gentle(axis);
        let moved = bench.tick(bench.ticks_in(0.1), push)? - rest;
        let mut across = moved;
        across[axis] = 0.0;
        ensure!(
            moved[axis] > 0.0 && across.norm() < 0.1 * moved[axis],
            "a force along axis {axis} moved the tool by {moved:?} m"
        );
    }
    bench.tick(settle, Wrench::ZERO).map(|_| ())
}

pub(super) fn disabling_is_zero(bench: &mut Bench<'_, '_>) -> Verdict {
    bench.tick(10, bench.gentle(1))?;
    bench.device.enable_forces(false)?;
    bench.expect_off()?;
    bench.expect_rendered_zero()
}

pub(super) fn no_motors_no_force(bench: &mut Bench<'_, '_>) -> Verdict {
    bench.device.enable_forces(true)?;
    for n in [1.0, f64::NAN] {
        let wrench = Wrench::from_force(Vector3::new(0.0, 0.0, n));
        let now = bench.now();
        let before = bench.device.read(now)?.pose;
        // At one time, so that only the write or the cue could move the tool.
        let written = bench.device.write(now, wrench);
        let refused = Written::Rejected(Rejection::NoMotors);
        ensure!(written == refused, "{written:?}");
        bench.device.cue(now, &wrench);
        bench.expect_rendered_zero()?;
        let after = bench.device.read(now)?.pose;
        ensure!(
            before == after,
            "a cue moved the tool from {before:?} to {after:?}"
        );
    }
    Ok(())
}

/// The motors get the force that the device reports as rendered, within a delay of a twentieth of a second.
pub(super) fn motors_get_the_reported_force(bench: &mut Bench<'_, '_>) -> Verdict {
    bench.tick(bench.ticks_in(0.5), bench.gentle(2))?;
    let said = bench.device.rendered().force.norm();
    let got = bench.at_motors().unwrap_or(said);
    ensure!(
        (got - said).abs() <= 1e-6 * said,
        "it says {said} N, and the motors got {got} N"
    );
    bench.tick(bench.ticks_in(0.05), Wrench::ZERO)?;
    bench.expect_zero_at_motors()
}

/// A plug pulled under force: within a second the driver reports it and removes the force on its side; it rejects
/// writes and does not enable forces again.
pub(super) fn unplugging_is_reported(bench: &mut Bench<'_, '_>) -> Verdict {
    let forced = bench.device.caps().dof_out > 0;
    let wrench = bench.gentle(1);
    if forced {
        bench.device.enable_forces(true)?;
        bench.tick(bench.ticks_in(1.0), wrench)?;
    }
    bench.unplug();
    let mut said = false;
    for _ in 0..bench.ticks_in(1.0) {
        let now = bench.now();
        match bench.device.read(now) {
            Ok(sample) if sample.faults.forbid_force() => bench.expect_rendered_zero()?,
            Ok(_) => {}
            Err(_) => said = true,
        }
        let written = bench.device.write(now, wrench);
        if said {
            let is_taken = forced && !matches!(written, Written::Rejected(_));
            ensure!(!is_taken, "{written:?} after it was gone");
            break;
        }
    }
    ensure!(said, "readings go on as if nothing had happened");
    bench.expect_rendered_zero()?;
    if forced {
        bench.expect_off()?;
        let enabled = bench.device.enable_forces(true);
        ensure!(enabled.is_err(), "it can be switched on");
    }
    Ok(())
}

pub(super) fn closing_is_final(bench: &mut Bench<'_, '_>) -> Verdict {
    if bench.device.caps().dof_out > 0 && !bench.is_unplugged {
        bench.device.enable_forces(true)?;
        bench.tick(bench.ticks_in(1.0), bench.gentle(1))?;
    }
    bench.device.close();
    bench.device.close();
    bench.expect_rendered_zero()?;
    if !bench.is_unplugged {
        bench.expect_zero_at_motors()?;
    }
    bench.expect_rejected(Wrench::ZERO, Rejection::Closed)?;
    let now = bench.now();
    let read = bench.device.read(now);
    ensure!(read == Err(DeviceFault::Closed), "{read:?}");
    let enabled = bench.device.enable_forces(true);
    ensure!(enabled == Err(DeviceFault::Closed), "{enabled:?}");
    Ok(())
}

/// The maker's side reports no violation: frames and calls in order, no error left unread.
pub(super) fn no_violations(bench: &mut Bench<'_, '_>) -> Verdict {
    let amiss = bench.hooks.amiss.as_mut().map(|look| look());
    let amiss = amiss.unwrap_or_default().join("; ");
    ensure!(amiss.is_empty(), "{amiss}");
    Ok(())
}
