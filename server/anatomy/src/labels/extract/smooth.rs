//! Smoothing the voxel steps of the shared mesh.

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::net::{Corner, NONE, Net};
use super::restore::push_towards;

/// Largest distance of a vertex from its corner along each axis, in voxels. Below one half, so that the two
/// faces of a layer one voxel thick never touch.
pub(super) const REACH: f64 = 0.45;

/// Least distance of a vertex from a corner where a layer is pinched, towards its own side, in voxels: the
/// layer is at least twice that thick there.
const ASIDE_MIN: f64 = 0.15;

/// Rounds of sweeps, each followed by a volume correction. Without it, smoothing alone would shrink round
/// shapes up to the limit of [`REACH`].
const ROUNDS: usize = 4;

/// Sweeps in a round.
const SWEEPS: usize = 4;

/// Relaxation factor of one sweep.
const STEP: f64 = 0.5;

/// Relaxation factor for vertices on lines. It is half as large, because all their neighbours lie along the
/// line: the rim of a cylinder then shrinks as fast as its side.
const STEP_ON_LINE: f64 = 0.25;

/// Moves the vertices; `targets` are the volumes of the regions in voxels.
pub(super) fn smooth(net: &mut Net, targets: &[f64]) {
    for _ in 0..ROUNDS {
        for _ in 0..SWEEPS {
            sweep(net);
        }
        push_towards(net, targets, &[]);
    }
}

fn sweep(net: &mut Net) {
    let moved = (0..net.corners.len())
        .into_par_iter()
        .map(|v| slid(net, v))
        .collect();
    net.moved = moved;
}

fn slid(net: &Net, v: usize) -> Vec3 {
    let corner = &net.corners[v];
    let own = net.moved[v];
    let mut sum = Vec3::zeros();
    let mut count = 0.0;
    for (direction, &n) in corner.neighbours.iter().enumerate() {
        if n != NONE && corner.follows >> direction & 1 == 1 {
            sum += net.moved[n as usize];
            sum[direction / 2] += if direction % 2 == 1 { 1.0 } else { -1.0 };
            count += 1.0;
        }
    }
    if count == 0.0 {
        return own;
    }
    let step = if corner.on_line { STEP_ON_LINE } else { STEP };
    confined(own + (sum / count - own) * step, corner)
}

/// Within reach of the corner, on the vertex's side of a pinched layer, and in the border if the vertex belongs
/// to it.
pub(super) fn confined(mut moved: Vec3, corner: &Corner) -> Vec3 {
    if let Some(aside) = corner.aside {
        moved += aside * (ASIDE_MIN - moved.dot(&aside)).max(0.0);
    }
    Vec3::from_fn(|a, _| {
        if corner.locked >> a & 1 == 1 {
            0.0
        } else {
            moved[a].clamp(-REACH, REACH)
        }
    })
}
