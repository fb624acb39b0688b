//! One turn on the library's servo thread: begin a frame, read, write the newest force, end the frame, drain errors.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use super::error::Errors;
use super::sys::{Api, Handle};
use super::{frame, parameter};
use crate::backend::mailbox::{DeviceState, DriverEnd, Order};
use crate::{Buttons, Calibration, DeviceFault};

/// Errors read after one frame. The library keeps a list; the rest is read after the next.
const ERRORS_MAX: usize = 32;

/// Turns between two calibration checks.
const CALIBRATION_EVERY: u32 = 100;

/// Requests of the driver to the servo thread besides forces.
#[derive(Debug, Default)]
pub(super) struct Requests {
    /// End with zero force.
    pub(super) leave: AtomicBool,
    /// Number of requested calibrations.
    pub(super) calibrate: AtomicU32,
    /// Number of calibrations done.
    pub(super) calibrated: AtomicU32,
}

/// State of the servo thread.
pub(super) struct Turner {
    api: Arc<Api>,
    handle: Handle,
    end: DriverEnd,
    requests: Arc<Requests>,
    style: u32,
    device_state: DeviceState,
    is_on: bool,
    is_lost: bool,
    until_checked: u32,
}

impl Turner {
    /// For an open device with forces off; `style` is its calibration style.
    pub(super) fn new(
        api: Arc<Api>,
        handle: Handle,
        end: DriverEnd,
        requests: Arc<Requests>,
        style: u32,
    ) -> Self {
        Self {
            api,
            handle,
            end,
            requests,
            style,
            device_state: DeviceState::at_rest(),
            is_on: false,
            is_lost: false,
            until_checked: 0,
        }
    }

    /// Runs one turn; returns whether to continue.
    pub(super) fn turn(&mut self) -> bool {
        let leaves = self.requests.leave.load(Ordering::Acquire);
        let mut order = self.end.order();
        if leaves || self.is_lost {
            order = Order::OFF;
        }
        self.api.make_current(self.handle);
        self.calibrate();
        self.api.begin(self.handle);
        self.read();
        self.write(&order);
        self.api.end(self.handle);
        self.judge();
        self.end.publish(self.device_state);
        !leaves
    }

    /// Checks the calibration, and calibrates on request.
    fn calibrate(&mut self) {
        let asked = self.requests.calibrate.load(Ordering::Acquire);
        let is_asked = asked != self.requests.calibrated.load(Ordering::Acquire);
        if !is_asked && self.until_checked > 0 {
            self.until_checked -= 1;
            return;
        }
        self.until_checked = CALIBRATION_EVERY;
        let mut state = self.api.check_calibration();
        if state == parameter::CALIBRATION_NEEDS_UPDATE
            || is_asked && state != parameter::CALIBRATION_OK
        {
            self.api.update_calibration(self.style);
            state = self.api.check_calibration();
        }
        self.device_state.calibration = match state {
            parameter::CALIBRATION_OK => Calibration::Done,
            parameter::CALIBRATION_NEEDS_UPDATE => Calibration::InProgress,
            _ => Calibration::NeedsUser,
        };
        self.requests.calibrated.store(asked, Ordering::Release);
    }

    fn read(&mut self) {
        let three = |of: u32| {
            let m = self.api.doubles(of);
            [m[0], m[1], m[2]]
        };
        self.device_state.pose = frame::pose(&self.api.doubles(parameter::TRANSFORM));
        // The transform's last column is the same position; the header names this parameter the position.
        self.device_state.pose.position = frame::metres(three(parameter::POSITION));
        self.device_state.velocity = frame::metres(three(parameter::VELOCITY));
        self.device_state.angular_velocity = frame::turned(three(parameter::ANGULAR_VELOCITY));
        self.device_state.buttons = Buttons::from_bits(self.api.integer(parameter::BUTTONS) as u32);
    }

    fn write(&mut self, order: &Order) {
        // Zero before off; on before force.
        if order.on && !self.is_on {
            self.api.switch(parameter::FORCE_OUTPUT, true);
        }
        self.api
            .set(parameter::FORCE, frame::back(order.wrench.force));
        if !order.on && self.is_on {
            self.api.switch(parameter::FORCE_OUTPUT, false);
        }
        self.is_on = order.on;
    }

    /// Removes the force after a turn that failed at any point.
    pub(super) fn rescue(api: &Api, handle: Handle) {
        api.make_current(handle);
        // Ends the open frame, and one more: without an open frame the first end only adds an error.
        for _ in 0..2 {
            api.set(parameter::FORCE, [0.0; 3]);
            api.end(handle);
            api.begin(handle);
        }
        api.switch(parameter::FORCE_OUTPUT, false);
        api.end(handle);
    }

    /// Evaluates the library's errors of this frame.
    fn judge(&mut self) {
        let mut errors = Errors::default();
        for _ in 0..ERRORS_MAX {
            let Some(code) = self.api.error() else { break };
            errors.add(code);
        }
        let pose = &self.device_state.pose;
        let is_number = pose.is_finite()
            && (self.device_state.velocity + self.device_state.angular_velocity)
                .iter()
                .all(|c| c.is_finite());
        self.is_lost = errors.lost || !is_number;
        self.device_state.faults = errors.faults;
        self.device_state.lost = match (errors.lost, is_number) {
            (true, _) => Some(DeviceFault::Unplugged),
            (_, false) => Some(DeviceFault::Driver { code: 0 }),
            _ => None,
        };
    }
}
