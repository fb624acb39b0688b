//! Restoring the voxel volume of every region.
//!
//! Moving vertex v by d changes the volume of region r by g(r,v)·d, where g is a third of the sum of the area
//! vectors of r's triangles around v. The smallest movement (in the world's metric) that restores the missing
//! volume of every region is d(v) = D Σ λ(r) g(r,v), with λ from A λ = missing, A(r,s) = Σ g(r,v)ᵀ D g(s,v).
//! Regions that share vertices are solved together. D maps a direction in voxel indices into the world and
//! drops locked axes.

use nalgebra::Matrix3;
use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::net::Net;
use super::smooth::confined;

/// Newton steps towards the volumes; each squares the error unless vertices reach their limits.
const STEPS: usize = 12;
/// Relative tolerance of a region's volume.
const EXACT: f64 = 1e-6;
/// Accepted relative error of a region's volume at the end; a model guarantees a hundredth.
const TOLERANCE: f64 = 2e-3;
/// Largest movement of a vertex in one step, in voxels.
const STEP_MAX: f64 = 0.2;
/// Rounds in which the vertices of regions that miss their volume move half way back to their corners. After
/// them they move all the way back, where the volume is exact.
const HALVINGS: usize = 4;
/// Quadrilaterals per partial sum; the order of summation does not depend on the number of threads.
const CHUNK: usize = 4096;

/// Moves the vertices until every region has its volume (in voxels) within [`TOLERANCE`].
pub(super) fn restore(net: &mut Net, targets: &[f64]) {
    net.choose_diagonals();
    let mut frozen = vec![false; targets.len()];
    for round in 0.. {
        push_towards(net, targets, &frozen);
        let volumes = volumes(net, targets.len());
        let off = |r: usize| (volumes[r] / targets[r] - 1.0).abs() > TOLERANCE;
        let wrong: Vec<usize> = (0..targets.len())
            .filter(|&r| off(r) && !frozen[r])
            .collect();
        if wrong.is_empty() {
            return;
        }
        let part = if round < HALVINGS { 0.5 } else { 0.0 };
        for r in &wrong {
            frozen[*r] = round >= HALVINGS;
        }
        for (v, corner) in net.corners.iter().enumerate() {
            if wrong.iter().any(|r| corner.block.contains(&(*r as u8 + 1))) {
                net.moved[v] *= part;
            }
        }
    }
}

/// Takes steps towards the volumes, within the vertices' limits. Vertices of frozen regions stay (`frozen` may
/// be empty).
pub(super) fn push_towards(net: &mut Net, targets: &[f64], frozen: &[bool]) {
    let pull = Pull::new(net, frozen);
    for _ in 0..STEPS {
        let volumes = volumes(net, targets.len());
        let missing: Vec<f64> = targets.iter().zip(&volumes).map(|(t, v)| t - v).collect();
        if missing
            .iter()
            .zip(targets)
            .all(|(m, t)| m.abs() <= EXACT * t)
        {
            return;
        }
        pull.step(net, missing);
    }
}

/// Volume that each region's surface encloses, in voxels.
pub(super) fn volumes(net: &Net, regions: usize) -> Vec<f64> {
    let parts: Vec<Vec<f64>> = net
        .quads
        .par_chunks(CHUNK)
        .map(|quads| {
            let mut sums = vec![0.0; regions + 1];
            let volume = |p: [Vec3; 4], t: [usize; 3]| p[t[0]].dot(&p[t[1]].cross(&p[t[2]])) / 6.0;
            for q in quads {
                let p = q.corners.map(|v| net.position(v));
                let [one, two] = q.triangles().map(|t| volume(p, t));
                sums[usize::from(q.sides[0])] += one + two;
                sums[usize::from(q.sides[1])] -= one + two;
            }
            sums
        })
        .collect();
    let mut sums = vec![0.0; regions];
    for part in parts {
        for (sum, p) in sums.iter_mut().zip(&part[1..]) {
            *sum += p;
        }
    }
    sums
}

/// Constant parts of the equations.
struct Pull {
    /// First entry of each vertex, and one past the last of all.
    start: Vec<u32>,
    /// Regions around each vertex, ascending.
    regions: Vec<u8>,
    /// D without locked axes.
    metric: Matrix3<f64>,
    /// Whether a vertex stays where it is.
    stays: Vec<bool>,
}

impl Pull {
    fn new(net: &Net, frozen: &[bool]) -> Self {
        let mut start = vec![0];
        let mut regions = Vec::new();
        let mut stays = Vec::with_capacity(net.corners.len());
        let is_region =
            |r: &u8| *r != super::voxel_grid::OUTSIDE && *r != super::voxel_grid::BEYOND;
        for corner in &net.corners {
            let mut around = corner.block;
            around.sort_unstable();
            let first = regions.len();
            for r in around.into_iter().filter(is_region) {
                if regions[first..].last() != Some(&r) {
                    regions.push(r);
                }
            }
            let frozen = |r: &u8| frozen.get(usize::from(*r) - 1) == Some(&true);
            stays.push(regions[first..].iter().any(frozen));
            start.push(regions.len() as u32);
        }
        let m = &net.to_world.linear;
        let gram = Matrix3::from_fn(|r, c| m.column(r).dot(&m.column(c)));
        let scale = gram.trace() / 3.0;
        let metric = gram
            .try_inverse()
            .map_or(Matrix3::identity(), |i| i * scale);
        Self {
            start,
            regions,
            metric,
            stays,
        }
    }

    fn step(&self, net: &mut Net, mut missing: Vec<f64>) {
        let gradients = self.gradients(net);
        let n = missing.len();
        let mut matrix = vec![0.0; n * n];
        let entries = |v: usize| self.start[v] as usize..self.start[v + 1] as usize;
        for v in (0..net.corners.len()).filter(|&v| !self.stays[v]) {
            for r in entries(v) {
                let towards = self.direction(net, v, &gradients[r]);
                for s in entries(v) {
                    let (row, column) = (self.regions[r] - 1, self.regions[s] - 1);
                    matrix[usize::from(row) * n + usize::from(column)] +=
                        towards.dot(&gradients[s]);
                }
            }
        }
        solve(&mut matrix, &mut missing);
        let moved = (0..net.corners.len())
            .into_par_iter()
            .map(|v| {
                if self.stays[v] {
                    return net.moved[v];
                }
                let mut g = Vec3::zeros();
                for e in entries(v) {
                    g += gradients[e] * missing[usize::from(self.regions[e]) - 1];
                }
                let step = self.direction(net, v, &g);
                let length = step.norm();
                let step = if length > STEP_MAX {
                    step * (STEP_MAX / length)
                } else {
                    step
                };
                confined(net.moved[v] + step, &net.corners[v])
            })
            .collect();
        net.moved = moved;
    }

    /// D g for one vertex.
    fn direction(&self, net: &Net, v: usize, g: &Vec3) -> Vec3 {
        let locked = net.corners[v].locked;
        let free = |a: usize| locked >> a & 1 == 0;
        Vec3::from_fn(|r, _| {
            let term = |c: usize| {
                if free(c) {
                    self.metric[(r, c)] * g[c]
                } else {
                    0.0
                }
            };
            if free(r) {
                term(0) + term(1) + term(2)
            } else {
                0.0
            }
        })
    }

    fn gradients(&self, net: &Net) -> Vec<Vec3> {
        let vectors: Vec<[Vec3; 2]> = net
            .quads
            .par_iter()
            .map(|q| {
                let p = q.corners.map(|v| net.position(v));
                q.triangles()
                    .map(|[a, b, c]| (p[b] - p[a]).cross(&(p[c] - p[a])) / 6.0)
            })
            .collect();
        let mut gradients = vec![Vec3::zeros(); self.regions.len()];
        for (q, vectors) in net.quads.iter().zip(&vectors) {
            for (triangle, vector) in q.triangles().into_iter().zip(vectors) {
                for v in triangle.map(|c| q.corners[c] as usize) {
                    let (from, to) = (self.start[v] as usize, self.start[v + 1] as usize);
                    for e in from..to {
                        if self.regions[e] == q.sides[0] {
                            gradients[e] += vector;
                        } else if self.regions[e] == q.sides[1] {
                            gradients[e] -= vector;
                        }
                    }
                }
            }
        }
        gradients
    }
}

/// Solves a symmetric positive semidefinite system in place by elimination. Rows without a pivot
/// (regions none of whose vertices can move) get zero.
fn solve(matrix: &mut [f64], right: &mut [f64]) {
    /// A pivot below this part of the largest diagonal is none.
    const PIVOT_MIN: f64 = 1e-12;
    let n = right.len();
    let largest = (0..n).map(|i| matrix[i * n + i]).fold(0.0, f64::max);
    let is_pivot = |x: f64| x > PIVOT_MIN * largest;
    for k in 0..n {
        let pivot = matrix[k * n + k];
        if !is_pivot(pivot) {
            continue;
        }
        for i in k + 1..n {
            let factor = matrix[i * n + k] / pivot;
            if factor != 0.0 {
                for j in k..n {
                    matrix[i * n + j] -= factor * matrix[k * n + j];
                }
                right[i] -= factor * right[k];
            }
        }
    }
    for k in (0..n).rev() {
        let pivot = matrix[k * n + k];
        if !is_pivot(pivot) {
            right[k] = 0.0;
            continue;
        }
        for j in k + 1..n {
            right[k] -= matrix[k * n + j] * right[j];
        }
        right[k] /= pivot;
    }
}
