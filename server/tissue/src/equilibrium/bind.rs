//! What has become stiff moves as one.
//!
//! Coarse levels know the tissue at rest, and a step's change is carried on along a straight line. Where tissue
//! is pressed nearly flat it is hundreds of times stiffer than that, and a move that strains one such place a little
//! more does more work there than everywhere else together: of the whole a hundredth could be taken, and
//! forces were up to twice too high for several ticks. So where little of a move can be taken, the bricks that
//! resist it most are bound: those that hang together move by the mean of what their free nodes would, or not at
//! all where a node of them is held. Smoothing sees to them afterwards. (What the seed does with forces of
//! rigid clusters, Lin 2007, section 3.5, done with moves.)

use std::collections::BTreeMap;

use super::block::{Quad, ZERO};
use super::brick::LOCALS;
use super::field::Field;
use super::solver::Solver;
use super::structure::Structure;
use crate::Vec3;

/// Share of a move below which what resists it is bound.
const HINDERED: f64 = 0.5;
/// Part of what a move gains that a brick may resist it by.
const RESISTED: f64 = 0.03;

impl Solver {
    /// The share of these moves at which no work is left along them, within bounds. `moves` are in order of nodes,
    /// and the shape is where they lead to; `before` are the forces of bricks on the nodes where they began, in
    /// N, and `waiting` is the work of what waits along them, at both ends, in N m. What hinders them is bound.
    pub(super) fn share_of(
        &mut self,
        u: &mut [Vec3],
        moves: &mut [(u32, Vec3)],
        before: &[Quad],
        waiting: [f64; 2],
        bounds: [f64; 2],
    ) -> f64 {
        let (share, gain) = self.rest_along(u, moves, before, waiting, bounds);
        // Once: to bind what is strained by that in turn brought nothing.
        let hindered = share < HINDERED && gain > 0.0;
        if !hindered || !self.field.bind(&self.structure, u, moves, RESISTED * gain) {
            return share;
        }
        self.rest_along(u, moves, before, waiting, bounds).0
    }

    /// That share for the moves as they are, and the work along them where they begin, in N m.
    fn rest_along(
        &self,
        u: &[Vec3],
        moves: &[(u32, Vec3)],
        before: &[Quad],
        waiting: [f64; 2],
        bounds: [f64; 2],
    ) -> (f64, f64) {
        let by = |n: u32| {
            let found = moves.binary_search_by_key(&n, |m| m.0);
            found.map_or_else(|_| Vec3::zeros(), |i| moves[i].1)
        };
        let along = self.contacts.along(u, by, 1.0);
        let here = waiting[0] + work(moves, |i, _| &before[i]);
        let r = &self.field.r;
        let there = waiting[1] + work(moves, |_, node| &r[node as usize]);
        (along.rest([here, there], bounds), here + along.work(0.0))
    }
}

/// Work along moves of the force that `of` gives for each by its number and node, in N m.
fn work<'a>(moves: &[(u32, Vec3)], of: impl Fn(usize, u32) -> &'a Quad) -> f64 {
    let one = |(i, (node, by)): (usize, &(u32, Vec3))| {
        let force = of(i, *node);
        (0..3).map(|a| f64::from(force[a]) * by[a]).sum::<f64>()
    };
    moves.iter().enumerate().map(one).sum()
}

impl Field {
    /// Binds what resists these moves by more than `most` N m per brick; the shape is where they lead to, and the
    /// forces where they began are those kept. Returns whether any move has changed.
    fn bind(
        &mut self,
        structure: &Structure,
        u: &mut [Vec3],
        moves: &mut [(u32, Vec3)],
        most: f64,
    ) -> bool {
        let mut changed = Vec::new();
        for nodes in hang_together(structure, &self.resisting(structure, moves, most)) {
            let places: Vec<usize> = nodes
                .iter()
                .filter(|&&n| self.free[n as usize])
                .filter_map(|n| moves.binary_search_by_key(n, |m| m.0).ok())
                .collect();
            let held = nodes.iter().any(|&n| self.fixed[n as usize]);
            let sum: Vec3 = places.iter().map(|&i| moves[i].1).sum();
            let mean = if held {
                Vec3::zeros()
            } else {
                sum / places.len().max(1) as f64
            };
            for i in places {
                let (node, by) = moves[i];
                if by != mean {
                    self.shift(u, node, mean - by);
                    moves[i].1 = mean;
                    changed.push(node);
                }
            }
        }
        self.left.clear();
        for &node in &changed {
            for &entry in structure.around.row(node) {
                self.left.insert(entry / 32);
            }
        }
        let bricks = self.left.take();
        self.compute(structure, u, &bricks);
        for &brick in &bricks {
            for &node in &structure.bricks[brick as usize].nodes {
                self.r[node as usize] = self.sum(structure, node);
            }
        }
        !changed.is_empty()
    }

    /// Bricks of the set that do more than `most` N m against the moves.
    fn resisting(&mut self, structure: &Structure, moves: &[(u32, Vec3)], most: f64) -> Vec<u32> {
        // Smoothing begins without a last step, so its memory is free for what each node moves by.
        for &node in &self.nodes.items {
            self.d[node as usize] = ZERO;
        }
        for (node, by) in moves {
            self.d[*node as usize] = [by.x as f32, by.y as f32, by.z as f32, 0.0];
        }
        let resists = |(&brick, before): (&u32, &[[f32; LOCALS]; 3])| {
            let nodes = &structure.bricks[brick as usize].nodes;
            let now = &self.forces[brick as usize];
            let mut work = [0.0f32; LOCALS];
            for (l, work) in work.iter_mut().enumerate() {
                let by = &self.d[nodes[l] as usize];
                for a in 0..3 {
                    *work += (before[a][l] - now[a][l]) * by[a];
                }
            }
            (f64::from(work.iter().sum::<f32>()) > most).then_some(brick)
        };
        let bricks = self.set.items.iter().zip(&self.kept);
        bricks.filter_map(resists).collect()
    }
}

/// Nodes of bricks that share nodes, group by group.
fn hang_together(structure: &Structure, bricks: &[u32]) -> Vec<Vec<u32>> {
    let mut groups: Vec<Vec<u32>> = Vec::new();
    let mut group_of: BTreeMap<u32, usize> = BTreeMap::new();
    for (own, &brick) in bricks.iter().enumerate() {
        groups.push(Vec::new());
        let b = &structure.bricks[brick as usize];
        for l in (0..LOCALS).filter(|l| b.present >> l & 1 == 1) {
            let node = b.nodes[l];
            match group_of.insert(node, own) {
                None => groups[own].push(node),
                Some(other) if other != own => {
                    let others = std::mem::take(&mut groups[other]);
                    for &n in &others {
                        group_of.insert(n, own);
                    }
                    groups[own].extend(others);
                }
                Some(_) => {}
            }
        }
    }
    groups
}
