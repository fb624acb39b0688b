//! Placement of a device in the scene.

use nalgebra::{UnitQuaternion, Vector3};

use crate::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, ForceState, HapticDevice, Pose,
    Sample, Workspace, Wrench, Written,
};

/// Pose of a device's frame in the scene. It has no scale: a millimetre of the hand is a millimetre of the tool,
/// and newtons are unchanged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// Rotation from the device's frame to the scene's.
    pub turn: UnitQuaternion<f64>,
    /// Position of the device's origin, m.
    pub origin: Vector3<f64>,
}

impl Default for Placement {
    /// The device's frame is the scene's.
    fn default() -> Self {
        Self {
            turn: UnitQuaternion::identity(),
            origin: Vector3::zeros(),
        }
    }
}

impl Placement {
    /// The placement with rotation `turn` and the device's `point` (m) at `at` (m) in the scene.
    pub fn with(turn: UnitQuaternion<f64>, point: Vector3<f64>, at: Vector3<f64>) -> Self {
        Self {
            turn,
            origin: at - turn * point,
        }
    }

    /// Transforms a pose from the device's frame to the scene's.
    pub fn to_scene(&self, pose: &Pose) -> Pose {
        Pose {
            position: self.turn * pose.position + self.origin,
            orientation: self.turn * pose.orientation,
        }
    }

    /// Transforms a pose from the scene's frame to the device's.
    pub fn to_device(&self, pose: &Pose) -> Pose {
        let back = self.turn.inverse();
        Pose {
            position: back * (pose.position - self.origin),
            orientation: back * pose.orientation,
        }
    }

    /// The box along the scene's axes around a workspace of the device.
    fn around(&self, workspace: &Workspace) -> Workspace {
        let (min, max) = (workspace.min, workspace.max);
        let corner =
            |k: usize| Vector3::from_fn(|i, _| if k >> i & 1 == 0 { min[i] } else { max[i] });
        let first = self.turn * corner(0) + self.origin;
        let mut around = Workspace {
            min: first,
            max: first,
        };
        for k in 1..8 {
            let at = self.turn * corner(k) + self.origin;
            around.min = around.min.inf(&at);
            around.max = around.max.sup(&at);
        }
        around
    }
}

/// A device with its placement; all its inputs and outputs are in the scene's frame.
pub struct Placed {
    device: Box<dyn HapticDevice>,
    placement: Placement,
    caps: DeviceCaps,
}

impl Placed {
    /// A device at a placement.
    pub fn new(device: Box<dyn HapticDevice>, placement: Placement) -> Self {
        let mut caps = device.caps().clone();
        caps.workspace = placement.around(&caps.workspace);
        Self {
            device,
            placement,
            caps,
        }
    }
}

fn turned(by: UnitQuaternion<f64>, wrench: Wrench) -> Wrench {
    Wrench {
        force: by * wrench.force,
        torque: by * wrench.torque,
    }
}

impl HapticDevice for Placed {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn calibration(&self) -> Calibration {
        self.device.calibration()
    }

    fn calibrate(&mut self) -> Result<Calibration, DeviceFault> {
        self.device.calibrate()
    }

    fn clock(&self) -> ClockOwner {
        self.device.clock()
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.device.enable_forces(on)
    }

    fn force_state(&self) -> ForceState {
        self.device.force_state()
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        let sample = self.device.read(now)?;
        let turn = self.placement.turn;
        Ok(Sample {
            pose: self.placement.to_scene(&sample.pose),
            velocity: turn * sample.velocity,
            angular_velocity: turn * sample.angular_velocity,
            ..sample
        })
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        let turn = self.placement.turn;
        match self.device.write(now, turned(turn.inverse(), wrench)) {
            Written::Saturated { applied } => Written::Saturated {
                applied: turned(turn, applied),
            },
            other => other,
        }
    }

    fn cue(&mut self, now: DeviceTime, felt: &Wrench) {
        let turn = self.placement.turn.inverse();
        self.device.cue(now, &turned(turn, *felt));
    }

    fn rendered(&self) -> Wrench {
        turned(self.placement.turn, self.device.rendered())
    }

    fn close(&mut self) {
        self.device.close();
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use proptest::prelude::*;

    use super::{Placed, Placement};
    use crate::backend::sim::{ScriptStart, SimHand};
    use crate::{DeviceTime, HapticDevice, Pose, Script, conformance};

    #[test]
    fn a_placed_device_passes_the_suite_in_the_frame_of_the_scene() {
        let script = Script::resting_probe(Vector3::new(0.1, 0.0, 0.0), 4e-3).unwrap();
        let mut caps = SimHand::new(script.clone(), ScriptStart::not_yet())
            .caps()
            .clone();
        caps.workspace.max = Vector3::repeat(0.5);
        caps.workspace.min = -caps.workspace.max;
        let hand = SimHand::with_caps(script, ScriptStart::not_yet(), caps);
        let placement = Placement {
            turn: UnitQuaternion::from_scaled_axis(Vector3::new(0.4, -1.0, 2.0)),
            origin: Vector3::new(0.3, 0.2, 0.9),
        };
        let mut us = 0;
        let mut clock = || {
            us += 1000;
            DeviceTime::from_micros(us)
        };
        let options = conformance::Options {
            moves_under_force: true,
        };
        let mut placed = Placed::new(Box::new(hand), placement);
        let report = conformance::run(&mut placed, &mut clock, options);
        assert!(report.passed(), "{report}");
    }

    proptest! {
        #[test]
        fn to_device_inverts_to_scene(
            turn in prop::array::uniform3(-3.0..3.0f64), origin in prop::array::uniform3(-1.0..1.0f64),
            at in prop::array::uniform3(-1.0..1.0f64), turned in prop::array::uniform3(-3.0..3.0f64),
        ) {
            let placement = Placement {
                turn: UnitQuaternion::from_scaled_axis(turn.into()),
                origin: origin.into(),
            };
            let pose = Pose {
                position: at.into(),
                orientation: UnitQuaternion::from_scaled_axis(turned.into()),
            };
            let back = placement.to_device(&placement.to_scene(&pose));
            prop_assert!((back.position - pose.position).norm() < 1e-12);
            prop_assert!(back.orientation.angle_to(&pose.orientation) < 1e-7);
        }
    }
}
