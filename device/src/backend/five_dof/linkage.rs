//! Both arms and the probe between their ends (equations 4.7 and 4.8).

use nalgebra::{Unit, UnitQuaternion, Vector3};

use super::arm::{Angles, Arm, Side};
use crate::OpenError;

/// The probe: its middle and its direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Probe {
    /// The pivot P between the two ends, m (4.7).
    pub pivot: Vector3<f64>,
    /// From the right end to the left one (4.8).
    pub axis: Unit<Vector3<f64>>,
    /// Distance between the two ends, m. On a consistent device it is the length of the probe.
    pub length_m: f64,
}

impl Probe {
    /// Orientation of the tool: identity along y, otherwise the shortest rotation to the axis. No motor measures
    /// the rotation about the axis.
    pub fn orientation(&self) -> UnitQuaternion<f64> {
        // For the direction opposite to y every perpendicular axis is valid.
        UnitQuaternion::rotation_between(&Vector3::y_axis(), &self.axis).unwrap_or_else(|| {
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
        })
    }
}

/// The lengths of a device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Linkage {
    /// The left arm and the right one.
    pub arms: [Arm; 2],
    /// Length of the probe between the arms' ends, m.
    pub probe_m: f64,
}

impl Default for Linkage {
    /// The device of 2007: L0 = 80, L1 = 150, L2 = 180 and a probe of 30 mm. Figure 4.1 gives the left arm an upper
    /// link of 180 mm, probably by mistake.
    fn default() -> Self {
        let arm = |side| Arm {
            side,
            offset_m: 0.08,
            upper_m: 0.15,
            lower_m: 0.18,
        };
        Self {
            arms: Side::BOTH.map(arm),
            probe_m: 0.03,
        }
    }
}

impl Linkage {
    /// Where the arms end, m.
    pub fn ends(&self, angles: &[Angles; 2]) -> [Vector3<f64>; 2] {
        [0, 1].map(|a| self.arms[a].end(&angles[a]))
    }

    /// The probe between the ends that these angles give.
    pub fn probe(&self, angles: &[Angles; 2]) -> Probe {
        let [left, right] = self.ends(angles);
        let across = left - right;
        Probe {
            pivot: (left + right) * 0.5,
            axis: Unit::try_new(across, 1e-12).unwrap_or_else(Vector3::y_axis),
            length_m: across.norm(),
        }
    }

    /// The angles that hold the probe at `pivot` (m) along `axis`.
    pub fn angles(
        &self,
        pivot: &Vector3<f64>,
        axis: &Unit<Vector3<f64>>,
    ) -> Result<[Angles; 2], OpenError> {
        let half = axis.into_inner() * (0.5 * self.probe_m);
        let of = |arm: &Arm, end: Vector3<f64>| {
            arm.angles(&end).ok_or_else(|| {
                let side = match arm.side {
                    Side::Left => "left",
                    Side::Right => "right",
                };
                let [x, y, z]: [f64; 3] = (end * 1e3).into();
                OpenError::new(format_args!(
                    "the {side} arm can not reach ({x:.1}, {y:.1}, {z:.1}) mm"
                ))
            })
        };
        Ok([
            of(&self.arms[0], pivot + half)?,
            of(&self.arms[1], pivot - half)?,
        ])
    }

    /// The smaller manipulability of both arms, 0 to 1.
    pub fn manipulability(&self, angles: &[Angles; 2]) -> f64 {
        let of = |a: usize| self.arms[a].manipulability(&angles[a]);
        of(0).min(of(1))
    }

    /// Velocity of the pivot (m/s) and angular velocity of the probe across its axis (rad/s), for angles that change
    /// at `rates` (rad/s).
    pub fn velocity(
        &self,
        angles: &[Angles; 2],
        rates: &[Angles; 2],
    ) -> (Vector3<f64>, Vector3<f64>) {
        let of = |a: usize| self.arms[a].jacobian(&angles[a]) * rates[a];
        let (left, right) = (of(0), of(1));
        let probe = self.probe(angles);
        let across = (left - right) / probe.length_m.max(1e-3 * self.probe_m);
        ((left + right) * 0.5, probe.axis.cross(&across))
    }
}
