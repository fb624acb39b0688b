//! The haptic device trait, and the capabilities of a device.

use nalgebra::Vector3;
use thiserror::Error;

use crate::script::POSITION_MAX_M;
use crate::{DeviceTime, Sample, Wrench};

/// The reachable box of a device, in the frame of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Workspace {
    /// The corner with the smallest coordinates, m.
    pub min: Vector3<f64>,
    /// The corner with the largest coordinates, m.
    pub max: Vector3<f64>,
}

impl Workspace {
    /// Whether `p` (m) is inside or on the border.
    pub fn contains(&self, p: &Vector3<f64>) -> bool {
        (0..3).all(|i| self.min[i] <= p[i] && p[i] <= self.max[i])
    }
}

/// Capabilities of a device. All values are positive and finite; force, torque and stiffness are zero where the
/// device renders none.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceCaps {
    /// Name for the user.
    pub name: String,
    /// Degrees of freedom it senses, 1 to 7 (a gripper is the seventh).
    pub dof_in: u8,
    /// Degrees of freedom it renders, 0 to 7; 0 for an input device without motors.
    pub dof_out: u8,
    /// Reachable box.
    pub workspace: Workspace,
    /// Peak force, N.
    pub max_force_n: f64,
    /// Continuous force, N. The haptic chain clamps to this one.
    pub continuous_force_n: f64,
    /// Maximum torque, N·m; zero for a device without torque.
    pub max_torque_nm: f64,
    /// Maximum stable stiffness, N/m.
    pub max_stiffness_n_per_m: f64,
    /// Rate of reads and writes, Hz.
    pub rate_hz: f64,
}

impl DeviceCaps {
    pub(crate) fn without_motors(name: String, dof_in: u8, workspace: Workspace) -> Self {
        Self {
            name,
            dof_in,
            dof_out: 0,
            workspace,
            max_force_n: 0.0,
            continuous_force_n: 0.0,
            max_torque_nm: 0.0,
            max_stiffness_n_per_m: 0.0,
            rate_hz: 1000.0,
        }
    }

    /// The limits of a desktop device, for a simulated one: 20 N peak, 10 N continuous, 3000 N/m, 1 kHz. Its
    /// workspace is the range of a script.
    pub(crate) fn simulated(name: &str) -> Self {
        let half = Vector3::repeat(POSITION_MAX_M);
        Self {
            dof_out: 3,
            max_force_n: 20.0,
            continuous_force_n: 10.0,
            max_stiffness_n_per_m: 3000.0,
            ..Self::without_motors(
                name.to_owned(),
                6,
                Workspace {
                    min: -half,
                    max: half,
                },
            )
        }
    }
}

/// Calibration state of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Calibration {
    /// Always calibrated: absolute encoders, or no hardware at all.
    NotNeeded,
    /// Poses are valid.
    Done,
    /// The user must do something first (put the stylus in its inkwell, hold it still).
    NeedsUser,
    /// Calibration is running.
    InProgress,
}

impl Calibration {
    /// Whether poses are valid.
    pub const fn is_ready(self) -> bool {
        matches!(self, Self::NotNeeded | Self::Done)
    }
}

/// Owner of the clock that drives a device. A driver of a device with a clock of its own has a thread for it, which
/// exchanges the newest values with the loop, so the loop is the same for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ClockOwner {
    /// The loop reads and writes at any time.
    Ours,
    /// The driver calls back at its own rate.
    DeviceCallback,
    /// The device answers each message with one message: the sender is the clock.
    ReplyPerMessage,
}

/// Whether the motors may push.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ForceState {
    /// The motors are off; every write is rejected.
    Off,
    /// The motors were just enabled, and the driver scales writes up from zero.
    Ramping,
    /// Writes are rendered.
    On,
}

/// Result of a write. A driver's own ramp after enabling is not a saturation.
#[derive(Debug, Clone, Copy, PartialEq)]
#[must_use]
pub enum Written {
    /// It is rendered as written.
    Applied,
    /// It was clamped before the device saw it.
    Saturated {
        /// The rendered wrench.
        applied: Wrench,
    },
    /// It was rejected, and the device renders zero.
    Rejected(Rejection),
}

/// Reason for rejecting a wrench.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
pub enum Rejection {
    /// A number of the wrench is not finite.
    #[error("the wrench holds a number that is not finite; zero force was written instead")]
    NotFinite,
    /// Forces are off.
    #[error("forces are off; enable them before writing")]
    ForcesOff,
    /// The device has no motors.
    #[error("this device renders no force")]
    NoMotors,
    /// The device was closed.
    #[error("the device is closed")]
    Closed,
    /// The device rejected it.
    #[error("the device rejected the wrench (driver code {code})")]
    Driver {
        /// The driver's own code.
        code: i32,
    },
}

/// Reason for a failed read or switch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
pub enum DeviceFault {
    /// The device was closed.
    #[error("the device is closed; open it again")]
    Closed,
    /// The device no longer answers.
    #[error("the device no longer answers; check its cable and power")]
    Unplugged,
    /// Its motors have no power.
    #[error("the device's motors have no power; plug in its power supply")]
    NoPower,
    /// The device is not calibrated.
    #[error("the device is not calibrated; follow its maker's procedure, then try again")]
    NotCalibrated,
    /// The driver reported an error.
    #[error("the driver reported error {code}")]
    Driver {
        /// The driver's own code.
        code: i32,
    },
}

/// A haptic device, once opened by its backend.
///
/// The calling order: [`enable_forces`](Self::enable_forces), then in every tick one [`read`](Self::read) and one
/// [`write`](Self::write) (for a device without motors [`cue`](Self::cue)) with times that do not run backwards,
/// and [`close`](Self::close) at the end. Neither `read` nor `write` allocates, locks, logs or panics.
///
/// The following holds for a caller at [`DeviceCaps::rate_hz`] and for every owner of the [`clock`](Self::clock).
/// Neither call waits longer than one call of the driver takes. If the clock is not the loop's, `read` returns the
/// newest state, and [`Sample::time`] is the time of its arrival. A state older than 50 ms carries
/// [`Faults::COMMUNICATION`](crate::Faults::COMMUNICATION); after half a second `read` returns an error. A wrench
/// stands while the loop runs: a driver with its own thread fades it after some tens of milliseconds without a
/// write.
pub trait HapticDevice: Send {
    /// Capabilities; constant while the device is open.
    fn caps(&self) -> &DeviceCaps;

    /// Calibration state; without a reference to find, none is needed.
    fn calibration(&self) -> Calibration {
        Calibration::NotNeeded
    }

    /// Runs the calibration that this program supports, in the posture that the driver requires, and returns the
    /// state after it. A device that its maker's program calibrates only returns its state.
    fn calibrate(&mut self) -> Result<Calibration, DeviceFault> {
        Ok(self.calibration())
    }

    /// Owner of the clock that drives it.
    fn clock(&self) -> ClockOwner {
        ClockOwner::Ours
    }

    /// Switches the motors. Off is immediate and writes zero first; on may ramp
    /// ([`ForceState::Ramping`]).
    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault>;

    /// Whether the motors may push.
    fn force_state(&self) -> ForceState;

    /// State of the tool at `now`.
    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault>;

    /// Renders `wrench` from `now` until the next write. A wrench that is not finite is
    /// [`Written::Rejected`] and the device renders zero.
    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written;

    /// Passes the force on the tool to a device without motors, once per tick and in place of
    /// [`write`](Self::write). It is a cue, not a force: a driver may rumble, and most do nothing. It neither
    /// allocates nor waits.
    fn cue(&mut self, _now: DeviceTime, _felt: &Wrench) {}

    /// The wrench that the device renders now, after clamps and ramps, as far as its driver knows. A driver whose
    /// device reduces force by itself (its own watchdog, motors without power) returns the rest from that moment
    /// on. The loop continues from there, so that no step follows.
    fn rendered(&self) -> Wrench;

    /// Writes zero, then closes. A second call does nothing.
    fn close(&mut self);
}
