//! The conformance suite fails for a driver that violates a law.

#![allow(clippy::unwrap_used)]

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use nalgebra::Vector3;
use palpate_device::backend::pointer::{Pointer, PointerConfig, PointerHandle};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::conformance::{Hooks, Options, Outcome, Report, run, run_with};
use palpate_device::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, ForceState, HapticDevice,
    Rejection, Sample, Script, Workspace, Wrench, Written,
};

#[derive(Debug, Clone, Copy, PartialEq)]
enum Bug {
    None,
    Millimetres,
    ForgetsCaps,
    WritesWhileOff,
    KeepsForceOnNan,
    SaysAppliedWhenClamped,
    SwapsAxes,
    TimeRunsBackwards,
    RendersBeyondLimit,
    AnswersAfterClose,
    MotorsGetHalf,
    LeavesForceAtClose,
    DoesNotSeeThePlug,
    KeepsForceWhenUnplugged,
    SwitchesOnUnplugged,
    LeavesAnError,
}

/// A simulated hand behind a driver with one bug.
struct Buggy {
    hand: SimHand,
    caps: DeviceCaps,
    bug: Bug,
    last: Wrench,
    reads: i64,
    closed: bool,
    world: Arc<World>,
}

/// State behind the driver.
#[derive(Default)]
struct World {
    unplugged: AtomicBool,
    /// N.
    motors: Mutex<f64>,
}

impl Buggy {
    fn is_unplugged(&self) -> bool {
        self.world.unplugged.load(Ordering::Acquire)
    }

    fn drive(&self) {
        let share = if self.bug == Bug::MotorsGetHalf {
            0.5
        } else {
            1.0
        };
        *self.world.motors.lock().unwrap() = share * self.hand.rendered().force.norm();
    }
}

impl HapticDevice for Buggy {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }
    fn calibration(&self) -> Calibration {
        self.hand.calibration()
    }
    fn clock(&self) -> ClockOwner {
        self.hand.clock()
    }
    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        if on && !self.closed && self.is_unplugged() && self.bug != Bug::SwitchesOnUnplugged {
            return Err(DeviceFault::Unplugged);
        }
        let done = self.hand.enable_forces(on);
        self.drive();
        done
    }
    fn force_state(&self) -> ForceState {
        self.hand.force_state()
    }
    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        self.reads += 1;
        if self.closed && self.bug == Bug::AnswersAfterClose {
            return Ok(Sample::resting(now, palpate_device::Pose::default()));
        }
        if self.is_unplugged() && !self.closed && self.bug != Bug::DoesNotSeeThePlug {
            if self.bug != Bug::KeepsForceWhenUnplugged {
                self.hand.enable_forces(false)?;
                self.drive();
            }
            return Err(DeviceFault::Unplugged);
        }
        let mut sample = self.hand.read(now)?;
        match self.bug {
            Bug::Millimetres => sample.pose.position *= 1e3,
            Bug::TimeRunsBackwards => sample.time = DeviceTime::from_micros(-self.reads),
            _ => {}
        }
        Ok(sample)
    }
    fn write(&mut self, now: DeviceTime, mut wrench: Wrench) -> Written {
        if self.bug == Bug::SwapsAxes {
            wrench.force = Vector3::new(wrench.force.y, wrench.force.x, wrench.force.z);
        }
        let written = self.hand.write(now, wrench);
        self.drive();
        match (self.bug, written) {
            (Bug::WritesWhileOff, Written::Rejected(Rejection::ForcesOff))
            | (Bug::SaysAppliedWhenClamped, Written::Saturated { .. }) => return Written::Applied,
            (Bug::KeepsForceOnNan, Written::Rejected(Rejection::NotFinite)) => return written,
            _ => {}
        }
        self.last = if wrench.is_finite() {
            wrench
        } else {
            Wrench::ZERO
        };
        written
    }
    fn rendered(&self) -> Wrench {
        match self.bug {
            Bug::KeepsForceOnNan | Bug::RendersBeyondLimit
                if self.force_state() != ForceState::Off =>
            {
                self.last
            }
            _ => self.hand.rendered(),
        }
    }
    fn close(&mut self) {
        self.closed = true;
        self.hand.close();
        if self.bug != Bug::LeavesForceAtClose {
            self.drive();
        }
    }
}

/// The suite's report on a driver with `bug`, with a plug to pull or without.
fn report_of(bug: Bug, has_plug: bool) -> Report {
    let script = Script::resting_probe(Vector3::new(0.2, 0.0, 0.0), 0.004).unwrap();
    let hand = SimHand::new(script, ScriptStart::not_yet());
    let mut caps = hand.caps().clone();
    if bug == Bug::ForgetsCaps {
        caps.continuous_force_n = f64::NAN;
    }
    let world: Arc<World> = Arc::default();
    let mut device = Buggy {
        hand,
        caps,
        bug,
        last: Wrench::ZERO,
        reads: 0,
        closed: false,
        world: Arc::clone(&world),
    };
    let mut us = 0;
    let mut clock = || {
        us += 1000;
        DeviceTime::from_micros(us)
    };
    let mut unplug = || world.unplugged.store(true, Ordering::Release);
    let mut at_motors = || *world.motors.lock().unwrap();
    let mut amiss = || match bug {
        Bug::LeavesAnError => vec!["error 0x0402 was never asked for".to_owned()],
        _ => vec![],
    };
    let hooks = Hooks {
        unplug: has_plug.then_some(&mut unplug),
        at_motors: Some(&mut at_motors),
        amiss: Some(&mut amiss),
    };
    let options = Options {
        moves_under_force: true,
    };
    run_with(&mut device, &mut clock, options, hooks)
}

/// The laws that `bug` breaks.
fn broken_by(bug: Bug) -> Vec<&'static str> {
    let is_broken = |o: &Outcome| matches!(o, Outcome::Failed(_));
    // Closing under force is observed only if the plug was not pulled before.
    [true, false]
        .iter()
        .flat_map(|&has_plug| report_of(bug, has_plug).rows().to_vec())
        .filter(|r| is_broken(&r.outcome))
        .map(|r| r.law)
        .collect()
}

#[test]
fn each_bug_breaks_the_law_it_should() {
    assert_eq!(broken_by(Bug::None), Vec::<&str>::new());
    for (bug, word) in [
        (Bug::Millimetres, "poses are metres"),
        (Bug::ForgetsCaps, "caps are finite"),
        (Bug::WritesWhileOff, "forces off is rejected"),
        (Bug::KeepsForceOnNan, "not finite is rejected"),
        (Bug::SaysAppliedWhenClamped, "is clamped"),
        (Bug::SwapsAxes, "along its own axis"),
        (Bug::TimeRunsBackwards, "does not run backwards"),
        (Bug::RendersBeyondLimit, "is clamped"),
        (Bug::AnswersAfterClose, "closing"),
        (Bug::MotorsGetHalf, "motors get"),
        (Bug::LeavesForceAtClose, "closing"),
        (Bug::DoesNotSeeThePlug, "plug"),
        (Bug::KeepsForceWhenUnplugged, "plug"),
        (Bug::SwitchesOnUnplugged, "plug"),
        (Bug::LeavesAnError, "amiss"),
    ] {
        let broken = broken_by(bug);
        assert!(
            broken.iter().any(|law| law.contains(word)),
            "{bug:?} broke {broken:?}"
        );
    }
}

/// A pointer that claims to render force, or that moves on a cue.
struct Eager {
    pointer: Pointer,
    _view: PointerHandle,
    applies: bool,
    pushed: f64,
}

impl HapticDevice for Eager {
    fn caps(&self) -> &DeviceCaps {
        self.pointer.caps()
    }
    fn calibration(&self) -> Calibration {
        self.pointer.calibration()
    }
    fn clock(&self) -> ClockOwner {
        self.pointer.clock()
    }
    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.pointer.enable_forces(on)
    }
    fn force_state(&self) -> ForceState {
        self.pointer.force_state()
    }
    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        let mut sample = self.pointer.read(now)?;
        sample.pose.position.z += self.pushed;
        Ok(sample)
    }
    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        let written = self.pointer.write(now, wrench);
        if self.applies {
            Written::Applied
        } else {
            written
        }
    }
    fn cue(&mut self, _now: DeviceTime, felt: &Wrench) {
        if !self.applies {
            self.pushed = 1e-3 * felt.force.z;
        }
    }
    fn rendered(&self) -> Wrench {
        self.pointer.rendered()
    }
    fn close(&mut self) {
        self.pointer.close();
    }
}

#[test]
fn a_force_on_a_device_without_motors_is_caught() {
    for applies in [true, false] {
        let half = Vector3::repeat(0.1);
        let workspace = Workspace {
            min: -half,
            max: half,
        };
        let config = PointerConfig::new(workspace, palpate_device::Pose::default());
        let (pointer, view) = Pointer::new(&config).unwrap();
        let mut device = Eager {
            pointer,
            _view: view,
            applies,
            pushed: 0.0,
        };
        let mut us = 0;
        let mut clock = || {
            us += 1000;
            DeviceTime::from_micros(us)
        };
        let report = run(&mut device, &mut clock, Options::default());
        let caught = report.rows().iter().any(|row| {
            row.law.contains("without motors") && matches!(row.outcome, Outcome::Failed(_))
        });
        assert!(caught, "{report}");
    }
}
