//! Stiffness and loads of contacts and held nodes on the coarse levels.

use super::brick::CORNER;
use super::coarse_level::{CoarseLevel, ContactStiffness, NONE, invert};
use super::cycle::{Multigrid, restrict};
use super::hierarchy::{Hierarchy, Level};
use super::matrix::{Columns, at, lane};
use super::prolongation::STENCILS;
use super::quad::{ZERO, plus};
use crate::Vec3;

impl Multigrid {
    /// Adds the stiffness of a node, a block in N/m, to level 1.
    pub(super) fn stiffen(&mut self, structure: &Hierarchy, node: u32, block: &[f32; 6]) {
        let Some(&entry) = structure.around.row(node).first() else {
            return;
        };
        let (brick, place) = (entry / 32, entry % 32);
        let element = structure.element_of[brick as usize];
        if structure.prolongation.element_of(node as usize).is_none() {
            return;
        }
        let w = super::element::WEIGHTS[place as usize].map(|w| w as f32);
        self.patches[0].overlay(&structure.levels[0], element, |k| {
            for (p, wp) in w.iter().enumerate().filter(|w| *w.1 > 0.0) {
                for (q, wq) in w.iter().enumerate().filter(|w| *w.1 > 0.0) {
                    const AT: [[usize; 3]; 3] = [[0, 3, 4], [3, 1, 5], [4, 5, 2]];
                    for a in 0..3 {
                        for b in 0..3 {
                            k.0[at(p, a)][lane(q, b)] += wp * wq * block[AT[a][b]];
                        }
                    }
                }
            }
        });
        let corners = structure.levels[0].corners[element as usize];
        for (c, wc) in w.iter().enumerate().filter(|w| *w.1 > 0.0) {
            self.patches[0].bear(corners[c], block, *wc);
        }
    }

    /// Adds a force in N on a node to the loads of level 1.
    pub(super) fn draw(&mut self, structure: &Hierarchy, node: u32, force: &Vec3) {
        let load = [force.x as f32, force.y as f32, force.z as f32, 0.0];
        restrict(&structure.prolongation, node, &load, &mut self.patches[0]);
    }

    /// Adds the stiffness to the Galerkin operators of all levels.
    pub(super) fn spread(&mut self, structure: &Hierarchy) {
        for l in 0..self.patches.len() {
            let level = &structure.levels[l];
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let patch = &mut finer[l];
            for &point in &patch.stiffened.items {
                let p = point as usize;
                let sum = std::array::from_fn(|i| level.bound[p][i] + patch.stiffer[p][i]);
                patch.inverse[p] = invert(&sum);
            }
            for overlay in &mut patch.overlays {
                let element = overlay.element as usize;
                if let Some(next) = coarser.first_mut() {
                    let octant = level.octant[element] as usize;
                    next.overlay(&structure.levels[l + 1], level.parent[element], |k| {
                        add_child(k, &overlay.k, octant);
                    });
                }
                let (_, own) = level.element(overlay.element);
                own.k.add_to(&mut overlay.k);
            }
            let Some(next) = coarser.first_mut() else {
                break;
            };
            for &point in &patch.stiffened.items {
                for (coarse, weight) in level.prolongation.row(point as usize) {
                    next.bear(coarse, &patch.stiffer[point as usize], weight);
                }
            }
        }
    }

    /// Removes all added stiffness.
    pub(super) fn soften(&mut self, structure: &Hierarchy) {
        for (patch, level) in self.patches.iter_mut().zip(&structure.levels) {
            for overlay in &patch.overlays {
                patch.overlay_of[overlay.element as usize] = NONE;
            }
            patch.spare.append(&mut patch.overlays);
            for &point in &patch.stiffened.items {
                patch.stiffer[point as usize] = [0.0; 6];
                patch.inverse[point as usize] = invert(&level.bound[point as usize]);
            }
            patch.stiffened.clear();
        }
    }
}

impl CoarseLevel {
    pub(super) fn overlay(&mut self, level: &Level, element: u32, add: impl FnOnce(&mut Columns)) {
        debug_assert!((element as usize) < level.corners.len());
        let entry = &mut self.overlay_of[element as usize];
        if *entry == NONE {
            *entry = self.overlays.len() as u32;
            let mut overlay = self.spare.pop().unwrap_or_else(|| ContactStiffness {
                element,
                k: Box::new(Columns::ZERO),
            });
            overlay.element = element;
            *overlay.k = Columns::ZERO;
            self.overlays.push(overlay);
        }
        add(&mut self.overlays[*entry as usize].k);
    }

    pub(super) fn bear(&mut self, point: u32, block: &[f32; 6], weight: f32) {
        self.stiffened.insert(point);
        for (to, v) in self.stiffer[point as usize].iter_mut().zip(block) {
            *to += weight * v;
        }
    }
}

/// Adds `PᵀKP` of the matrix of a finer element.
fn add_child(to: &mut Columns, child: &Columns, octant: usize) {
    let stencils = CORNER[octant].map(|place| &STENCILS[place]);
    for (c, row) in stencils.iter().enumerate() {
        for a in 0..3 {
            // Rows first: one column of K becomes t.
            let from = &child.0[at(c, a)];
            let mut t = [ZERO; 8];
            for (own, stencil) in stencils.iter().enumerate() {
                let value = [0, 1, 2, 3].map(|i| from[lane(own, i)]);
                for (q, w) in stencil.corners() {
                    t[q] = plus(&t[q], w, &value);
                }
            }
            for (p, w) in row.corners() {
                let column = &mut to.0[at(p, a)];
                for (v, t) in column.iter_mut().zip(t.as_flattened()) {
                    *v += w * t;
                }
            }
        }
    }
}
