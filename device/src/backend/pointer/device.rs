//! The driver as a [`HapticDevice`](crate::HapticDevice).

use nalgebra::UnitQuaternion;
use rtrb::Consumer;

use super::handle::queue;
use super::{EVENTS_MAX, Follower, PointerEvent, PointerHandle};
use crate::error::check_ranges;
use crate::{
    Buttons, DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, OpenError,
    Pose, Rejection, Sample, Workspace, Wrench, Written,
};

/// Age of an event after which it presses no button, µs: the loop was held up, and the press referred to another
/// moment.
const OLD_US: i64 = 500_000;

/// Maximum step of the follower, µs; a longer pause is split.
const STEP_MAX_US: i64 = 1000;

/// Maximum pause between two readings that is integrated, µs. After a longer one the tool keeps its pose, at rest,
/// and the sample carries [`Faults::TIME_JUMP`].
const PAUSE_MAX_US: i64 = 100_000;

/// Limits of a tool under a pointer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointerConfig {
    /// Reachable box.
    pub workspace: Workspace,
    /// Initial pose.
    pub start: Pose,
    /// Maximum speed, m/s, 0.001 to 2.
    pub speed_m_per_s: f64,
    /// Maximum angular speed, rad/s, 0.01 to 20.
    pub turn_rad_per_s: f64,
}

impl PointerConfig {
    /// A pointer in this workspace from `start` on, no faster than a hand over tissue: 0.4 m/s, 4 rad/s.
    pub fn new(workspace: Workspace, start: Pose) -> Self {
        Self {
            workspace,
            start,
            speed_m_per_s: 0.4,
            turn_rad_per_s: 4.0,
        }
    }
}

/// A tool under a pointer.
#[derive(Debug)]
pub struct Pointer {
    caps: DeviceCaps,
    /// Target pose, within the workspace.
    goal: Pose,
    /// The buttons held.
    buttons: Buttons,
    follower: Follower,
    events: Consumer<PointerEvent>,
    /// The time of the last accepted event, at most the time of its reading.
    last: DeviceTime,
    now: Option<DeviceTime>,
    open: bool,
}

impl Pointer {
    /// A tool under a pointer, and the handle by which a view sends events.
    pub fn new(config: &PointerConfig) -> Result<(Self, PointerHandle), OpenError> {
        let speeds = [
            ("speed_m_per_s", config.speed_m_per_s, 1e-3..=2.0),
            ("turn_rad_per_s", config.turn_rad_per_s, 1e-2..=20.0),
        ];
        check_ranges("the pointer", speeds)?;
        let Workspace { min, max } = config.workspace;
        let finite = min.iter().chain(&max).all(|c| c.is_finite());
        if !(finite && config.start.is_finite() && (0..3).all(|i| min[i] <= max[i])) {
            return Err(OpenError::new(
                "the pointer's workspace or start is not a box and a pose of finite numbers",
            ));
        }
        let (handle, events) = queue();
        let goal = within(&config.workspace, config.start);
        let pointer = Self {
            caps: DeviceCaps::without_motors("pointer".to_owned(), 6, config.workspace),
            goal,
            buttons: Buttons::NONE,
            follower: Follower::new(goal, config.speed_m_per_s, config.turn_rad_per_s),
            events,
            last: DeviceTime::from_micros(i64::MIN),
            now: None,
            open: true,
        };
        Ok((pointer, handle))
    }

    /// Applies the events since the last reading. Returns the buttons held at any time in between, so that a short
    /// click counts, and whether events were rejected.
    fn receive(&mut self, now: DeviceTime) -> (Buttons, Faults) {
        let mut held = Buttons::NONE;
        let mut faults = Faults::NONE;
        // Bounded, so that a flood of events does not hold up the loop.
        for _ in 0..EVENTS_MAX {
            let Ok(event) = self.events.pop() else {
                break;
            };
            if !event.is_sound() {
                faults = Faults::COMMUNICATION;
                continue;
            }
            // Its time does not matter: the clock of a view may differ from that of the sender that reports it gone.
            let Some(goal) = event.goal else {
                self.leave(*self.follower.lead());
                continue;
            };
            if event.time < self.last {
                continue;
            }
            // A time in the future must not block the events after it.
            self.last = event.time.min(now);
            self.goal = within(&self.caps.workspace, goal);
            // The sender's clock is a little ahead at most.
            self.buttons = if now.micros_since(event.time).abs() <= OLD_US {
                event.buttons
            } else {
                // Buttons that were held and still are.
                Buttons::from_bits(event.buttons.bits() & self.buttons.bits())
            };
            held = held.with(self.buttons);
        }
        (held, faults)
    }

    /// The pointer is gone: no button is held, and the target becomes `here`.
    fn leave(&mut self, here: Pose) {
        self.goal = here;
        self.buttons = Buttons::NONE;
    }
}

impl HapticDevice for Pointer {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn enable_forces(&mut self, _on: bool) -> Result<(), DeviceFault> {
        if self.open {
            Ok(())
        } else {
            Err(DeviceFault::Closed)
        }
    }

    fn force_state(&self) -> ForceState {
        ForceState::Off
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        if !self.open {
            return Err(DeviceFault::Closed);
        }
        let before = self.now.unwrap_or(now);
        let now = now.max(before);
        self.now = Some(now);
        if self.events.is_abandoned() && self.events.is_empty() {
            self.follower.halt();
            self.leave(*self.follower.pose());
            return Err(DeviceFault::Unplugged);
        }
        let (held, mut faults) = self.receive(now);
        let passed = now.micros_since(before);
        if passed > PAUSE_MAX_US {
            self.follower.halt();
            faults = faults.with(Faults::TIME_JUMP);
        } else {
            let steps = (passed + STEP_MAX_US - 1) / STEP_MAX_US;
            for _ in 0..steps {
                let h = passed as f64 * 1e-6 / steps as f64;
                self.follower.step(&self.goal, h);
            }
        }
        // Rounding may leave the box by a little.
        let pose = within(&self.caps.workspace, *self.follower.pose());
        Ok(Sample {
            time: now,
            pose,
            velocity: self.follower.velocity(),
            angular_velocity: self.follower.angular_velocity(),
            buttons: held.with(self.buttons),
            gripper: None,
            faults,
        })
    }

    fn write(&mut self, _now: DeviceTime, _wrench: Wrench) -> Written {
        Written::Rejected(if self.open {
            Rejection::NoMotors
        } else {
            Rejection::Closed
        })
    }

    fn rendered(&self) -> Wrench {
        Wrench::ZERO
    }

    fn close(&mut self) {
        self.open = false;
    }
}

/// `pose`, clamped to the workspace, with a rotation of norm 1.
fn within(workspace: &Workspace, pose: Pose) -> Pose {
    Pose {
        position: pose.position.sup(&workspace.min).inf(&workspace.max),
        orientation: UnitQuaternion::new_normalize(pose.orientation.into_inner()),
    }
}
