//! The driver as a [`HapticDevice`](crate::HapticDevice).

use std::ffi::CString;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use nalgebra::Vector3;

use super::sys::{Api, Handle, Servo};
use super::turn::{Requests, Turner};
use super::{frame, parameter};
use crate::backend::mailbox::{Fade, LoopEnd, mailbox};
use crate::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, ForceState, HapticDevice,
    OpenError, Sample, Workspace, Wrench, Written,
};

/// Turns of the servo thread without a new force before it fades, and for the fade: 20 ms each, at a thousand a
/// second.
const FADE: Fade = Fade::new(20, 20);

/// Number of waits for the servo thread's answer, of about a millisecond each.
const PATIENCE: u32 = 1000;

/// An open Touch or Phantom.
#[derive(Debug)]
pub struct OpenHaptics {
    api: Arc<Api>,
    handle: Handle,
    servo: Option<Servo>,
    requests: Arc<Requests>,
    loop_end: LoopEnd,
    caps: DeviceCaps,
}

impl OpenHaptics {
    /// Opens a device by the name it has in the maker's setup program, or the default one.
    pub(super) fn open(library: Option<&Path>, name: Option<&str>) -> Result<Self, OpenError> {
        let api = Arc::new(Api::load(library)?);
        let handle = init(&api, name)?;
        api.switch(parameter::MAX_FORCE_CLAMPING, true);
        // Forces stay off until they are enabled; the library may have them on.
        api.switch(parameter::FORCE_OUTPUT, false);
        let caps = caps(&api);
        let style = api.integer(parameter::CALIBRATION_STYLE) as u32;
        drain(&api);
        let (loop_end, end) = mailbox(FADE);
        let requests = Arc::new(Requests::default());
        let mut turner = Turner::new(Arc::clone(&api), handle, end, Arc::clone(&requests), style);
        let rescued = Arc::clone(&api);
        let servo = Servo::start(
            Arc::clone(&api),
            Box::new(move || turner.turn()),
            Box::new(move || Turner::rescue(&rescued, handle)),
        );
        let mut device = Self {
            api,
            handle,
            servo: Some(servo),
            requests,
            loop_end,
            caps,
        };
        let mut heard = false;
        for _ in 0..PATIENCE {
            heard = device.loop_end.receive().1;
            if heard {
                break;
            }
            std::thread::park_timeout(Duration::from_millis(1));
        }
        if heard {
            Ok(device)
        } else {
            let name = called(name);
            Err(OpenError::new(format_args!(
                "the device {name} was opened but sends no state; unplug it, plug it in and try again"
            )))
        }
    }

    /// Waits until the servo thread has done something, or has stopped.
    fn wait(&self, mut is_done: impl FnMut(&Servo) -> bool) {
        let Some(servo) = &self.servo else { return };
        for _ in 0..PATIENCE {
            if is_done(servo) || servo.has_ended() {
                return;
            }
            std::thread::park_timeout(Duration::from_millis(1));
        }
    }

    fn has_panicked(&self) -> bool {
        self.servo.as_ref().is_some_and(Servo::has_panicked)
    }
}

/// Opens the device itself.
pub(super) fn init(api: &Api, name: Option<&str>) -> Result<Handle, OpenError> {
    let text = name.map(CString::new).transpose();
    let text = text.map_err(|_| {
        OpenError::new(format_args!(
            "invalid device name {:?}; use the name in the maker's setup program",
            called(name)
        ))
    })?;
    let handle = api.init(text.as_ref());
    let code = api.error();
    match (handle, code) {
        (Some(handle), None) => {
            api.make_current(handle);
            Ok(handle)
        }
        (handle, code) => {
            drain(api);
            if let Some(handle) = handle {
                api.disable_device(handle);
            }
            let code = code.unwrap_or_default();
            let (name, words) = (called(name), api.words(code));
            Err(OpenError::new(format_args!(
                "the device {name} can not be opened: {words} (code {code:#06x}); look at cable and power, \
                 and see in the maker's setup program that a device of this name is set up and paired"
            )))
        }
    }
}

/// Removes errors of queries that this model does not support.
fn drain(api: &Api) {
    for _ in 0..64 {
        if api.error().is_none() {
            return;
        }
    }
}

/// Name of the default device in the maker's setup program.
pub(super) fn called(name: Option<&str>) -> &str {
    name.unwrap_or("Default Device")
}

/// Capabilities reported by the device. Invalid values are replaced by those of a Touch: 3.3 N peak, 0.88 N
/// continuous, 160 x 120 x 70 mm (its maker's data sheet).
fn caps(api: &Api) -> DeviceCaps {
    let asked = |of: u32, unit: f64, range: std::ops::RangeInclusive<f64>, touch: f64| {
        let said = api.doubles(of)[0] * unit;
        if range.contains(&said) { said } else { touch }
    };
    let half = Vector3::new(0.08, 0.035, 0.06);
    let touch = Workspace {
        min: -half,
        max: half,
    };
    let max_force_n = asked(parameter::MAX_FORCE, 1.0, 0.1..=100.0, 3.3);
    let held = asked(parameter::MAX_CONTINUOUS_FORCE, 1.0, 0.1..=100.0, 0.88);
    let dof_in = api.integer(parameter::INPUT_DOF);
    DeviceCaps {
        name: api.text(parameter::MODEL),
        dof_in: u8::try_from(dof_in).map_or(6, |n| n.clamp(3, 7)),
        dof_out: 3,
        workspace: frame::workspace(&api.doubles(parameter::MAX_WORKSPACE)).unwrap_or(touch),
        max_force_n,
        continuous_force_n: held.min(max_force_n),
        max_torque_nm: 0.0,
        // N/mm to N/m.
        max_stiffness_n_per_m: asked(parameter::MAX_STIFFNESS, 1e3, 100.0..=20_000.0, 1000.0),
        rate_hz: asked(parameter::UPDATE_RATE, 1.0, 100.0..=10_000.0, 1000.0),
    }
}

impl HapticDevice for OpenHaptics {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn calibration(&self) -> Calibration {
        self.loop_end.last().calibration
    }

    /// Lets the library calibrate the device; put the stylus into its inkwell first, where it has one.
    fn calibrate(&mut self) -> Result<Calibration, DeviceFault> {
        self.loop_end.motors().check_open()?;
        self.loop_end.halt();
        let wish = self.requests.calibrate.fetch_add(1, Ordering::AcqRel) + 1;
        let done = || self.requests.calibrated.load(Ordering::Acquire) == wish;
        self.wait(|_| done());
        if !done() {
            return Err(DeviceFault::Unplugged);
        }
        // The state of that turn arrives at its end.
        for _ in 0..PATIENCE {
            if self.loop_end.receive().1 {
                break;
            }
            std::thread::park_timeout(Duration::from_millis(1));
        }
        Ok(self.calibration())
    }

    fn clock(&self) -> ClockOwner {
        ClockOwner::DeviceCallback
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        if on && self.has_panicked() {
            return Err(DeviceFault::Driver { code: -1 });
        }
        self.loop_end.enable(on)
    }

    fn force_state(&self) -> ForceState {
        self.loop_end.motors().state()
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        if self.has_panicked() {
            self.loop_end.halt();
            return Err(DeviceFault::Driver { code: -1 });
        }
        self.loop_end.read(now)
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        self.loop_end.write(now, wrench, &self.caps)
    }

    fn rendered(&self) -> Wrench {
        self.loop_end.rendered()
    }

    /// Writes zero, switches forces off, stops the scheduler, then closes the device.
    fn close(&mut self) {
        self.loop_end.close();
        // The servo thread's last turn writes zero and switches forces off.
        self.requests.leave.store(true, Ordering::Release);
        self.wait(Servo::has_ended);
        if let Some(servo) = self.servo.take() {
            self.api.make_current(self.handle);
            if !servo.has_ended() {
                // The servo thread has stopped: write zero from this thread.
                servo.unschedule();
                self.api.begin(self.handle);
                self.api.set(parameter::FORCE, [0.0; 3]);
                self.api.end(self.handle);
            }
            self.api.switch(parameter::FORCE_OUTPUT, false);
            servo.stop();
            self.api.disable_device(self.handle);
            // Otherwise the next opened device would report them.
            drain(&self.api);
        }
    }
}

impl Drop for OpenHaptics {
    fn drop(&mut self) {
        self.close();
    }
}
