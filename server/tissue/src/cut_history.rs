//! Strokes in effect and strokes taken back.
//!
//! A cut has no inverse: it moves nodes of the tissue around it. The topology after an undo is therefore that of the
//! uncut tissue with the remaining parts of strokes in their order, or a copy of it that was kept when the stroke began.
//! Cuts number new nodes in order, so every node from before the stroke keeps its number.

use std::sync::Arc;

use crate::cut::{Plan, StrokeTree};
use crate::{CutError, CutOutcome, StrokePart, Topology};

/// Strokes whose undo repeats nothing: the topologies before the latest ones are kept. Older ones thin out, so that their
/// number grows with the logarithm of that of the strokes, and taking all of n strokes back repeats about n log n.
const KEPT: u64 = 8;

/// The strokes of a topology.
#[derive(Debug, Clone)]
pub struct CutHistory {
    uncut: Arc<Topology>,
    /// Parts of strokes in effect, in order.
    done: Vec<Arc<StrokePart>>,
    /// Their swept surfaces.
    swept: StrokeTree,
    /// Strokes taken back, the latest last.
    undone: Vec<Vec<Arc<StrokePart>>>,
    /// Strokes in effect that began here.
    begun: u64,
    /// Topologies before them, in order.
    kept: Vec<Kept>,
}

/// The topology before a stroke. It shares all that has not changed since.
#[derive(Debug, Clone)]
struct Kept {
    /// Number of the stroke, from 1.
    number: u64,
    /// Parts that were done.
    parts: usize,
    topology: Arc<Topology>,
}

impl Kept {
    /// Whether it stays when stroke `newest` begins: of every second, fourth, eighth ... stroke the latest ones stay.
    fn stays(&self, newest: u64) -> bool {
        (newest - self.number) >> self.number.trailing_zeros() < KEPT
    }
}

/// Follows an undo, a redo or a reset change by change.
pub(crate) trait Follower {
    /// The topology is again that of the first `parts` parts of strokes.
    fn rewind(&mut self, topology: &Topology, parts: usize);
    /// Parts were repeated up to the stroke that is taken back: all nodes up to here stay.
    fn reach(&mut self, topology: &Topology);
    /// A further part was cut after the first `parts`.
    fn advance(&mut self, topology: &Topology, parts: usize, outcome: CutOutcome);
}

/// Follows nothing.
impl Follower for () {
    fn rewind(&mut self, _: &Topology, _: usize) {}
    fn reach(&mut self, _: &Topology) {}
    fn advance(&mut self, _: &Topology, _: usize, _: CutOutcome) {}
}

impl CutHistory {
    /// No strokes.
    pub fn new(uncut: Arc<Topology>) -> Self {
        Self {
            uncut,
            done: Vec::new(),
            swept: StrokeTree::default(),
            undone: Vec::new(),
            begun: 0,
            kept: Vec::new(),
        }
    }

    /// The strokes of a snapshot.
    pub(crate) fn of_strokes(
        uncut: Arc<Topology>,
        done: Vec<Arc<StrokePart>>,
        undone: Vec<Vec<Arc<StrokePart>>>,
    ) -> Self {
        let mut swept = StrokeTree::default();
        for (i, part) in done.iter().enumerate() {
            swept.push(part, &done[..i]);
        }
        Self {
            done,
            swept,
            undone,
            ..Self::new(uncut)
        }
    }

    /// The topology without any stroke.
    pub fn uncut(&self) -> &Arc<Topology> {
        &self.uncut
    }

    /// Numbers of the strokes in effect, then of those taken back; the latest last.
    pub fn stroke_numbers(&self) -> [Vec<u64>; 2] {
        let mut done: Vec<u64> = Vec::new();
        for stroke in self.done.iter().rev().filter_map(|part| part.stroke) {
            if done.last() != Some(&stroke) && !done.contains(&stroke) {
                done.push(stroke);
            }
        }
        done.reverse();
        let undone = self.undone.iter().filter_map(|stroke| stroke.first());
        [done, undone.filter_map(|part| part.stroke).collect()]
    }

    /// Parts of strokes in effect, in order.
    pub(crate) fn done(&self) -> &[Arc<StrokePart>] {
        &self.done
    }

    /// The swept surfaces of the strokes in effect.
    pub(crate) fn swept(&self) -> &StrokeTree {
        &self.swept
    }

    /// Strokes taken back, the latest last.
    pub(crate) fn undone(&self) -> &[Vec<Arc<StrokePart>>] {
        &self.undone
    }

    /// Whether an undo or a reset may return to the topology of the first `parts` parts.
    pub(crate) fn returns_to(&self, parts: usize) -> bool {
        parts == 0 || self.kept.iter().any(|kept| kept.parts == parts)
    }

    /// Whether a stroke is in effect.
    pub fn can_undo(&self) -> bool {
        !self.done.is_empty()
    }

    /// Whether a stroke was taken back since the last cut.
    pub fn can_redo(&self) -> bool {
        !self.undone.is_empty()
    }

    /// Cuts the topology. Nothing can be redone afterwards. On an error nothing has changed.
    pub fn cut(
        &mut self,
        topology: &mut Arc<Topology>,
        part: StrokePart,
    ) -> Result<CutOutcome, CutError> {
        let outcome = self.apply(topology, Arc::new(part))?;
        self.undone.clear();
        Ok(outcome)
    }

    /// Repeats the latest stroke that was taken back; `None` if there is none. The version of the topology rises by one. Of
    /// a stroke that others crossed, parts with nothing left to part are left out; an error if those are all.
    pub fn redo(&mut self, topology: &mut Arc<Topology>) -> Option<Result<CutOutcome, CutError>> {
        self.redo_with(topology, &mut ())
    }

    /// [`redo`](Self::redo) with a follower.
    pub(crate) fn redo_with(
        &mut self,
        topology: &mut Arc<Topology>,
        follower: &mut impl Follower,
    ) -> Option<Result<CutOutcome, CutError>> {
        let parts = self.undone.pop()?;
        let version = topology.version() + 1;
        let before = self.done.len();
        let doubled = self.repeat(topology, &parts, follower);
        if self.done.len() == before {
            self.undone.push(parts);
            return Some(Err(CutError::NothingNew));
        }
        Arc::make_mut(topology).version = version;
        Some(Ok(CutOutcome::returned(version, doubled)))
    }

    /// Takes back the latest stroke in effect with all its parts; `None` if there is none. The version of the topology rises
    /// by one. Parts of other strokes that are left with nothing to part are left out.
    pub fn undo(&mut self, topology: &mut Arc<Topology>) -> Option<CutOutcome> {
        self.undo_with(topology, &mut ())
    }

    /// [`undo`](Self::undo) with a follower.
    pub(crate) fn undo_with(
        &mut self,
        topology: &mut Arc<Topology>,
        follower: &mut impl Follower,
    ) -> Option<CutOutcome> {
        let last = Arc::clone(self.done.last()?);
        let is_last = |part: &Arc<StrokePart>| Arc::ptr_eq(part, &last) || part.is_of_stroke(&last);
        let first = self.done.iter().position(is_last)?;
        let others = self.done.split_off(first);
        let (undone, others): (Vec<_>, Vec<_>) = others.into_iter().partition(is_last);
        self.kept.retain(|kept| kept.parts <= first);
        let kept = self.kept.pop().unwrap_or_else(|| Kept {
            number: 1,
            parts: 0,
            topology: Arc::clone(&self.uncut),
        });
        self.begun = kept.number - 1;
        let (parts, mut by) = (kept.parts, kept.topology);
        follower.rewind(&by, parts);
        let since = self.done.split_off(parts);
        self.swept.truncate(parts);
        self.repeat(&mut by, &since, follower);
        follower.reach(&by);
        let doubled = self.repeat(&mut by, &others, follower);
        self.undone.push(undone);
        Some(replace(topology, by, doubled))
    }

    /// Returns to the uncut tissue. Nothing can be undone or redone afterwards. The version of the topology rises.
    pub fn reset(&mut self, topology: &mut Arc<Topology>) -> CutOutcome {
        self.reset_with(topology, &mut ())
    }

    /// [`reset`](Self::reset) with a follower.
    pub(crate) fn reset_with(
        &mut self,
        topology: &mut Arc<Topology>,
        follower: &mut impl Follower,
    ) -> CutOutcome {
        follower.rewind(&self.uncut, 0);
        *self = Self::new(Arc::clone(&self.uncut));
        replace(topology, Arc::clone(&self.uncut), Vec::new())
    }

    /// Cuts the parts again that have something to part. Returns the nodes that they double.
    fn repeat(
        &mut self,
        topology: &mut Arc<Topology>,
        parts: &[Arc<StrokePart>],
        follower: &mut impl Follower,
    ) -> Vec<(u32, u32)> {
        let mut doubled = Vec::new();
        for part in parts {
            let before = self.done.len();
            if let Ok(outcome) = self.apply(topology, Arc::clone(part)) {
                doubled.extend_from_slice(&outcome.doubled);
                follower.advance(topology, before, outcome);
            }
        }
        doubled
    }

    fn apply(
        &mut self,
        topology: &mut Arc<Topology>,
        part: Arc<StrokePart>,
    ) -> Result<CutOutcome, CutError> {
        let path = part.with_overlap(&self.done, topology.model().spacing_m);
        let begins = !part.joins && !self.done.iter().rev().any(|p| p.is_of_stroke(&part));
        let before = begins.then(|| (self.done.len(), Arc::new(topology.to_keep())));
        // A copy is made only for a stroke that parts something.
        let plan = Plan::of(topology, &path)?;
        let outcome = plan.apply(Arc::make_mut(topology), &path);
        self.swept.push(&part, &self.done);
        self.done.push(part);
        if let Some((parts, topology)) = before {
            self.begun += 1;
            self.kept.retain(|kept| kept.stays(self.begun));
            self.kept.push(Kept {
                number: self.begun,
                parts,
                topology,
            });
        }
        Ok(outcome)
    }
}

/// Replaces a topology by one with other cuts and the next version.
fn replace(
    topology: &mut Arc<Topology>,
    mut by: Arc<Topology>,
    doubled: Vec<(u32, u32)>,
) -> CutOutcome {
    let version = topology.version() + 1;
    Arc::make_mut(&mut by).version = version;
    *topology = by;
    CutOutcome::returned(version, doubled)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::snapshot::{restore, snapshot};
    use crate::{BladePoint, CutStroke, Material, Shape, TopologyHash, Vec3, block};

    const CELL: f64 = 4e-3;

    fn uncut() -> Arc<Topology> {
        let fat = Material::built_in("fat").unwrap();
        Arc::new(Topology::new(Arc::new(block([8, 8, 4], CELL, &fat, 1))))
    }

    fn blade(x: f64, y: f64) -> BladePoint {
        BladePoint {
            tip: Vec3::new(x, y, 1.1) * CELL,
            axis: Vec3::z(),
            depth_m: 0.03,
        }
    }

    fn whole(points: impl Iterator<Item = BladePoint>) -> StrokePart {
        StrokePart::from(&CutStroke {
            points: points.collect(),
            width_m: 0.0,
        })
    }

    /// A slit across the block at `x`, in cells.
    fn slit(x: f64) -> StrokePart {
        whole((0..9).map(|i| blade(x, f64::from(i))))
    }

    /// A blade that cuts in parts of half a cell.
    #[derive(Debug)]
    struct Blade {
        /// Whether it moves along x instead of y.
        is_across: bool,
        stroke: u64,
        parts: u32,
        joins: bool,
    }

    impl Blade {
        fn part(&self) -> StrokePart {
            let point = |i: u32| {
                let (along, at) = (
                    0.5 * f64::from(self.parts + i),
                    2.2 + 1.3 * (self.stroke / 2) as f64,
                );
                if self.is_across {
                    blade(along, at)
                } else {
                    blade(at, along)
                }
            };
            StrokePart {
                stroke: Some(self.stroke),
                joins: self.joins,
                ..whole((u32::from(self.joins)..2).map(point))
            }
        }

        fn advance(&mut self, was_cut: bool) {
            self.joins = was_cut;
            self.parts += 1;
            if self.parts == 16 {
                (self.stroke, self.parts, self.joins) = (self.stroke + 2, 0, false);
            }
        }
    }

    #[derive(Debug, Clone)]
    enum Step {
        Cut(f64),
        Part(usize),
        Undo,
        Redo,
        Reset,
        /// Continues as a late participant does.
        Restore,
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            2 => (1.0_f64..7.0).prop_map(Step::Cut),
            12 => (0_usize..2).prop_map(Step::Part),
            2 => Just(Step::Undo),
            2 => Just(Step::Redo),
            1 => Just(Step::Reset),
            2 => Just(Step::Restore),
        ]
    }

    /// The uncut tissue with these parts, without those that part nothing.
    fn expected(uncut: &Arc<Topology>, parts: &mut Vec<StrokePart>) -> Arc<Topology> {
        let mut topology = Arc::clone(uncut);
        let mut history = CutHistory::new(Arc::clone(uncut));
        parts.retain(|part| history.cut(&mut topology, part.clone()).is_ok());
        topology
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        /// The expected topology after each step is that of the parts in effect, from the uncut tissue.
        #[test]
        fn topology_is_that_of_the_parts_in_effect(steps in prop::collection::vec(step(), 1..60)) {
            let uncut = uncut();
            let mut topology = Arc::clone(&uncut);
            let mut history = CutHistory::new(Arc::clone(&uncut));
            let mut shape = Shape::rest(&topology);
            let mut blades = [false, true].map(|is_across| Blade {
                is_across,
                stroke: u64::from(is_across),
                parts: 0,
                joins: false,
            });
            let (mut done, mut undone): (Vec<StrokePart>, Vec<Vec<StrokePart>>) = Default::default();
            for step in steps {
                let version = topology.version();
                let part = match step {
                    Step::Cut(x) => Some(slit(x)),
                    Step::Part(k) => Some(blades[k].part()),
                    _ => None,
                };
                let outcome = match step {
                    Step::Cut(_) | Step::Part(_) => {
                        let part = part.unwrap();
                        let outcome = history.cut(&mut topology, part.clone()).ok();
                        if let Step::Part(k) = step {
                            blades[k].advance(outcome.is_some());
                        }
                        if outcome.is_some() {
                            done.push(part);
                            undone.clear();
                        }
                        outcome
                    }
                    Step::Undo => {
                        if let Some(last) = done.pop() {
                            let (mut taken, left): (Vec<_>, Vec<_>) = done.into_iter().partition(|p| p.stroke.is_some() && p.stroke == last.stroke);
                            taken.push(last);
                            undone.push(taken);
                            done = left;
                            for blade in &mut blades { blade.joins = false; }
                        }
                        history.undo(&mut topology)
                    }
                    Step::Redo => {
                        let outcome = history.redo(&mut topology).and_then(Result::ok);
                        if outcome.is_some() {
                            done.extend(undone.pop().unwrap());
                            for blade in &mut blades { blade.joins = false; }
                        }
                        outcome
                    }
                    Step::Reset => {
                        (done, undone) = Default::default();
                        for blade in &mut blades { blade.joins = false; }
                        Some(history.reset(&mut topology))
                    }
                    Step::Restore => {
                        let bytes = snapshot(&topology, &history);
                        let before = Arc::clone(&topology);
                        (topology, history) = restore(&uncut, &bytes).unwrap();
                        prop_assert_eq!(topology.boundary(), before.boundary());
                        None
                    }
                };
                prop_assert_eq!(topology.version(), version + u32::from(outcome.is_some()));
                let expected = expected(&uncut, &mut done);
                prop_assert_eq!(topology.hash(), expected.hash());
                prop_assert_eq!(history.can_undo(), !done.is_empty());
                prop_assert_eq!(history.can_redo(), !undone.is_empty());
                prop_assert!(topology.boundary().is_closed());
                if let Some(outcome) = outcome {
                    shape.follow(&topology, &outcome);
                }
                prop_assert_eq!(shape.displacement.len(), topology.node_count());
            }
            while history.undo(&mut topology).is_some() {}
            prop_assert_eq!(topology.hash(), TopologyHash::of_uncut(uncut.model()));
        }
    }

    #[test]
    fn stroke_in_parts_opens_the_faces_of_the_whole() {
        let fat = Material::built_in("fat").unwrap();
        let uncut = Arc::new(Topology::new(Arc::new(block([16, 16, 8], CELL, &fat, 1))));
        let point = |i: u32| {
            let along = 0.2 * f64::from(i);
            BladePoint {
                tip: Vec3::new(along, 8.0 + 2.0 * (0.3 * along).sin(), 3.1) * CELL,
                axis: Vec3::new(0.2, 0.1, 1.0).normalize(),
                depth_m: 0.03,
            }
        };
        let mut topology = Arc::clone(&uncut);
        let mut history = CutHistory::new(Arc::clone(&uncut));
        let outcome = history
            .cut(&mut topology, whole((0..60).map(point)))
            .unwrap();
        let (mut in_parts, mut opened) = (Arc::clone(&uncut), 0);
        let mut history = CutHistory::new(uncut);
        let mut from = 0;
        for to in (1..60).step_by(2) {
            let joins = from > 0;
            let part = StrokePart {
                stroke: Some(1),
                joins,
                ..whole((from + u32::from(joins)..=to).map(point))
            };
            if let Ok(outcome) = history.cut(&mut in_parts, part) {
                opened += outcome.faces_opened;
                from = to;
            }
        }
        let whole = outcome.faces_opened;
        assert!(
            opened.abs_diff(whole) <= whole / 20,
            "{opened} instead of {whole} faces"
        );
        history.undo(&mut in_parts).unwrap();
        assert_eq!(in_parts.node_count(), 17 * 17 * 9);
        assert!(!history.can_undo());
        history.redo(&mut in_parts).unwrap().unwrap();
    }

    #[test]
    fn few_copies_are_kept_and_undos_repeat_few_strokes() {
        const STROKES: usize = 64;
        let fat = Material::built_in("fat").unwrap();
        let model = Arc::new(block([150, 4, 3], CELL, &fat, 1));
        let mut topology = Arc::new(Topology::new(model));
        let mut history = CutHistory::new(Arc::clone(&topology));
        for stroke in 0..STROKES {
            let x = 1.2 + 2.3 * stroke as f64;
            history.cut(&mut topology, slit(x)).unwrap();
        }
        let log = STROKES.ilog2() as usize;
        let (mut repeated, mut longest) = (0, 0);
        while history.can_undo() {
            assert!(history.kept.len() <= KEPT as usize * (log + 1));
            let first = history.done.len() - 1;
            let kept = history.kept.iter().rfind(|kept| kept.parts <= first);
            let strokes = first - kept.map_or(0, |kept| kept.parts);
            if first + KEPT as usize >= STROKES {
                assert_eq!(strokes, 0, "before stroke {first}");
            }
            repeated += strokes;
            longest = longest.max(strokes);
            history.undo(&mut topology).unwrap();
        }
        assert!(repeated <= STROKES, "{repeated} strokes");
        assert!(longest <= STROKES / KEPT as usize, "{longest} strokes");
        assert_eq!(topology.hash(), history.uncut().hash());
    }

    #[test]
    fn nodes_that_remain_keep_their_number_and_displacement() {
        let mut topology = uncut();
        let mut history = CutHistory::new(Arc::clone(&topology));
        history.cut(&mut topology, slit(2.1)).unwrap();
        let before = Arc::clone(&topology);
        let mut shape = Shape::rest(&topology);
        for (n, u) in shape.displacement.iter_mut().enumerate() {
            u.x = n as f64;
        }
        let outcome = history.cut(&mut topology, slit(5.2)).unwrap();
        shape.follow(&topology, &outcome);
        assert!(topology.node_count() > before.node_count());
        let cut = shape.displacement.clone();
        let outcome = history.undo(&mut topology).unwrap();
        shape.follow(&topology, &outcome);
        assert_eq!(topology.node_count(), before.node_count());
        for n in 0..before.node_count() as u32 {
            assert_eq!(topology.cells_around(n), before.cells_around(n));
            assert_eq!(topology.rest(n), before.rest(n));
        }
        assert_eq!(shape.displacement, cut[..before.node_count()]);
    }
}
