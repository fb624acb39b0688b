//! What contacts and held nodes add to the coarse levels: stiffness, and the force that draws them along.

use super::block::{ZERO, plus};
use super::cycle::{Multigrid, restrict};
use super::matrix::{Columns, at, lane};
use super::patch::{NONE, Overlay, Patch, invert};
use super::structure::{Level, Structure};
use crate::Vec3;

impl Multigrid {
    /// Adds the stiffness of a node, a block in N/m, to level 1.
    pub(super) fn stiffen(&mut self, structure: &Structure, node: u32, block: &[f32; 6]) {
        let Some(&entry) = structure.around.row(node).first() else {
            return;
        };
        let (brick, place) = (entry / 32, entry % 32);
        let element = structure.element_of[brick as usize];
        if structure.ties[node as usize].len == 0 {
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
    pub(super) fn draw(&mut self, structure: &Structure, node: u32, force: &Vec3) {
        let load = [force.x as f32, force.y as f32, force.z as f32, 0.0];
        restrict(&structure.ties[node as usize], &load, &mut self.patches[0]);
    }

    /// Carries the added stiffness to all levels.
    pub(super) fn spread(&mut self, structure: &Structure) {
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
                let ties = &level.ties[point as usize];
                for t in 0..ties.len as usize {
                    next.bear(ties.to[t], &patch.stiffer[point as usize], ties.weight[t]);
                }
            }
        }
    }

    /// Forgets all added stiffness.
    pub(super) fn soften(&mut self, structure: &Structure) {
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

impl Patch {
    pub(super) fn overlay(&mut self, level: &Level, element: u32, add: impl FnOnce(&mut Columns)) {
        debug_assert!((element as usize) < level.corners.len());
        let entry = &mut self.overlay_of[element as usize];
        if *entry == NONE {
            *entry = self.overlays.len() as u32;
            let mut overlay = self.spare.pop().unwrap_or_else(|| Overlay {
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

/// Corners of an element that a corner of its child hangs on, and its weights: those that are not zero.
#[derive(Clone, Copy)]
struct Hangs {
    on: [usize; 8],
    weight: [f32; 8],
    len: usize,
}

/// Of each corner of the child in each octant. (Looking for the zeros takes longer than everything else.)
const HANGS: [[Hangs; 8]; 8] = hangs();

const fn hangs() -> [[Hangs; 8]; 8] {
    let none = Hangs {
        on: [0; 8],
        weight: [0.0; 8],
        len: 0,
    };
    let mut list = [[none; 8]; 8];
    let mut i = 0;
    while i < 64 {
        let (octant, corner) = (i / 8, i % 8);
        let weights = super::element::WEIGHTS[super::brick::CORNER[octant][corner]];
        let mut c = 0;
        while c < 8 {
            if weights[c] > 0.0 {
                let hangs = &mut list[octant][corner];
                hangs.on[hangs.len] = c;
                hangs.weight[hangs.len] = weights[c] as f32;
                hangs.len += 1;
            }
            c += 1;
        }
        i += 1;
    }
    list
}

impl Hangs {
    #[inline(always)]
    fn each(&self) -> impl Iterator<Item = (usize, f32)> {
        let both = self.on.iter().copied().zip(self.weight);
        both.take(self.len)
    }
}

/// Adds `PᵀKP` of the matrix of a finer element.
fn add_child(to: &mut Columns, child: &Columns, octant: usize) {
    let corners = &HANGS[octant];
    for (c, row) in corners.iter().enumerate() {
        for a in 0..3 {
            // Rows first: what one column of K becomes.
            let from = &child.0[at(c, a)];
            let mut t = [ZERO; 8];
            for (own, hangs) in corners.iter().enumerate() {
                let value = [0, 1, 2, 3].map(|i| from[lane(own, i)]);
                for (q, w) in hangs.each() {
                    t[q] = plus(&t[q], w, &value);
                }
            }
            for (p, w) in row.each() {
                let column = &mut to.0[at(p, a)];
                for (v, t) in column.iter_mut().zip(t.as_flattened()) {
                    *v += w * t;
                }
            }
        }
    }
}
