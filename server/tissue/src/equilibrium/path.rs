//! The path of a shape that is led: a parabola through the shapes that were last solved for.
//!
//! Where held nodes go on as they went, equilibrium follows them on a smooth curve. What a step changes is then
//! carried on by the next one, and what is left to be solved for is of second order in the step. A correction tells
//! that second order: if it took the shape c away from where it had been carried over m steps, the curve's second
//! difference is 2 c / (m (m + 1)) more than was thought. With that known only the third order is left, and a cube
//! that needed an iteration in every third step of a press needs one in all of it.

use super::block::make_room;
use crate::Vec3;

/// Steps between two shapes that were solved for, in m (m + 1) / 2, below which a correction tells nothing of the curve.
const APART: f64 = 0.9;

/// Part of what was left that a correction has to take away to be the whole of it.
const SURE: f64 = 0.75;

/// What is known of the curve at a node.
#[derive(Clone, Copy)]
struct Curve {
    node: u32,
    /// What the node was carried on by in this step, in m.
    carried: [f32; 3],
    /// Second difference for steps of this length, in m.
    bend: [f32; 3],
}

impl Curve {
    const UNKNOWN: Self = Self {
        node: u32::MAX,
        carried: [0.0; 3],
        bend: [0.0; 3],
    };
}

/// The curve that a led shape is on.
#[derive(Default)]
pub(super) struct Path {
    /// In order of nodes.
    curves: Vec<Curve>,
    /// How far the last shape that was solved for lies back, in steps of this length.
    since: f64,
    /// Part of what carrying on had left that iterations took away, if there were any in this step.
    solved: Option<f64>,
}

impl Path {
    /// Forgets the curve: the shape is not carried on.
    pub(super) fn leave(&mut self) {
        self.curves.clear();
        self.since = 0.0;
        self.solved = None;
    }

    /// Notes that the step is not on the curve: what corrects it tells nothing of that.
    pub(super) fn lose(&mut self) {
        self.since = 0.0;
    }

    /// Notes that iterations took away this part of what carrying on had left.
    pub(super) fn solve(&mut self, part: f64) {
        self.solved = Some((part / SURE).clamp(0.0, 1.0));
    }

    /// Lays out memory for so many nodes: the first step that is carried on would wait for it.
    pub(super) fn make_room(&mut self, nodes: usize) {
        make_room(&mut self.curves, Curve::UNKNOWN, nodes);
    }

    /// Of these moves, in order of nodes, nodes made the part `made` in the last step; makes of them what they move on
    /// by over the share of that step which the next one is long. Nodes for which `bends` does not hold go straight on.
    pub(super) fn follow(
        &mut self,
        moves: &mut [(u32, Vec3)],
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
                // A single step's correction is as much error as curve where little of it was solved for.
                faster *= if faster > 0.0 { part } else { 1.0 };
            }
            self.since = 0.0;
        }
        self.since = self.since / share + 1.0;
        self.join(moves);
        for ((node, by), curve) in moves.iter_mut().zip(&mut self.curves) {
            if !bends(*node) {
                *by *= made;
                curve.carried = [0, 1, 2].map(|a| (by[a] * share) as f32);
                curve.bend = [0.0; 3];
                continue;
            }
            for a in 0..3 {
                let last = by[a] * made;
                let correction = last - f64::from(curve.carried[a]);
                let old = f64::from(curve.bend[a]);
                let bend = old + correction * sharper;
                by[a] = last + old + correction * faster + bend * ((share - 1.0) / 2.0);
                curve.carried[a] = (by[a] * share) as f32;
                curve.bend[a] = (bend * (share * share)) as f32;
            }
        }
    }

    /// Makes the curves those of the nodes that move; newcomers are where they were to be, and go straight on.
    fn join(&mut self, moves: &[(u32, Vec3)]) {
        let nodes = self.curves.iter().map(|c| c.node);
        if nodes.eq(moves.iter().map(|m| m.0)) {
            return;
        }
        let before = self.curves.clone();
        let mut known = before.iter().peekable();
        self.curves.clear();
        self.curves.extend(moves.iter().map(|&(node, by)| {
            while known.next_if(|k| k.node < node).is_some() {}
            let same = known.next_if(|k| k.node == node).copied();
            same.unwrap_or(Curve {
                node,
                carried: [0, 1, 2].map(|a| by[a] as f32),
                bend: [0.0; 3],
            })
        }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Follows a curve over steps of these lengths; every so many, a correction brings the node onto it. Gives how far
    /// off it is after each step.
    fn follow(curve: impl Fn(f64) -> Vec3, steps: &[f64], every: usize) -> Vec<f64> {
        let mut path = Path::default();
        let (mut s, mut at) = (1.0, curve(1.0));
        let (mut moves, mut made) = (vec![(7, at - curve(0.0))], 1.0);
        let mut last = 1.0;
        let mut off = Vec::new();
        for (k, &step) in steps.iter().enumerate() {
            let share = step / last;
            path.follow(&mut moves, made, share, |_| true);
            made = share;
            (s, last) = (s + step, step);
            let start = at;
            at += moves[0].1 * share;
            if (k + 1) % every == 0 {
                at = curve(s);
                path.solve(1.0);
                (moves[0].1, made) = (at - start, 1.0);
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
        fn a_parabola_is_followed_from_the_first_correction_on(
            (v, a) in (vector(), vector()),
            every in 1usize..6,
        ) {
            let curve = |s: f64| v * s + a * (0.1 * s * s);
            let off = follow(curve, &[1.0; 12], every);
            for off in &off[every..] {
                prop_assert!(*off < 1e-8, "{off}");
            }
        }

        #[test]
        fn and_back_again_and_in_steps_of_other_lengths(
            (v, a) in (vector(), vector()),
            steps in prop::collection::vec(0.7..1.4f64, 8),
        ) {
            let curve = |s: f64| v * s + a * (0.1 * s * s);
            let mut all = vec![1.0; 3];
            all.extend(steps);
            all.extend([-1.0, -1.0]);
            let off = follow(curve, &all, 3);
            for off in &off[3..] {
                prop_assert!(*off < 2e-8, "{off}");
            }
        }
    }

    #[test]
    fn what_was_hardly_solved_for_does_not_bend_a_path() {
        let mut path = Path::default();
        let mut moves = vec![(1, Vec3::x()), (2, Vec3::y())];
        path.follow(&mut moves, 1.0, 1.0, |_| true);
        path.solve(0.0);
        moves[0].1 = Vec3::x() * 3.0;
        path.follow(&mut moves, 1.0, 1.0, |_| true);
        assert_eq!(moves, [(1, Vec3::x() * 3.0), (2, Vec3::y())]);
    }

    #[test]
    fn what_corrects_a_step_beside_the_curve_does_not_bend_it() {
        let mut path = Path::default();
        let mut moves = vec![(1, Vec3::x())];
        path.follow(&mut moves, 1.0, 1.0, |_| true);
        path.lose();
        path.solve(1.0);
        moves[0].1 = Vec3::x() * 2.0;
        path.follow(&mut moves, 1.0, 1.0, |_| true);
        assert_eq!(moves[0].1, Vec3::x() * 2.0);
    }

    #[test]
    fn what_follows_a_level_goes_straight_on() {
        let mut path = Path::default();
        let mut moves = vec![(1, Vec3::x()), (2, Vec3::x())];
        path.follow(&mut moves, 1.0, 1.0, |_| true);
        path.solve(1.0);
        (moves[0].1, moves[1].1) = (Vec3::x() * 2.0, Vec3::x() * 2.0);
        path.follow(&mut moves, 1.0, 1.0, |node| node == 2);
        assert_eq!(moves, [(1, Vec3::x() * 2.0), (2, Vec3::x() * 3.0)]);
    }

    #[test]
    fn newcomers_go_straight_on() {
        let mut path = Path::default();
        path.follow(&mut [(5, Vec3::x())], 1.0, 1.0, |_| true);
        path.solve(1.0);
        let mut moves = [(3, Vec3::y()), (5, Vec3::x() * 1.5), (9, Vec3::z())];
        path.follow(&mut moves, 1.0, 1.0, |_| true);
        assert_eq!(moves[0].1, Vec3::y());
        assert_eq!(moves[1].1, Vec3::x() * 2.0);
        assert_eq!(moves[2].1, Vec3::z());
    }
}
