//! Bricks and coarse lattices of the equilibrium of one topology.
//!
//! Level 0 are the nodes of the model with the bricks as their elements; level 1 and up are lattices
//! of twice the side each, with matrices as their elements (`element`, `coarsen`). Every element of
//! level l + 1 has children of level l; those of level 1 have bricks. A cut changes all of it around
//! the new faces only (`hierarchy_change`).

use std::sync::Arc;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::brick::{Brick, Draft, Form, LOCALS};
use super::coarsen::{Coarse, Joints, Piece, coarsen, octant};
use super::effective_stiffness::Stiffness;
use super::kinds::{CUT, Kinds, Parts};
use super::prolongation::{FREE, Prolongation};
use super::quad::reserve;
use super::smoothing::Smoothing;
use crate::cell::NO_CELL;
use crate::{FaceId, Rows, Topology, Vec3};

/// Maximum of coarse levels: 8 halvings reduce 256 points per axis to one.
const LEVELS_MAX: usize = 8;
/// A level with this few elements is the coarsest.
const COARSEST_ELEMENTS: usize = 12;
/// Bricks built per batch, so that temporary forms stay below some 30 MB.
const BATCH: usize = 8192;

/// Rows of numbers.
pub(super) type Table = Rows<u32>;

/// One coarse lattice.
#[derive(Clone)]
pub(super) struct Level {
    /// Points at the corners of each element.
    pub(super) corners: Vec<[u32; 8]>,
    /// Number of the stiffness of each element.
    pub(super) matrix: Vec<u32>,
    pub(super) matrices: Vec<Stiffness>,
    /// Elements of the finer level in each element; on level 1 bricks.
    pub(super) children: Table,
    /// Element of the next coarser level that each element is part of; empty on the coarsest.
    pub(super) parent: Vec<u32>,
    /// Position of each element in its parent.
    pub(super) octant: Vec<u8>,
    /// Prolongation from the next coarser level; empty on the coarsest.
    pub(super) prolongation: Prolongation,
    /// Elements around each point.
    pub(super) around: Table,
    /// Diagonal bound of each point: the sum of its elements' bounds.
    pub(super) bound: Vec<[f32; 6]>,
}

impl Level {
    pub(super) fn points(&self) -> usize {
        self.bound.len()
    }

    /// The element of the next coarser level that a point follows.
    pub(super) fn element_above(&self, point: u32) -> Option<u32> {
        let has_parents = !self.parent.is_empty();
        has_parents.then(|| self.prolongation.element_of(point as usize))?
    }

    /// Diagonal bound of a point.
    pub(super) fn bound_of(&self, point: u32) -> [f32; 6] {
        let mut bound = [0.0f32; 6];
        for &element in self.around.row(point) {
            let (corners, matrix) = self.element(element);
            let at = corners.iter().zip(matrix.bound()).filter(|c| *c.0 == point);
            for (_, own) in at {
                for (sum, v) in bound.iter_mut().zip(own) {
                    *sum += v;
                }
            }
        }
        bound
    }
}

/// Bricks and coarse lattices of a topology.
#[derive(Clone)]
pub(crate) struct Hierarchy {
    pub(super) bricks: Vec<Brick>,
    pub(super) forms: Vec<Arc<Form>>,
    /// Whether more than one brick has the form.
    pub(super) shared: Vec<bool>,
    /// Element of level 1 that each brick is part of.
    pub(super) element_of: Vec<u32>,
    /// Bricks around each node, as `brick * 32 + entry`.
    pub(super) around: Table,
    /// Prolongation from level 1 to the nodes; pinned nodes follow no element.
    pub(super) prolongation: Prolongation,
    /// Nodes that follow each element of level 1.
    pub(super) nodes_of: Table,
    pub(super) levels: Vec<Level>,
    pub(super) per_spacing: f32,
    /// Smoothing of the nodes.
    pub(super) smoothing: Smoothing,
    /// Whether any tissue bottoms out.
    pub(super) bottoms_out: bool,
}

impl Hierarchy {
    /// Largest difference in displacement along an axis between the nodes of a brick, in m.
    pub(super) fn change_of(&self, brick: u32, u: &[Vec3]) -> f64 {
        let nodes = &self.bricks[brick as usize].nodes;
        let first = u[nodes[0] as usize];
        let (mut low, mut high) = (first, first);
        for &node in nodes {
            low = low.inf(&u[node as usize]);
            high = high.sup(&u[node as usize]);
        }
        (high - low).max()
    }

    /// Makes room for what cuts will add.
    pub(super) fn reserve(&mut self) {
        reserve(&mut self.bricks);
        reserve(&mut self.element_of);
        reserve(&mut self.forms);
        reserve(&mut self.shared);
        self.around.reserve();
        self.nodes_of.reserve();
        self.prolongation.reserve();
        for level in &mut self.levels {
            reserve(&mut level.corners);
            reserve(&mut level.matrix);
            reserve(&mut level.matrices);
            reserve(&mut level.parent);
            reserve(&mut level.octant);
            reserve(&mut level.bound);
            level.children.reserve();
            level.around.reserve();
            level.prolongation.reserve();
        }
    }

    /// Builds the hierarchy of a topology.
    pub(super) fn new(topology: &Topology) -> Self {
        let cells = pieces_of(topology);
        let coarse = coarsen(&cells, topology.node_count(), |cell, axis, list| {
            joined(topology, cell, axis, list);
        });
        let elements = coarse.pieces.len();
        let members = Table::new(
            elements,
            (0..cells.len()).map(|c| (coarse.element_of[c], c as u32)),
        );
        let mut kinds = Kinds::default();
        let (bricks, element_of) = bricks_of(topology, &members, elements, &mut kinds);
        let around = Table::new(
            topology.node_count(),
            (0..)
                .zip(&bricks)
                .flat_map(|(b, brick)| entries_of(b, brick)),
        );
        let mut entries = coarse.entries.clone();
        for (node, entry) in entries.iter_mut().enumerate() {
            if topology.is_pinned(node as u32) {
                *entry = FREE;
            }
        }
        let prolongation = Prolongation::new(entries, corners_of(&coarse));
        let followers = |node| Some((prolongation.element_of(node)?, node as u32));
        let nodes_of = Table::new(elements, (0..prolongation.len()).filter_map(followers));
        let mut hierarchy = Self {
            shared: shared(&bricks, kinds.forms.len()),
            forms: kinds.forms.clone(),
            bricks,
            element_of,
            around,
            nodes_of,
            prolongation,
            levels: Vec::new(),
            per_spacing: (1.0 / topology.model().spacing_m) as f32,
            smoothing: Smoothing::of(topology.model()),
            bottoms_out: topology
                .model()
                .regions
                .iter()
                .any(|r| r.material.bottoms_out),
        };
        hierarchy.add_levels(topology, coarse, &mut kinds);
        hierarchy
    }

    fn add_levels(&mut self, topology: &Topology, first: Coarse, kinds: &mut Kinds) {
        let mut children = Table::new(
            first.pieces.len(),
            (0..self.bricks.len()).map(|b| (self.element_of[b], b as u32)),
        );
        let mut parts: Vec<Parts> = (0..first.pieces.len() as u32)
            .map(|e| {
                parts_over_bricks(
                    topology,
                    children.row(e).iter().map(|b| &self.bricks[*b as usize]),
                )
            })
            .collect();
        let mut now = first;
        loop {
            let joints = Joints::new(&now.pieces);
            let l = self.levels.len();
            let last = l + 1 == LEVELS_MAX || now.pieces.len() <= COARSEST_ELEMENTS;
            let next = (!last).then(|| {
                coarsen(&now.pieces, now.points, |e, axis, list| {
                    joints.behind(&now.pieces, e, axis, list);
                })
            });
            let next = next.filter(|n| n.pieces.len() < now.pieces.len());
            let (matrix, _) = kinds.matrices(l, parts.iter(), self.per_spacing);
            let matrices = kinds.levels[l].matrices.clone();
            self.levels
                .push(level_of(&now, next.as_ref(), matrix, matrices, children));
            let Some(next) = next else { break };
            let level = &self.levels[l];
            children = Table::new(
                next.pieces.len(),
                level.parent.iter().enumerate().map(|(e, &p)| (p, e as u32)),
            );
            parts = (0..next.pieces.len() as u32)
                .map(|e| parts_over_children(level, children.row(e)))
                .collect();
            now = next;
        }
    }
}

/// Appends the cell joined to a cell through its upper face on an axis.
pub(super) fn joined(topology: &Topology, cell: u32, axis: usize, list: &mut Vec<u32>) {
    let next = topology.across(FaceId::new(cell, 2 * axis + 1));
    if next != NO_CELL {
        list.push(next);
    }
}

/// Nodes of a brick, each with the brick's entry in [`Hierarchy::around`].
pub(super) fn entries_of(b: u32, brick: &Brick) -> impl Iterator<Item = (u32, u32)> + Clone + '_ {
    (0..LOCALS as u32)
        .filter(|i| brick.present >> i & 1 == 1)
        .map(move |i| (brick.nodes[i as usize], b * 32 + i))
}

/// Forms of the bricks of an element of level 1, with their fixed nodes and [`CUT`].
pub(super) fn parts_over_bricks<'a>(
    topology: &Topology,
    bricks: impl Iterator<Item = &'a Brick>,
) -> Parts {
    let built = &topology.model().nodes;
    let part = |brick: &Brick| {
        let present = || (0..LOCALS).filter(|&i| brick.present >> i & 1 == 1);
        let is_fixed = |&i: &usize| topology.is_pinned(brick.nodes[i]);
        let fixed = present().filter(is_fixed).fold(0, |bits, i| bits | 1 << i);
        let is_moved = |node: u32| built.get(node as usize) != Some(&topology.rest(node));
        let is_cut = present().any(|i| is_moved(brick.nodes[i]));
        (brick.form, fixed | if is_cut { CUT } else { 0 })
    };
    bricks.map(part).collect()
}

/// Matrices and octants of the children of an element above level 1.
pub(super) fn parts_over_children(finer: &Level, children: &[u32]) -> Parts {
    let part = |&e: &u32| {
        (
            finer.matrix[e as usize],
            u32::from(finer.octant[e as usize]),
        )
    };
    children.iter().map(part).collect()
}

/// Which forms more than one brick has.
fn shared(bricks: &[Brick], forms: usize) -> Vec<bool> {
    let mut counts = vec![0u32; forms];
    for brick in bricks {
        counts[brick.form as usize] += 1;
    }
    counts.iter().map(|&count| count > 1).collect()
}

/// Lattice coordinates of a cell.
pub(super) fn place_of(topology: &Topology, cell: u32) -> [i32; 3] {
    let model = topology.model();
    model.lattice[model.cells[cell as usize].corners[0] as usize]
}

/// The cells of a topology by their place in the lattice.
fn pieces_of(topology: &Topology) -> Vec<Piece> {
    (0..topology.cell_count() as u32)
        .map(|cell| Piece {
            at: place_of(topology, cell),
            corners: topology.corners(cell),
        })
        .collect()
}

/// [`Draft::finish`] with the vectors of this machine.
struct Finish<'a> {
    draft: &'a Draft,
    topology: &'a Topology,
}

impl WithSimd for Finish<'_> {
    type Output = Made;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Made {
        let (brick, form) = self.draft.finish(simd, self.topology);
        let key = form.key();
        let form = Arc::new(form);
        Made { brick, form, key }
    }
}

/// A brick whose form has no number yet.
pub(super) struct Made {
    pub(super) brick: Brick,
    pub(super) form: Arc<Form>,
    pub(super) key: u128,
}

impl Made {
    /// The bricks of these elements of level 1 with their elements, in order; each element lists its cells. The list is
    /// allocated by the calling thread (see [`Matrix`]).
    pub(super) fn of<'a>(
        topology: &Topology,
        elements: impl Iterator<Item = (u32, &'a [u32])>,
    ) -> Vec<(u32, Self)> {
        let (mut drafts, mut cells) = (Vec::new(), Vec::new());
        let mut element_of = Vec::new();
        for (element, list) in elements {
            cells.clear();
            cells.extend(list.iter().map(|&c| (octant(place_of(topology, c)), c)));
            Draft::of(topology, &cells, &mut drafts);
            element_of.resize(drafts.len(), element);
        }
        let arch = Arch::new();
        let finish = |(&element, draft)| (element, arch.dispatch(Finish { draft, topology }));
        element_of.par_iter().zip(&drafts).map(finish).collect()
    }

    /// The brick with the number of its form.
    pub(super) fn numbered(self, kinds: &mut Kinds) -> Brick {
        Brick {
            form: kinds.form(&self.form, self.key),
            ..self.brick
        }
    }
}

/// All bricks, in the order of their elements, and the element of each.
fn bricks_of(
    topology: &Topology,
    cells: &Table,
    elements: usize,
    kinds: &mut Kinds,
) -> (Vec<Brick>, Vec<u32>) {
    let (mut bricks, mut element_of) = (Vec::new(), Vec::new());
    for from in (0..elements).step_by(BATCH) {
        let batch = from as u32..elements.min(from + BATCH) as u32;
        for (e, made) in Made::of(topology, batch.map(|e| (e, cells.row(e)))) {
            bricks.push(made.numbered(kinds));
            element_of.push(e);
        }
    }
    (bricks, element_of)
}

fn level_of(
    now: &Coarse,
    next: Option<&Coarse>,
    matrix: Vec<u32>,
    matrices: Vec<Stiffness>,
    children: Table,
) -> Level {
    let pairs = now
        .pieces
        .iter()
        .enumerate()
        .flat_map(|(e, piece)| piece.corners.map(|p| (p, e as u32)));
    let mut level = Level {
        corners: corners_of(now),
        matrix,
        matrices,
        children,
        parent: next.map_or_else(Vec::new, |n| n.element_of.clone()),
        octant: now.pieces.iter().map(|p| octant(p.at) as u8).collect(),
        prolongation: next.map_or_else(
            || Prolongation::new(Vec::new(), Vec::new()),
            |next| Prolongation::new(next.entries.clone(), corners_of(next)),
        ),
        around: Table::new(now.points, pairs),
        bound: Vec::new(),
    };
    level.bound = (0..now.points as u32).map(|p| level.bound_of(p)).collect();
    level
}

fn corners_of(coarse: &Coarse) -> Vec<[u32; 8]> {
    coarse.pieces.iter().map(|piece| piece.corners).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BladePoint, CutStroke, Material, block, cut};

    const CELL: f64 = 4e-3;

    /// Two crossing strokes oblique to the lattice; one ends inside the block.
    fn crossed() -> Topology {
        let mut topology =
            Topology::new(Arc::new(block([20, 16, 8], CELL, &Material::default(), 1)));
        for [from, by] in [[[2.3, 4.1], [1.1, 0.6]], [[11.7, 2.2], [-0.7, 1.3]]] {
            let point = |i: u32| BladePoint {
                tip: Vec3::new(
                    CELL * (from[0] + by[0] * f64::from(i)),
                    CELL * (from[1] + by[1] * f64::from(i)),
                    3.4 * CELL,
                ),
                axis: Vec3::z(),
                depth_m: 0.03,
            };
            let stroke = CutStroke {
                points: (0..9).map(point).collect(),
                width_m: 0.0,
            };
            let outcome = cut(&mut topology, &stroke).unwrap();
            assert!(outcome.doubled.len() > 20);
        }
        topology
    }

    #[test]
    fn interpolation_is_equal_from_every_element_around_a_node() {
        let hierarchy = Hierarchy::new(&crossed());
        let level = &hierarchy.levels[0];
        for node in 0..hierarchy.prolongation.len() {
            let row: Vec<(u32, f32)> = hierarchy.prolongation.row(node).collect();
            let sum: f32 = row.iter().map(|(_, weight)| weight).sum();
            assert_eq!(sum, if row.is_empty() { 0.0 } else { 1.0 }, "node {node}");
            for &entry in hierarchy.around.row(node as u32) {
                let corners = level.corners[hierarchy.element_of[(entry / 32) as usize] as usize];
                assert!(row.iter().all(|(p, _)| corners.contains(p)), "node {node}");
            }
        }
    }
}
