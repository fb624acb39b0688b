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
    pub(super) fn add_node_stiffness(
        &mut self,
        hierarchy: &Hierarchy,
        node: u32,
        block: &[f32; 6],
    ) {
        let Some(&entry) = hierarchy.around.row(node).first() else {
            return;
        };
        let (brick, place) = (entry / 32, entry % 32);
        let element = hierarchy.element_of[brick as usize];
        if hierarchy.prolongation.element_of(node as usize).is_none() {
            return;
        }
        let w = super::element::WEIGHTS[place as usize].map(|w| w as f32);
        self.grids[0].add_stiffness(&hierarchy.levels[0], element, |k| {
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
        let corners = hierarchy.levels[0].corners[element as usize];
        for (c, wc) in w.iter().enumerate().filter(|w| *w.1 > 0.0) {
            self.grids[0].add_bound(corners[c], block, *wc);
        }
    }

    /// Adds a force in N on a node to the loads of level 1.
    pub(super) fn load_node(&mut self, hierarchy: &Hierarchy, node: u32, force: &Vec3) {
        let load = [force.x as f32, force.y as f32, force.z as f32, 0.0];
        restrict(&hierarchy.prolongation, node, &load, &mut self.grids[0]);
    }

    /// Adds the stiffness to the Galerkin operators of all levels.
    pub(super) fn propagate_stiffness(&mut self, hierarchy: &Hierarchy) {
        for l in 0..self.grids.len() {
            let level = &hierarchy.levels[l];
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let grid = &mut finer[l];
            for &point in &grid.stiffened.items {
                let p = point as usize;
                let sum = std::array::from_fn(|i| level.bound[p][i] + grid.added_bound[p][i]);
                grid.inverse[p] = invert(&sum);
            }
            for stiffened in &mut grid.stiffened_elements {
                let element = stiffened.element as usize;
                if let Some(next) = coarser.first_mut() {
                    let octant = level.octant[element] as usize;
                    next.add_stiffness(&hierarchy.levels[l + 1], level.parent[element], |k| {
                        add_child(k, &stiffened.k, octant);
                    });
                }
                let (_, own) = level.element(stiffened.element);
                own.add_to(&mut stiffened.k);
            }
            let Some(next) = coarser.first_mut() else {
                break;
            };
            for &point in &grid.stiffened.items {
                for (coarse, weight) in level.prolongation.row(point as usize) {
                    next.add_bound(coarse, &grid.added_bound[point as usize], weight);
                }
            }
        }
    }

    /// Removes all added stiffness.
    pub(super) fn clear_stiffness(&mut self, hierarchy: &Hierarchy) {
        for (grid, level) in self.grids.iter_mut().zip(&hierarchy.levels) {
            for stiffened in &grid.stiffened_elements {
                grid.stiffness_of[stiffened.element as usize] = NONE;
            }
            grid.spare.append(&mut grid.stiffened_elements);
            for &point in &grid.stiffened.items {
                grid.added_bound[point as usize] = [0.0; 6];
                grid.inverse[point as usize] = invert(&level.bound[point as usize]);
            }
            grid.stiffened.clear();
        }
    }
}

impl CoarseLevel {
    pub(super) fn add_stiffness(
        &mut self,
        level: &Level,
        element: u32,
        add: impl FnOnce(&mut Columns),
    ) {
        debug_assert!((element as usize) < level.corners.len());
        let entry = &mut self.stiffness_of[element as usize];
        if *entry == NONE {
            *entry = self.stiffened_elements.len() as u32;
            let mut stiffened = self.spare.pop().unwrap_or_else(|| ContactStiffness {
                element,
                k: Box::new(Columns::ZERO),
            });
            stiffened.element = element;
            *stiffened.k = Columns::ZERO;
            self.stiffened_elements.push(stiffened);
        }
        add(&mut self.stiffened_elements[*entry as usize].k);
    }

    pub(super) fn add_bound(&mut self, point: u32, block: &[f32; 6], weight: f32) {
        self.stiffened.insert(point);
        for (to, v) in self.added_bound[point as usize].iter_mut().zip(block) {
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
