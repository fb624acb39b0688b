//! Change of a hierarchy by a cut, an undo, a redo or a reset: everything around the faces, and nothing else.
//!
//! A [`CutPreparer`](super::CutPreparer) computes it once with its own hierarchy, and every solver of the same topology
//! applies it to another. Its price depends on the faces and not on the size of the model. A cut keeps the numbers of
//! nodes, bricks, elements and points, and appends new ones; an undo removes these (`reversal`).

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::sync::Arc;

use rayon::prelude::*;

use super::brick::{Brick, CORNER, Form};
use super::coarsen::{octant, place};
use super::construction::{Construction, Places};
use super::effective_stiffness::Stiffness;
use super::fine_level::own_stiffness;
use super::hierarchy::{
    Hierarchy, Level, Made, entries_of, joined, parts_over_bricks, parts_over_children, place_of,
};
use super::kinds::{Numbered, Parts, set_numbered};
use super::prolongation::{FREE, set};
use super::quad::Quad;
use super::recoarsen::{Cells, Changed, Recoarsened, recoarsen};
use super::reversal::Reversal;
use super::sizes::Sizes;
use crate::Topology;
use crate::cell::NO_CELL;
use crate::contact::SurfaceChange;
use crate::cut::CutOutcome;

/// The change of one coarse level.
#[derive(Clone, Default)]
pub(super) struct LevelChange {
    /// Corners of elements, new ones included.
    pub(super) corners: Vec<(u32, [u32; 8])>,
    /// New elements: the element that each was split from, and its position in its parent.
    pub(super) new: Vec<(u32, u32, u8)>,
    /// Children of elements; on level 1 bricks.
    pub(super) children: Vec<(u32, Vec<u32>)>,
    /// Numbers of the stiffness of elements, and new stiffness.
    pub(super) matrix: Vec<(u32, u32)>,
    pub(super) matrices: Numbered<Stiffness>,
    /// The point that each new point was split from.
    pub(super) origins: Vec<u32>,
    /// Elements around points.
    pub(super) around: Vec<(u32, Vec<u32>)>,
    /// Diagonal bounds of points.
    pub(super) bounds: Vec<(u32, [f32; 6])>,
    /// Element and place of the points of the next finer level.
    pub(super) entries: BTreeMap<u32, u32>,
}

impl LevelChange {
    /// All changed elements, new ones included, sorted.
    pub(super) fn elements(&self) -> Vec<u32> {
        let corners = self.corners.iter().map(|e| e.0);
        let children = self.children.iter().map(|e| e.0);
        let matrix = self.matrix.iter().map(|e| e.0);
        sorted(corners.chain(children).chain(matrix))
    }

    /// Points whose elements changed, new ones included.
    pub(super) fn points(&self) -> impl Iterator<Item = u32> + '_ {
        self.around.iter().map(|row| row.0)
    }
}

/// See the module. First the items from these sizes on are removed, which an undo does; then items are set.
#[derive(Clone, Default)]
pub(crate) struct HierarchyChange {
    pub(super) keeps: Sizes,
    /// Changed and new bricks with their elements, sorted by their numbers.
    pub(super) bricks: Vec<(u32, Brick, u32)>,
    /// New forms, sorted by their numbers.
    pub(super) forms: Numbered<Arc<Form>>,
    /// Whether forms are shared.
    pub(super) shared: Vec<(u32, bool)>,
    /// Bricks around nodes.
    pub(super) around: Vec<(u32, Vec<u32>)>,
    /// Mean stiffness of nodes at rest, in N/m.
    pub(super) own: Vec<(u32, f64)>,
    pub(super) levels: Vec<LevelChange>,
    pub(super) surface: SurfaceChange,
    /// Number of nodes whose displacement stays; outcomes of the cuts after them.
    pub(super) stays: usize,
    pub(super) outcomes: Vec<Arc<CutOutcome>>,
    /// Whether a component may have become two, or two of them one.
    pub(super) separates: bool,
    /// Weights of all nodes, if `separates` under gravity.
    pub(super) weights: Option<Arc<Vec<Quad>>>,
}

impl HierarchyChange {
    /// Changed elements of a level, and those that the change removes.
    pub(super) fn changed_or_removed(&self, l: usize, level: &Level) -> Vec<u32> {
        let count = level.corners.len() as u32;
        let mut list = self.levels[l].elements();
        list.retain(|e| *e < count);
        list.extend(self.keeps.levels[l].elements as u32..count);
        list
    }
}

/// The cells of a topology.
struct Fine<'a>(&'a Topology);

impl Cells for Fine<'_> {
    fn at(&self, cell: u32) -> [i32; 3] {
        place_of(self.0, cell)
    }

    fn corners(&self, cell: u32) -> [u32; 8] {
        self.0.corners(cell)
    }

    fn joined(&self, cell: u32, axis: usize, list: &mut Vec<u32>) {
        joined(self.0, cell, axis, list);
    }
}

/// The elements of a level.
struct Elements<'a> {
    level: &'a Level,
    places: &'a Places,
}

impl Cells for Elements<'_> {
    fn at(&self, element: u32) -> [i32; 3] {
        self.places.of[element as usize]
    }

    fn corners(&self, element: u32) -> [u32; 8] {
        self.level.corners[element as usize]
    }

    /// Elements are joined if they share all points of a face.
    fn joined(&self, element: u32, axis: usize, list: &mut Vec<u32>) {
        let own = self.corners(element);
        let mut to = self.at(element);
        to[axis] += 1;
        let shares = |&other: &u32| {
            let corners = self.corners(other);
            (0..8)
                .filter(|c| c >> axis & 1 == 0)
                .all(|c| corners[c] == own[c | 1 << axis])
        };
        list.extend(self.places.at(to).filter(shares));
    }
}

impl Hierarchy {
    /// Follows a cut of its topology. Returns the change, for other hierarchies, and the way back.
    pub(super) fn follow(
        &mut self,
        construction: &mut Construction,
        topology: &Topology,
        outcome: &Arc<CutOutcome>,
    ) -> (HierarchyChange, Reversal) {
        let level_1 = (
            &self.levels[0],
            &construction.places[0],
            &construction.cells,
        );
        let coarse = recoarsen(&Fine(topology), level_1, &parted_cells(topology, outcome));
        let mut reversal = Reversal::new(self, &outcome.touched, outcome.components_near > 1);
        for element in &coarse.elements {
            reversal.note_cells(construction, element.id);
            construction.set_cells(element.id, &element.cells);
        }
        let own = |&node: &u32| (node, own_stiffness(topology, node));
        let mut change = HierarchyChange {
            own: outcome.touched.par_iter().map(own).collect(),
            keeps: self.sizes(),
            stays: self.prolongation.len(),
            outcomes: vec![Arc::clone(outcome)],
            separates: outcome.components_near > 1,
            surface: SurfaceChange::of(topology, &outcome.touched),
            ..HierarchyChange::default()
        };
        let reshaped = outcome.reshaped.iter();
        let reshaped = reshaped.map(|&cell| construction.element_of[cell as usize]);
        let elements = sorted(reshaped.chain(coarse.elements.iter().map(|e| e.id)));
        let children = self.remake_bricks(construction, topology, &elements, &mut change);
        let brick = |id: &u32| {
            let at = change.bricks.binary_search_by_key(id, |b| b.0);
            at.ok().map(|at| &change.bricks[at].1)
        };
        let parts: Vec<(u32, Parts)> = children
            .iter()
            .map(|(e, list)| {
                (
                    *e,
                    parts_over_bricks(topology, list.iter().filter_map(brick)),
                )
            })
            .collect();
        let place = |cell: u32| place(place_of(topology, cell));
        let mut first = self.level_change(construction, 0, coarse, &parts, place);
        first.children = children;
        for (_, entry) in first
            .entries
            .iter_mut()
            .filter(|e| topology.is_pinned(*e.0))
        {
            *entry = FREE;
        }
        share_forms(&mut change);
        reversal.note_bricks(self, &change);
        self.apply_bricks(&change);
        self.apply_computed(0, first, &mut change, &mut reversal);
        for l in 1..self.levels.len() {
            let next = self.compute_level(construction, l, &change.levels[l - 1]);
            self.apply_computed(l, next, &mut change, &mut reversal);
        }
        (change, reversal)
    }

    /// Applies the change of a level and adds its bounds.
    fn apply_computed(
        &mut self,
        l: usize,
        mut level: LevelChange,
        change: &mut HierarchyChange,
        reversal: &mut Reversal,
    ) {
        reversal.note_level(self, l, &level);
        self.apply_level(l, &level);
        let now = &mut self.levels[l];
        let corners = level.matrix.iter().flat_map(|m| now.corners[m.0 as usize]);
        for point in sorted(level.points().chain(corners)) {
            let bound = now.bound_of(point);
            reversal.note_bound(now, l, point);
            set(&mut now.bound, point, bound);
            level.bounds.push((point, bound));
        }
        change.levels.push(level);
    }

    /// Rebuilds the bricks of elements, under their former numbers as far as possible. Returns the bricks of each element.
    fn remake_bricks(
        &self,
        construction: &mut Construction,
        topology: &Topology,
        elements: &[u32],
        change: &mut HierarchyChange,
    ) -> Vec<(u32, Vec<u32>)> {
        let cells = &construction.cells;
        let made = Made::of(topology, elements.iter().map(|&e| (e, cells.row(e))));
        let mut made = made.into_iter().peekable();
        let former = &self.levels[0].children;
        let mut count = self.bricks.len() as u32;
        let mut children = Vec::with_capacity(elements.len());
        for &element in elements {
            let is_old = (element as usize) < former.rows();
            let known = if is_old { former.row(element) } else { &[] };
            let mut known = known.iter();
            let mut list = Vec::new();
            while let Some((_, made)) = made.next_if(|m| m.0 == element) {
                let id = known.next().copied().unwrap_or_else(|| {
                    count += 1;
                    count - 1
                });
                let brick = made.numbered(&mut construction.kinds);
                change.bricks.push((id, brick, element));
                list.push(id);
            }
            for &unused in known {
                let brick = Brick {
                    present: 0,
                    ..self.bricks[unused as usize]
                };
                change.bricks.push((unused, brick, element));
            }
            children.push((element, list));
        }
        // Numbers become unused only after all new ones are given.
        let replaced = change.bricks.iter().filter(|b| b.1.present != 0);
        for former in replaced.filter_map(|b| self.bricks.get(b.0 as usize)) {
            construction.kinds.release_form(former.form);
        }
        change.forms = construction.kinds.take_new_forms();
        change.bricks.sort_unstable_by_key(|b| b.0);
        change.around = self.around_rewired(&change.bricks);
        children
    }

    /// The bricks around the nodes of those of these bricks whose nodes changed.
    fn around_rewired(&self, bricks: &[(u32, Brick, u32)]) -> Vec<(u32, Vec<u32>)> {
        let former = |id: u32| self.bricks.get(id as usize);
        let is_rewired = |&(id, now, _): &&(u32, Brick, u32)| {
            former(*id).is_none_or(|b| b.present != now.present || b.nodes != now.nodes)
        };
        let rewired: Vec<_> = bricks.iter().filter(is_rewired).collect();
        let is_kept = |entry: &u32| {
            rewired
                .binary_search_by_key(&(entry / 32), |b| b.0)
                .is_err()
        };
        let mut rows: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for &&(id, ref brick, _) in &rewired {
            for (node, entry) in entries_of(id, brick) {
                rows.entry(node).or_default().push(entry);
            }
            for (node, _) in former(id).into_iter().flat_map(|b| entries_of(id, b)) {
                rows.entry(node).or_default();
            }
        }
        for (&node, row) in &mut rows {
            if (node as usize) < self.prolongation.len() {
                row.extend(self.around.row(node).iter().filter(|e| is_kept(e)));
            }
            row.sort_unstable();
        }
        rows.into_iter().collect()
    }

    /// The change of a level above level 1.
    fn compute_level(
        &self,
        construction: &mut Construction,
        l: usize,
        finer: &LevelChange,
    ) -> LevelChange {
        let (level, below) = (&self.levels[l], &self.levels[l - 1]);
        let elements = Elements {
            level: below,
            places: &construction.places[l - 1],
        };
        let mut changed: BTreeMap<u32, Option<u32>> =
            finer.corners.iter().map(|e| (e.0, None)).collect();
        for &(new, from, _) in &finer.new {
            changed.insert(new, Some(below.parent[from as usize]));
        }
        let new = (below.points() - finer.origins.len()) as u32..below.points() as u32;
        let changed = Changed {
            cells: changed,
            points: sorted(new.chain(finer.origins.iter().copied())),
        };
        let here = (level, &construction.places[l], &level.children);
        let mut coarse = recoarsen(&elements, here, &changed);
        // A point may have followed an element that has left it to a new point.
        for point in finer.points() {
            if let Entry::Vacant(entry) = coarse.entries.entry(point) {
                let e = below.around.row(point)[0];
                let corner = below.corners[e as usize].iter().position(|p| *p == point);
                let own = usize::from(below.octant[e as usize]);
                let place = CORNER[own][corner.unwrap_or_default()] as u32;
                entry.insert(below.parent[e as usize] * 32 + place);
            }
        }
        let mut parts: BTreeMap<u32, Parts> = BTreeMap::new();
        let mut children = Vec::new();
        for element in &coarse.elements {
            parts.insert(element.id, parts_over_children(below, &element.cells));
            children.push((element.id, element.cells.clone()));
        }
        let former = |e: u32| level.children.row(e);
        for &(child, _) in finer
            .matrix
            .iter()
            .filter(|m| (m.0 as usize) < below.parent.len())
        {
            let parent = below.parent[child as usize];
            parts
                .entry(parent)
                .or_insert_with(|| parts_over_children(below, former(parent)));
        }
        let parts: Vec<(u32, Parts)> = parts.into_iter().collect();
        let places: Vec<[i32; 3]> = coarse
            .elements
            .iter()
            .map(|e| elements.at(e.cells[0]))
            .collect();
        let of: BTreeMap<u32, [i32; 3]> = coarse
            .elements
            .iter()
            .map(|e| e.cells[0])
            .zip(places)
            .collect();
        let mut change =
            self.level_change(construction, l, coarse, &parts, |cell| place(of[&cell]));
        change.children = children;
        change
    }

    /// The change of a level but for the children and bounds. `parts` are those of the elements whose matrix may have changed;
    /// `place` is the place of the element of a finer cell.
    fn level_change(
        &self,
        construction: &mut Construction,
        l: usize,
        coarse: Recoarsened,
        parts: &[(u32, Parts)],
        place: impl Fn(u32) -> [i32; 3],
    ) -> LevelChange {
        let level = &self.levels[l];
        let count = level.corners.len() as u32;
        let mut new = Vec::new();
        for element in coarse.elements.iter().filter(|e| e.id >= count) {
            let at = place(element.cells[0]);
            new.push((element.id, element.origin, octant(at) as u8));
            construction.places[l].push(at);
        }
        let list = parts.iter().map(|p| &p.1);
        let (numbers, matrices) = construction.kinds.matrices(l, list, self.per_spacing);
        let elements = parts.iter().map(|p| p.0);
        for &former in elements
            .clone()
            .filter_map(|e| level.matrix.get(e as usize))
        {
            construction.kinds.levels[l].release(former);
        }
        let is_changed = |&(e, m): &(u32, u32)| level.matrix.get(e as usize) != Some(&m);
        let matrix = elements.zip(numbers).filter(is_changed).collect();
        LevelChange {
            corners: coarse.corners,
            new,
            children: Vec::new(),
            matrix,
            matrices,
            origins: coarse.origins,
            around: coarse.around,
            bounds: Vec::new(),
            entries: coarse.entries,
        }
    }

    /// Applies a change that another hierarchy of the same topology has computed.
    pub(super) fn apply(&mut self, change: &HierarchyChange) {
        self.truncate(&change.keeps);
        self.apply_bricks(change);
        for (l, level) in change.levels.iter().enumerate() {
            self.apply_level(l, level);
        }
    }

    fn apply_bricks(&mut self, change: &HierarchyChange) {
        for (number, form) in &change.forms {
            set_numbered(&mut self.forms, *number, form);
        }
        for &(form, is_shared) in &change.shared {
            set(&mut self.shared, form, is_shared);
        }
        for &(id, brick, element) in &change.bricks {
            set(&mut self.bricks, id, brick);
            set(&mut self.element_of, id, element);
        }
        for (node, row) in &change.around {
            self.around.set(*node, row);
        }
    }

    fn apply_level(&mut self, l: usize, change: &LevelChange) {
        let (finer, coarser) = self.levels.split_at_mut(l);
        let level = &mut coarser[0];
        for (number, matrix) in &change.matrices {
            set_numbered(&mut level.matrices, *number, matrix);
        }
        for &(e, _, octant) in &change.new {
            set(&mut level.octant, e, octant);
        }
        for &(e, matrix) in &change.matrix {
            set(&mut level.matrix, e, matrix);
        }
        for &(e, corners) in &change.corners {
            set(&mut level.corners, e, corners);
        }
        for (e, children) in &change.children {
            level.children.set(*e, children);
        }
        for (point, row) in &change.around {
            level.around.set(*point, row);
        }
        for &(point, bound) in &change.bounds {
            set(&mut level.bound, point, bound);
        }
        let prolongation = if let Some(below) = finer.last_mut() {
            for (e, children) in &change.children {
                for &child in children {
                    set(&mut below.parent, child, *e);
                }
            }
            &mut below.prolongation
        } else {
            move_followers(&mut self.nodes_of, &self.prolongation, &change.entries);
            &mut self.prolongation
        };
        for (&point, &entry) in &change.entries {
            prolongation.set_entry(point, entry);
        }
        for &(e, corners) in &change.corners {
            prolongation.set_corners(e, corners);
        }
    }
}

/// Notes the forms of changed bricks that several bricks share from now on.
fn share_forms(change: &mut HierarchyChange) {
    let mut shared: BTreeMap<u32, Option<bool>> =
        change.forms.iter().map(|form| (form.0, None)).collect();
    for (_, brick, _) in &change.bricks {
        let is_shared = shared.entry(brick.form).or_insert(Some(true));
        *is_shared = Some(is_shared.is_some());
    }
    let shared = shared.into_iter();
    change.shared = shared.map(|(f, is)| (f, is.unwrap_or(false))).collect();
}

/// Cells around the nodes that a cut doubled: all whose corners or open faces changed.
fn parted_cells(topology: &Topology, outcome: &CutOutcome) -> Changed {
    let nodes = outcome.doubled.iter().flat_map(|&(new, from)| [new, from]);
    let points = sorted(nodes);
    let cells = points.iter().flat_map(|&node| topology.cells_around(node));
    let cells = cells.filter(|&cell| cell != NO_CELL);
    Changed {
        cells: cells.map(|cell| (cell, None)).collect(),
        points,
    }
}

fn sorted(items: impl Iterator<Item = u32>) -> Vec<u32> {
    let mut list: Vec<u32> = items.collect();
    list.sort_unstable();
    list.dedup();
    list
}

/// Moves nodes to the rows of the elements that they follow from now on.
fn move_followers(
    nodes_of: &mut super::hierarchy::Table,
    before: &super::prolongation::Prolongation,
    entries: &BTreeMap<u32, u32>,
) {
    let mut rows: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (&node, &entry) in entries {
        let known = (node as usize) < before.len();
        let from = known.then(|| before.element_of(node as usize)).flatten();
        let from = from.filter(|&e| (e as usize) < nodes_of.rows());
        let to = (entry != FREE).then_some(entry / 32);
        if from == to {
            continue;
        }
        if let Some(from) = from {
            let row = rows
                .entry(from)
                .or_insert_with(|| nodes_of.row(from).to_vec());
            row.retain(|n| *n != node);
        }
        if let Some(to) = to {
            let is_new = to as usize >= nodes_of.rows();
            let known: &[u32] = if is_new { &[] } else { nodes_of.row(to) };
            rows.entry(to).or_insert_with(|| known.to_vec()).push(node);
        }
    }
    for (element, row) in rows {
        nodes_of.set(element, &row);
    }
}

#[cfg(test)]
mod tests;
