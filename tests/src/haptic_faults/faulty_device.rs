//! A device with fault injection that records all calls.
//!
//! Its hand moves in run time, independent of the machine clock.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use palpate_device::backend::sim::{CATCH_UP_MAX_US, SimHand};
use palpate_device::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, ForceState, HapticDevice,
    Rejection, Sample, Wrench, Written,
};

use super::fault::{BadPose, FaultKind};

/// Error of a driver whose device is absent.
const GONE: Rejection = Rejection::Driver { code: -1 };

/// Watchdog of the device: it drops the force without writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceWatchdog {
    pub after_us: i64,
    /// Whether the motors stay off until they are enabled.
    pub turns_off: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Driver {
    /// Whether forces ramp up over 100 ms after enabling, or at once.
    pub ramps: bool,
    /// Whether the reported position jumps after a pause of more than a second.
    pub leaps_after_pause: bool,
    /// Watchdog without writes; `None`: the device renders the last wrench for ever.
    pub watchdog: Option<DeviceWatchdog>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Write {
    pub commanded: Wrench,
    /// Rendered wrench right before the write.
    pub before: Wrench,
    /// Rendered wrench right after the write.
    pub after: Wrench,
    /// Whether the device neither rejected nor clamped the command.
    pub obeyed: bool,
    /// Whether the motors were on and not ramping.
    pub is_on: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Log {
    /// The last write; the oracle takes it.
    pub write: Option<Write>,
    pub unread: u64,
    pub bad_poses: u64,
    /// Writes rejected while the forces were on.
    pub refused: u64,
    pub clamped: u64,
    /// Force that the device dropped by itself since the last check, N.
    pub cut_n: f64,
    pub nan_written: u64,
    pub times_back: u64,
}

#[derive(Debug, Clone, Default)]
pub struct DeviceState {
    /// Run time, µs.
    pub now_us: i64,
    pub faults: Vec<FaultKind>,
    pub log: Log,
}

#[derive(Debug, Clone, Default)]
pub struct DeviceHandle(Arc<Mutex<DeviceState>>);

impl DeviceHandle {
    /// Locks the shared state; each lock is short.
    pub fn state(&self) -> MutexGuard<'_, DeviceState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

pub struct FaultyDevice {
    hand: SimHand,
    driver: Driver,
    handle: DeviceHandle,
    /// For a driver without a ramp, whose hand is always enabled.
    on: bool,
    is_plugged: bool,
    last_write_us: i64,
    last_read_us: i64,
    last_stamp: DeviceTime,
    reads: u32,
    writes: u32,
    /// Added to every write: a jerking device, for tests of the oracle.
    jerk: Option<Jerk>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jerk {
    /// Index of the write.
    pub write: u32,
    pub by_n: f64,
}

impl FaultyDevice {
    /// A faulty device around a hand; the run time begins at `now_us`.
    pub fn new(hand: SimHand, driver: Driver, jerk: Option<Jerk>) -> (Self, DeviceHandle) {
        let handle = DeviceHandle::default();
        let device = Self {
            hand,
            driver,
            handle: handle.clone(),
            on: false,
            is_plugged: true,
            last_write_us: 0,
            last_read_us: 0,
            last_stamp: DeviceTime::from_micros(i64::MIN),
            reads: 0,
            writes: 0,
            jerk,
        };
        (device, handle)
    }

    fn now(&self) -> DeviceTime {
        DeviceTime::from_micros(self.handle.state().now_us)
    }

    fn check_stamp(&mut self, stamp: DeviceTime) {
        self.handle.state().log.times_back += u64::from(stamp < self.last_stamp);
        self.last_stamp = stamp;
    }

    fn fault<T>(&self, find: impl Fn(&FaultKind) -> Option<T>) -> Option<T> {
        self.handle.state().faults.iter().find_map(find)
    }

    /// Drops the force at `at` on the part of the device.
    fn drop_force(&mut self, at: DeviceTime, turns_off: bool) {
        let stood = self.hand.rendered().force.norm();
        let _ = self.hand.write(at, Wrench::ZERO);
        self.handle.state().log.cut_n += stood;
        if turns_off {
            self.on = false;
            if self.driver.ramps {
                // A simulated hand can be disabled at any time.
                let _ = self.hand.enable_forces(false);
            }
        }
    }

    fn unplug_or_plug(&mut self, now: DeviceTime) {
        let gone = self.fault(|what| match what {
            FaultKind::Unplugged { forgets } => Some(*forgets),
            _ => None,
        });
        if let Some(forgets) = gone
            && self.is_plugged
        {
            self.drop_force(now, forgets);
        }
        self.is_plugged = gone.is_none();
    }

    /// Simulates the hand until `now`, including the watchdog.
    fn simulate_until(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        if let Some(watchdog) = self.driver.watchdog {
            let at = DeviceTime::from_micros(self.last_write_us + watchdog.after_us);
            if at < now && self.hand.rendered() != Wrench::ZERO {
                self.hand.read(at)?;
                self.drop_force(at, watchdog.turns_off);
            }
        }
        if !self.driver.leaps_after_pause {
            let mut at = self.last_read_us;
            while at + CATCH_UP_MAX_US / 2 < now.as_micros() {
                at += CATCH_UP_MAX_US / 2;
                self.hand.read(DeviceTime::from_micros(at))?;
            }
        }
        self.last_read_us = now.as_micros();
        self.hand.read(now)
    }
}

fn damaged(mut sample: Sample, how: BadPose) -> Sample {
    match how {
        BadPose::PositionNan => sample.pose.position.x = f64::NAN,
        BadPose::VelocityInfinite => sample.velocity.z = f64::INFINITY,
        BadPose::FarAway => sample.pose.position.y = -3.8e8,
        BadPose::TurnNan => sample.pose.orientation.as_mut_unchecked().coords.x = f64::NAN,
    }
    sample
}

impl HapticDevice for FaultyDevice {
    fn caps(&self) -> &DeviceCaps {
        self.hand.caps()
    }

    fn calibration(&self) -> Calibration {
        self.hand.calibration()
    }

    fn clock(&self) -> ClockOwner {
        self.hand.clock()
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        if !self.is_plugged {
            return Err(DeviceFault::Unplugged);
        }
        self.on = on;
        if self.driver.ramps {
            return self.hand.enable_forces(on);
        }
        if self.hand.force_state() == ForceState::Off {
            self.hand.enable_forces(true)?;
            // The ramp runs before the run begins, without a command.
            let now = self.now();
            let _ = self
                .hand
                .write(now.plus_micros(-CATCH_UP_MAX_US / 2), Wrench::ZERO);
        }
        Ok(())
    }

    fn force_state(&self) -> ForceState {
        match (self.driver.ramps, self.on) {
            (true, _) => self.hand.force_state(),
            (false, true) => ForceState::On,
            (false, false) => ForceState::Off,
        }
    }

    fn read(&mut self, stamp: DeviceTime) -> Result<Sample, DeviceFault> {
        self.check_stamp(stamp);
        let now = self.now();
        let sample = self.simulate_until(now)?;
        self.unplug_or_plug(now);
        if !self.is_plugged {
            self.handle.state().log.unread += 1;
            return Err(DeviceFault::Unplugged);
        }
        self.reads = self.reads.wrapping_add(1);
        let reads = self.reads;
        let bad = self.fault(|what| match what {
            FaultKind::BadPoses { how, every } if reads.is_multiple_of(*every) => Some(*how),
            _ => None,
        });
        let sample = Sample {
            time: stamp,
            ..sample
        };
        Ok(match bad {
            Some(how) => {
                self.handle.state().log.bad_poses += 1;
                damaged(sample, how)
            }
            None => sample,
        })
    }

    fn write(&mut self, stamp: DeviceTime, commanded: Wrench) -> Written {
        self.check_stamp(stamp);
        let now = self.now();
        self.last_write_us = now.as_micros();
        self.writes = self.writes.wrapping_add(1);
        let writes = self.writes;
        let before = self.hand.rendered();
        let force_state = self.force_state();
        let refuses = self.fault(|what| match what {
            FaultKind::Refused { every } if writes.is_multiple_of(*every) => Some(()),
            _ => None,
        });
        let limit = self.fault(|what| match what {
            FaultKind::Clamped { to_n } => Some(*to_n),
            _ => None,
        });
        let jerk = self.jerk.filter(|j| j.write == writes);
        let done = if !self.is_plugged {
            Written::Rejected(GONE)
        } else if force_state == ForceState::Off {
            Written::Rejected(Rejection::ForcesOff)
        } else if !commanded.is_finite() {
            self.handle.state().log.nan_written += 1;
            Written::Rejected(Rejection::NotFinite)
        } else if refuses.is_some() {
            Written::Rejected(Rejection::Driver { code: 7 })
        } else {
            let norm = commanded.force.norm();
            let share = limit.filter(|n| norm > *n).map_or(1.0, |n| n / norm);
            let mut given = commanded.scaled(share);
            given.force.z += jerk.map_or(0.0, |j| j.by_n);
            match self.hand.write(now, given) {
                Written::Applied if share < 1.0 => Written::Saturated { applied: given },
                other => other,
            }
        };
        if matches!(done, Written::Rejected(_)) {
            let _ = self.hand.write(now, Wrench::ZERO);
        }
        let mut shared = self.handle.state();
        let is_refused = matches!(done, Written::Rejected(why) if why != Rejection::ForcesOff);
        shared.log.refused += u64::from(is_refused);
        shared.log.clamped += u64::from(matches!(done, Written::Saturated { .. }));
        shared.log.write = Some(Write {
            commanded,
            before,
            after: self.hand.rendered(),
            obeyed: done == Written::Applied,
            is_on: force_state == ForceState::On,
        });
        done
    }

    fn rendered(&self) -> Wrench {
        self.hand.rendered()
    }

    fn close(&mut self) {
        self.hand.close();
    }
}
