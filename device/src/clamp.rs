//! Clamps a wrench before it reaches the motors, and ramps it up after enabling.

use nalgebra::Vector3;

use crate::{DeviceCaps, DeviceTime, ForceState, Wrench};

/// `wrench` clamped to the limits of a device, and whether it was changed. The directions are kept.
pub(crate) fn clamp_wrench(wrench: Wrench, caps: &DeviceCaps) -> (Wrench, bool) {
    let within = |v: Vector3<f64>, limit: f64| {
        let n = v.norm();
        if n > limit {
            (v * (limit / n), true)
        } else {
            (v, false)
        }
    };
    let (force, a) = within(wrench.force, caps.max_force_n);
    let (torque, b) = within(wrench.torque, caps.max_torque_nm);
    (Wrench { force, torque }, a || b)
}

/// The ramp after enabling: it begins with the first write.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Ramp {
    length_us: i64,
    enabled: bool,
    from: Option<DeviceTime>,
}

impl Ramp {
    /// Motors that are off.
    pub(crate) const fn off(length_us: i64) -> Self {
        Self {
            length_us,
            enabled: false,
            from: None,
        }
    }

    /// Motors that were enabled and have no write yet.
    pub(crate) const fn on(length_us: i64) -> Self {
        Self {
            enabled: true,
            ..Self::off(length_us)
        }
    }

    pub(crate) const fn is_off(&self) -> bool {
        !self.enabled
    }

    /// A write at `now` begins the ramp.
    pub(crate) fn begin(&mut self, now: DeviceTime) {
        self.from.get_or_insert(now);
    }

    /// The rendered fraction of a write at `now`, 0 to 1.
    pub(crate) fn gain(&self, now: DeviceTime) -> f64 {
        match self.from {
            Some(from) if self.enabled => {
                (now.micros_since(from) as f64 / self.length_us as f64).clamp(0.0, 1.0)
            }
            _ => 0.0,
        }
    }

    pub(crate) fn state(&self, now: DeviceTime) -> ForceState {
        if !self.enabled {
            ForceState::Off
        } else if self.gain(now) < 1.0 {
            ForceState::Ramping
        } else {
            ForceState::On
        }
    }
}
