//! Soundness of the cells around a sheet by projections onto constraints (Kaczmarz's method for inequalities; known
//! from position-based dynamics).
//!
//! A cell has a constraint C(x) >= c per corner (the volume V that its three edges span) and per spring (its length). Cells that
//! the opening of the wound deforms have those of corners twice: for closed and for opened positions. A violated one
//! moves its nodes i along the gradients `g_i = ∂C/∂x_i`, as far as these are left to them:
//!
//! ```text
//! x_i <- x_i + λ P_i g_i,    λ = (c - C) / Σ g_i·P_i g_i
//! ```
//!
//! `P_i` is the projector onto the directions of a node; for a node of the sheet it is smaller along the normal of the
//! swept surface, so that nodes rather spread along the cut. Nodes of the sheet stay in a slab around the swept surface;
//! nodes of interfaces and walls stay on these. A flat corner, with all its edges in one of them, gets its volume
//! from its distance to the interface, so its nodes may leave it a little.
//!
//! Sweeps visit the cells around nodes that moved. In cells that stay unsound the slabs of nodes grow with every sweep;
//! then nodes on interfaces go back half of their way and then the whole, and at last all nodes of the cell.

use std::collections::BTreeMap;

use super::freedom::Freedom;
use super::interface::Interfaces;
use super::patch::{Patch, within_drift};
use super::ribbon::Ribbon;
use super::sheet_snap::SheetNode;
use super::soundness::{CORNER_FLOOR, Soundness, span};
use crate::cell::{NO_CELL, PAIRS};
use crate::{Topology, Vec3};

/// Most sweeps before nodes go back, and after each time that they did.
const SWEEPS: usize = 160;
const SWEEPS_BACK: usize = 24;
/// Sweeps after which the slabs of nodes in unsound cells grow, and by which factor per sweep.
const PATIENCE: usize = 100;
const GROWTH: f64 = 1.05;
/// Rounds in which nodes of unsound cells go back: those on interfaces by half in the first and as a whole in the second,
/// then all.
const ROUNDS: usize = 5;
/// A violated constraint of a corner and of a spring is met with this much to spare, relative to the floor, so that fewer
/// sweeps suffice.
const CORNER_MARGIN: f64 = 0.5;
const SPRING_MARGIN: f64 = 0.1;
/// Factor of P along the normal of the swept surface.
const NORMAL_SHARE: f64 = 0.05;
/// A constraint is left alone if its nodes have less than this part of its gradient: moves would be long and of no use.
const GRADIENT_MIN: f64 = 0.003;
/// Longest move of a node in one step, in spacings.
const STEP_MAX: f64 = 0.1;
/// Farthest a node may leave its interfaces, in spacings.
const LIFT_MAX: f64 = 0.07;
/// A node farther from its interfaces than this, in spacings, stays where it was.
pub(crate) const DRIFT_ALLOWED: f64 = 0.09;
/// A corner was flat, as built or before this cut, if it spanned less than this, in cubed spacings.
const FLAT: f64 = 0.5;

pub(crate) struct Projections<'a> {
    pub(crate) topology: &'a Topology,
    pub(crate) ribbon: &'a Ribbon,
    pub(crate) patch: &'a mut Patch,
    pub(crate) nodes: &'a mut [SheetNode],
    /// Interfaces of nodes around the sheet, from when they first slide.
    slid: BTreeMap<usize, Interfaces>,
    /// Nodes that stay where they were.
    fixed: Vec<bool>,
    /// Nodes that may leave their interfaces a little.
    lifted: Vec<bool>,
    /// Nodes that moved in this sweep.
    moved: Vec<bool>,
}

impl<'a> Projections<'a> {
    pub(crate) fn new(
        topology: &'a Topology,
        ribbon: &'a Ribbon,
        patch: &'a mut Patch,
        nodes: &'a mut [SheetNode],
    ) -> Self {
        let none = vec![false; patch.movable];
        Self {
            topology,
            ribbon,
            patch,
            nodes,
            slid: BTreeMap::new(),
            fixed: none.clone(),
            lifted: none.clone(),
            moved: none,
        }
    }

    /// Moves nodes until all cells are sound, or gives nodes up.
    pub(crate) fn run(&mut self) {
        self.sweep(SWEEPS);
        for round in 0..ROUNDS {
            self.give_up_drifted();
            let unsound = self.patch.unsound();
            if unsound.is_empty() {
                break;
            }
            let nodes = unsound.iter().flat_map(|&c| self.patch.cells[c]);
            let mut nodes: Vec<usize> = nodes.map(|n| n as usize).collect();
            nodes.sort_unstable();
            nodes.dedup();
            nodes.retain(|&n| n < self.patch.movable && !self.fixed[n]);
            let is_held = |n: usize| self.patch.holds[n] != Freedom::Free;
            if round < 2 && nodes.iter().any(|&n| is_held(n)) {
                nodes.retain(|&n| is_held(n));
            }
            for n in nodes {
                if round == 0 {
                    self.halve(n);
                } else {
                    self.give_up(n);
                }
            }
            self.sweep(SWEEPS_BACK);
        }
        self.give_up_drifted();
    }

    /// Takes back half of a node's way, and lets it be there.
    fn halve(&mut self, n: usize) {
        self.patch.at[n] = (self.patch.start[n] + self.patch.at[n]) / 2.0;
        if let Some(node) = self.nodes.get_mut(n) {
            node.slab = self.patch.spacing;
        }
    }

    fn give_up(&mut self, n: usize) {
        self.patch.at[n] = self.patch.start[n];
        self.fixed[n] = true;
    }

    /// Gives up the nodes that are too far from their interfaces.
    fn give_up_drifted(&mut self) {
        let spacing = self.patch.spacing;
        for n in 0..self.patch.movable {
            let at = self.patch.at[n];
            let drift = match self.nodes.get(n) {
                Some(node) => node.interfaces.distance(&at),
                None => self.slid.get(&n).map_or(0.0, |own| own.distance(&at)),
            };
            if drift > DRIFT_ALLOWED * spacing {
                self.give_up(n);
            }
        }
    }

    fn sweep(&mut self, most: usize) {
        let mut active = self.patch.changed();
        for sweep in 1..=most {
            for c in 0..active.len() {
                let is_unsound = std::mem::take(&mut active[c]) && self.correct(c);
                if is_unsound && sweep > PATIENCE {
                    for n in self.patch.cells[c] {
                        if let Some(node) = self.nodes.get_mut(n as usize) {
                            node.slab *= GROWTH;
                        }
                    }
                }
            }
            let mut any = false;
            for n in 0..self.patch.movable {
                if std::mem::take(&mut self.moved[n]) {
                    any = true;
                    self.put_back(n);
                    let around = self.patch.around[n].into_iter();
                    around
                        .filter(|&c| c != NO_CELL)
                        .for_each(|c| active[c as usize] = true);
                }
            }
            if !any {
                break;
            }
        }
    }

    /// Brings a node that moved back to its interfaces and into its slab.
    fn put_back(&mut self, n: usize) {
        let is_held = self.patch.holds[n] != Freedom::Free;
        let lift = if self.lifted[n] { LIFT_MAX } else { 0.0 } * self.patch.spacing;
        let mut x = self.patch.at[n];
        if let Some(node) = self.nodes.get_mut(n) {
            if is_held {
                x = node.interfaces.clamp(x, lift);
            }
            if let Some(foot) = self.ribbon.nearest(&x) {
                node.plane = Some((foot.point, foot.normal));
            }
            x = node.within_drift(node.within_slab(x), self.patch.spacing);
        } else {
            let id = self.patch.ids[n];
            if is_held {
                let own = self.slid.entry(n);
                let own = own.or_insert_with(|| Interfaces::at(self.topology, id));
                x = own.clamp(x, lift);
            }
            x = within_drift(x, &self.topology.original(id), self.patch.spacing);
        }
        self.patch.at[n] = x;
    }

    /// Projects onto the constraints of a cell that are violated; whether there are any.
    fn correct(&mut self, c: usize) -> bool {
        if self.patch.is_sound(c) {
            return false;
        }
        let floor = self.patch.floor(c);
        let cell = self.patch.cells[c].map(|n| n as usize);
        if Soundness::of(&self.patch.corners(c)).spring < floor.spring {
            for [a, b] in PAIRS.map(|pair| pair.map(|i| cell[i])) {
                let d = self.patch.at[b] - self.patch.at[a];
                let length = d.norm();
                if length * length < floor.spring && length > 0.0 {
                    let g = d / length;
                    let miss = floor.spring.sqrt() * (1.0 + SPRING_MARGIN) - length;
                    let moves = [(a, -g), (b, g)].map(|(n, g)| (n, g, self.left_to(n, g, false)));
                    self.step(&moves, miss);
                }
            }
        }
        for corner in 0..8 {
            let now = self.patch.corners(c);
            self.correct_corner(c, corner, &now);
            if let Some(opened) = self.patch.opened(c) {
                self.correct_corner(c, corner, &opened);
            }
        }
        true
    }

    /// Projects onto the constraint of a corner of a cell, for its closed or opened positions `x`.
    fn correct_corner(&mut self, c: usize, corner: usize, x: &[Vec3; 8]) {
        let sign = |a: usize| if corner >> a & 1 == 0 { 1.0 } else { -1.0 };
        let e = [0, 1, 2].map(|a| (x[corner ^ (1 << a)] - x[corner]) * sign(a));
        let volume = e[0].cross(&e[1]).dot(&e[2]);
        let floor = self.patch.floor(c).volume;
        if volume >= floor {
            return;
        }
        let wanted = floor + CORNER_MARGIN * CORNER_FLOOR * self.patch.spacing.powi(3);
        let g = [e[1].cross(&e[2]), e[2].cross(&e[0]), e[0].cross(&e[1])];
        let [gx, gy, gz] = [0, 1, 2].map(|a| g[a] * sign(a));
        let cell = self.patch.cells[c].map(|n| n as usize);
        let four = [corner, corner ^ 1, corner ^ 2, corner ^ 4].map(|i| cell[i]);
        let lifts = self.is_flat(c, corner, &four);
        let moves = [-(gx + gy + gz), gx, gy, gz];
        let moves = [0, 1, 2, 3].map(|i| {
            let (n, g) = (four[i], moves[i]);
            (n, g, self.left_to(n, g, lifts))
        });
        self.step(&moves, wanted - volume);
    }

    /// Whether a corner has all its edges in an interface or wall.
    fn is_flat(&self, c: usize, corner: usize, four: &[usize; 4]) -> bool {
        let built = self
            .topology
            .model
            .corners_of(self.patch.cell_ids[c] as usize);
        let start = self.patch.cells[c].map(|n| self.patch.start[n as usize]);
        let is_free = |n: usize| n < self.patch.movable && self.patch.holds[n] == Freedom::Free;
        !four.iter().any(|&n| is_free(n))
            && span(&built, corner).min(span(&start, corner)) < FLAT * self.patch.spacing.powi(3)
    }

    /// The part of a direction that is left to a node; with `lifts` also off its interfaces.
    fn left_to(&mut self, n: usize, v: Vec3, lifts: bool) -> Vec3 {
        if n >= self.patch.movable || self.fixed[n] {
            return Vec3::zeros();
        }
        let node = self.nodes.get(n);
        let left = match self.patch.holds[n] {
            Freedom::Free => v,
            Freedom::Held(_) if lifts => {
                self.lifted[n] = true;
                v
            }
            Freedom::Held(free) => free * v,
            Freedom::Pinned => return Vec3::zeros(),
        };
        let Some(node) = node else {
            return left;
        };
        let Some((_, normal)) = node.plane else {
            return Vec3::zeros();
        };
        let Some(rise) = node.rise(&normal) else {
            return left;
        };
        let part = rise.dot(&left) / rise.norm_squared();
        left - rise * (part * (1.0 - NORMAL_SHARE))
    }

    /// Moves nodes, each given with the gradient and the part of it that is left to the node.
    fn step(&mut self, moves: &[(usize, Vec3, Vec3)], miss: f64) {
        let sum: f64 = moves.iter().map(|(_, g, left)| g.dot(left)).sum();
        let whole: f64 = moves.iter().map(|(_, g, _)| g.norm_squared()).sum();
        if sum <= GRADIENT_MIN * whole {
            return;
        }
        let longest = moves.iter().map(|(_, _, left)| left.norm());
        let longest = longest.fold(0.0, f64::max);
        let part = (miss / sum).min(STEP_MAX * self.patch.spacing / longest);
        for &(n, _, left) in moves {
            if left != Vec3::zeros() {
                let x = self.patch.at[n] + left * part;
                let node = self.nodes.get(n);
                self.patch.at[n] = node.map_or(x, |node| node.within_slab(x));
                self.moved[n] = true;
            }
        }
    }
}
