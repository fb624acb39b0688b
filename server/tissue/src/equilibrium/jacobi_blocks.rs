//! Diagonal blocks of the nodes for the block Jacobi preconditioner of the smoother.
//!
//! The block of a node sums the tangent stiffness of the bricks around it at the current displacements. Bricks with
//! small strain use the precomputed blocks of their form at rest, unless their springs are close to stiffening or
//! extreme.

use super::brick::{Brick, LOCALS};
use super::coarse_level::invert;
use super::fine_level::{FineLevel, contact_block};
use super::hierarchy::Hierarchy;
use super::kernel::{LocalBlocks, Tangents};
use super::mechanism::Mechanism;
use crate::Vec3;
use crate::contact::Contacts;

/// Weight of a contact in the block of its node. A Chebyshev step reaches up to 1.74 times the Jacobi step, and a
/// contact that opens does not pull the node back. With a weight of 1, forces of a real thigh doubled for single ticks.
const CAUTION: f64 = 2.0;
/// Change of size in spacings up to which a brick uses its blocks at rest. Pressed springs and corners count as closer
/// to hardening by the same amount.
const MILD: f64 = 0.05;

/// Diagonal blocks of the nodes of a brick in N/m, and their sum over present nodes.
#[derive(Clone)]
pub(super) struct JacobiBlocks {
    of: [[f32; 6]; LOCALS],
    block_sum: [f32; 6],
}

impl JacobiBlocks {
    fn new(blocks: &LocalBlocks, present: u32) -> Self {
        let of = std::array::from_fn(|i| blocks.each_ref().map(|entry| entry[i]));
        let block_sum = block_sum(blocks, present);
        Self { of, block_sum }
    }
}

impl FineLevel {
    /// Recomputes the diagonal blocks of the active nodes at the current displacements.
    pub(super) fn update_blocks(&mut self, hierarchy: &Hierarchy, u: &[Vec3], contacts: &Contacts) {
        for &node in &self.nodes.items {
            self.blocks[node as usize] = [0.0; 6];
        }
        for i in 0..self.set.items.len() {
            let brick = self.set.items[i];
            let b = &hierarchy.bricks[brick as usize];
            if let Some(blocks) = self.at_rest(hierarchy, brick, u) {
                let (of, block_sum) = (blocks.of, blocks.block_sum);
                self.block_sum[brick as usize] = block_sum;
                self.add_blocks(b, |i, e| of[i][e]);
            } else {
                let m = self.tangents(hierarchy, b, Some(u));
                self.block_sum[brick as usize] = block_sum(&m, b.present);
                self.add_blocks(b, |i, e| m[e][i]);
            }
        }
        for &node in &self.nodes.items {
            self.inverse[node as usize] = invert(&self.blocks[node as usize]);
        }
        self.update_contact_blocks(u, contacts);
    }

    #[inline(always)]
    fn add_blocks(&mut self, brick: &Brick, of: impl Fn(usize, usize) -> f32) {
        for (i, &node) in brick.nodes.iter().enumerate() {
            if brick.present >> i & 1 == 1 {
                for (e, to) in self.blocks[node as usize].iter_mut().enumerate() {
                    *to += of(i, e);
                }
            }
        }
    }

    fn tangents(
        &mut self,
        hierarchy: &Hierarchy,
        brick: &Brick,
        u: Option<&[Vec3]>,
    ) -> LocalBlocks {
        self.arch.dispatch(Tangents {
            brick,
            form: &hierarchy.forms[brick.form as usize],
            u,
            per_spacing: hierarchy.per_spacing,
            scratch: &mut self.block_scratch,
        })
    }

    /// The blocks at rest of a brick with a shared form and small strain.
    fn at_rest(&mut self, hierarchy: &Hierarchy, brick: u32, u: &[Vec3]) -> Option<&JacobiBlocks> {
        let b = &hierarchy.bricks[brick as usize];
        let form = b.form as usize;
        let mild = MILD / f64::from(hierarchy.per_spacing);
        let tame = hierarchy.shared[form] && hierarchy.forms[form].is_plain();
        let allowed = self.disabled.allows(Mechanism::BlocksAtRest);
        if !allowed || !tame || hierarchy.change_of(brick, u) > mild {
            return None;
        }
        if self.blocks_at_rest[form].is_none() {
            let m = self.tangents(hierarchy, b, None);
            self.blocks_at_rest[form] = Some(Box::new(JacobiBlocks::new(&m, b.present)));
        }
        self.blocks_at_rest[form].as_deref()
    }

    /// The same for nodes in contact, whose stiffness changes with the contact. A block without the contact would throw
    /// the node out of the tool.
    pub(super) fn update_contact_blocks(&mut self, u: &[Vec3], contacts: &Contacts) {
        self.update_contacts(u, contacts, false);
    }

    /// The same; also adds the contact forces to their nodes.
    pub(super) fn add_contacts_and_blocks(&mut self, u: &[Vec3], contacts: &Contacts) {
        self.update_contacts(u, contacts, true);
    }

    fn update_contacts(&mut self, u: &[Vec3], contacts: &Contacts, presses: bool) {
        self.pressed.clear();
        let blocks = contacts.nodes.iter().map(|&n| self.blocks[n as usize]);
        self.pressed.extend(blocks);
        let cautious = self.disabled.allows(Mechanism::ContactCaution);
        let weight = if cautious { CAUTION } else { 1.0 };
        let (pressed, r) = (&mut self.pressed, &mut self.r);
        contacts.pressed(u, |sample, force, kappa, n| {
            let whole = contact_block(weight * kappa, &n);
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

    /// Recomputes the block sums of bricks that have just become active: with outdated sums corrections were ten times
    /// too long.
    pub(super) fn update_block_sums(&mut self, hierarchy: &Hierarchy, u: &[Vec3], bricks: &[u32]) {
        if !hierarchy.bottoms_out {
            return;
        }
        for &brick in bricks {
            let block_sum = if let Some(blocks) = self.at_rest(hierarchy, brick, u) {
                blocks.block_sum
            } else {
                let b = &hierarchy.bricks[brick as usize];
                block_sum(&self.tangents(hierarchy, b, Some(u)), b.present)
            };
            self.block_sum[brick as usize] = block_sum;
        }
    }

    /// Sum of the diagonal blocks of a brick at rest.
    pub(super) fn block_sum_at_rest(&mut self, hierarchy: &Hierarchy, brick: u32) -> [f32; 6] {
        let b = &hierarchy.bricks[brick as usize];
        if let Some(known) = self.block_sum_at_rest[b.form as usize] {
            return known;
        }
        let block_sum = block_sum(&self.tangents(hierarchy, b, None), b.present);
        *self.block_sum_at_rest[b.form as usize].insert(block_sum)
    }
}

/// Sum of the blocks of the present nodes.
fn block_sum(blocks: &LocalBlocks, present: u32) -> [f32; 6] {
    std::array::from_fn(|e| {
        let there = (0..LOCALS).filter(|i| present >> i & 1 == 1);
        there.map(|i| blocks[e][i]).sum()
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::solver::Solver;
    use crate::cut_history::CutHistory;
    use crate::{BladePoint, Budget, CutStroke, Material, Shape, Tool, Topology, Vec3, block};

    const CELL: f64 = 4e-3;

    /// Cells at an oblique cut are skewed, and their corners stiffen at once.
    #[test]
    fn block_sums_at_rest_do_not_depend_on_earlier_steps() {
        let material = Material::built_in("fat").expect("a built-in material");
        let mut topology = Arc::new(Topology::new(Arc::new(block(
            [12, 12, 6],
            CELL,
            &material,
            1,
        ))));
        let point = |i: u32| BladePoint {
            tip: Vec3::new(6.4, 2.0 + f64::from(i), 1.1) * CELL,
            axis: Vec3::new(0.3, 0.0, 1.0).normalize(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: (0..9).map(point).collect(),
            width_m: 0.0,
        };
        let mut history = CutHistory::new(Arc::clone(&topology));
        history.cut(&mut topology, (&stroke).into()).expect("a cut");
        let tool = Tool::ball(1, Vec3::new(6.0, 6.0, 7.5) * CELL, 8e-3);
        let sums = |near: bool| -> Vec<[f32; 6]> {
            let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
            let budget = Budget {
                near,
                ..Budget::new(1, 1e-9)
            };
            solver.step(&topology, &mut shape, &[tool], budget);
            let hierarchy = &solver.hierarchy;
            let bricks = 0..hierarchy.bricks.len() as u32;
            let fine = &mut solver.fine;
            bricks
                .map(|b| fine.block_sum_at_rest(hierarchy, b))
                .collect()
        };
        assert_eq!(sums(false), sums(true));
    }
}
