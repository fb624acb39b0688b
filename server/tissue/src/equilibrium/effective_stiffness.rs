//! Effective stiffness of coarse elements: numerical coarsening (Kharevych et al. 2009) by one test load.
//!
//! A trilinear element is stiffer than the tissue in it. It can not bend a stiff sheet over a soft layer, and it strains
//! cells on a curved surface when it only turns. The V-cycle corrects this on the nodes, but an element that a quick step
//! defers answers by its matrix alone. So the matrix K of a deferred element is scaled by
//!
//! ```text
//! factor = - Σ f · P t / (tᵀ K t)
//! ```
//!
//! f are the forces of its bricks and t its corner displacements under random forces on the surface of the uncut model,
//! after a few iterations. Rotations are taken out of t, and give no force, unless the element contains fixed nodes.
//! Elements that a cut splits keep their factor.

use std::collections::BTreeMap;

use nalgebra::{SMatrix, SVector};
use pulp::Simd;

use super::brick::{CORNER, LOCALS};
use super::budget::Budget;
use super::cut_preparer::all_own_stiffness;
use super::element::WEIGHTS;
use super::fine_level::FineLevel;
use super::hierarchy::{Hierarchy, Level, LevelPlaces};
use super::matrix::{Corners, Matrix};
use super::quad::ZERO;
use super::solver::Solver;
use super::weight::hanging_nodes;
use crate::{Shape, Topology, Vec3};

/// Iterations of the test load. With four or twenty the force error of a press differs by less than 0.3 % (rms).
/// With two a deep release at 2 mm was up to 23 % off.
const ITERATIONS: usize = 3;
/// Residual of the test load at which it ends.
const TOLERANCE: f64 = 1e-3;
/// Test forces relative to the one that moves a typical node by a spacing: strains stay small.
const LOAD: f64 = 1e-3;
/// Bounds of a factor. With 0.2 as the lower one, a withdrawal from a thigh all of skin refined most of the model.
const FACTORS: [f64; 2] = [0.35, 1.0];
/// Factor without a test load, in components without fixed nodes.
const UNKNOWN: f32 = 0.75;
/// Stiffness that draws corners without nodes to the mean of the others in the fit of t.
const LOOSE: f64 = 1e-3;

/// How a deferred element answers to displacements of its corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Effective {
    /// Stiffness relative to its matrix.
    factor: f32,
    /// Whether it can turn without a force.
    turns: bool,
}

impl Effective {
    /// The matrix itself.
    pub(super) const MATRIX: Self = Self {
        factor: 1.0,
        turns: false,
    };

    /// This stiffness times a factor.
    #[inline(always)]
    pub(super) fn times(self, factor: f32) -> Self {
        Self {
            factor: self.factor * factor,
            ..self
        }
    }

    /// Forces in N for these displacements of the corners in m.
    #[inline(always)]
    pub(super) fn force<S: Simd>(self, simd: S, k: &Matrix, by: &Corners) -> Corners {
        const ALL: [u32; 8] = [0, 1, 2, 3, 4, 5, 6, 7];
        let mut force = if self.turns {
            let strains = without_rotation(by);
            without_rotation(&k.multiply(simd, &ALL, &strains).corners())
        } else {
            k.multiply(simd, &ALL, by).corners()
        };
        for v in force.as_flattened_mut() {
            *v *= self.factor;
        }
        force
    }
}

/// Side of the element on which a corner is, along an axis.
#[inline(always)]
const fn side(corner: usize, axis: usize) -> f32 {
    if corner >> axis & 1 == 1 { 1.0 } else { -1.0 }
}

/// Values of the corners without their mean rotation about the middle.
#[inline(always)]
fn without_rotation(by: &Corners) -> Corners {
    let mut turn = [0.0; 3];
    for (c, v) in by.iter().enumerate() {
        let [x, y, z] = [side(c, 0), side(c, 1), side(c, 2)];
        turn[0] += y * v[2] - z * v[1];
        turn[1] += z * v[0] - x * v[2];
        turn[2] += x * v[1] - y * v[0];
    }
    // Each axis has a moment of inertia of 16.
    let [a, b, c] = [turn[0] / 16.0, turn[1] / 16.0, turn[2] / 16.0];
    let mut rest = *by;
    for (corner, v) in rest.iter_mut().enumerate() {
        let [x, y, z] = [side(corner, 0), side(corner, 1), side(corner, 2)];
        v[0] -= b * z - c * y;
        v[1] -= c * x - a * z;
        v[2] -= a * y - b * x;
    }
    rest
}

/// Answers of the elements of a model, by level and place.
#[derive(Debug, Default)]
pub(crate) struct EffectiveStiffness {
    levels: Vec<BTreeMap<[i32; 3], Effective>>,
}

impl EffectiveStiffness {
    /// Measures the elements of an uncut topology.
    pub(super) fn of(topology: &Topology, hierarchy: &Hierarchy, places: &LevelPlaces) -> Self {
        let own = all_own_stiffness(topology);
        let fine = FineLevel::new(topology, hierarchy, own);
        let mut solver = Solver::with(topology, hierarchy.clone(), fine, None);
        solver.fine.load_surface(topology, LOAD * solver.least);
        solver.reference = solver.fine.square_of_weights().sqrt();
        solver.fine.disturb_all();
        solver.dirty = true;
        let mut shape = Shape::rest(topology);
        let budget = Budget::new(ITERATIONS, TOLERANCE);
        solver.step(topology, &mut shape, &[], budget);
        // Evaluates every brick at the final shape.
        solver.residual_over_all(&shape);
        let mut tested = Tested::first(&solver, &shape);
        let mut levels = Vec::with_capacity(hierarchy.levels.len());
        for (l, (level, places)) in hierarchy.levels.iter().zip(places).enumerate() {
            if let Some(finer) = l.checked_sub(1) {
                tested = tested.coarser(&hierarchy.levels[finer], level);
            }
            let mut works: BTreeMap<[i32; 3], Work> = BTreeMap::new();
            for (e, &place) in places.iter().enumerate() {
                works.entry(place).or_default().add(level, e, &tested);
            }
            let effective = works.iter().map(|(place, work)| (*place, work.effective()));
            levels.push(effective.collect());
        }
        Self { levels }
    }

    /// The answers of these elements of a level.
    pub(super) fn at(&self, l: usize, places: &[[i32; 3]]) -> Vec<Effective> {
        let known = self.levels.get(l);
        let of = |place| known?.get(place).copied();
        let all = places
            .iter()
            .map(|place| of(place).unwrap_or(Effective::MATRIX));
        all.collect()
    }
}

impl FineLevel {
    /// Loads each node of the outer surface by a random force of up to `most` N per axis, if its component is fixed.
    fn load_surface(&mut self, topology: &Topology, most: f64) {
        let mut state = 0u64;
        let mut next = || (2.0 * random(&mut state) - 1.0) * most;
        let hangs = hanging_nodes(topology);
        self.weights = vec![ZERO; topology.node_count()];
        for (node, load) in (0..).zip(&mut self.weights) {
            if topology.on_boundary(node) && hangs[node as usize] {
                *load = [next() as f32, next() as f32, next() as f32, 0.0];
            }
        }
    }
}

/// Uniform random number below 1 (`SplitMix64`, Steele et al. 2014).
fn random(state: &mut u64) -> f64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// Place of a point in a part of an element (0..27), and the force of the part on it in N.
type Loaded = (u32, usize, Vec3);

/// The elements of a level under the test load.
struct Tested {
    /// Displacement of each point in m.
    displacement: Vec<Vec3>,
    /// Forces of each element on its corners in N.
    forces: Vec<[Vec3; 8]>,
    /// Whether each element contains fixed nodes.
    fixed: Vec<bool>,
}

impl Tested {
    /// Level 1, from the bricks.
    fn first(solver: &Solver, shape: &Shape) -> Self {
        let (fine, bricks) = (&solver.fine, &solver.hierarchy.bricks);
        let points = |brick: u32| -> Vec<Loaded> {
            let (brick, f) = (&bricks[brick as usize], &fine.forces[brick as usize]);
            let present = (0..LOCALS).filter(|i| brick.present >> i & 1 == 1);
            let force = |i: usize| Vec3::new(f[0][i].into(), f[1][i].into(), f[2][i].into());
            present.map(|i| (brick.nodes[i], i, force(i))).collect()
        };
        let is_fixed = |node: u32| fine.fixed[node as usize];
        let holds = |brick: u32| points(brick).iter().any(|point| is_fixed(point.0));
        let moving = |brick: u32| {
            let mut points = points(brick);
            for point in points.iter_mut().filter(|point| is_fixed(point.0)) {
                point.2 = Vec3::zeros();
            }
            points
        };
        Self::of(
            &solver.hierarchy.levels[0],
            &shape.displacement,
            moving,
            holds,
        )
    }

    /// The next coarser level.
    fn coarser(&self, finer: &Level, level: &Level) -> Self {
        let points = |child: u32| -> Vec<Loaded> {
            let c = child as usize;
            let place = CORNER[usize::from(finer.octant[c])];
            let corners = finer.corners[c].iter().zip(place).zip(self.forces[c]);
            corners
                .map(|((&point, place), force)| (point, place, force))
                .collect()
        };
        Self::of(level, &self.displacement, points, |child| {
            self.fixed[child as usize]
        })
    }

    /// A level from the displacements of the finer points and the parts of its elements.
    fn of(
        level: &Level,
        displacement: &[Vec3],
        points: impl Fn(u32) -> Vec<Loaded>,
        is_fixed: impl Fn(u32) -> bool,
    ) -> Self {
        let mut forces = Vec::with_capacity(level.corners.len());
        let mut fixed = Vec::with_capacity(level.corners.len());
        let mut sums = vec![(Vec3::zeros(), 0.0); level.points()];
        for (e, corners) in (0..).zip(&level.corners) {
            let mut force = [Vec3::zeros(); 8];
            let mut fit = Fit::default();
            let children = level.children.row(e);
            for (point, place, of_part) in children.iter().flat_map(|&child| points(child)) {
                fit.add(&WEIGHTS[place], &displacement[point as usize]);
                for (sum, w) in force.iter_mut().zip(WEIGHTS[place]) {
                    *sum += w * of_part;
                }
            }
            for (value, &point) in fit.corners().iter().zip(corners) {
                let sum = &mut sums[point as usize];
                sum.0 += value;
                sum.1 += 1.0;
            }
            forces.push(force);
            fixed.push(children.iter().any(|&child| is_fixed(child)));
        }
        Self {
            displacement: sums.iter().map(|(sum, count)| sum / *count).collect(),
            forces,
            fixed,
        }
    }
}

/// Trilinear least-squares fit of the corner values of an element.
struct Fit {
    normal: SMatrix<f64, 8, 8>,
    right: SMatrix<f64, 8, 3>,
}

impl Default for Fit {
    fn default() -> Self {
        let mean = SMatrix::from_element(1.0 / 8.0);
        // The second part keeps an element without nodes regular.
        let normal = (SMatrix::identity() - mean) * LOOSE + SMatrix::identity() * 1e-9;
        Self {
            normal,
            right: SMatrix::zeros(),
        }
    }
}

impl Fit {
    fn add(&mut self, weights: &[f64; 8], value: &Vec3) {
        let weights = SVector::from(*weights);
        self.normal.ger(1.0, &weights, &weights, 1.0);
        self.right.ger(1.0, &weights, value, 1.0);
    }

    fn corners(self) -> [Vec3; 8] {
        let Some(factors) = self.normal.cholesky() else {
            return [Vec3::zeros(); 8];
        };
        let values = factors.solve(&self.right);
        std::array::from_fn(|c| values.row(c).transpose())
    }
}

/// Work of the elements at one place along their test displacement in N m.
#[derive(Default)]
struct Work {
    bricks: f64,
    matrix: f64,
    fixed: bool,
}

impl Work {
    /// Adds element `e` of a level.
    fn add(&mut self, level: &Level, e: usize, tested: &Tested) {
        let mut by = level.corners[e].map(|point| {
            let v = tested.displacement[point as usize];
            [v.x as f32, v.y as f32, v.z as f32, 0.0]
        });
        self.fixed |= tested.fixed[e];
        if !tested.fixed[e] {
            by = without_rotation(&by);
        }
        let (_, matrix) = level.element(e as u32);
        let forces = Effective::MATRIX.force(pulp::Scalar::new(), matrix, &by);
        for ((v, force), of_matrix) in by.iter().zip(&tested.forces[e]).zip(&forces) {
            for a in 0..3 {
                self.bricks -= force[a] * f64::from(v[a]);
                self.matrix += f64::from(of_matrix[a]) * f64::from(v[a]);
            }
        }
    }

    fn effective(&self) -> Effective {
        let factor = self.bricks / self.matrix;
        let [least, most] = FACTORS;
        Effective {
            factor: if factor.is_finite() {
                factor.clamp(least, most) as f32
            } else {
                UNKNOWN
            },
            turns: !self.fixed,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::{Material, block};

    const CELL: f64 = 4e-3;

    fn answers(topology: &Topology) -> Vec<(Effective, [f64; 3])> {
        let hierarchy = Hierarchy::new(topology);
        let level = &hierarchy.levels[0];
        let middle = |e: u32| {
            let brick = &hierarchy.bricks[level.children.row(e)[0] as usize];
            (topology.rest(brick.nodes[13]) / CELL).into()
        };
        let elements = 0..level.corners.len() as u32;
        elements
            .map(|e| (level.effective[e as usize], middle(e)))
            .collect()
    }

    /// Mean factor of the elements with heights between these cells.
    fn mean(list: &[(Effective, [f64; 3])], from: f64, to: f64) -> f32 {
        let here = list.iter().filter(|(_, at)| from < at[2] && at[2] < to);
        let factors: Vec<f32> = here.map(|(answer, _)| answer.factor).collect();
        factors.iter().sum::<f32>() / factors.len() as f32
    }

    #[test]
    fn uniform_tissue_is_nearly_its_matrix_and_an_interface_is_softer() {
        let mut model = block([16, 16, 14], CELL, &Material::default(), 2);
        let uniform = answers(&Topology::new(Arc::new(model.clone())));
        // The upper half of the third row of elements is thirty times as stiff.
        let mut stiff = model.regions[0].clone();
        stiff.material.young_pa *= 30.0;
        stiff.pinned = false;
        let id = crate::RegionId(model.regions.len() as u16);
        model.regions.push(stiff);
        for cell in &mut model.cells {
            if model.lattice[cell.corners[0] as usize][2] >= 9 {
                cell.region = id;
            }
        }
        let layered = answers(&Topology::new(Arc::new(model)));
        let [whole, interface] = [&uniform, &layered].map(|list| mean(list, 8.0, 10.0));
        assert!((0.75..1.0).contains(&whole), "{whole}");
        assert!(interface < 0.8 * whole, "{interface}, {whole}");
        for (answer, at) in uniform {
            assert_eq!(answer.turns, at[2] > 4.0, "{at:?}");
        }
    }

    #[test]
    fn loose_component_has_the_unknown_factor() {
        let model = block([6, 6, 6], CELL, &Material::default(), 0);
        let answers = answers(&Topology::new(Arc::new(model)));
        assert!(answers.iter().all(|(answer, _)| answer.factor == UNKNOWN));
    }

    proptest! {
        /// Forces balance, do no work on a rotation, and never push along a displacement.
        #[test]
        fn forces_balance_and_resist(
            x in prop::array::uniform24(-1.0..1.0f32), turn in prop::array::uniform3(-1.0..1.0f32),
        ) {
            let hierarchy = Hierarchy::new(&Topology::new(Arc::new(block([8, 8, 8], CELL, &Material::default(), 1))));
            let level = &hierarchy.levels[0];
            let mut by = [ZERO; 8];
            for (i, v) in x.iter().enumerate() {
                by[i / 3][i % 3] = *v;
            }
            let mut turned = by;
            for (c, v) in turned.iter_mut().enumerate() {
                let [x, y, z] = [side(c, 0), side(c, 1), side(c, 2)];
                v[0] += turn[1] * z - turn[2] * y;
                v[1] += turn[2] * x - turn[0] * z;
                v[2] += turn[0] * y - turn[1] * x;
            }
            for (e, answer) in level.effective.iter().enumerate() {
                let k = level.element(e as u32).1;
                let force = |by: &Corners| answer.force(pulp::Scalar::new(), k, by);
                let forces = force(&by);
                let work: f32 = forces.iter().flatten().zip(by.as_flattened()).map(|(f, v)| f * v).sum();
                prop_assert!(work > 0.0);
                let largest = forces.as_flattened().iter().fold(0.0f32, |a, f| a.max(f.abs()));
                if answer.turns {
                    for a in 0..3 {
                        let sum: f32 = forces.iter().map(|f| f[a]).sum();
                        prop_assert!(sum.abs() < 1e-4 * largest);
                    }
                    for (f, g) in forces.iter().flatten().zip(force(&turned).as_flattened()) {
                        prop_assert!((f - g).abs() < 1e-4 * largest);
                    }
                }
            }
        }
    }
}
