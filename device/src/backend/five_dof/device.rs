//! The driver as a [`HapticDevice`](crate::HapticDevice): counts become a pose, a wrench becomes codes.

use nalgebra::{UnitQuaternion, Vector3};

use super::arm::Angles;
use super::linkage::Linkage;
use super::map::Middle;
use super::port::{Port, PortFault, Six};
use super::rates::Rate;
use super::signals::{Drive, Encoder};
use super::statics::{Torques, torques};
use crate::motors::Motors;
use crate::{
    Calibration, DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, OpenError,
    Pose, Rejection, Sample, Wrench, Written,
};

/// Tolerance of the distance between the two ends against the probe's length, m. Six readings give five independent
/// numbers; the sixth is a consistency check. One count at all six motors is 0.3 mm.
pub const PROBE_TOLERANCE_M: f64 = 2e-3;

/// Ramp time of the force after enabling, µs.
const RAMP_US: i64 = 200_000;

/// Parts of the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Config {
    /// Lengths of arms and probe.
    pub linkage: Linkage,
    /// The encoders, all alike.
    pub encoder: Encoder,
    /// Conversion from a code to a torque, alike for all motors.
    pub drive: Drive,
    /// Maximum force, N, peak and continuous.
    pub force_n: [f64; 2],
    /// Maximum torque about the pivot, N·m.
    pub torque_nm: f64,
    /// Maximum stable stiffness.
    pub stiffness_n_per_m: f64,
}

/// The 5-DOF device behind its boards.
#[derive(Debug)]
pub struct FiveDof<P: Port> {
    pub(super) port: P,
    config: Config,
    caps: DeviceCaps,
    middle: Middle,
    pub(super) angles: [Angles; 2],
    rates: [Rate; 6],
    motors: Motors,
}

impl<P: Port> FiveDof<P> {
    /// The device behind these boards. Its workspace is the largest cube around the middle of its reach in which the
    /// probe may be tilted by [`TILT_RAD`](super::map::TILT_RAD) without coming close to a singular posture.
    pub fn open(port: P, config: Config) -> Result<Self, OpenError> {
        let middle = Middle::of(&config.linkage)?;
        let caps = DeviceCaps {
            name: "5-DOF device".to_owned(),
            dof_in: 5,
            dof_out: 5,
            workspace: middle.workspace(),
            max_force_n: config.force_n[0],
            continuous_force_n: config.force_n[1],
            max_torque_nm: config.torque_nm,
            max_stiffness_n_per_m: config.stiffness_n_per_m,
            rate_hz: 1000.0,
        };
        let step = config.encoder.step_rad();
        Ok(Self {
            port,
            caps,
            angles: middle.angles,
            middle,
            rates: std::array::from_fn(|_| Rate::new(step)),
            motors: Motors::new(RAMP_US),
            config,
        })
    }

    /// Applies `torques`; sets zero when the boards do not take them.
    fn drive(&mut self, torques: &[Vector3<f64>; 2]) -> Result<(), PortFault> {
        let drive = self.config.drive;
        let codes = six(|arm, k| drive.code(torques[arm][k]));
        self.port.command(self.motors.now(), codes)
    }

    /// Zero torque, forces off. After an error the boards may not have received it.
    fn stop(&mut self) -> Result<(), PortFault> {
        self.motors.stop();
        self.drive(&[Vector3::zeros(); 2])
    }

    /// Motor torques for the wrench at the present posture.
    fn torques(&self, wrench: &Wrench) -> Torques {
        let limit = self.config.drive.limit_nm;
        torques(&self.config.linkage, &self.angles, wrench, limit)
    }

    /// Renders `wrench` scaled by the ramp.
    fn render(&mut self, wrench: Wrench) -> Result<Torques, PortFault> {
        let gain = self.motors.gain();
        let torques = self.torques(&wrench);
        self.drive(&torques.nm.map(|t| t * gain))?;
        Ok(torques)
    }

    fn refuse(&mut self, why: Rejection) -> Written {
        self.motors.render_only(Wrench::ZERO);
        let zero = self.drive(&[Vector3::zeros(); 2]);
        Written::Rejected(zero.err().map_or(why, rejection))
    }
}

impl<P: Port> HapticDevice for FiveDof<P> {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn calibration(&self) -> Calibration {
        if self.port.is_homed() {
            Calibration::Done
        } else {
            Calibration::NeedsUser
        }
    }

    /// Takes the present posture as the calibration posture: the probe in the middle of the workspace, along y.
    /// Hold it in its rest meanwhile.
    fn calibrate(&mut self) -> Result<Calibration, DeviceFault> {
        self.motors.check_open()?;
        let (encoder, at) = (self.config.encoder, self.middle.angles);
        let counts = six(|arm, k| encoder.count(at[arm][k]));
        // Codes computed for the old posture would push in another direction.
        self.stop()?;
        self.port.set_counts(counts)?;
        self.angles = at;
        self.rates.iter_mut().for_each(Rate::clear);
        Ok(self.calibration())
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.motors.check_open()?;
        self.stop()?;
        if on && !self.calibration().is_ready() {
            return Err(DeviceFault::NotCalibrated);
        }
        self.motors.enable(on)
    }

    fn force_state(&self) -> ForceState {
        self.motors.state()
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        let now = self.motors.advance_to(now)?;
        let counts = match self.port.counts(now) {
            Ok(counts) => counts,
            Err(fault) => {
                // The error is already reported; the next reading or order tries zero again.
                let _ = self.stop();
                return Err(fault.into());
            }
        };
        let encoder = self.config.encoder;
        let time = now.as_secs_f64();
        let mut rates = [Vector3::zeros(); 2];
        for (j, &count) in counts.iter().enumerate() {
            let angle = encoder.angle(count);
            self.angles[j / 3][j % 3] = angle;
            rates[j / 3][j % 3] = self.rates[j].read(time, angle);
        }
        let linkage = &self.config.linkage;
        let probe = linkage.probe(&self.angles);
        let mut faults = Faults::NONE;
        // NaN is outside the tolerance.
        let sound = (probe.length_m - linkage.probe_m).abs() <= PROBE_TOLERANCE_M;
        let homed = self.calibration().is_ready();
        if !(sound && homed) {
            faults = faults.with(Faults::UNTRUSTED_POSE);
        }
        if !self.caps.workspace.contains(&probe.pivot) {
            faults = faults.with(Faults::OUT_OF_WORKSPACE);
        }
        let (velocity, angular_velocity) = linkage.velocity(&self.angles, &rates);
        if !homed && !self.motors.are_off() {
            // Boards that lost their counts under force.
            self.stop()?;
        }
        Ok(Sample {
            time: now,
            pose: Pose {
                position: probe.pivot,
                orientation: UnitQuaternion::new_normalize(probe.orientation().into_inner()),
            },
            velocity,
            angular_velocity,
            buttons: self.port.buttons(now),
            gripper: None,
            faults,
        })
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        if self.motors.advance_to(now).is_err() {
            return Written::Rejected(Rejection::Closed);
        }
        if let Err(why) = self.motors.ready() {
            return self.refuse(why);
        }
        // The device can not render a torque about the probe's own axis.
        let axis = self.config.linkage.probe(&self.angles).axis.into_inner();
        let about_itself = wrench.torque.dot(&axis);
        let possible = Wrench {
            torque: wrench.torque - axis * about_itself,
            ..wrench
        };
        let (within, clamped) = match self.motors.take(now, possible, &self.caps) {
            Ok(taken) => taken,
            Err(why) => return self.refuse(why),
        };
        let torques = match self.render(within) {
            Ok(torques) => torques,
            Err(fault) => {
                let _ = self.stop();
                return Written::Rejected(rejection(fault));
            }
        };
        let applied = within.scaled(torques.share);
        self.motors.render_only(applied);
        let left_out = about_itself.abs() > 1e-9;
        if clamped || left_out || torques.share < 1.0 {
            Written::Saturated { applied }
        } else {
            Written::Applied
        }
    }

    fn rendered(&self) -> Wrench {
        self.motors.rendered()
    }

    fn close(&mut self) {
        if self.motors.check_open().is_ok() {
            // A board that did not take the first zero may take the second; the port closes with zero, too.
            if self.stop().is_err() {
                let _ = self.stop();
            }
            self.port.close();
            self.motors.close();
        }
    }
}

impl<P: Port> Drop for FiveDof<P> {
    fn drop(&mut self) {
        self.close();
    }
}

/// A number per motor, of its arm and its place in it.
fn six(of: impl Fn(usize, usize) -> i32) -> Six {
    std::array::from_fn(|j| of(j / 3, j % 3))
}

fn rejection(fault: PortFault) -> Rejection {
    match fault {
        PortFault::Gone => Rejection::Driver { code: -1 },
        PortFault::Board(code) => Rejection::Driver { code },
    }
}
