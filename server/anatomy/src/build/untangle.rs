//! Making every cell meet the quality floors (reconstructed).
//!
//! Where a step of the lattice lies on a smooth surface, a cell has two or three faces in one plane: its corner
//! there is flat, and a little noise inverts it. Such a node has to leave the surface by a few hundredths of a
//! spacing. With the other nodes held, the determinants at the corners that involve a node are linear in its
//! position x, so
//!
//! ```text
//! f(x) = w (n·(x - s))² + ε |x - x0|² + Σ max(0, D - det(x))² + Σ max(0, L - |x - y|)²
//! ```
//!
//! (s the point of its surface, n the normal there) is convex except for the spring lengths, and a few Newton
//! steps minimise it. Nodes of failing cells are visited in eight colours by the parity of their lattice point.
//! No two nodes of one colour share a cell, so each colour runs in parallel and the result is the same on any
//! number of threads. Cells that still fail are released: their nodes move back towards their lattice points,
//! where every cell is a cube, until the cells pass.
//!
//! A step of 0.05 spacings off the surface is a tenth of a layer of half a spacing. So the nodes of layers one cell
//! thick then return towards their surfaces as far as cells do not fail.

use palpate_tissue::Vec3;
use palpate_tissue::cell::NO_CELL;
use rayon::prelude::*;

use super::constraint::Constraint;
use super::interfaces::Interfaces;
use super::lattice::Lattice;
use super::quality::{CORNER_FLOOR, SPRING_FLOOR, corner, passes};
use super::snap::{ON_SURFACE, project};

/// Cells with a smaller determinant, in Δd³, or a shorter spring, in Δd, are visited.
const GOOD: (f64, f64) = (0.03, 0.33);
/// Target of the minimisation: a margin above the floor, so that one visit suffices.
pub(super) const AIM: (f64, f64) = (0.08, 0.38);
/// Limits that must hold at the end; slightly above the floors, to be safe from rounding.
pub(super) const FLOOR: (f64, f64) = (CORNER_FLOOR * 1.001, SPRING_FLOOR * 1.001);

/// Sweeps, and their weights of the distance to the surface (w above). Later sweeps let nodes move farther off.
const STAGES: [(usize, f64); 3] = [(10, 0.1), (12, 0.01), (16, 0.001)];
/// Part of a gap that each of its two sides may take up for the volumes of its regions.
const GAP_PART: f64 = 0.25;
/// Distance in spacings between a lattice point and the places of its copies, along each axis that a copy faces.
const GAP_SIDE: f64 = 0.125;
/// Weight of the distance to the current position (ε above).
const INERTIA: f64 = 0.02;
/// Newton steps per visit.
const NEWTON_STEPS: usize = 4;
/// Longest move in one visit, in spacings.
const MOVE_MAX: f64 = 0.25;
/// Fractions of a move that are tried until the cells around a node pass.
const TRIES: [f64; 3] = [1.0, 0.5, 0.25];
/// Rounds in which the nodes of thin layers return to their interfaces.
const RETURNS: usize = 3;
/// Rounds in which nodes move half way back to their lattice points, each followed by sweeps.
const HALVINGS: usize = 6;
const SWEEPS_AFTER_HALVING: usize = 4;

/// The cells around each node: slot `c` holds the cell of which it is corner `c`.
pub(super) struct Untangler<'a> {
    lattice: &'a Lattice,
    interfaces: &'a Interfaces,
    constraints: &'a [Constraint],
    spacing: f64,
    origin: Vec3,
    around: Vec<[u32; 8]>,
}

impl<'a> Untangler<'a> {
    /// Gathers the cells around each node. `origin` is the position of lattice point (0, 0, 0).
    pub(super) fn new(
        lattice: &'a Lattice,
        interfaces: &'a Interfaces,
        constraints: &'a [Constraint],
        spacing: f64,
        origin: Vec3,
    ) -> Self {
        let mut around = vec![[NO_CELL; 8]; lattice.nodes.len()];
        for (index, cell) in lattice.cells.iter().enumerate() {
            for (c, &node) in cell.corners.iter().enumerate() {
                around[node as usize][c] = index as u32;
            }
        }
        Self {
            lattice,
            interfaces,
            constraints,
            spacing,
            origin,
            around,
        }
    }

    /// Moves nodes until every cell meets the floors; returns the released nodes, in order.
    pub(super) fn untangle(&self, positions: &mut [Vec3]) -> Vec<u32> {
        let mut bad = self.failing(0..self.lattice.cells.len() as u32, positions, GOOD);
        for (sweeps, hold) in STAGES {
            for _ in 0..sweeps {
                bad = self.sweep(&bad, hold, positions);
            }
        }
        let bad = self.failing(bad.into_iter(), positions, FLOOR);
        let gone = self.let_go(bad, positions);
        self.return_layers(positions);
        gone
    }

    /// Returns the nodes of layers one cell thick towards their interfaces. All corners of their cells lie on interfaces,
    /// and not all on the same one.
    fn return_layers(&self, positions: &mut [Vec3]) {
        let layers = self.lattice.cells.iter().filter(|cell| {
            let corners = cell.corners.map(|node| self.constraints[node as usize]);
            let common = corners.into_iter().reduce(Constraint::common);
            !corners.iter().any(|c| c.free()) && common.is_some_and(Constraint::free)
        });
        let nodes = sorted(layers.flat_map(|cell| cell.corners));
        for _ in 0..RETURNS {
            let moves = nodes.par_iter().filter_map(|&node| {
                let at = positions[node as usize];
                let by = project(self.interfaces, self.constraints[node as usize], at) - at;
                (by.norm() > ON_SURFACE * self.spacing).then_some((node, by))
            });
            let moves: Vec<(u32, Vec3)> = moves.collect();
            self.move_while_it_holds(&moves, GOOD, positions);
        }
    }

    /// The cells around each node.
    pub(super) fn into_around(self) -> Vec<[u32; 8]> {
        self.around
    }

    /// Some nodes and all others of the cells around them, sorted.
    pub(super) fn with_neighbours(&self, nodes: &[u32]) -> Vec<u32> {
        self.nodes_of(&self.cells_at(nodes))
    }

    /// The lattice point of a node, for a copy a place on its own side of the gap.
    fn lattice_point(&self, node: u32) -> Vec3 {
        let mut at = Vec3::from(self.lattice.nodes[node as usize].map(f64::from));
        if self.copies(node).next().is_some() {
            let facing = self.constraints[node as usize].facing;
            at -= Vec3::from(facing.map(|f| f64::from(f.signum()))) * GAP_SIDE;
        }
        self.origin + at * self.spacing
    }

    /// The other copies of a node, on other sides of a gap. Copies are numbered one after the other.
    fn copies(&self, node: u32) -> impl Iterator<Item = u32> {
        let nodes = &self.lattice.nodes;
        let same = move |n: &u32| nodes.get(*n as usize) == Some(&nodes[node as usize]);
        let below = (0..node).rev().take_while(same);
        below.chain((node + 1..).take_while(same))
    }

    /// Lattice spacing in m.
    pub(super) fn spacing(&self) -> f64 {
        self.spacing
    }

    /// The interfaces of the input.
    pub(super) fn interfaces(&self) -> &Interfaces {
        self.interfaces
    }

    /// The interfaces of each node.
    pub(super) fn constraint(&self, node: u32) -> Constraint {
        self.constraints[node as usize]
    }

    /// Moves each node by the first of [`TRIES`] of its step that makes no cell around it worse than the limits and keeps a
    /// gap beside it open, or not at all.
    pub(super) fn move_while_it_holds(
        &self,
        moves: &[(u32, Vec3)],
        limits: (f64, f64),
        positions: &mut [Vec3],
    ) {
        for colour in 0..8 {
            let moved: Vec<(u32, Vec3)> = moves
                .par_iter()
                .filter(|(n, _)| colour_of(self.lattice.nodes[*n as usize]) == colour)
                .filter_map(|(node, by)| {
                    let at = positions[*node as usize];
                    let tried = TRIES.iter().map(|part| at + by * *part);
                    let to = tried.into_iter().find(|to| {
                        self.holds(*node, to, limits, positions) && self.keeps_gap_open(*node, to)
                    })?;
                    Some((*node, to))
                })
                .collect();
            for (node, at) in moved {
                positions[node as usize] = at;
            }
        }
    }

    /// Whether no determinant and no spring that a move of a node to `to` changes falls below the limits, or farther below
    /// them than it is.
    fn holds(&self, node: u32, to: &Vec3, (det, length): (f64, f64), positions: &[Vec3]) -> bool {
        let (det, length) = (det * self.spacing.powi(3), length * self.spacing);
        let from = positions[node as usize];
        let slots = self.around[node as usize].iter().enumerate();
        slots
            .filter(|(_, cell)| **cell != NO_CELL)
            .all(|(c, &cell)| {
                let before = self.corners(cell, positions);
                let mut after = before;
                after[c] = *to;
                let springs = (0..8).filter(|other| *other != c).all(|other| {
                    let squared = |end: &Vec3| (end - before[other]).norm_squared();
                    let now = squared(to);
                    now >= length * length || now >= squared(&from)
                });
                // The determinants at a corner and at the three next to it depend on its position.
                springs
                    && [c, c ^ 1, c ^ 2, c ^ 4].into_iter().all(|d| {
                        let now = corner(&after, d);
                        now >= det || now >= corner(&before, d)
                    })
            })
    }

    fn corners(&self, cell: u32, positions: &[Vec3]) -> [Vec3; 8] {
        self.lattice.cells[cell as usize]
            .corners
            .map(|n| positions[n as usize])
    }

    fn failing(
        &self,
        cells: impl Iterator<Item = u32>,
        positions: &[Vec3],
        (det, length): (f64, f64),
    ) -> Vec<u32> {
        let cells: Vec<u32> = cells.collect();
        cells
            .into_par_iter()
            .filter(|&c| !passes(&self.corners(c, positions), self.spacing, det, length))
            .collect()
    }

    fn nodes_of(&self, cells: &[u32]) -> Vec<u32> {
        sorted(
            cells
                .iter()
                .flat_map(|&c| self.lattice.cells[c as usize].corners),
        )
    }

    fn cells_at(&self, nodes: &[u32]) -> Vec<u32> {
        let cells = nodes.iter().flat_map(|&n| self.around[n as usize]);
        sorted(cells.filter(|&c| c != NO_CELL))
    }

    /// Whether a node beside a gap that moves to `to` leaves most of the gap to the other side.
    fn keeps_gap_open(&self, node: u32, to: &Vec3) -> bool {
        let constraint = self.constraints[node as usize];
        if !(constraint.outer && constraint.beside_gap()) {
            return true;
        }
        let facing = constraint.facing();
        let off = |way: Vec3| {
            let nearest = self.interfaces.outer.nearest_facing(to, self.spacing, &way);
            nearest.map_or(f64::INFINITY, |p| (p - to).norm())
        };
        off(facing) / GAP_PART <= off(-facing) / (1.0 - GAP_PART)
    }

    /// Visits the nodes of `bad` cells once; returns the cells around them that fail afterwards.
    fn sweep(&self, bad: &[u32], hold: f64, positions: &mut [Vec3]) -> Vec<u32> {
        if bad.is_empty() {
            return Vec::new();
        }
        let nodes = self.nodes_of(bad);
        for colour in 0..8 {
            let moved: Vec<(u32, Vec3)> = nodes
                .par_iter()
                .filter(|&&n| colour_of(self.lattice.nodes[n as usize]) == colour)
                .map(|&n| (n, self.visited(n, hold, positions)))
                .collect();
            for (node, at) in moved {
                positions[node as usize] = at;
            }
        }
        self.failing(self.cells_at(&nodes).into_iter(), positions, GOOD)
    }

    /// New position of a node, which minimises f of the module docs with all others held.
    fn visited(&self, node: u32, hold: f64, positions: &[Vec3]) -> Vec3 {
        let at = positions[node as usize];
        let constraint = self.constraints[node as usize];
        let mut pull = (nalgebra::Matrix3::identity() * INERTIA, Vec3::zeros());
        if !constraint.free() {
            let off = (project(self.interfaces, constraint, at) - at) / self.spacing;
            // Off the surface the normal is the direction back to it. On the surface the term vanishes; it acts
            // at the next visit that finds the node off the surface.
            let normal = off.try_normalize(1e-9);
            if let Some(normal) = normal {
                pull.0 += normal * normal.transpose() * hold;
                pull.1 += off * hold;
            }
        }
        let stencil = Stencil::gather(self, node, positions);
        let to = at + stencil.minimise(&pull.0, &pull.1) * self.spacing;
        // The step stays on the node's own side of a gap.
        let mut tried = TRIES.iter().map(|part| at + (to - at) * *part);
        tried.find(|to| self.keeps_gap_open(node, to)).unwrap_or(at)
    }

    /// Moves some nodes and their copies half way to their lattice points, and untangles the cells around them until none
    /// fails.
    pub(super) fn move_half_way(&self, nodes: &[u32], positions: &mut [Vec3]) {
        let touched = self.halve(&self.with_copies(nodes), positions);
        let bad = self.failing(touched.into_iter(), positions, FLOOR);
        self.let_go(bad, positions);
    }

    /// Some nodes and their copies, sorted: both sides of a gap move, so that none comes beyond the other.
    fn with_copies(&self, nodes: &[u32]) -> Vec<u32> {
        let copies = nodes.iter().flat_map(|node| self.copies(*node));
        sorted(copies.chain(nodes.iter().copied()))
    }

    /// Moves some nodes half way to their lattice points, and visits those of cells that fail; returns the cells that
    /// may fail afterwards.
    fn halve(&self, nodes: &[u32], positions: &mut [Vec3]) -> Vec<u32> {
        for &node in nodes {
            let at = positions[node as usize];
            positions[node as usize] = (at + self.lattice_point(node)) / 2.0;
        }
        let mut touched = self.failing(self.cells_at(nodes).into_iter(), positions, GOOD);
        for _ in 0..SWEEPS_AFTER_HALVING {
            touched = self.sweep(&touched, 0.0, positions);
        }
        touched
    }

    /// Moves the nodes of failing cells back towards their lattice points until none fails.
    fn let_go(&self, mut bad: Vec<u32>, positions: &mut [Vec3]) -> Vec<u32> {
        let mut gone = Vec::new();
        for _ in 0..HALVINGS {
            if bad.is_empty() {
                return sorted(gone.into_iter());
            }
            let nodes = self.with_copies(&self.nodes_of(&bad));
            let mut touched = self.halve(&nodes, positions);
            gone.extend(nodes);
            touched.extend(&bad);
            bad = self.failing(sorted(touched.into_iter()).into_iter(), positions, FLOOR);
        }
        // Whole cells move back, then the cells that this spoils; in the limit all are cubes.
        while !bad.is_empty() {
            let nodes = self.with_copies(&self.nodes_of(&bad));
            for &node in &nodes {
                positions[node as usize] = self.lattice_point(node);
            }
            bad = self.failing(self.cells_at(&nodes).into_iter(), positions, FLOOR);
            gone.extend(nodes);
        }
        sorted(gone.into_iter())
    }
}

fn colour_of(at: [i32; 3]) -> i32 {
    (at[0] & 1) | (at[1] & 1) << 1 | (at[2] & 1) << 2
}

fn sorted(numbers: impl Iterator<Item = u32>) -> Vec<u32> {
    let mut numbers: Vec<u32> = numbers.collect();
    numbers.sort_unstable();
    numbers.dedup();
    numbers
}

/// Terms that depend on a node's position, in spacings relative to its current one.
struct Stencil {
    /// Determinant here and its gradient, for each corner that involves the node.
    dets: [(f64, Vec3); 32],
    det_count: usize,
    /// The other ends of springs that may become too short.
    near: [Vec3; 56],
    near_count: usize,
}

impl Stencil {
    fn gather(untangler: &Untangler<'_>, node: u32, positions: &[Vec3]) -> Self {
        let mut stencil = Self {
            dets: [(0.0, Vec3::zeros()); 32],
            det_count: 0,
            near: [Vec3::zeros(); 56],
            near_count: 0,
        };
        let at = positions[node as usize];
        for (c, &cell) in untangler.around[node as usize].iter().enumerate() {
            if cell == NO_CELL {
                continue;
            }
            let corners = untangler
                .corners(cell, positions)
                .map(|p| (p - at) / untangler.spacing);
            let sign = if c.count_ones() % 2 == 0 { 1.0 } else { -1.0 };
            let [x, y, z] = [1, 2, 4].map(|bit| corners[c ^ bit]);
            // det(x - p, y - p, z - p) at the node's own corner.
            let gradient = -(y - x).cross(&(z - x)) * sign;
            stencil.add_det(sign * x.dot(&y.cross(&z)), gradient);
            for axis in 0..3 {
                // The corner next to the node along `axis`; one of its edges leads to the node.
                let d = c ^ (1 << axis);
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                let edge = |a: usize| corners[d ^ (1 << a)] - corners[d];
                let normal = edge(u).cross(&edge(v)) * -sign;
                stencil.add_det(-normal.dot(&corners[d]), normal);
            }
            for other in (0..8).filter(|&o| o != c) {
                if corners[other].norm_squared() < (AIM.1 + 2.0 * MOVE_MAX).powi(2) {
                    stencil.near[stencil.near_count] = corners[other];
                    stencil.near_count += 1;
                }
            }
        }
        stencil
    }

    fn add_det(&mut self, det: f64, gradient: Vec3) {
        self.dets[self.det_count] = (det, gradient);
        self.det_count += 1;
    }

    /// The step, in spacings, that minimises the quadratic `1/2 x·A x - b·x` plus the penalties of determinants
    /// and spring lengths.
    fn minimise(&self, a: &nalgebra::Matrix3<f64>, b: &Vec3) -> Vec3 {
        let mut x = Vec3::zeros();
        for _ in 0..NEWTON_STEPS {
            let mut matrix = *a;
            let mut rhs = b - a * x;
            for (det, gradient) in &self.dets[..self.det_count] {
                let lacks = AIM.0 - (det + gradient.dot(&x));
                if lacks > 0.0 {
                    matrix += gradient * gradient.transpose();
                    rhs += gradient * lacks;
                }
            }
            for other in &self.near[..self.near_count] {
                let away = x - other;
                let length = away.norm();
                if length < AIM.1 && length > 0.0 {
                    let way = away / length;
                    matrix += way * way.transpose();
                    rhs += way * (AIM.1 - length);
                }
            }
            let Some(inverse) = matrix.try_inverse() else {
                break;
            };
            let step = inverse * rhs;
            x += step;
            let length = x.norm();
            if length > MOVE_MAX {
                return x * (MOVE_MAX / length);
            }
            if step.norm_squared() < 1e-8 {
                break;
            }
        }
        x
    }
}
