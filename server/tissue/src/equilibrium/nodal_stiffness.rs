//! Stiffness of the nodes of a coarse element, and its condensation to the corners.
//!
//! The unknowns are hierarchical: with the trilinear weights P, `u = P e + W z`. Along an axis the three nodes have the
//! functions (1, ½, 0) and (0, ½, 1) of P and the bubble (1, -1, 1) of W, which is orthogonal to both with the masses 1, 2, 1
//! of the nodes; in space these are products. So W spans the kernel of `PᵀM`, and the stiffness `XᵀAX`, X = (W, P), needs three
//! passes over the rows per side. Elimination of z leaves the least energy of nodes that follow the corners in the mean
//! (`effective_stiffness`).

use nalgebra::Matrix3;
use pulp::Simd;

use super::brick::{CORNER, Form, LOCALS, OFFSETS};
use super::element::{Dense, spring_block, volume_gradients};
use super::lanes::Wide;
use super::matrix::{SIZE, at};

/// Unknowns of an element.
const UNKNOWNS: usize = 3 * LOCALS;
/// The unknowns in whole vectors of any width.
const ROW: usize = 88;
/// Functions of W.
const BUBBLES: usize = LOCALS - 8;
/// Stiffness that keeps nodes without tissue at their interpolated places, relative to the largest entry of A. Fixed nodes have
/// no entries in A and are held like them; it does no work.
const HELD: f64 = 1e6;
/// Stiffness of motions without energy, relative to the largest entry of A.
const NOTHING: f64 = 1e-9;
/// Values of the three functions of an axis at each of its nodes.
const VALUES: [[f64; 3]; 3] = [[1.0, 1.0, 0.0], [0.5, -1.0, 0.5], [0.0, 1.0, 1.0]];

/// Position of each node among the unknowns: first those with bubbles, then the corners.
const POSITION: [usize; LOCALS] = positions();

const fn positions() -> [usize; LOCALS] {
    let mut list = [0; LOCALS];
    let (mut i, mut bubbles) = (0, 0);
    while i < LOCALS {
        let [x, y, z] = [i % 3, i / 3 % 3, i / 9];
        if x == 1 || y == 1 || z == 1 {
            list[i] = bubbles;
            bubbles += 1;
        } else {
            list[i] = BUBBLES + x / 2 + y + 2 * z;
        }
        i += 1;
    }
    assert!(bubbles == BUBBLES);
    list
}

/// The symmetric stiffness of the nodes of an element, by their positions and the axes.
pub(super) struct NodalStiffness {
    a: Vec<[f64; ROW]>,
}

impl NodalStiffness {
    pub(super) fn new() -> Self {
        Self {
            a: vec![[0.0; ROW]; UNKNOWNS],
        }
    }

    /// Adds the springs and volume terms of a brick; bit `i` of `fixed` marks entry `i` as fixed.
    #[inline(always)]
    pub(super) fn add_brick(&mut self, form: &Form, fixed: u32, per_spacing: f32) {
        let moves = |entry: usize| fixed >> entry & 1 == 0;
        for (direction, offset) in OFFSETS.into_iter().enumerate() {
            for (i, &k) in form.stiffness[direction][..LOCALS].iter().enumerate() {
                if k > 0.0 {
                    let ends = [i, i + offset];
                    let [xx, yy, zz, xy, xz, yz, ..] =
                        spring_block(form, ends, f64::from(k), per_spacing);
                    let block = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
                    for (p, q) in [(0, 0), (1, 1), (0, 1), (1, 0)] {
                        if moves(ends[p]) && moves(ends[q]) {
                            let sign = if p == q { 1.0 } else { -1.0 };
                            self.add_block([ends[p], ends[q]], sign, &block);
                        }
                    }
                }
            }
        }
        if form.has_bulk {
            self.add_bulk(form, moves);
        }
    }

    #[inline(always)]
    fn add_bulk(&mut self, form: &Form, moves: impl Fn(usize) -> bool) {
        for corners in CORNER {
            let bulk = f64::from(form.bulk[corners[0]]);
            if bulk == 0.0 {
                continue;
            }
            let g = volume_gradients(form, &corners);
            for (c, d) in (0..64).map(|i| (i / 8, i % 8)) {
                if moves(corners[c]) && moves(corners[d]) {
                    let block = g[c].map(|v| g[d].map(|w| v * w));
                    self.add_block([corners[c], corners[d]], bulk, &block);
                }
            }
        }
    }

    /// Adds the matrix of a finer element at an octant.
    #[inline(always)]
    pub(super) fn add_child(&mut self, k: &Dense, octant: usize) {
        for (c, &i) in CORNER[octant].iter().enumerate() {
            for (d, &j) in CORNER[octant].iter().enumerate() {
                let block = [0, 1, 2].map(|a| [0, 1, 2].map(|b| k[at(c, a)][at(d, b)]));
                self.add_block([i, j], 1.0, &block);
            }
        }
    }

    #[inline(always)]
    fn add_block(&mut self, nodes: [usize; 2], factor: f64, block: &[[f64; 3]; 3]) {
        let [i, j] = nodes.map(|node| 3 * POSITION[node]);
        for (row, values) in self.a[i..i + 3].iter_mut().zip(block) {
            for (to, v) in row[j..j + 3].iter_mut().zip(values) {
                *to += factor * v;
            }
        }
    }

    /// The matrix of the corners with the least energy of z, times a factor.
    #[inline(always)]
    pub(super) fn condensed<S: Simd>(self, simd: S, factor: f64) -> Dense {
        let largest = (0..UNKNOWNS).map(|i| self.a[i][i]).fold(0.0, f64::max);
        if largest == 0.0 {
            return [[0.0; SIZE]; SIZE];
        }
        let diagonal = |i: usize, a: usize| self.a[3 * POSITION[i] + a][3 * POSITION[i] + a];
        let is_absent = |&i: &usize| (0..3).all(|a| diagonal(i, a) == 0.0);
        let absent: Vec<usize> = (0..LOCALS).filter(is_absent).collect();
        let mut t = self.a;
        change_rows(simd, &mut t);
        let mut t = transposed(&t);
        change_rows(simd, &mut t);
        for node in absent {
            hold(&mut t, node, HELD * largest);
        }
        for p in (0..3 * BUBBLES).step_by(3) {
            eliminate(simd, &mut t, p, NOTHING * largest);
        }
        let of = |i: usize| 3 * BUBBLES + i;
        std::array::from_fn(|i| std::array::from_fn(|j| factor * t[of(i.min(j))][of(i.max(j))]))
    }
}

/// Block elimination of three unknowns from the rows after them, whose entries before the diagonal are not needed. `nothing`
/// is the stiffness of motions without energy.
#[inline(always)]
fn eliminate<S: Simd>(simd: S, t: &mut [[f64; ROW]], p: usize, nothing: f64) {
    let (above, below) = t.split_at_mut(p + 3);
    let [r, s, t] = [&above[p], &above[p + 1], &above[p + 2]];
    let (rs, rt, st) = (r[p + 1], r[p + 2], s[p + 2]);
    let block = Matrix3::new(r[p], rs, rt, rs, s[p + 1], st, rt, st, t[p + 2]);
    let block = block + Matrix3::identity() * nothing;
    let Some(m) = block.try_inverse() else {
        // Singular in spite of the floor: these unknowns stay zero.
        return;
    };
    let mut weights = [[0.0; 3]; UNKNOWNS];
    for (w, i) in weights.iter_mut().zip(p + 3..UNKNOWNS) {
        for (w, m) in w.iter_mut().zip(m.row_iter()) {
            *w = -(m[0] * r[i] + m[1] * s[i] + m[2] * t[i]);
        }
    }
    // Columns of a vector at a time, down to the last row that needs them.
    let width = Wide::<S>::WIDTH;
    for from in ((p + 3) / width * width..ROW).step_by(width) {
        let (r, s) = (Wide::load(simd, r, from), Wide::load(simd, s, from));
        let t = Wide::load(simd, t, from);
        let rows = (from + width).saturating_sub(p + 3).min(below.len());
        for (row, w) in below[..rows].iter_mut().zip(&weights) {
            let (a, b) = (Wide::all(simd, w[0]) * r, Wide::all(simd, w[1]) * s);
            let sum = Wide::load(simd, row, from) + a + b + Wide::all(simd, w[2]) * t;
            sum.store(row, from);
        }
    }
}

/// `Xᵀ A`, axis by axis.
#[inline(always)]
fn change_rows<S: Simd>(simd: S, a: &mut [[f64; ROW]]) {
    let half = Wide::all(simd, 0.5);
    for step in [1, 3, 9] {
        for first in (0..LOCALS).filter(|i| i / step % 3 == 0) {
            for axis in 0..3 {
                let line = [first, first + step, first + 2 * step];
                let rows = line.map(|node| 3 * POSITION[node] + axis);
                let Ok([low, middle, high]) = a.get_disjoint_mut(rows) else {
                    unreachable!("the positions of nodes differ");
                };
                for from in (0..ROW).step_by(Wide::<S>::WIDTH) {
                    let l = Wide::load(simd, low, from);
                    let m = Wide::load(simd, middle, from);
                    let h = Wide::load(simd, high, from);
                    (l + half * m).store(low, from);
                    (l - m + h).store(middle, from);
                    (half * m + h).store(high, from);
                }
            }
        }
    }
}

/// Adds a stiffness against the bubbles at a node.
fn hold(t: &mut [[f64; ROW]], node: usize, stiffness: f64) {
    let along = |i: usize| [i % 3, i / 3 % 3, i / 9];
    let at = along(node);
    let value = |function: usize| -> f64 {
        let values = at.iter().zip(along(function));
        values.map(|(&n, f)| VALUES[n][f]).product()
    };
    let bubbles = (0..LOCALS).filter(|&i| POSITION[i] < BUBBLES && value(i) != 0.0);
    let values: Vec<(usize, f64)> = bubbles.map(|i| (3 * POSITION[i], value(i))).collect();
    for &(i, v) in &values {
        for &(j, w) in &values {
            for a in 0..3 {
                t[i + a][j + a] += stiffness * v * w;
            }
        }
    }
}

/// Not inlined: vector gathers are slower than these copies.
#[inline(never)]
fn transposed(a: &[[f64; ROW]]) -> Vec<[f64; ROW]> {
    let mut to = vec![[0.0; ROW]; UNKNOWNS];
    for (i, row) in to.iter_mut().enumerate() {
        for (v, column) in row.iter_mut().zip(a) {
            *v = column[i];
        }
    }
    to
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::DMatrix;

    use super::super::element::WEIGHTS;
    use super::super::hierarchy::Hierarchy;
    use super::*;
    use crate::{Material, Topology, block};

    /// Independent of the functions W: the saddle point of the Lagrangian, by singular values.
    #[test]
    fn matrix_is_the_least_energy_of_nodes_that_follow_in_the_mean() {
        let mut model = block(
            [5; 3],
            4e-3,
            &Material {
                poisson: 0.4,
                ..Material::default()
            },
            1,
        );
        let mut stiff = model.regions[0].clone();
        stiff.material.young_pa *= 30.0;
        model.regions.push(stiff);
        for cell in model.cells.iter_mut().step_by(3) {
            cell.region = crate::RegionId(model.regions.len() as u16 - 1);
        }
        let hierarchy = Hierarchy::new(&Topology::new(Arc::new(model)));
        // The last brick has one layer of cells along each axis.
        let last = hierarchy.bricks.len() - 1;
        for (brick, fixed) in [
            (0, 0),
            (0, 0o777),
            (0, 0o777_111),
            (0, 0o707_070_007),
            (last, 0),
        ] {
            let form = &hierarchy.forms[hierarchy.bricks[brick].form as usize];
            let mut nodal = NodalStiffness::new();
            nodal.add_brick(form, fixed, hierarchy.per_spacing);
            let a = DMatrix::from_fn(UNKNOWNS, UNKNOWNS, |i, j| {
                nodal.a[3 * POSITION[i / 3] + i % 3][3 * POSITION[j / 3] + j % 3]
            });
            let p = DMatrix::from_fn(UNKNOWNS, SIZE, |i, j| {
                let moves = a[(i, i)] > 0.0;
                if moves && i % 3 == j % 3 {
                    WEIGHTS[i / 3][j / 3]
                } else {
                    0.0
                }
            });
            let mass = |i: usize| [i % 3, i / 3 % 3, i / 9].map(|x| if x == 1 { 2.0 } else { 1.0 });
            let c = DMatrix::from_fn(UNKNOWNS, SIZE, |i, j| {
                mass(i / 3).iter().product::<f64>() * p[(i, j)]
            });
            let k = nodal.condensed(pulp::Scalar::new(), 1.0);
            let mut saddle = DMatrix::zeros(UNKNOWNS + SIZE, UNKNOWNS + SIZE);
            saddle.view_mut((0, 0), (UNKNOWNS, UNKNOWNS)).copy_from(&a);
            saddle
                .view_mut((0, UNKNOWNS), (UNKNOWNS, SIZE))
                .copy_from(&c);
            saddle
                .view_mut((UNKNOWNS, 0), (SIZE, UNKNOWNS))
                .copy_from(&c.transpose());
            let mut right = DMatrix::zeros(UNKNOWNS + SIZE, SIZE);
            right
                .view_mut((UNKNOWNS, 0), (SIZE, SIZE))
                .copy_from(&c.tr_mul(&p));
            let solved = saddle.svd(true, true).solve(&right, 1e-10).unwrap();
            let u = solved.rows(0, UNKNOWNS);
            let least = u.tr_mul(&(&a * u));
            for (i, j) in (0..SIZE * SIZE).map(|i| (i / SIZE, i % SIZE)) {
                let [k, least] = [k[i][j], least[(i, j)]];
                assert!(
                    (k - least).abs() < 1e-4 * a.max(),
                    "{brick} {fixed:o}: {k} {least}"
                );
            }
        }
    }
}
