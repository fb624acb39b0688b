//! Conversions between protocol and tissue types.

use nalgebra::{Quaternion, UnitQuaternion};
use palpate_protocol::operation::{BladePoint, CutStroke};
use palpate_protocol::{ParticipantId, Pose};
use palpate_tissue::{StrokePart, Vec3};

/// A part of an author's stroke as the tissue's type.
pub fn tissue_stroke(author: ParticipantId, part: &CutStroke) -> StrokePart {
    StrokePart {
        path: palpate_tissue::CutStroke {
            points: part.points.iter().map(tissue_blade).collect(),
            width_m: part.width_m,
        },
        stroke: Some(part.number(author)),
        joins: part.joins,
    }
}

fn tissue_blade(p: &BladePoint) -> palpate_tissue::BladePoint {
    palpate_tissue::BladePoint {
        tip: Vec3::from(p.tip_m),
        axis: Vec3::from(p.axis),
        depth_m: p.depth_m,
    }
}

/// The blade of a tool at `pose`, for the protocol. Its edge lies along the tool's z axis, from the tip up; the axis
/// points up, against the depth, as the tissue expects.
pub(super) fn wire_blade(pose: &Pose, length_m: f64) -> BladePoint {
    BladePoint {
        tip_m: pose.position_m,
        axis: (orientation(pose) * Vec3::z()).into(),
        depth_m: length_m,
    }
}

/// The rotation of a protocol pose; identity if the quaternion is invalid.
pub(crate) fn orientation(pose: &Pose) -> UnitQuaternion<f64> {
    let [x, y, z, w] = pose.orientation;
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn top_of_upright_blade_is_above_its_tip() {
        let pose = Pose {
            position_m: [0.01, 0.02, 0.03],
            ..Pose::IDENTITY
        };
        let blade = wire_blade(&pose, 0.02);
        assert!(blade.is_valid());
        assert_eq!(blade.axis, [0.0, 0.0, 1.0]);
        let top = tissue_blade(&blade).top();
        assert!((top - Vec3::new(0.01, 0.02, 0.05)).norm() < 1e-12);
    }

    #[test]
    fn blade_rotated_about_x_leans() {
        let half = std::f64::consts::FRAC_PI_4;
        let pose = Pose {
            orientation: [half.sin(), 0.0, 0.0, half.cos()],
            ..Pose::IDENTITY
        };
        // A quarter turn about x takes z to -y.
        let blade = wire_blade(&pose, 0.01);
        assert!((Vec3::from(blade.axis) + Vec3::y()).norm() < 1e-12);
    }
}
