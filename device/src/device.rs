//! The one trait of a haptic device, and what a device says of itself.

use nalgebra::Vector3;
use thiserror::Error;

use crate::{DeviceTime, Sample, Wrench};

/// The box in which a device can follow the hand, in the frame of the scene.
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

/// What a device can do. All of it is positive and finite; force, torque and stiffness are zero where it renders none.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceCaps {
    /// What to call it to the user.
    pub name: String,
    /// Degrees of freedom it senses, 1 to 7 (a gripper is the seventh).
    pub dof_in: u8,
    /// Degrees of freedom it renders, 0 to 7; 0 for an input device without motors.
    pub dof_out: u8,
    /// Where it can follow the hand.
    pub workspace: Workspace,
    /// The largest force for a moment, N.
    pub max_force_n: f64,
    /// The largest force it can hold, N. The haptic chain clamps to this one.
    pub continuous_force_n: f64,
    /// The largest torque, N·m; zero where it renders none.
    pub max_torque_nm: f64,
    /// The largest stiffness it renders stably, N/m.
    pub max_stiffness_n_per_m: f64,
    /// How often it is to be read and written, Hz.
    pub rate_hz: f64,
}

/// How far a device knows where it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Calibration {
    /// It always knows: absolute encoders, or no hardware at all.
    NotNeeded,
    /// Poses are trusted.
    Done,
    /// The user must do something first (put the stylus in its inkwell, hold it still).
    NeedsUser,
    /// It is finding its reference now.
    InProgress,
}

impl Calibration {
    /// Whether poses can be trusted.
    pub const fn is_ready(self) -> bool {
        matches!(self, Self::NotNeeded | Self::Done)
    }
}

/// Whose clock drives a device. Real drivers differ in this more than in anything else; the loop that drives them does
/// not: a driver of a device with a clock of its own has a thread for it, which hands the newest over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ClockOwner {
    /// We read and write whenever we want to.
    Ours,
    /// The driver calls back at its own rate.
    DeviceCallback,
    /// The device answers each message with one message: whoever writes is the clock.
    ReplyPerMessage,
}

/// Whether the motors may push.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ForceState {
    /// The motors are off; every write is rejected.
    Off,
    /// The motors were just enabled and the driver scales what it is given up from zero.
    Ramping,
    /// What is written is rendered.
    On,
}

/// What became of a wrench. A driver's own ramp after enabling is not a saturation.
#[derive(Debug, Clone, Copy, PartialEq)]
#[must_use]
pub enum Written {
    /// It is rendered as written.
    Applied,
    /// It was clamped before the device saw it.
    Saturated {
        /// What is rendered instead.
        applied: Wrench,
    },
    /// It was refused, and the device renders zero.
    Rejected(Rejection),
}

/// Why a wrench was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
pub enum Rejection {
    /// A number of the wrench is not finite.
    #[error("the wrench holds a number that is not finite; zero force was written instead")]
    NotFinite,
    /// Forces are off.
    #[error("forces are off; enable them before writing")]
    ForcesOff,
    /// The device renders no force at all.
    #[error("this device renders no force")]
    NoMotors,
    /// The device was closed.
    #[error("the device is closed")]
    Closed,
    /// The device did not take it.
    #[error("the device did not take the wrench (driver code {code})")]
    Driver {
        /// The driver's own code.
        code: i32,
    },
}

/// Why a device could not be read or switched.
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
    /// The device does not know where it is.
    #[error("the device is not calibrated; follow its maker's procedure, then try again")]
    NotCalibrated,
    /// The driver reported an error.
    #[error("the driver reported error {code}")]
    Driver {
        /// The driver's own code.
        code: i32,
    },
}

/// A haptic device. Constructors belong to the backends; everything after that is here.
///
/// The calling order: [`enable_forces`](Self::enable_forces), then in every tick one
/// [`read`](Self::read) and one [`write`](Self::write) (of a device that renders no force
/// [`cue`](Self::cue)) with times that do not run backwards, and
/// [`close`](Self::close) at the end. Neither `read` nor `write` allocates, locks or logs, and
/// neither panics.
///
/// Whoever calls them at the rate of [`DeviceCaps::rate_hz`] may rely on the following, whoever's [`clock`](Self::clock)
/// drives the device. Neither waits for the device longer than one call of its driver takes: where the clock is not ours,
/// `read` gives what came last, and [`Sample::time`] says since when it is known. What came last and is older than
/// 50 ms carries [`Faults::COMMUNICATION`](crate::Faults::COMMUNICATION), and after half a second reading is an error.
/// A wrench stands for as long as the loop goes on: a driver with a thread of its own takes it away by itself when
/// nobody has written for some tens of milliseconds.
pub trait HapticDevice: Send {
    /// What it can do; constant for as long as it is open.
    fn caps(&self) -> &DeviceCaps;

    /// Whether its poses can be trusted.
    fn calibration(&self) -> Calibration;

    /// Does what calibration this program can do, in the posture that the driver asks for, and gives the state
    /// after it. A device whose maker has a program for that only says where it stands.
    fn calibrate(&mut self) -> Result<Calibration, DeviceFault> {
        Ok(self.calibration())
    }

    /// Whose clock drives it.
    fn clock(&self) -> ClockOwner;

    /// Switches the motors. Off is immediate and writes zero first; on may ramp
    /// ([`ForceState::Ramping`]).
    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault>;

    /// Whether the motors may push.
    fn force_state(&self) -> ForceState;

    /// Where the tool is at `now`.
    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault>;

    /// Renders `wrench` from `now` until the next write. A wrench that is not finite is
    /// [`Written::Rejected`] and the device renders zero.
    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written;

    /// Tells a device that renders no force what the tool would be pushed with, once per tick and in place of
    /// [`write`](Self::write). It is a hint and no force: a driver may let its hardware shake, and most do nothing. Like
    /// the others it neither allocates nor waits.
    fn cue(&mut self, _now: DeviceTime, _felt: &Wrench) {}

    /// What the device renders now, as far as its driver knows: after clamps and ramps. A driver whose
    /// device takes its force away by itself (a watchdog of its own, motors that were cut) gives here
    /// what is left from that moment on: the loop goes on from there, and what it does not know it can
    /// not keep from becoming a blow.
    fn rendered(&self) -> Wrench;

    /// Writes zero, then closes. A second call does nothing.
    fn close(&mut self);
}

/// A device of whatever kind.
impl<D: HapticDevice + ?Sized> HapticDevice for Box<D> {
    fn caps(&self) -> &DeviceCaps {
        (**self).caps()
    }

    fn calibration(&self) -> Calibration {
        (**self).calibration()
    }

    fn calibrate(&mut self) -> Result<Calibration, DeviceFault> {
        (**self).calibrate()
    }

    fn clock(&self) -> ClockOwner {
        (**self).clock()
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        (**self).enable_forces(on)
    }

    fn force_state(&self) -> ForceState {
        (**self).force_state()
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        (**self).read(now)
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        (**self).write(now, wrench)
    }

    fn cue(&mut self, now: DeviceTime, felt: &Wrench) {
        (**self).cue(now, felt);
    }

    fn rendered(&self) -> Wrench {
        (**self).rendered()
    }

    fn close(&mut self) {
        (**self).close();
    }
}
