//! Corner energy: resistance of cells against collapse.
//!
//! Springs do not know on which side of a face a node is. A lattice softens as it is pressed flat, because its
//! diagonals turn sideways; the layer under a tool then takes all of a deep press, and its cells invert. With e1, e2,
//! e3 the edges of a cell at one of its corners, D = e1·(e2 × e3), D0 at rest and J = D/D0, a corner below θ of its
//! volume has an energy (reconstructed; the neighbouring bounding box of Lin 2007, eq. 3.7, protects along the axes
//! only) with
//!
//! ```text
//! -dW/dD = C E/8 x²/(max(J, 0) + ε)          x = θ - J > 0
//! ```
//!
//! It depends on the shape of the corner alone, so it is invariant under rotation. It starts with zero first and second
//! derivatives, rises more steeply the flatter the corner is, and pushes an inverted corner back. Corners with less
//! than a cube's volume at rest are measured in cubes, x = (θ D0 - D)/Δd³ and J = D/Δd³. Otherwise flat corners would
//! be too stiff for f32 blocks and the smoother (deep presses on real surfaces diverged). Corners inverted at rest have
//! no such energy.
//!
//! Only bricks with a spring at least a tenth longer or shorter than at rest are checked: no uniform deformation brings
//! a cube to θ otherwise. Skewed corners reach θ at small strains, so their bricks are always checked (measured: forces
//! that switched with a spring at that tenth kept iterates oscillating).

use pulp::Simd;

use super::brick::Form;
use super::kernel::{Local, LocalBlocks, PAIRS, cross, dot};
use super::lanes::{LANES, V};
use super::stabilisation::MARGIN;

/// θ: relative volume below which a corner hardens.
const KEPT: f32 = 0.5;
/// C: strength in parts of Young's modulus.
pub(crate) const STRENGTH: f32 = 10.0;
/// ε: softens the rise towards a flat corner.
const SOFT: f32 = 0.08;
/// Relative change of a spring's squared length from which on the corners of its brick are checked.
pub(crate) const NEAR: f32 = 0.2;
/// Volume of a corner at rest, relative to the product of its edges, below which its brick is always checked.
pub(crate) const SKEWED: f64 = 0.8;
/// Nodes of a corner; this factor makes the diagonal blocks an upper bound of its matrix.
const NODES: f32 = 4.0;

/// Steps to the next node along each axis of a brick.
const STEP: [usize; 3] = [1, 3, 9];

/// One corner of all cells of a brick.
struct Corner<S: Simd> {
    /// Edges along the axes, from the near node to the far one, in m.
    now: [[V<S>; 3]; 3],
    /// Derivative of D by the edge along the first axis in m².
    first: [V<S>; 3],
    /// Reference volume of J in m³.
    unit: V<S>,
    /// J and x.
    kept: V<S>,
    lost: V<S>,
    /// Modulus in Pa; zero where the corner does not push.
    modulus: V<S>,
}

/// Start of the edge of corner `which` along an axis, relative to the first node of its cell. Bit `a` of `which` is set
/// when the corner is the far one along axis `a`.
const fn start(which: usize, axis: usize) -> usize {
    own(which) - (which >> axis & 1) * STEP[axis]
}

/// Position of the corner itself.
const fn own(which: usize) -> usize {
    (which & 1) * STEP[0] + (which >> 1 & 1) * STEP[1] + (which >> 2 & 1) * STEP[2]
}

/// Difference between the ends of an edge. (A closure would not be inlined for wider vectors.)
#[inline(always)]
fn edge<S: Simd>(simd: S, of: &Local, at: usize, step: usize) -> [V<S>; 3] {
    [
        V::load(simd, &of[0], at + step) - V::load(simd, &of[0], at),
        V::load(simd, &of[1], at + step) - V::load(simd, &of[1], at),
        V::load(simd, &of[2], at + step) - V::load(simd, &of[2], at),
    ]
}

#[inline(always)]
fn sum<S: Simd>(a: [V<S>; 3], b: [V<S>; 3]) -> [V<S>; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

impl<S: Simd> Corner<S> {
    /// Evaluates a corner of the cells whose first nodes start at `from`, as if it had lost a `further` fraction
    /// of its volume at rest.
    #[inline(always)]
    fn of(simd: S, form: &Form, u: &Local, which: usize, from: usize, further: f32) -> Self {
        let at = [
            from + start(which, 0),
            from + start(which, 1),
            from + start(which, 2),
        ];
        let rest = [
            edge(simd, &form.rest, at[0], STEP[0]),
            edge(simd, &form.rest, at[1], STEP[1]),
            edge(simd, &form.rest, at[2], STEP[2]),
        ];
        let now = [
            sum(rest[0], edge(simd, u, at[0], STEP[0])),
            sum(rest[1], edge(simd, u, at[1], STEP[1])),
            sum(rest[2], edge(simd, u, at[2], STEP[2])),
        ];
        let first = cross(&now[1], &now[2]);
        let whole = dot(&rest[0], &cross(&rest[1], &rest[2]));
        let unit = whole.max(V::all(simd, form.cell_volume));
        let at_rest = whole / unit;
        let kept = dot(&now[0], &first) / unit - V::all(simd, further) * at_rest;
        let lost = V::all(simd, KEPT) * at_rest - kept;
        let modulus = V::load(simd, &form.corner, from);
        let modulus = whole.where_above_zero(lost.where_above_zero(modulus));
        Self {
            now,
            first,
            unit,
            kept,
            lost,
            modulus,
        }
    }

    /// max(J, 0) + ε.
    #[inline(always)]
    fn above(&self, simd: S) -> V<S> {
        self.kept.max(V::all(simd, 0.0)) + V::all(simd, SOFT)
    }

    /// Derivative of the energy by D, in Pa.
    #[inline(always)]
    fn push(&self, simd: S) -> V<S> {
        self.modulus * self.lost * self.lost / self.above(simd)
    }

    /// The second one, in Pa/m³.
    #[inline(always)]
    fn stiffness(&self, simd: S) -> V<S> {
        let above = self.above(simd);
        let rise = V::all(simd, 2.0) * above + self.kept.where_above_zero(self.lost);
        self.modulus * self.lost * rise / (above * above * self.unit)
    }

    /// Derivative of D by the edge along each axis in m².
    #[inline(always)]
    fn normals(&self) -> [[V<S>; 3]; 3] {
        [
            self.first,
            cross(&self.now[2], &self.now[0]),
            cross(&self.now[0], &self.now[1]),
        ]
    }
}

/// Adds to a row from an entry on, times `sign`. Rows are added one by one, so the order of summation does not depend
/// on the width of the vectors.
#[inline(always)]
fn add<S: Simd>(simd: S, row: &mut [f32], at: usize, by: &[f32; LANES], sign: f32) {
    let mut from = 0;
    while from < LANES {
        let by = V::all(simd, sign) * V::load(simd, by, from);
        (V::load(simd, row, at + from) + by).store(row, at + from);
        from += V::<S>::WIDTH;
    }
}

/// Adds the forces of flat corners on a brick's nodes, in N.
#[inline(always)]
pub(crate) fn corner_forces<S: Simd>(simd: S, form: &Form, u: &Local, f: &mut Local) {
    for which in 0..8 {
        let mut by = [[[0.0; LANES]; 3]; 3];
        let mut any = false;
        let mut from = 0;
        while from < LANES {
            let corner = Corner::of(simd, form, u, which, from, 0.0);
            if corner.modulus.any_above_zero() {
                any = true;
                let push = corner.push(simd);
                let normals = corner.normals();
                for axis in 0..3 {
                    for a in 0..3 {
                        (push * normals[axis][a]).store(&mut by[axis][a], from);
                    }
                }
            }
            from += V::<S>::WIDTH;
        }
        if !any {
            continue;
        }
        for axis in 0..3 {
            let start = start(which, axis);
            for a in 0..3 {
                add(simd, &mut f[a], start + STEP[axis], &by[axis][a], 1.0);
                add(simd, &mut f[a], start, &by[axis][a], -1.0);
            }
        }
    }
}

/// Adds upper bounds of flat corners to the diagonal blocks of a brick's nodes, in N/m.
#[inline(always)]
pub(crate) fn corner_tangents<S: Simd>(
    simd: S,
    form: &Form,
    u: &Local,
    per_spacing: f32,
    m: &mut LocalBlocks,
) {
    let zero = V::all(simd, 0.0);
    let spacing = V::all(simd, 2.0 / per_spacing);
    for which in 0..8 {
        // Blocks of the ends of the three edges, and of the corner itself.
        let mut blocks = [[[0.0; LANES]; 6]; 4];
        let mut any = false;
        let mut from = 0;
        while from < LANES {
            let corner = Corner::of(simd, form, u, which, from, MARGIN);
            if corner.modulus.any_above_zero() {
                any = true;
                let turning = V::all(simd, NODES) * corner.push(simd) * spacing;
                let stiffness = V::all(simd, NODES) * corner.stiffness(simd);
                let normals = corner.normals();
                let mut own = [zero, zero, zero];
                for axis in 0..3 {
                    for a in 0..3 {
                        own[a] = if which >> axis & 1 == 1 {
                            own[a] + normals[axis][a]
                        } else {
                            own[a] - normals[axis][a]
                        };
                    }
                    stiffen(&mut blocks[axis], from, &normals[axis], stiffness, turning);
                }
                stiffen(&mut blocks[3], from, &own, stiffness, turning);
            }
            from += V::<S>::WIDTH;
        }
        if !any {
            continue;
        }
        for (end, block) in blocks.iter().enumerate() {
            let at = match end {
                3 => own(which),
                axis if which >> axis & 1 == 1 => start(which, axis),
                axis => start(which, axis) + STEP[axis],
            };
            for (row, by) in m.iter_mut().zip(block) {
                add(simd, row, at, by, 1.0);
            }
        }
    }
}

#[inline(always)]
fn stiffen<S: Simd>(
    to: &mut [[f32; LANES]; 6],
    from: usize,
    gradient: &[V<S>; 3],
    stiffness: V<S>,
    turning: V<S>,
) {
    for (e, row) in to.iter_mut().enumerate() {
        let (a, b) = PAIRS[e];
        let mut v = stiffness * gradient[a] * gradient[b];
        if e < 3 {
            v = v + turning;
        }
        v.store(row, from);
    }
}
