//! Limits the steps of a picture after a stall of the network.
//!
//! ```text
//! a tool returns from a hold   x moves towards the solved u by at most 0.5 mm per frame
//! afterwards                   x = u + e, and the difference e shrinks by 0.5 mm per frame
//! ```
//!
//! Tissue and forces follow the solved shape at once. Without a stall a picture shows it unchanged.

use std::collections::BTreeMap;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use palpate_protocol::{ParticipantId, Pose};

use crate::tool_code::{ShownTool, ToolPose};

/// Largest step of a displayed point towards the solved one in a frame, m.
const STEP_MAX_M: f64 = 0.5e-3;

/// The same of a rotation, rad: that step at the end of a tool of 50 mm.
const TURN_MAX: f64 = STEP_MAX_M / 0.05;

/// A displayed point.
#[derive(Debug, Clone, Copy)]
struct Point {
    last: Vector3<f32>,
    /// The displayed point minus the solved one.
    off: Vector3<f32>,
}

impl Point {
    fn show(&mut self, solved: Vector3<f32>, returns: bool) -> Vector3<f32> {
        let off = if returns {
            self.last - solved
        } else {
            self.off
        };
        let left = (off.norm() - STEP_MAX_M as f32).max(0.0);
        self.off = off.try_normalize(0.0).unwrap_or_default() * left;
        self.last = solved + self.off;
        self.last
    }
}

/// Displayed points of a list.
#[derive(Debug, Default)]
pub(crate) struct PointLimits {
    points: Vec<Point>,
}

impl PointLimits {
    /// Limits the steps of points since the last frame. The limit begins again with a list of another length.
    pub(crate) fn limit(&mut self, points: &mut [[f32; 3]], returns: bool) {
        if self.points.len() != points.len() {
            let start = |at: &[f32; 3]| Point {
                last: (*at).into(),
                off: Vector3::zeros(),
            };
            self.points = points.iter().map(start).collect();
            return;
        }
        for (point, at) in self.points.iter_mut().zip(points) {
            *at = point.show((*at).into(), returns).into();
        }
    }
}

/// Displayed poses of the shared tools.
#[derive(Debug, Default)]
pub(crate) struct ToolLimits {
    tools: BTreeMap<ParticipantId, (Point, UnitQuaternion<f64>, UnitQuaternion<f64>)>,
}

impl ToolLimits {
    /// Limits the steps of tools since the last frame. A tool that appears starts at its pose.
    pub(crate) fn limit(&mut self, tools: &mut [ToolPose]) {
        let is_shared = |tool: &&mut ToolPose| tool.shown == ShownTool::Shared && tool.is_active;
        let mut shown = BTreeMap::new();
        for tool in tools.iter_mut().filter(is_shared) {
            let at = Vector3::from(tool.pose.position_m);
            let turn = rotation(&tool.pose);
            let known = self.tools.get(&tool.participant).copied();
            let (mut point, last, off) = known.unwrap_or_else(|| {
                let still = Point {
                    last: at.cast(),
                    off: Vector3::zeros(),
                };
                (still, turn, UnitQuaternion::identity())
            });
            let moved = point.show(at.cast(), tool.returns);
            let off = if tool.returns {
                last * turn.inverse()
            } else {
                off
            };
            let off = UnitQuaternion::from_scaled_axis({
                let left = (off.angle() - TURN_MAX).max(0.0);
                off.axis()
                    .map_or_else(Vector3::zeros, |axis| axis.into_inner() * left)
            });
            if point.off != Vector3::zeros() {
                tool.pose.position_m = moved.cast().into();
            }
            let turned = off * turn;
            if off != UnitQuaternion::identity() {
                tool.pose.orientation = turned.coords.into();
            }
            shown.insert(tool.participant, (point, turned, off));
        }
        self.tools = shown;
    }
}

fn rotation(pose: &Pose) -> UnitQuaternion<f64> {
    let [x, y, z, w] = pose.orientation;
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn distance(a: [f32; 3], b: [f32; 3]) -> f64 {
        f64::from((Vector3::from(a) - Vector3::from(b)).norm())
    }

    #[test]
    fn points_after_a_stall_step_by_half_a_millimetre_and_reach_the_solved_ones() {
        let mut limits = PointLimits::default();
        // Moves on at 0.2 mm per frame; a stall displaces it by 10 mm within six frames.
        let solved = |k: i32| {
            let jump = 10.0 * (f64::from(k - 20) / 6.0).clamp(0.0, 1.0);
            [(0.2e-3 * f64::from(k)) as f32, 0.0, (-1e-3 * jump) as f32]
        };
        let mut last = solved(0);
        for k in 0..100 {
            let mut points = [solved(k), [0.0; 3]];
            let returns = (20..32).contains(&k);
            limits.limit(&mut points, returns);
            let step = distance(points[0], last);
            assert!(
                step <= 0.5e-3 + if returns { 1e-8 } else { 0.2e-3 + 1e-8 },
                "{k}: {step}"
            );
            let exact = !(20..41).contains(&k);
            assert!(
                !exact || distance(points[0], solved(k)) < 1e-8,
                "{k}: {points:?}"
            );
            assert_eq!(points[1], [0.0; 3]);
            last = points[0];
        }
    }

    #[test]
    fn points_without_a_stall_are_shown_as_solved_at_any_speed() {
        let mut limits = PointLimits::default();
        for k in 0..50 {
            let solved = [3e-3 * k as f32, 0.0, 0.0];
            let mut points = [solved];
            limits.limit(&mut points, false);
            assert_eq!(points, [solved]);
        }
    }

    #[test]
    fn tool_after_a_stall_moves_and_turns_within_the_limits() {
        let mut limits = ToolLimits::default();
        let pose = |k: i32| {
            let there = if k < 10 { 0.0 } else { 1.0 };
            let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * there);
            Pose {
                position_m: [0.04 * there, 0.0, 0.0],
                orientation: turn.coords.into(),
            }
        };
        let mut last = pose(0);
        for k in 0..200 {
            let tool = |participant, returns| ToolPose {
                participant: ParticipantId(participant),
                is_active: true,
                pose: pose(k),
                returns,
                ..ToolPose::default()
            };
            let mut tools = [tool(1, (10..22).contains(&k)), tool(2, false)];
            limits.limit(&mut tools);
            let shown = tools[0].pose;
            let step = (Vector3::from(shown.position_m) - Vector3::from(last.position_m)).norm();
            let turned = rotation(&shown).angle_to(&rotation(&last));
            assert!(
                step <= STEP_MAX_M + 1e-8 && turned <= TURN_MAX + 1e-9,
                "{k}: {step}, {turned}"
            );
            assert_eq!(tools[1].pose, pose(k), "a tool that does not return");
            last = shown;
        }
        assert_eq!(last, pose(199));
    }
}
