//! Restoring the region volumes that straight cell faces have cut off curved interfaces (reconstructed).
//!
//! Faces between nodes that lie exactly on a curved surface run inside it: a bone of radius 7 mm loses 6 % at a
//! spacing of 4 mm. So the nodes of each interface move along its normal, mostly by well below a tenth of the
//! spacing. A node moves less if its cells would fail the floors or a gap would close.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use palpate_tissue::Vec3;

use super::faces::{Face, OUTSIDE, volumes};
use super::untangle::{FLOOR, Untangler};

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
        slots.shift(untangler, faces, &shifts, positions);
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

    /// Moves every node on one interface by the shifts of the walls around it, each with its area.
    fn shift(
        &mut self,
        untangler: &Untangler<'_>,
        faces: &[Face],
        shifts: &BTreeMap<Pair, f64>,
        positions: &mut [Vec3],
    ) {
        self.normals.fill(Vec3::zeros());
        self.shifted.fill(Vec3::zeros());
        for face in faces {
            let vector = face_vector(face, positions);
            let by = shifts.get(&(face.region, face.other)).copied();
            for node in face.nodes {
                let slot = self.slot_of[node as usize] as usize;
                self.normals[slot] += vector;
                self.shifted[slot] += vector * by.unwrap_or(0.0);
            }
        }
        let moves: Vec<(u32, Vec3)> = self
            .nodes
            .iter()
            .zip(self.normals.iter().zip(&self.shifted))
            .filter(|(node, _)| untangler.constraint(**node).single())
            .filter_map(|(node, (normal, shifted))| {
                let size = normal.norm();
                let direction = normal.try_normalize(0.0)?;
                Some((*node, direction * (shifted.dot(&direction) / size)))
            })
            .collect();
        untangler.move_while_it_holds(&moves, FLOOR, positions);
    }
}
