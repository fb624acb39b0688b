//! One turn on the library's servo thread: begin a frame, read, write the newest force, end the frame, drain errors.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use super::error::Errors;
use super::sys::{Api, Handle};
use super::{frame, parameter};
use crate::backend::exchange::{DriverEnd, News, Order};
use crate::{Buttons, Calibration, DeviceFault};

/// Errors that are asked for after one frame. The library keeps a list; what is left comes with the next.
const ERRORS_MAX: usize = 32;

/// Turns between two questions whether the device still knows where it is.
const CALIBRATION_EVERY: u32 = 100;

/// What the driver tells the servo thread besides forces.
#[derive(Debug, Default)]
pub(super) struct Wishes {
    /// End with zero.
    pub(super) leave: AtomicBool,
    /// Calibrate once more.
    pub(super) calibrate: AtomicU32,
    /// So often that was done.
    pub(super) calibrated: AtomicU32,
}

/// The servo thread's own.
pub(super) struct Turner {
    api: Arc<Api>,
    handle: Handle,
    end: DriverEnd,
    wishes: Arc<Wishes>,
    style: u32,
    news: News,
    is_on: bool,
    is_lost: bool,
    until_checked: u32,
}

impl Turner {
    /// For a device that was opened, with its forces off; `style` is how it can be calibrated.
    pub(super) fn new(
        api: Arc<Api>,
        handle: Handle,
        end: DriverEnd,
        wishes: Arc<Wishes>,
        style: u32,
    ) -> Self {
        Self {
            api,
            handle,
            end,
            wishes,
            style,
            news: News::at_rest(),
            is_on: false,
            is_lost: false,
            until_checked: 0,
        }
    }

    /// One turn; whether there is to be another.
    pub(super) fn turn(&mut self) -> bool {
        let leaves = self.wishes.leave.load(Ordering::Acquire);
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
        self.end.tell(self.news);
        !leaves
    }

    /// Asks how far the device knows where it is, and calibrates it when that is due.
    fn calibrate(&mut self) {
        let asked = self.wishes.calibrate.load(Ordering::Acquire);
        let is_asked = asked != self.wishes.calibrated.load(Ordering::Acquire);
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
        self.news.calibration = match state {
            parameter::CALIBRATION_OK => Calibration::Done,
            parameter::CALIBRATION_NEEDS_UPDATE => Calibration::InProgress,
            _ => Calibration::NeedsUser,
        };
        self.wishes.calibrated.store(asked, Ordering::Release);
    }

    fn read(&mut self) {
        let three = |of: u32| {
            let m = self.api.doubles(of);
            [m[0], m[1], m[2]]
        };
        self.news.pose = frame::pose(&self.api.doubles(parameter::TRANSFORM));
        // The transform's last column is the same place; the position is what the header calls so.
        self.news.pose.position = frame::metres(three(parameter::POSITION));
        self.news.velocity = frame::metres(three(parameter::VELOCITY));
        self.news.angular_velocity = frame::turned(three(parameter::ANGULAR_VELOCITY));
        self.news.buttons = Buttons::from_bits(self.api.integer(parameter::BUTTONS) as u32);
    }

    fn write(&mut self, order: &Order) {
        // Zero first, then off; on, then force.
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

    /// Takes the force away after a turn that went wrong, wherever it did.
    pub(super) fn rescue(api: &Api, handle: Handle) {
        api.make_current(handle);
        // The end of the frame that was left open, and another: where none was open the first end is one more error.
        for _ in 0..2 {
            api.set(parameter::FORCE, [0.0; 3]);
            api.end(handle);
            api.begin(handle);
        }
        api.switch(parameter::FORCE_OUTPUT, false);
        api.end(handle);
    }

    /// What the library has to say of this frame.
    fn judge(&mut self) {
        let mut errors = Errors::default();
        for _ in 0..ERRORS_MAX {
            let Some(code) = self.api.error() else { break };
            errors.add(code);
        }
        let pose = &self.news.pose;
        let is_number = pose.is_finite()
            && (self.news.velocity + self.news.angular_velocity)
                .iter()
                .all(|c| c.is_finite());
        self.is_lost = errors.lost || !is_number;
        self.news.faults = errors.faults;
        self.news.lost = match (errors.lost, is_number) {
            (true, _) => Some(DeviceFault::Unplugged),
            (_, false) => Some(DeviceFault::Driver { code: 0 }),
            _ => None,
        };
    }
}
