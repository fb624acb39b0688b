//! Predictor for a led shape: a parabola through the last converged shapes.
//!
//! Equilibrium follows smoothly moving held nodes on a smooth path. The warm start repeats the last increment, with an
//! error of second order in the step. A correction determines the curvature: a correction c after m extrapolated steps
//! changes the second difference by 2 c / (m (m + 1)). The remaining error is of third order. A cube that needed an
//! iteration in every third step of a press then needs one in all of it.

use super::quad::make_room;
use crate::Vec3;

/// Minimum distance m (m + 1) / 2 between two converged shapes for a correction to update the curvature.
const APART: f64 = 0.9;

/// Fraction of the residual that a correction must remove to count in full.
const SURE: f64 = 0.75;

/// Predictor state of a node.
#[derive(Clone, Copy)]
struct NodeCurve {
    node: u32,
    /// Increment predicted in this step, in m.
    predicted: [f32; 3],
    /// Second difference for steps of this length, in m.
    second_difference: [f32; 3],
}

impl NodeCurve {
    const UNKNOWN: Self = Self {
        node: u32::MAX,
        predicted: [0.0; 3],
        second_difference: [0.0; 3],
    };
}

/// The predicted path of a shape.
#[derive(Default)]
pub(super) struct Predictor {
    /// In order of nodes.
    curves: Vec<NodeCurve>,
    /// Steps of the current length since the last converged shape.
    since: f64,
    /// Fraction of the extrapolation residual that the iterations of this step removed, if any were made.
    solved: Option<f64>,
}

impl Predictor {
    /// Discards the path: the shape is not extrapolated.
    pub(super) fn discard(&mut self) {
        self.curves.clear();
        self.since = 0.0;
        self.solved = None;
    }

    /// Marks the step as not on the path: its correction does not update the curvature.
    pub(super) fn skip_correction(&mut self) {
        self.since = 0.0;
    }

    /// Records the fraction of the extrapolation residual that iterations removed.
    pub(super) fn record_solve(&mut self, part: f64) {
        self.solved = Some((part / SURE).clamp(0.0, 1.0));
    }

    /// Reserves memory for so many nodes, so that the first extrapolation does not allocate.
    pub(super) fn make_room(&mut self, nodes: usize) {
        make_room(&mut self.curves, NodeCurve::UNKNOWN, nodes);
    }

    /// Replaces the last increments by the predicted ones. `made` is the part of an increment that the last step made;
    /// `share` is the length of the next step relative to it. Nodes without `bends` are extrapolated linearly.
    pub(super) fn predict(
        &mut self,
        increments: &mut [(u32, Vec3)],
        made: f64,
        share: f64,
        bends: impl Fn(u32) -> bool,
    ) {
        let far = self.since * (self.since + 1.0) / 2.0;
        let (mut sharper, mut faster) = (0.0, 0.0);
        if let Some(part) = self.solved.take() {
            if far >= APART {
                sharper = part / far;
                faster = 2.0 / self.since - 1.0;
                // After an incomplete solve, the correction of a single step is as much error as curvature.
                faster *= if faster > 0.0 { part } else { 1.0 };
            }
            self.since = 0.0;
        }
        self.since = self.since / share + 1.0;
        self.join(increments);
        for ((node, by), curve) in increments.iter_mut().zip(&mut self.curves) {
            if !bends(*node) {
                *by *= made;
                curve.predicted = [0, 1, 2].map(|a| (by[a] * share) as f32);
                curve.second_difference = [0.0; 3];
                continue;
            }
            for a in 0..3 {
                let last = by[a] * made;
                let correction = last - f64::from(curve.predicted[a]);
                let old = f64::from(curve.second_difference[a]);
                let second_difference = old + correction * sharper;
                by[a] =
                    last + old + correction * faster + second_difference * ((share - 1.0) / 2.0);
                curve.predicted[a] = (by[a] * share) as f32;
                curve.second_difference[a] = (second_difference * (share * share)) as f32;
            }
        }
    }

    /// Aligns the states with the moving nodes; new nodes start without curvature.
    fn join(&mut self, increments: &[(u32, Vec3)]) {
        let nodes = self.curves.iter().map(|c| c.node);
        if nodes.eq(increments.iter().map(|m| m.0)) {
            return;
        }
        let before = self.curves.clone();
        let mut known = before.iter().peekable();
        self.curves.clear();
        self.curves.extend(increments.iter().map(|&(node, by)| {
            while known.next_if(|k| k.node < node).is_some() {}
            let same = known.next_if(|k| k.node == node).copied();
            same.unwrap_or(NodeCurve {
                node,
                predicted: [0, 1, 2].map(|a| by[a] as f32),
                second_difference: [0.0; 3],
            })
        }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Predicts a curve over steps of these lengths; every `every` steps a correction moves the node onto it. Returns
    /// the error after each step.
    fn predict_curve(curve: impl Fn(f64) -> Vec3, steps: &[f64], every: usize) -> Vec<f64> {
        let mut path = Predictor::default();
        let (mut s, mut at) = (1.0, curve(1.0));
        let (mut increments, mut made) = (vec![(7, at - curve(0.0))], 1.0);
        let mut last = 1.0;
        let mut off = Vec::new();
        for (k, &step) in steps.iter().enumerate() {
            let share = step / last;
            path.predict(&mut increments, made, share, |_| true);
            made = share;
            (s, last) = (s + step, step);
            let start = at;
            at += increments[0].1 * share;
            if (k + 1) % every == 0 {
                at = curve(s);
                path.record_solve(1.0);
                (increments[0].1, made) = (at - start, 1.0);
            }
            off.push((at - curve(s)).norm());
        }
        off
    }

    fn vector() -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-1e-3..1e-3f64).prop_map(Vec3::from)
    }

    proptest! {
        #[test]
        fn parabola_is_predicted_after_the_first_correction(
            (v, a) in (vector(), vector()),
            every in 1usize..6,
        ) {
            let curve = |s: f64| v * s + a * (0.1 * s * s);
            let off = predict_curve(curve, &[1.0; 12], every);
            for off in &off[every..] {
                prop_assert!(*off < 1e-8, "{off}");
            }
        }

        #[test]
        fn parabola_is_predicted_in_steps_of_any_length_and_direction(
            (v, a) in (vector(), vector()),
            steps in prop::collection::vec(0.7..1.4f64, 8),
        ) {
            let curve = |s: f64| v * s + a * (0.1 * s * s);
            let mut all = vec![1.0; 3];
            all.extend(steps);
            all.extend([-1.0, -1.0]);
            let off = predict_curve(curve, &all, 3);
            for off in &off[3..] {
                prop_assert!(*off < 2e-8, "{off}");
            }
        }
    }

    #[test]
    fn incomplete_solve_does_not_change_the_curvature() {
        let mut path = Predictor::default();
        let mut increments = vec![(1, Vec3::x()), (2, Vec3::y())];
        path.predict(&mut increments, 1.0, 1.0, |_| true);
        path.record_solve(0.0);
        increments[0].1 = Vec3::x() * 3.0;
        path.predict(&mut increments, 1.0, 1.0, |_| true);
        assert_eq!(increments, [(1, Vec3::x() * 3.0), (2, Vec3::y())]);
    }

    #[test]
    fn correction_off_the_path_does_not_change_the_curvature() {
        let mut path = Predictor::default();
        let mut increments = vec![(1, Vec3::x())];
        path.predict(&mut increments, 1.0, 1.0, |_| true);
        path.skip_correction();
        path.record_solve(1.0);
        increments[0].1 = Vec3::x() * 2.0;
        path.predict(&mut increments, 1.0, 1.0, |_| true);
        assert_eq!(increments[0].1, Vec3::x() * 2.0);
    }

    #[test]
    fn nodes_on_the_coarse_level_are_extrapolated_linearly() {
        let mut path = Predictor::default();
        let mut increments = vec![(1, Vec3::x()), (2, Vec3::x())];
        path.predict(&mut increments, 1.0, 1.0, |_| true);
        path.record_solve(1.0);
        (increments[0].1, increments[1].1) = (Vec3::x() * 2.0, Vec3::x() * 2.0);
        path.predict(&mut increments, 1.0, 1.0, |node| node == 2);
        assert_eq!(increments, [(1, Vec3::x() * 2.0), (2, Vec3::x() * 3.0)]);
    }

    #[test]
    fn new_nodes_are_extrapolated_linearly() {
        let mut path = Predictor::default();
        path.predict(&mut [(5, Vec3::x())], 1.0, 1.0, |_| true);
        path.record_solve(1.0);
        let mut increments = [(3, Vec3::y()), (5, Vec3::x() * 1.5), (9, Vec3::z())];
        path.predict(&mut increments, 1.0, 1.0, |_| true);
        assert_eq!(increments[0].1, Vec3::y());
        assert_eq!(increments[1].1, Vec3::x() * 2.0);
        assert_eq!(increments[2].1, Vec3::z());
    }
}
