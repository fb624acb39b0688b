//! A script as a function of time.

use nalgebra::{UnitQuaternion, Vector3};

use super::{Ease, Script, Waypoint};
use crate::Pose;

/// Pose and velocity of a script at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScriptPose {
    /// Position and orientation.
    pub pose: Pose,
    /// Velocity of the tip, m/s.
    pub velocity: Vector3<f64>,
    /// Angular velocity, rad/s, in the frame of the scene.
    pub angular_velocity: Vector3<f64>,
    /// Whether the primary button is held.
    pub button: bool,
}

impl ScriptPose {
    fn resting(way: &Waypoint) -> Self {
        Self {
            pose: Pose {
                position: way.position,
                orientation: way.orientation,
            },
            velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
            button: way.button,
        }
    }
}

impl Script {
    /// The script at `t_s` seconds. Any time is valid, also a negative one; NaN counts as before the first way
    /// point. Does not allocate.
    pub fn pose(&self, t_s: f64) -> ScriptPose {
        let waypoints = self.waypoints();
        let (first, last) = (&waypoints[0], &waypoints[waypoints.len() - 1]);
        let t_s = if self.repeats() && t_s > last.t_s {
            first.t_s + (t_s - first.t_s).rem_euclid(last.t_s - first.t_s)
        } else {
            t_s
        };
        // The first way point later than t_s; the segment before it is active.
        let next = waypoints.partition_point(|way| way.t_s <= t_s);
        if next == 0 || t_s.is_nan() {
            // No button is held before the script begins.
            return ScriptPose {
                button: false,
                ..ScriptPose::resting(first)
            };
        }
        match waypoints.get(next) {
            None => ScriptPose::resting(last),
            Some(to) => between(&waypoints[next - 1], to, t_s),
        }
    }
}

/// The motion between two way points at `t_s`.
fn between(from: &Waypoint, to: &Waypoint, t_s: f64) -> ScriptPose {
    let duration = to.t_s - from.t_s;
    let u = (t_s - from.t_s) / duration;
    let (s, ds_du) = match to.ease {
        Ease::Linear => (u, 1.0),
        Ease::MinimumJerk => (
            u * u * u * (10.0 + u * (6.0 * u - 15.0)),
            30.0 * u * u * (1.0 - u) * (1.0 - u),
        ),
    };
    let ds_dt = ds_du / duration;
    let path = to.position - from.position;
    // The shorter rotation, as one axis and one angle.
    let turn = from.orientation.rotation_to(&to.orientation).scaled_axis();
    ScriptPose {
        pose: Pose {
            position: from.position + path * s,
            orientation: UnitQuaternion::new(turn * s) * from.orientation,
        },
        velocity: path * ds_dt,
        angular_velocity: turn * ds_dt,
        button: from.button,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use proptest::prelude::*;

    use super::super::{Hand, Script, Tool, Waypoint};

    fn script(repeat: bool) -> Script {
        let tool = Tool::probe(0.004);
        let turn = UnitQuaternion::new(Vector3::new(0.0, 0.3, 1.0));
        let waypoints = vec![
            Waypoint::new(0.5, Vector3::new(0.0, 0.0, 0.08)),
            Waypoint::new(1.5, Vector3::new(0.01, 0.0, 0.04))
                .pressed()
                .turned(turn),
            Waypoint::new(2.0, Vector3::new(0.05, -0.02, 0.04)).linear(),
            Waypoint::new(4.0, Vector3::new(0.0, 0.0, 0.08)),
        ];
        Script::new(tool, Hand::default(), waypoints, repeat).unwrap()
    }

    #[test]
    fn before_the_first_and_after_the_last_it_stays() {
        let s = script(false);
        for t in [f64::NEG_INFINITY, -5.0, 0.5, f64::NAN] {
            assert_eq!(s.pose(t).pose.position, s.waypoints()[0].position, "{t}");
        }
        assert_eq!(s.pose(1e5).pose.position, s.waypoints()[3].position);
        assert_eq!(s.pose(1e5).velocity, Vector3::zeros());
    }

    #[test]
    fn the_button_is_held_from_its_way_point_on() {
        let s = script(false);
        assert!(!s.pose(1.49).button && s.pose(1.5).button && s.pose(1.99).button);
        assert!(!s.pose(2.01).button);
    }

    #[test]
    fn a_repeated_script_has_its_period() {
        let s = script(true);
        for t in [0.6, 1.2, 1.7, 3.9] {
            let (a, b) = (s.pose(t), s.pose(t + 7.0));
            assert!((a.pose.position - b.pose.position).norm() < 1e-12, "{t}");
        }
    }

    #[test]
    fn minimum_jerk_is_at_rest_at_both_ends_and_fastest_between() {
        let s = script(false);
        assert!(s.pose(0.5 + 1e-6).velocity.norm() < 1e-9);
        assert!(s.pose(1.5 - 1e-6).velocity.norm() < 1e-9);
        // Peak speed is 15/8 of the mean.
        let mean = (s.waypoints()[1].position - s.waypoints()[0].position).norm();
        assert!((s.pose(1.0).velocity.norm() / mean - 15.0 / 8.0).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn velocity_is_the_derivative_of_position(t in 0.0f64..4.5) {
            let s = script(false);
            let h = 1e-6;
            // Not across a corner, where a linear piece begins or ends.
            prop_assume!(s.waypoints().iter().all(|w| (w.t_s - t).abs() > 2.0 * h));
            let (a, b) = (s.pose(t - h), s.pose(t + h));
            let numeric = (b.pose.position - a.pose.position) / (2.0 * h);
            prop_assert!((numeric - s.pose(t).velocity).norm() < 1e-6);
            let turn = a.pose.orientation.rotation_to(&b.pose.orientation).scaled_axis() / (2.0 * h);
            prop_assert!((turn - s.pose(t).angular_velocity).norm() < 1e-4);
        }
    }
}
