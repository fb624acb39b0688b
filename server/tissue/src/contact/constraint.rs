//! Bounds of a tool's motion by the tissue it touches, and the nearest motion within them.
//!
//! A proxy keeps the outside of the tissue as a god-object does (Zilles and Salisbury 1995): of all motions that leave no
//! sample deeper than a bound, it takes the one nearest to the way to its tool,
//!
//! ```text
//! min |m - w|²   with   g_i · m <= room_i          (Hildreth 1957: coordinate ascent of the dual problem)
//! ```
//!
//! Motions join a translation and a rotation vector times the lever of the tool, both in m.

use crate::Vec3;

/// A translation, and a rotation vector times the tool's lever, in m.
pub(super) type Motion = [Vec3; 2];

/// Maximum number of sweeps over the constraints. A motion that still exceeds one is shortened.
const SWEEPS: usize = 30;

/// A bound of a tool's motion by one sample.
#[derive(Debug, Clone)]
pub(super) struct Constraint {
    /// Gradient of the sample's depth by the motion.
    pub(super) gradient: Motion,
    /// Growth of the depth allowed, in m; at least minus the slack.
    pub(super) room: f64,
}

impl Constraint {
    /// How far a motion exceeds it, in m.
    fn excess(&self, motion: &Motion) -> f64 {
        dot(&self.gradient, motion) - self.room
    }
}

pub(super) fn length(motion: &Motion) -> f64 {
    motion[0].norm().hypot(motion[1].norm())
}

pub(super) fn dot(a: &Motion, b: &Motion) -> f64 {
    a[0].dot(&b[0]) + a[1].dot(&b[1])
}

/// The motion nearest to `way` within all constraints, up to `slack` m. No motion at all is such a motion.
pub(super) fn nearest_motion(way: Motion, constraints: &[Constraint], slack: f64) -> Motion {
    let mut motion = way;
    let mut multipliers = vec![0.0_f64; constraints.len()];
    for _ in 0..SWEEPS {
        let mut change = 0.0_f64;
        for (c, multiplier) in constraints.iter().zip(&mut multipliers) {
            let by = c.excess(&motion) / dot(&c.gradient, &c.gradient);
            let by = by.max(-*multiplier);
            if by != 0.0 {
                *multiplier += by;
                motion = [0, 1].map(|k| motion[k] - c.gradient[k] * by);
                change = change.max(by.abs());
            }
        }
        if change <= 0.1 * slack {
            break;
        }
    }
    let share = constraints.iter().fold(1.0_f64, |share, c| {
        let along = dot(&c.gradient, &motion);
        share.min(if along > c.room + slack {
            (c.room + slack) / along
        } else {
            1.0
        })
    });
    motion.map(|part| part * share)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn vector() -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-1.0..1.0f64).prop_map(Vec3::from)
    }

    fn constraint() -> impl Strategy<Value = Constraint> {
        let unit = vector().prop_filter("too short", |v| v.norm() > 0.1);
        (unit, vector(), prop_oneof![Just(0.0), 0.0..1.0f64]).prop_map(|(n, turn, room)| {
            let gradient = [n.normalize(), turn];
            Constraint { gradient, room }
        })
    }

    proptest! {
        #[test]
        fn motion_keeps_every_constraint_and_never_leads_away_from_the_way(
            way in prop::array::uniform2(prop::array::uniform3(-1.0..1.0f64)),
            constraints in prop::collection::vec(constraint(), 0..40),
        ) {
            let way = way.map(Vec3::from);
            let motion = nearest_motion(way, &constraints, 1e-3);
            for c in &constraints {
                prop_assert!(c.excess(&motion) <= 1e-3 + 1e-12);
            }
            prop_assert!(length(&motion) <= length(&way) * (1.0 + 1e-9) + 1e-3);
            prop_assert!(dot(&motion, &way) >= -0.02, "{}", dot(&motion, &way));
            if constraints.iter().all(|c| c.excess(&way) <= 0.0) {
                prop_assert_eq!(motion, way);
            }
        }

        /// The projection on a wedge of two planes, in closed form.
        #[test]
        fn motion_along_one_plane_or_the_edge_of_two_is_the_projection(
            way in prop::array::uniform3(-1.0..1.0f64), half_angle in 0.3..1.2f64,
        ) {
            let way = Vec3::from(way);
            let (sin, cos) = half_angle.sin_cos();
            let planes = [Vec3::new(sin, cos, 0.0), Vec3::new(-sin, cos, 0.0)];
            let constraints = planes.map(|n| Constraint { gradient: [n, Vec3::zeros()], room: 0.0 });
            let motion = nearest_motion([way, Vec3::zeros()], &constraints, 1e-6)[0];
            let keeps = |m: &Vec3| planes.iter().all(|n| n.dot(m) <= 1e-12);
            let on_planes = planes.map(|n| way - n * n.dot(&way));
            let along = Vec3::z() * way.z;
            let all = [way, on_planes[0], on_planes[1], along];
            let nearest = all.into_iter().filter(keeps).min_by(|a, b| {
                (a - way).norm().total_cmp(&(b - way).norm())
            });
            prop_assert!((motion - nearest.unwrap()).norm() < 1e-3, "{} {:?}", motion, nearest);
        }
    }
}
