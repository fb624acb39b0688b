//! The volume term of a brick: ½ κ V0 (J - 1)² per cell.
//!
//! J is the determinant of the cell's three mean edges over that at rest: one point per cell. Numbers of a cell stand at
//! its first node, so that cells are processed in vectors as springs are.

use pulp::Simd;

use super::brick::{Brick, CORNER, Form, LOCALS, SPAN};
use super::kernel::{LEAD, Local, LocalBlocks, PAIRS, cross};
use super::lanes::{LANES, V, Wide};
use crate::Vec3;

/// Offsets of the corners of a cell from its first node.
const STEPS: [usize; 8] = CORNER[0];
/// The gradients of J at two opposite corners differ in sign only, so four corners stand for all.
const HALF: usize = 4;

/// Numbers of cells, behind and before zeros.
type Cells = [f32; LEAD + SPAN];

/// Adds the forces of the volume term in N.
#[inline(always)]
pub(super) fn volume_forces<S: Simd>(
    simd: S,
    brick: &Brick,
    form: &Form,
    all: &[Vec3],
    u: &Local,
    f: &mut Local,
) {
    let changes = volume_changes(simd, brick, form, all);
    let mut pushes: [[Cells; 3]; HALF] = [[[0.0; LEAD + SPAN]; 3]; HALF];
    let mut from = 0;
    while from < LANES {
        let change = V::load(simd, &changes, from);
        let pressure = V::load(simd, &form.bulk, from) * change * V::all(simd, 0.25);
        for (push, gradient) in pushes.iter_mut().zip(gradients(simd, form, u, from)) {
            for (row, along) in push.iter_mut().zip(gradient) {
                (pressure * along).store(row, LEAD + from);
            }
        }
        from += V::<S>::WIDTH;
    }
    for (a, to) in f.iter_mut().enumerate() {
        let mut from = 0;
        while from < SPAN {
            let mut sum = V::load(simd, to, from);
            for (c, push) in pushes.iter().enumerate() {
                let this = V::load(simd, &push[a], LEAD + from - STEPS[c]);
                sum = sum + (this - V::load(simd, &push[a], LEAD + from - STEPS[7 - c]));
            }
            sum.store(to, from);
            from += V::<S>::WIDTH;
        }
    }
}

/// Adds the diagonal blocks of the volume term in N/m, eight times: with eight corners, they bound the matrix of a cell.
#[inline(always)]
pub(super) fn volume_tangents<S: Simd>(simd: S, form: &Form, u: &Local, m: &mut LocalBlocks) {
    let mut blocks: [[Cells; 6]; HALF] = [[[0.0; LEAD + SPAN]; 6]; HALF];
    let mut from = 0;
    while from < LANES {
        let k = V::load(simd, &form.bulk, from) * V::all(simd, 8.0 / 16.0);
        for (block, g) in blocks.iter_mut().zip(gradients(simd, form, u, from)) {
            for (row, (a, b)) in block.iter_mut().zip(PAIRS) {
                (k * g[a] * g[b]).store(row, LEAD + from);
            }
        }
        from += V::<S>::WIDTH;
    }
    for (e, to) in m.iter_mut().enumerate() {
        let mut from = 0;
        while from < SPAN {
            let mut sum = V::load(simd, to, from);
            for (c, block) in blocks.iter().enumerate() {
                let this = V::load(simd, &block[e], LEAD + from - STEPS[c]);
                sum = sum + (this + V::load(simd, &block[e], LEAD + from - STEPS[7 - c]));
            }
            sum.store(to, from);
            from += V::<S>::WIDTH;
        }
    }
}

/// -4 ∇J in 1/m at the first four corners of the cells from `from` on; at corner 7 - c it has the opposite sign.
#[inline(always)]
fn gradients<S: Simd>(simd: S, form: &Form, u: &Local, from: usize) -> [[V<S>; 3]; HALF] {
    let zero = V::all(simd, 0.0);
    let mut edges = [[zero; 3]; 3];
    for (axis, edge) in edges.iter_mut().enumerate() {
        for (a, to) in edge.iter_mut().enumerate() {
            *to = mean_edge(simd, &form.rest[a], axis, from) + mean_edge(simd, &u[a], axis, from);
        }
    }
    let per_volume = V::load(simd, &form.per_volume, from);
    let mut parts = [[zero; 3]; 3];
    for (axis, part) in parts.iter_mut().enumerate() {
        let normal = cross(&edges[(axis + 1) % 3], &edges[(axis + 2) % 3]);
        for (to, v) in part.iter_mut().zip(normal) {
            *to = per_volume * v;
        }
    }
    let [x, y, z] = parts;
    let mut list = [[zero; 3]; HALF];
    for a in 0..3 {
        let (low, high) = (z[a] + x[a], z[a] - x[a]);
        list[0][a] = low + y[a];
        list[1][a] = high + y[a];
        list[2][a] = low - y[a];
        list[3][a] = high - y[a];
    }
    list
}

/// J - 1 of each cell. Strains nearly cancel in it and a large κ multiplies it, so it is computed in f64.
#[inline(always)]
fn volume_changes<S: Simd>(simd: S, brick: &Brick, form: &Form, u: &[Vec3]) -> [f32; LANES] {
    let (mut rest_at, mut moved_by) = ([[0.0; SPAN]; 3], [[0.0; SPAN]; 3]);
    for (row, rest) in rest_at.iter_mut().zip(form.rest.iter()) {
        for (to, rest) in row.iter_mut().zip(&rest[..LOCALS]) {
            *to = f64::from(*rest);
        }
    }
    for (i, &node) in brick.nodes.iter().enumerate() {
        let by = &u[node as usize];
        moved_by[0][i] = by.x;
        moved_by[1][i] = by.y;
        moved_by[2][i] = by.z;
    }
    let zero = Wide::all(simd, 0.0);
    let mut changes = [0.0; LANES];
    let mut from = 0;
    while from < LANES {
        let (mut rest, mut by, mut now) = ([[zero; 3]; 3], [[zero; 3]; 3], [[zero; 3]; 3]);
        for axis in 0..3 {
            for a in 0..3 {
                rest[axis][a] = wide_mean_edge(simd, &rest_at[a], axis, from);
                by[axis][a] = wide_mean_edge(simd, &moved_by[a], axis, from);
                now[axis][a] = rest[axis][a] + by[axis][a];
            }
        }
        // det(now) - det(rest), term by term, so that a small change keeps its digits.
        let change = triple(&by[0], &now[1], &now[2])
            + triple(&rest[0], &by[1], &now[2])
            + triple(&rest[0], &rest[1], &by[2]);
        let mut numbers = [0.0; LANES];
        change.store(&mut numbers, 0);
        for (l, change) in numbers[..Wide::<S>::WIDTH].iter().enumerate() {
            changes[from + l] = (change * f64::from(form.per_volume[from + l])) as f32;
        }
        from += Wide::<S>::WIDTH;
    }
    changes
}

/// Offsets of the two ends of the four edges along each axis.
const ENDS: [[[usize; 2]; 4]; 3] = [
    [[0, 1], [3, 4], [9, 10], [12, 13]],
    [[0, 3], [1, 4], [9, 12], [10, 13]],
    [[0, 9], [1, 10], [3, 12], [4, 13]],
];

/// The mean difference along the edges of an axis, of the cells from `from` on.
#[inline(always)]
fn mean_edge<S: Simd>(simd: S, of: &[f32], axis: usize, from: usize) -> V<S> {
    let mut sum = V::all(simd, 0.0);
    for [low, high] in ENDS[axis] {
        sum = sum + (V::load(simd, of, from + high) - V::load(simd, of, from + low));
    }
    V::all(simd, 0.25) * sum
}

/// The same in f64.
#[inline(always)]
fn wide_mean_edge<S: Simd>(simd: S, of: &[f64], axis: usize, from: usize) -> Wide<S> {
    let mut sum = Wide::all(simd, 0.0);
    for [low, high] in ENDS[axis] {
        sum = sum + (Wide::load(simd, of, from + high) - Wide::load(simd, of, from + low));
    }
    Wide::all(simd, 0.25) * sum
}

/// a · (b × c).
#[inline(always)]
fn triple<S: Simd>(a: &[Wide<S>; 3], b: &[Wide<S>; 3], c: &[Wide<S>; 3]) -> Wide<S> {
    a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
}
