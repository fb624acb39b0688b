//! Search for the cells that an edge passes through.

use super::to_rest;
use super::trilinear::invert;
use crate::cell::NO_CELL;
use crate::{FaceId, Shape, Topology, Vec3};

/// Cells that a search expands without coming nearer to the point before it ends: all around a cell.
const IN_VAIN_MAX: usize = 24;
/// The same once the nearest cell is at the outer surface and the point beyond it.
const IN_VAIN_OUTSIDE_MAX: usize = 6;
/// How far outside a cell a point may be by rounding, in cells.
const ROUNDING: f64 = 1e-9;
/// Greatest distance of a point in a wound from either side, in cells. A wider wound holds no edge.
const GAP_MAX: f64 = 0.5;

/// The search for the cells of the edge's points, each from that of the point before.
pub(super) struct Search<'a> {
    topology: &'a Topology,
    shape: &'a Shape,
    /// The cell of the latest point in the tissue.
    pub(super) cell: Option<u32>,
    has_guessed: bool,
    /// Cells of the search for the present point.
    seen: Vec<u32>,
    open: Vec<Visit>,
}

impl<'a> Search<'a> {
    pub(super) fn new(topology: &'a Topology, shape: &'a Shape) -> Self {
        Self {
            topology,
            shape,
            cell: None,
            has_guessed: false,
            seen: Vec::new(),
            open: Vec::new(),
        }
    }

    /// The place of a point in the tissue; `None` outside of it.
    pub(super) fn find(&mut self, world: Vec3, near: &mut Option<u32>) -> Option<Visit> {
        let cells = self.topology.cell_count();
        let known = self.cell.or(*near).filter(|&c| (c as usize) < cells);
        let mut end = known.and_then(|cell| self.cell_at(cell, &world));
        // The edge may be far from where it was.
        if end.is_none() && !self.has_guessed && self.cell.is_none() {
            self.has_guessed = true;
            let guess = to_rest(self.topology, self.shape, world);
            end = guess.and_then(|guess| self.cell_at(guess.cell, &world));
        }
        if let Some(at) = &end {
            self.cell = Some(at.cell);
            *near = self.cell;
        }
        end
    }

    /// The place of a point in the cell that contains it, or that borders on the wound that does; searched from a cell on,
    /// those nearest to the point first.
    fn cell_at(&mut self, from: u32, world: &Vec3) -> Option<Visit> {
        let mut best = self.visit(from, world);
        self.seen.clear();
        self.open.clear();
        self.seen.push(from);
        self.open.push(best);
        let mut in_vain = 0;
        while best.outside > ROUNDING {
            let is_outside = best
                .beyond()
                .any(|face| self.neighbours(best.cell)[face] == NO_CELL);
            let limit = if is_outside {
                IN_VAIN_OUTSIDE_MAX
            } else {
                IN_VAIN_MAX
            };
            if in_vain > limit {
                break;
            }
            let nearest = (0..self.open.len())
                .min_by(|&a, &b| self.open[a].outside.total_cmp(&self.open[b].outside));
            let Some(nearest) = nearest else { break };
            let visit = self.open.swap_remove(nearest);
            in_vain += 1;
            for next in self.neighbours(visit.cell) {
                if next != NO_CELL && !self.seen.contains(&next) {
                    let visit = self.visit(next, world);
                    if visit.outside < best.outside {
                        (best, in_vain) = (visit, 0);
                    }
                    self.seen.push(next);
                    self.open.push(visit);
                }
            }
        }
        // A point outside of its nearest cell is in a wound if a cut has opened that side of the cell.
        let is_open = |face: usize| {
            let across = self.topology.across(FaceId::new(best.cell, face));
            across == NO_CELL && self.neighbours(best.cell)[face] != NO_CELL
        };
        let is_inside = best.outside <= GAP_MAX && best.beyond().all(is_open);
        is_inside.then_some(best)
    }

    /// The neighbours of a cell in the uncut tissue.
    fn neighbours(&self, cell: u32) -> [u32; 6] {
        self.topology.model.cells[cell as usize].neighbours
    }

    /// Where a point lies in a cell. Of a cell too distorted to tell, it is a cell away.
    fn visit(&self, cell: u32, world: &Vec3) -> Visit {
        let nodes = self.topology.corners(cell);
        let deformed = nodes.map(|n| self.shape.position(self.topology, n));
        let local = invert(&deformed, world).unwrap_or(Vec3::repeat(2.0));
        let outside = local.map(|v| (v - 0.5).abs() - 0.5).max().max(0.0);
        Visit {
            cell,
            local,
            outside,
        }
    }
}

/// A cell that was searched.
#[derive(Debug, Clone, Copy)]
pub(super) struct Visit {
    pub(super) cell: u32,
    /// The point in the coordinates of the cell.
    local: Vec3,
    /// Its distance from the cell, in cells.
    outside: f64,
}

impl Visit {
    /// The point of the cell nearest to it.
    pub(super) fn inside(&self) -> Vec3 {
        self.local.map(|v| v.clamp(0.0, 1.0))
    }

    /// The faces that the point is beyond.
    fn beyond(&self) -> impl Iterator<Item = usize> + '_ {
        let beyond = |axis: &usize| (self.local[*axis] - 0.5).abs() > 0.5 + ROUNDING;
        (0..3)
            .filter(beyond)
            .map(|axis| 2 * axis + usize::from(self.local[axis] > 0.5))
    }
}
