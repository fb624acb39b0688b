//! Restoring the volume that straight cell faces have cut off curved interfaces (reconstructed).
//!
//! Faces between nodes that lie exactly on a curved surface run inside it: a bone of radius 7 mm loses 6 % at a
//! spacing of 4 mm. So faces are fitted to their interfaces: the mean distance of a face to its interface is known from its
//! corners and its middle, and each node moves along the normal by the mean of its faces. This keeps volume where it was
//! cut off, also where hollows make up for bumps. Volume lost at edges and in thin parts cannot return there, so each
//! interface then moves along its normal by its missing volume, mostly by well below a tenth of the spacing. A node moves
//! less if its cells would fail the limits or a gap would close.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::faces::{Face, OUTSIDE, volumes};
use super::snap::project;
use super::untangle::{AIM, FLOOR, Untangler};

/// Rounds of fitting; more gain less than 0.001 of the Dice coefficient of layers.
const FITS: usize = 3;
/// Shortest move of a fit, in spacings; less is not worth the test of the cells around.
const FIT_MIN: f64 = 0.002;

/// Most rounds of correction; later rounds make up for nodes that could not move. Three are enough for a limb;
/// a skin of one cell's thickness takes eight.
const ROUNDS_MAX: usize = 8;
/// Correction ends when every region is within this part of its volume.
const EXACT: f64 = 1e-4;
/// Farthest total move of an interface, in spacings; a skin thinner than a cell needs a third. A region that
/// misses more volume than this gives has lost thin parts, and inflating the rest would be wrong.
const SHIFT_MAX: f64 = 0.4;
/// The same per round, so that the normals of the interface remain valid.
const STEP_MAX: f64 = 0.1;

/// Moves the nodes of curved interfaces until region volumes match `targets` (m³).
///
/// Each pair of neighbours r, s has one shift of its wall, `λ_r - λ_s` out of r, with λ = 0 outside. With the
/// areas `A_rs` the volumes change by the missing volumes `m_r = Σ_s A_rs (λ_r - λ_s)`. This is a small
/// Laplacian system, whose solution has the smallest shifts.
pub(super) fn restore_volumes(
    untangler: &Untangler<'_>,
    faces: &[Face],
    targets: &[f64],
    positions: &mut [Vec3],
) {
    let mut slots = Slots::new(faces, positions.len());
    fit(untangler, faces, &mut slots, positions);
    // Total shift of each wall.
    let mut shifted: BTreeMap<Pair, f64> = BTreeMap::new();
    for _ in 0..ROUNDS_MAX {
        let volumes = volumes(faces, positions, targets.len());
        let missing: Vec<f64> = targets.iter().zip(&volumes).map(|(t, v)| t - v).collect();
        let exact = |(m, t): (&f64, &f64)| *t <= 0.0 || m.abs() <= EXACT * t;
        if missing.iter().zip(targets).all(exact) {
            break;
        }
        let Some(mut shifts) = shifts(faces, positions, &missing) else {
            break;
        };
        let [step, most] = [STEP_MAX, SHIFT_MAX].map(|part| part * untangler.spacing());
        for (pair, shift) in &mut shifts {
            let before = shifted.entry(*pair).or_default();
            let now = (*before + shift.clamp(-step, step)).clamp(-most, most);
            *shift = now - *before;
            *before = now;
        }
        let by = |_, face: &Face| {
            let shift = shifts.get(&(face.region, face.other));
            shift.copied().unwrap_or(0.0)
        };
        let moves = slots.moves(untangler, faces, by, positions);
        untangler.move_while_it_holds(&moves, FLOOR, positions);
    }
}

/// Moves nodes towards a mean distance of zero between faces and their interfaces. On a smooth surface the steps of the
/// lattice are flat in the limit, so no corner of a cell becomes flatter than untangling aims at.
fn fit(untangler: &Untangler<'_>, faces: &[Face], slots: &mut Slots, positions: &mut [Vec3]) {
    let targets = Targets::new(untangler, faces, slots, positions);
    for _ in 0..FITS {
        let off = targets.distances(faces, slots, positions);
        let mut moves = slots.moves(untangler, faces, |face, _| off[face], positions);
        moves.retain(|(_, by)| by.norm() > FIT_MIN * untangler.spacing());
        untangler.move_while_it_holds(&moves, AIM, positions);
    }
}

/// Points of the interfaces near the faces. Nodes move by a small part of a spacing, so they are searched for once.
struct Targets {
    /// For the node in each slot.
    of_nodes: Vec<Vec3>,
    /// For the middle of each face; `None` where the interface is a spacing away.
    of_faces: Vec<Option<Vec3>>,
}

impl Targets {
    fn new(untangler: &Untangler<'_>, faces: &[Face], slots: &Slots, positions: &[Vec3]) -> Self {
        let interfaces = untangler.interfaces();
        let of_nodes = slots.nodes.par_iter().map(|&node| {
            let at = positions[node as usize];
            project(interfaces, untangler.constraint(node), at)
        });
        let of_faces = faces.par_iter().map(|face| {
            // The two sides of a thin part may belong to one interface.
            let normal = face_vector(face, positions);
            let bvh = interfaces.bvh(face.interface());
            bvh.nearest_facing(&middle(face, positions), untangler.spacing(), &normal)
        });
        Self {
            of_nodes: of_nodes.collect(),
            of_faces: of_faces.collect(),
        }
    }

    /// Mean distance of each face to its interface along the normal out of its region.
    fn distances(&self, faces: &[Face], slots: &Slots, positions: &[Vec3]) -> Vec<f64> {
        let distance = |(face, target): (&Face, &Option<Vec3>)| {
            let Some(normal) = face_vector(face, positions).try_normalize(0.0) else {
                return 0.0;
            };
            let off = |node: u32| self.of_nodes[slots.of(node)] - positions[node as usize];
            let corners = face.nodes.map(off).iter().sum::<Vec3>() / 4.0;
            let middle = target.map_or(corners, |at| at - middle(face, positions));
            // Exact for a quadric.
            (corners + 2.0 * middle).dot(&normal) / 3.0
        };
        let pairs = faces.par_iter().zip(&self.of_faces);
        pairs.map(distance).collect()
    }
}

/// The region of a wall and the region behind it.
type Pair = (u16, u16);

/// The shift of every wall that restores the missing volumes of the regions (m³).
fn shifts(faces: &[Face], positions: &[Vec3], missing: &[f64]) -> Option<BTreeMap<Pair, f64>> {
    let mut areas: BTreeMap<Pair, f64> = BTreeMap::new();
    for face in faces {
        let vector = face_vector(face, positions);
        *areas.entry((face.region, face.other)).or_default() += vector.norm();
    }
    let count = missing.len();
    let whole: f64 = areas.values().sum();
    // A region without neighbours keeps its row solvable.
    let mut laplacian = DMatrix::from_diagonal_element(count, count, 1e-9 * whole);
    for (&(region, other), &area) in &areas {
        let r = usize::from(region);
        laplacian[(r, r)] += area;
        if other != OUTSIDE {
            let s = usize::from(other);
            laplacian[(s, s)] += area;
            laplacian[(r, s)] -= area;
            laplacian[(s, r)] -= area;
        }
    }
    let solved = laplacian.cholesky()?;
    let potential = solved.solve(&DVector::from_row_slice(missing));
    let of = |region: u16| {
        if region == OUTSIDE {
            0.0
        } else {
            potential[usize::from(region)]
        }
    };
    Some(
        areas
            .into_keys()
            .map(|pair| (pair, of(pair.0) - of(pair.1)))
            .collect(),
    )
}

/// Area of a face times its normal out of its region.
fn face_vector(face: &Face, positions: &[Vec3]) -> Vec3 {
    let [a, b, c, d] = face.corners(positions);
    (c - a).cross(&(d - b)) / 2.0
}

fn middle(face: &Face, positions: &[Vec3]) -> Vec3 {
    face.corners(positions).iter().sum::<Vec3>() / 4.0
}

/// A slot for the normal of every node on an interface.
struct Slots {
    slot_of: Vec<u32>,
    nodes: Vec<u32>,
    normals: Vec<Vec3>,
    /// Normals times the shifts of their walls.
    shifted: Vec<Vec3>,
}

impl Slots {
    fn new(faces: &[Face], node_count: usize) -> Self {
        let mut slot_of = vec![u32::MAX; node_count];
        let mut nodes = Vec::new();
        for node in faces.iter().flat_map(|f| f.nodes) {
            let slot = &mut slot_of[node as usize];
            if *slot == u32::MAX {
                *slot = nodes.len() as u32;
                nodes.push(node);
            }
        }
        let zeros = vec![Vec3::zeros(); nodes.len()];
        Self {
            slot_of,
            nodes,
            normals: zeros.clone(),
            shifted: zeros,
        }
    }

    fn of(&self, node: u32) -> usize {
        self.slot_of[node as usize] as usize
    }

    /// Moves of every node on one interface along its normal by the shifts of the faces around it, each with its area.
    fn moves(
        &mut self,
        untangler: &Untangler<'_>,
        faces: &[Face],
        shift: impl Fn(usize, &Face) -> f64,
        positions: &[Vec3],
    ) -> Vec<(u32, Vec3)> {
        self.normals.fill(Vec3::zeros());
        self.shifted.fill(Vec3::zeros());
        for (index, face) in faces.iter().enumerate() {
            let vector = face_vector(face, positions);
            let shifted = vector * shift(index, face);
            for node in face.nodes {
                let slot = self.of(node);
                self.normals[slot] += vector;
                self.shifted[slot] += shifted;
            }
        }
        self.nodes
            .iter()
            .zip(self.normals.iter().zip(&self.shifted))
            .filter(|(node, _)| untangler.constraint(**node).single())
            .filter_map(|(node, (normal, shifted))| {
                let size = normal.norm();
                let direction = normal.try_normalize(0.0)?;
                Some((*node, direction * (shifted.dot(&direction) / size)))
            })
            .collect()
    }
}
