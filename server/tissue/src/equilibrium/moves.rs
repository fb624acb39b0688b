//! How the nodes of the fine level move: by the coarse levels' correction, and by smoothing.

use super::block::{ZERO, plus};
use super::brick::LOCALS;
use super::cycle::{Chebyshev, LOW, Multigrid};
use super::field::{Field, contact_block};
use super::kernel::Tangents;
use super::patch::{apply, interpolate, invert};
use super::stiffen::firm;
use super::structure::Structure;
use crate::Vec3;
use crate::contact::Contacts;

/// Longest move of a node in one smoothing step, in spacings; longer ones are cut and counted. While a hand
/// waits, blocks are computed once per iteration, and what bottoms out hardens within the steps that go by them.
const MOVE_MAX: [f64; 2] = [0.5, 0.02];
/// How many times a contact counts in the block of a node that is smoothed: a Chebyshev step goes up to 1.74
/// times as far as the block says, and a contact that has opened does not bring the node back. Without it
/// forces of a real thigh were up to twice what they should be for a tick, now and then.
const CAUTION: f64 = 2.0;

impl Field {
    /// Hands the forces on the nodes of the set to level 1.
    pub(super) fn restrict(&self, structure: &Structure, coarse: &mut Multigrid) {
        let patch = &mut coarse.patches[0];
        for &node in &self.nodes.items {
            let n = node as usize;
            if self.fixed[n] {
                continue;
            }
            let ties = &structure.ties[n];
            for t in 0..ties.len as usize {
                patch.load(ties.to[t], &self.r[n], ties.weight[t]);
            }
        }
        // Others that were disturbed wait for their turn; what they carry is known.
        for &node in &self.loud.items {
            let n = node as usize;
            if self.nodes.contains(node) || self.fixed[n] {
                continue;
            }
            let ties = &structure.ties[n];
            for t in 0..ties.len as usize {
                patch.load(ties.to[t], &self.r[n], ties.weight[t]);
            }
        }
    }

    /// Moves the nodes of the set by level 1's correction, in full.
    pub(super) fn correct(&mut self, structure: &Structure, coarse: &Multigrid, u: &mut [Vec3]) {
        self.moved.clear();
        self.old.clear();
        let e = &coarse.patches[0].e;
        for i in 0..self.nodes.items.len() {
            let node = self.nodes.items[i];
            let n = node as usize;
            self.old.push(self.r[n]);
            let v = super::cycle::interpolate(&structure.ties[n], e);
            let by = Vec3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2]));
            let by = if self.fixed[n] { Vec3::zeros() } else { by };
            self.moved.push((node, by));
            self.shift(u, node, by);
        }
    }

    /// Takes only `share` of the correction after all; the forces of bricks follow linearly.
    pub(super) fn settle(
        &mut self,
        structure: &Structure,
        coarse: &Multigrid,
        u: &mut [Vec3],
        share: f64,
    ) {
        for i in 0..self.nodes.items.len() {
            let node = self.nodes.items[i];
            let n = node as usize;
            if share != 1.0 {
                self.shift(u, node, self.moved[i].1 * (share - 1.0));
                let change = plus(&self.r[n], -1.0, &self.old[i]);
                self.r[n] = plus(&self.old[i], share as f32, &change);
            }
            // The total was raised by the same: nothing is left to take over.
            self.applied[n] = interpolate(&structure.ties[n], &coarse.patches[0].total);
        }
    }

    /// One Chebyshev step over the free ones of these nodes from the forces in `r`.
    pub(super) fn relax(&mut self, u: &mut [Vec3], nodes: &[u32], factors: &mut Chebyshev) {
        let (last, new) = factors.next();
        for &node in nodes {
            let n = node as usize;
            if !self.free[n] {
                continue;
            }
            let step = apply(&self.inverse[n], &self.r[n]);
            let before = if last == 0.0 { ZERO } else { self.d[n] };
            let d = plus(&step.map(|v| new * v), last, &before);
            self.d[n] = d;
            let mut by = Vec3::new(f64::from(d[0]), f64::from(d[1]), f64::from(d[2]));
            let length = by.norm();
            if !length.is_finite() {
                self.clamped += 1;
                self.d[n] = ZERO;
                continue;
            }
            if length > self.move_max {
                by *= self.move_max / length;
                self.clamped += 1;
            }
            self.shift(u, node, by);
        }
    }

    /// Sets how far smoothing moves a node at most; see [`MOVE_MAX`].
    pub(super) fn limit_moves(&mut self, structure: &Structure, near: bool) {
        let short = near && structure.bottoms_out;
        self.move_max = MOVE_MAX[usize::from(short)] / f64::from(structure.per_spacing);
    }

    /// The blocks that smoothing divides by, at the displacements of now.
    pub(super) fn renew_blocks(&mut self, structure: &Structure, u: &[Vec3], contacts: &Contacts) {
        let (set, nodes) = (
            std::mem::take(&mut self.set.items),
            std::mem::take(&mut self.nodes.items),
        );
        self.renew_blocks_of(structure, u, &set, &nodes);
        (self.set.items, self.nodes.items) = (set, nodes);
        self.renew_pressed(u, contacts);
    }

    /// The same, without contacts, for these nodes, given the bricks around them.
    pub(super) fn renew_blocks_of(
        &mut self,
        structure: &Structure,
        u: &[Vec3],
        bricks: &[u32],
        nodes: &[u32],
    ) {
        for &node in nodes {
            self.touched.insert(node);
            self.blocks[node as usize] = [0.0; 6];
        }
        let (blocks, per_spacing) = (&mut self.blocks, structure.per_spacing);
        for &brick in bricks {
            let b = &structure.bricks[brick as usize];
            let form = &structure.forms[b.form as usize];
            let m = self.arch.dispatch(Tangents {
                brick: b,
                form,
                u: Some(u),
                per_spacing,
                scratch: &mut self.block_scratch,
            });
            self.firm[brick as usize] = firm(&m, b.present);
            for i in 0..LOCALS {
                if b.present >> i & 1 == 1 && self.touched.contains(b.nodes[i]) {
                    let to = &mut blocks[b.nodes[i] as usize];
                    for e in 0..6 {
                        to[e] += m[e][i];
                    }
                }
            }
        }
        for &node in nodes {
            self.inverse[node as usize] = invert(&self.blocks[node as usize]);
        }
        self.touched.clear();
    }

    /// The same for the nodes in contact only, whose stiffness comes and goes with what presses: a node
    /// smoothed with that of a moment when nothing pressed is thrown far out of the tool, and comes back.
    pub(super) fn renew_pressed(&mut self, u: &[Vec3], contacts: &Contacts) {
        self.renew_or_press(u, contacts, false);
    }

    /// The same, and adds the forces of contacts to those on their nodes.
    pub(super) fn press(&mut self, u: &[Vec3], contacts: &Contacts) {
        self.renew_or_press(u, contacts, true);
    }

    fn renew_or_press(&mut self, u: &[Vec3], contacts: &Contacts, presses: bool) {
        self.pressed.clear();
        let blocks = contacts.nodes.iter().map(|&n| self.blocks[n as usize]);
        self.pressed.extend(blocks);
        let (pressed, r) = (&mut self.pressed, &mut self.r);
        contacts.pressed(u, |sample, force, kappa, n| {
            let whole = contact_block(CAUTION * kappa, &n);
            for (node, w) in sample.nodes.iter().zip(sample.weights) {
                let place = &mut pressed[contacts.place(*node)];
                for (to, v) in place.iter_mut().zip(whole) {
                    *to += w as f32 * v;
                }
                if presses {
                    let r = &mut r[*node as usize];
                    for a in 0..3 {
                        r[a] += (w * force[a]) as f32;
                    }
                }
            }
        });
        for (&node, block) in contacts.nodes.iter().zip(&self.pressed) {
            self.inverse[node as usize] = invert(block);
        }
    }

    /// Chebyshev factors for the fine level.
    pub(super) fn smoothing() -> Chebyshev {
        Chebyshev::new(LOW)
    }
}
