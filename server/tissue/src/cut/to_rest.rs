//! From the deformed shape back to the rest frame.
//!
//! First a guess: with u the displacement, the rest point X of a world point x solves X = x - u(X),
//! iterated with u of the cell nearest to X. Then a walk: the point's local coordinates in the
//! deformed cell say through which face it lies, until a cell contains it or none is behind.

use nalgebra::Matrix3;

use super::trilinear::{gradient, invert, point};
use crate::cell::NO_CELL;
use crate::{FaceId, Shape, Topology, Vec3};

/// Steps of the guess. Displacements vary slowly from cell to cell, so a few will do.
const GUESSES: usize = 8;
/// Most cells the walk passes; the guess is a few cells off at most.
const WALK_MAX: usize = 64;
/// How far outside the tissue a point may be and still be mapped, in spacings.
const OUTSIDE_MAX: f64 = 1.5;

/// A point of the deformed shape seen in the rest frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RestPoint {
    /// Where it is at rest, in m.
    pub position: Vec3,
    /// The cell that contains it, or the nearest one.
    pub cell: u32,
    /// Distance from that cell in spacings; 0 inside.
    pub outside: f64,
    /// Derivative of the rest position by the deformed one: takes directions and lengths along.
    pub frame: Matrix3<f64>,
}

/// Maps a point in the world to the rest frame. A point up to 1.5 spacings outside the surface moves like the nearest point of
/// the nearest cell: a distorted cell would extrapolate by several millimetres. `None` for points farther away.
pub fn to_rest(topology: &Topology, shape: &Shape, world: Vec3) -> Option<RestPoint> {
    if !world.iter().all(|v| v.is_finite()) {
        return None;
    }
    let mut best: Option<RestPoint> = None;
    let mut cell = guess(topology, shape, &world)?;
    for _ in 0..WALK_MAX {
        let nodes = topology.corners(cell);
        let deformed = nodes.map(|n| shape.position(topology, n));
        let Some(local) = invert(&deformed, &world) else {
            break;
        };
        let out = local.map(|v| (v - 0.5).abs() - 0.5);
        let nearest = local.map(|v| v.clamp(0.0, 1.0));
        let off = world - point(&deformed, &nearest);
        let outside = off.norm() / topology.model().spacing_m;
        if best.is_none_or(|b| outside < b.outside) {
            let rest = nodes.map(|n| topology.rest(n));
            let inverse = gradient(&deformed, &nearest).try_inverse()?;
            best = Some(RestPoint {
                position: point(&rest, &nearest) + off,
                cell,
                outside,
                frame: gradient(&rest, &nearest) * inverse,
            });
        } else {
            break;
        }
        if outside < 1e-9 {
            break;
        }
        // Through the face it is farthest behind, or the next best that has a cell behind it.
        let mut axes = [0, 1, 2];
        axes.sort_by(|&a, &b| out[b].total_cmp(&out[a]));
        let next = axes
            .into_iter()
            .filter(|&a| out[a] > 0.0)
            .map(|a| topology.across(FaceId::new(cell, 2 * a + usize::from(local[a] > 0.5))))
            .find(|&c| c != NO_CELL);
        match next {
            Some(next) => cell = next,
            None => break,
        }
    }
    best.filter(|b| b.outside <= OUTSIDE_MAX)
}

fn guess(topology: &Topology, shape: &Shape, world: &Vec3) -> Option<u32> {
    let index = topology.cell_index();
    let displacement = |cell: u32| -> Vec3 {
        let nodes = topology.corners(cell);
        nodes
            .iter()
            .map(|&n| shape.displacement[n as usize])
            .sum::<Vec3>()
            / 8.0
    };
    let mut rest = *world;
    let mut nearest: Option<(f64, u32)> = None;
    for _ in 0..GUESSES {
        let mut found: Option<(f64, u32)> = None;
        for cell in index.cells_near(&rest) {
            let distance = (topology.centre(cell) - rest).norm_squared();
            if found.is_none_or(|f| (distance, cell) < f) {
                found = Some((distance, cell));
            }
        }
        let Some((_, cell)) = found else {
            break;
        };
        let miss = (topology.centre(cell) + displacement(cell) - world).norm_squared();
        if nearest.is_some_and(|n| n.1 == cell) {
            break;
        }
        if nearest.is_none_or(|n| miss < n.0) {
            nearest = Some((miss, cell));
        }
        rest = world - displacement(cell);
    }
    nearest.map(|n| n.1)
}
