//! Immutable data of the equilibrium of one topology: its bricks and its coarse lattices.
//!
//! Level 0 are the nodes of the model with the bricks as their elements; level 1 and up are lattices
//! of twice the side each, with matrices as their elements (`element`, `coarsen`). Every element of
//! level l + 1 has children of level l; those of level 1 have bricks.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::brick::{Brick, Draft, Form, LOCALS};
use super::coarsen::{Coarse, Joints, Piece, coarsen, octant};
use super::element::{Matrix, Sum};
use super::prolongation::{FREE, Prolongation};
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
pub(super) struct Level {
    /// Points at the corners of each element.
    pub(super) corners: Arc<Vec<[u32; 8]>>,
    /// Matrix of each element.
    pub(super) matrix: Vec<u32>,
    pub(super) matrices: Vec<Arc<Matrix>>,
    /// Elements of the finer level in each element; on level 1 bricks.
    pub(super) children: Table,
    /// Element of the next coarser level that each element is part of.
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
}

/// Forms and matrices shared by equal bricks and elements, numbered permanently: a cut only computes new ones.
#[derive(Clone, Default)]
struct Kinds {
    forms: Vec<Arc<Form>>,
    form_of: BTreeMap<u128, u32>,
    levels: Vec<LevelKinds>,
}

/// Matrices of one level by their parts.
#[derive(Clone, Default)]
struct LevelKinds {
    matrices: Vec<Arc<Matrix>>,
    known: BTreeMap<Parts, u32>,
}

/// Parts of an element: forms and fixed nodes of its bricks, or matrices and octants of its children.
type Parts = Vec<(u32, u32)>;

/// Bricks and coarse lattices of a topology.
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
    /// Whether any tissue bottoms out.
    pub(super) bottoms_out: bool,
    kinds: Kinds,
    /// First brick of the element of each cell.
    brick_of: Vec<u32>,
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

    /// Builds the hierarchy of a topology.
    pub(super) fn new(topology: &Topology) -> Self {
        Self::after(topology, None)
    }

    /// Builds the hierarchy of a topology after a change, from the earlier one and the nodes whose cells or rest
    /// positions changed.
    pub(super) fn after(topology: &Topology, before: Option<(&Self, &[u32])>) -> Self {
        let cells = pieces_of(topology);
        let coarse = coarsen(&cells, topology.node_count(), |cell, axis, list| {
            let next = topology.across(FaceId::new(cell, 2 * axis + 1));
            if next != NO_CELL {
                list.push(next);
            }
        });
        let mut kinds = before.map_or_else(Kinds::default, |b| b.0.kinds.clone());
        let made = bricks_of(topology, &cells, &coarse, before, &mut kinds);
        let Sorted {
            bricks,
            element_of,
            brick_of,
        } = made;
        let around = Table::new(
            topology.node_count(),
            bricks.iter().enumerate().flat_map(|(b, brick)| {
                (0..LOCALS as u32)
                    .filter(|i| brick.present >> i & 1 == 1)
                    .map(move |i| (brick.nodes[i as usize], b as u32 * 32 + i))
            }),
        );
        let mut entries = coarse.entries.clone();
        for (node, entry) in entries.iter_mut().enumerate() {
            if topology.is_pinned(node as u32) {
                *entry = FREE;
            }
        }
        let corners = Arc::new(corners_of(&coarse));
        let prolongation = Prolongation::new(entries, corners);
        let followers = |node| Some((prolongation.element_of(node)?, node as u32));
        let nodes_of = Table::new(
            coarse.pieces.len(),
            (0..prolongation.len()).filter_map(followers),
        );
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
            bottoms_out: topology
                .model()
                .regions
                .iter()
                .any(|r| r.material.bottoms_out),
            kinds,
            brick_of,
        };
        hierarchy.add_levels(topology, coarse);
        hierarchy
    }

    fn add_levels(&mut self, topology: &Topology, first: Coarse) {
        let mut parts = self.parts_over_bricks(topology, first.pieces.len());
        let mut children = Table::new(
            first.pieces.len(),
            (0..self.bricks.len()).map(|b| (self.element_of[b], b as u32)),
        );
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
            let matrix = self.matrices(l, &parts);
            let matrices = self.kinds.levels[l].matrices.clone();
            self.levels
                .push(level_of(&now, next.as_ref(), matrix, matrices, children));
            let Some(next) = next else { break };
            let level = &self.levels[l];
            parts = vec![Vec::new(); next.pieces.len()];
            for (e, &parent) in level.parent.iter().enumerate() {
                parts[parent as usize].push((level.matrix[e], u32::from(level.octant[e])));
            }
            children = Table::new(
                next.pieces.len(),
                level.parent.iter().enumerate().map(|(e, &p)| (p, e as u32)),
            );
            now = next;
        }
    }

    /// Forms and fixed nodes of the bricks of each element of level 1.
    fn parts_over_bricks(&self, topology: &Topology, elements: usize) -> Vec<Parts> {
        let mut parts = vec![Vec::new(); elements];
        for (brick, &element) in self.bricks.iter().zip(&self.element_of) {
            let fixed = (0..LOCALS)
                .filter(|&i| topology.is_pinned(brick.nodes[i]))
                .fold(0, |bits, i| bits | 1 << i);
            parts[element as usize].push((brick.form, fixed));
        }
        parts
    }

    /// The matrix of each element of a level; elements with equal parts share one.
    fn matrices(&mut self, l: usize, parts: &[Parts]) -> Vec<u32> {
        if self.kinds.levels.len() == l {
            self.kinds.levels.push(LevelKinds::default());
        }
        let LevelKinds { matrices, known } = &mut self.kinds.levels[l];
        let mut new: Vec<&Parts> = Vec::new();
        let from = matrices.len();
        let index = parts
            .iter()
            .map(|list| {
                if let Some(&index) = known.get(list) {
                    return index;
                }
                let index = (from + new.len()) as u32;
                known.insert(list.clone(), index);
                new.push(list);
                index
            })
            .collect();
        let (forms, per_spacing) = (&self.forms, self.per_spacing);
        let finer = self.levels.last();
        let made: Vec<Arc<Matrix>> = new
            .par_iter()
            .map(|list| {
                let mut sum = Sum::new();
                for &(part, how) in *list {
                    match finer {
                        None => sum.add_brick(&forms[part as usize], how, per_spacing),
                        Some(level) => {
                            sum.add_child(&level.matrices[part as usize], how as usize);
                        }
                    }
                }
                let alike = list.iter().all(|part| part.0 == list[0].0)
                    && match finer {
                        None => forms[list[0].0 as usize].is_regular(per_spacing),
                        Some(level) => level.matrices[list[0].0 as usize].even,
                    };
                Arc::new(sum.finish(alike))
            })
            .collect();
        matrices.extend(made);
        index
    }
}

/// Which forms more than one brick has.
fn shared(bricks: &[Brick], forms: usize) -> Vec<bool> {
    let mut counts = vec![0u32; forms];
    for brick in bricks {
        counts[brick.form as usize] += 1;
    }
    counts.iter().map(|&count| count > 1).collect()
}

/// The cells of a topology by their place in the lattice.
fn pieces_of(topology: &Topology) -> Vec<Piece> {
    let model = topology.model();
    (0..topology.cell_count() as u32)
        .map(|cell| Piece {
            at: model.lattice[model.cells[cell as usize].corners[0] as usize],
            corners: topology.corners(cell),
        })
        .collect()
}

/// A brick, and its form with its key where that is new.
type Made = (Brick, Option<(Arc<Form>, u128)>);

/// The bricks, sorted by their elements.
struct Sorted {
    bricks: Vec<Brick>,
    element_of: Vec<u32>,
    brick_of: Vec<u32>,
}

fn bricks_of(
    topology: &Topology,
    cells: &[Piece],
    coarse: &Coarse,
    before: Option<(&Hierarchy, &[u32])>,
    kinds: &mut Kinds,
) -> Sorted {
    let elements = coarse.pieces.len();
    let members = Table::new(
        elements,
        (0..cells.len()).map(|c| (coarse.element_of[c], c as u32)),
    );
    let changed = before.map(|(hierarchy, touched)| Changed::new(topology, hierarchy, touched));
    let make = |e: usize| -> Vec<Made> {
        let row = members.row(e as u32);
        if let Some(old) = changed.as_ref().and_then(|c| c.unchanged(topology, row)) {
            return old.map(|brick| (brick, None)).collect();
        }
        let list: Vec<(usize, u32)> = row
            .iter()
            .map(|&c| (octant(cells[c as usize].at), c))
            .collect();
        let mut drafts = Vec::new();
        Draft::of(topology, &list, &mut drafts);
        let finish = |draft: &Draft| {
            let (brick, form) = draft.finish(topology);
            let key = form.key();
            (brick, Some((Arc::new(form), key)))
        };
        drafts.iter().map(finish).collect()
    };
    let mut made = Sorted {
        bricks: Vec::new(),
        element_of: Vec::new(),
        brick_of: vec![0; cells.len()],
    };
    for from in (0..elements).step_by(BATCH) {
        let batch: Vec<_> = (from..elements.min(from + BATCH))
            .into_par_iter()
            .map(make)
            .collect();
        for (e, list) in (from..).zip(batch) {
            for &cell in members.row(e as u32) {
                made.brick_of[cell as usize] = made.bricks.len() as u32;
            }
            for (mut brick, form) in list {
                if let Some((form, key)) = form {
                    brick.form = *kinds.form_of.entry(key).or_insert_with(|| {
                        kinds.forms.push(form);
                        kinds.forms.len() as u32 - 1
                    });
                }
                made.bricks.push(brick);
                made.element_of.push(e as u32);
            }
        }
    }
    made
}

/// The unchanged part of a topology.
struct Changed<'a> {
    before: &'a Hierarchy,
    touched: Vec<bool>,
}

impl<'a> Changed<'a> {
    fn new(topology: &Topology, before: &'a Hierarchy, nodes: &[u32]) -> Self {
        let mut touched = vec![false; topology.node_count()];
        touched[before.prolongation.len().min(topology.node_count())..].fill(true);
        for &node in nodes {
            touched[node as usize] = true;
        }
        Self { before, touched }
    }

    /// The bricks of an element with these cells, if unchanged.
    fn unchanged(
        &self,
        topology: &Topology,
        cells: &[u32],
    ) -> Option<impl Iterator<Item = Brick> + 'a> {
        let first = self.before.brick_of[cells[0] as usize];
        let element = self.before.element_of[first as usize];
        let same = |&cell: &u32| {
            self.before.brick_of[cell as usize] == first
                && topology
                    .corners(cell)
                    .iter()
                    .all(|&n| !self.touched[n as usize])
        };
        let before = self.before;
        cells.iter().all(same).then(|| {
            let bricks = before.levels[0].children.row(element);
            bricks.iter().map(move |&b| before.bricks[b as usize])
        })
    }
}

fn level_of(
    now: &Coarse,
    next: Option<&Coarse>,
    matrix: Vec<u32>,
    matrices: Vec<Arc<Matrix>>,
    children: Table,
) -> Level {
    let mut bound = vec![[0.0f32; 6]; now.points];
    for (piece, &m) in now.pieces.iter().zip(&matrix) {
        for (c, &point) in piece.corners.iter().enumerate() {
            let own = &matrices[m as usize].bound[c];
            for (sum, v) in bound[point as usize].iter_mut().zip(own) {
                *sum += v;
            }
        }
    }
    let pairs = now
        .pieces
        .iter()
        .enumerate()
        .flat_map(|(e, piece)| piece.corners.map(|p| (p, e as u32)));
    Level {
        corners: Arc::new(corners_of(now)),
        matrix,
        matrices,
        children,
        parent: next.map_or_else(Vec::new, |n| n.element_of.clone()),
        octant: now.pieces.iter().map(|p| octant(p.at) as u8).collect(),
        prolongation: next.map_or_else(
            || Prolongation::new(Vec::new(), Arc::default()),
            |next| Prolongation::new(next.entries.clone(), Arc::new(corners_of(next))),
        ),
        around: Table::new(now.points, pairs),
        bound,
    }
}

fn corners_of(coarse: &Coarse) -> Vec<[u32; 8]> {
    coarse.pieces.iter().map(|piece| piece.corners).collect()
}

impl Form {
    /// Equal keys mean equal forms.
    fn key(&self) -> u128 {
        let mut hasher = xxhash_rust::xxh3::Xxh3::new();
        let mut take = |values: &[f32]| {
            for v in values {
                hasher.update(&v.to_bits().to_le_bytes());
            }
        };
        self.rest.iter().for_each(|axis| take(&axis[..LOCALS]));
        self.stiffness.iter().for_each(|row| take(row));
        take(&self.bulk);
        take(&self.per_volume);
        take(&[self.curve.stiffening]);
        take(&self.curve.limits);
        take(&self.corner);
        hasher.digest128()
    }
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
