//! Resistance of the tissue along the edge of a cutting blade.
//!
//! The work of parting tissue is its toughness R times the area of the cut (Griffith 1921; for blades Atkins 2009), so an
//! edge that advances feels the force
//!
//! ```text
//! F = ∫ R dl        over the part of the edge in the tissue
//! ```
//!
//! The wound gapes behind the edge and, on a lattice, somewhat before it. A point between the two sides of a wound
//! therefore counts as tissue.

use super::trilinear::invert;
use super::{BladePoint, to_rest};
use crate::cell::NO_CELL;
use crate::{FaceId, Shape, Topology, Vec3};

/// Length of a piece of the edge in which the tissue may change once, in spacings: half of the thinnest layer.
const PIECE: f64 = 0.5;
/// Most pieces; beyond them, those of a long edge are longer.
const PIECES_MAX: f64 = 64.0;
/// Halvings of a piece of the edge in which the tissue changes: to a hundredth of it.
const HALVINGS: usize = 6;
/// Cells that a search expands without coming nearer to the point before it ends: all around a cell.
const IN_VAIN_MAX: usize = 24;
/// The same once the nearest cell is at the outer surface and the point beyond it.
const IN_VAIN_OUTSIDE_MAX: usize = 6;
/// How far outside a cell a point may be by rounding, in cells.
const ROUNDING: f64 = 1e-9;
/// Greatest distance of a point in a wound from either side, in cells. A wider wound holds no edge.
const GAP_MAX: f64 = 0.5;

/// Motion of the tip that determines the direction of an edge, m: twice that between two solves.
const TURN_M: f64 = 0.3e-3;

/// The path of an edge so far.
#[derive(Debug, Clone, Default)]
pub struct EdgeTrack {
    /// A cell near the edge.
    near: Option<u32>,
    /// The tip when its direction was determined.
    from: Option<Vec3>,
    /// Direction of the edge, across itself.
    ahead: Option<Vec3>,
}

impl EdgeTrack {
    fn follow(&mut self, blade: &BladePoint) {
        let moved = blade.tip - *self.from.get_or_insert(blade.tip);
        if moved.norm() < TURN_M {
            return;
        }
        let across = moved - blade.axis * moved.dot(&blade.axis);
        self.ahead = across.try_normalize(0.5 * TURN_M).or(self.ahead);
        self.from = Some(blade.tip);
    }
}

/// The resistance against the edge of a blade.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EdgeResistance {
    /// Force against any motion across the edge, N.
    pub newtons: f64,
    /// Where it acts: distance from the tip along the edge, m.
    pub along_m: f64,
    /// Direction in which the edge moves, across itself; zero if it is unknown.
    pub ahead: Vec3,
}

/// The resistance against a blade in the deformed shape. `track` follows the edge from call to call.
pub fn edge_resistance(
    topology: &Topology,
    shape: &Shape,
    blade: &BladePoint,
    track: &mut EdgeTrack,
) -> EdgeResistance {
    track.follow(blade);
    let ahead = track.ahead.unwrap_or_default();
    let mut search = Search {
        topology,
        shape,
        cell: None,
        has_guessed: false,
        seen: Vec::new(),
        open: Vec::new(),
    };
    let mut at = |along_m: f64| search.toughness(blade.tip + blade.axis * along_m, &mut track.near);
    let (mut newtons, mut moment) = (0.0, 0.0);
    let mut add = |toughness: f64, from: f64, to: f64| {
        newtons += toughness * (to - from);
        moment += toughness * (to * to - from * from) / 2.0;
    };
    let mut from = at(0.0);
    let pieces = blade.depth_m / (PIECE * topology.model.spacing_m);
    let pieces = pieces.ceil().clamp(1.0, PIECES_MAX) as usize;
    for i in 0..pieces {
        let [begin, end] = [i, i + 1].map(|i| blade.depth_m * i as f64 / pieces as f64);
        let to = at(end);
        let mut change = begin;
        if from != to {
            let mut step = end - begin;
            for _ in 0..HALVINGS {
                step *= 0.5;
                if at(change + step) == from {
                    change += step;
                }
            }
        }
        add(from, begin, change);
        add(to, change, end);
        from = to;
    }
    EdgeResistance {
        newtons,
        along_m: if newtons > 0.0 { moment / newtons } else { 0.0 },
        ahead,
    }
}

/// The search for the cells of the edge's points, each from that of the point before.
struct Search<'a> {
    topology: &'a Topology,
    shape: &'a Shape,
    /// The cell of the latest point in the tissue.
    cell: Option<u32>,
    has_guessed: bool,
    /// Cells of the search for the present point.
    seen: Vec<u32>,
    open: Vec<Visit>,
}

impl Search<'_> {
    /// Toughness at a point in J/m²; 0 outside the tissue.
    fn toughness(&mut self, world: Vec3, near: &mut Option<u32>) -> f64 {
        let cells = self.topology.cell_count();
        let known = self.cell.or(*near).filter(|&c| (c as usize) < cells);
        let mut end = known.and_then(|cell| self.cell_at(cell, &world));
        // The edge may be far from where it was.
        if end.is_none() && !self.has_guessed && self.cell.is_none() {
            self.has_guessed = true;
            let guess = to_rest(self.topology, self.shape, world);
            end = guess.and_then(|guess| self.cell_at(guess.cell, &world));
        }
        if let Some(cell) = end {
            self.cell = end;
            *near = end;
            return self
                .topology
                .model
                .material_of(cell as usize)
                .toughness_j_m2;
        }
        0.0
    }

    /// The cell that contains a point, or borders on the wound that does; searched from a cell on, those nearest to the
    /// point first.
    fn cell_at(&mut self, from: u32, world: &Vec3) -> Option<u32> {
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
        is_inside.then_some(best.cell)
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
struct Visit {
    cell: u32,
    /// The point in the coordinates of the cell.
    local: Vec3,
    /// Its distance from the cell, in cells.
    outside: f64,
}

impl Visit {
    /// The faces that the point is beyond.
    fn beyond(&self) -> impl Iterator<Item = usize> + '_ {
        let beyond = |axis: &usize| (self.local[*axis] - 0.5).abs() > 0.5 + ROUNDING;
        (0..3)
            .filter(beyond)
            .map(|axis| 2 * axis + usize::from(self.local[axis] > 0.5))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::{CutStroke, Material, Model, block, cut};

    /// A block of 40 x 40 x 32 mm whose upper half is `tough`.
    fn layered(tough: f64) -> Topology {
        let mut model = block([10, 10, 8], 4e-3, &Material::default(), 4);
        for region in &mut model.regions {
            let is_base = region.name == "base";
            region.material.toughness_j_m2 = if is_base { 100.0 } else { tough };
        }
        Topology::new(Arc::new(model))
    }

    fn total(topology: &Topology, shape: &Shape, blade: &BladePoint) -> (f64, f64) {
        let edge = edge_resistance(topology, shape, blade, &mut EdgeTrack::default());
        (edge.newtons, edge.newtons * edge.along_m)
    }

    proptest! {
        /// Force and moment are the closed-form integrals over both layers, for any place, length and lean of the blade.
        #[test]
        fn resistance_is_the_integral_of_the_toughness(
            x in 0.012..0.028f64, y in 0.012..0.028f64, z in 1e-3..31e-3f64, length in 5e-3..40e-3f64, lean in -0.3..0.3f64,
        ) {
            let topology = layered(1_000.0);
            let shape = Shape::rest(&topology);
            let axis = Vec3::new(lean, 0.0, 1.0).normalize();
            let blade = BladePoint { tip: Vec3::new(x, y, z), axis, depth_m: length };
            let at = |height: f64| ((height - z) / axis.z).clamp(0.0, length);
            let (between, top) = (at(16e-3), at(32e-3));
            let force = 100.0 * between + 1_000.0 * (top - between);
            let moment = 50.0 * between.powi(2) + 500.0 * (top.powi(2) - between.powi(2));
            let (newtons, about_tip) = total(&topology, &shape, &blade);
            // The place of each change is known to 1/128 of a piece of half a spacing.
            let off = 1_000.0 * 2e-3 / 128.0;
            prop_assert!((newtons - force).abs() < 2.0 * off, "{newtons} {force}");
            prop_assert!((about_tip - moment).abs() < 2.0 * off * length, "{about_tip} {moment}");
        }
    }

    #[test]
    fn wound_that_gapes_around_the_edge_counts_as_tissue_and_a_wide_one_does_not() {
        let mut topology = layered(100.0);
        let point = |y| BladePoint {
            tip: Vec3::new(20e-3, y, 12e-3),
            axis: Vec3::z(),
            depth_m: 20e-3,
        };
        let stroke = CutStroke {
            points: vec![point(4e-3), point(36e-3)],
            width_m: 0.5e-3,
        };
        let outcome = cut(&mut topology, &stroke).unwrap();
        // At its front the widest is still narrow.
        for (open_m, newtons, off) in [(0.0, 2.0, 0.1), (1e-3, 2.0, 0.1), (8e-3, 0.0, 0.8)] {
            let mut shape = Shape::rest(&topology);
            for &(new, old) in &outcome.doubled {
                for node in [new, old] {
                    let cells = topology.cells_around(node);
                    let is_left = cells.iter().filter(|&&c| c != NO_CELL);
                    let x = is_left.map(|&c| topology.centre(c).x).sum::<f64>();
                    let count = cells.iter().filter(|&&c| c != NO_CELL).count() as f64;
                    shape.displacement[node as usize].x =
                        open_m / 2.0 * (x / count - 20e-3).signum();
                }
            }
            let (force, _) = total(&topology, &shape, &point(20e-3));
            assert!((force - newtons).abs() < off, "{open_m} {force}");
        }
    }

    #[test]
    fn edge_beside_the_tissue_has_no_resistance() {
        let topology = layered(100.0);
        let shape = Shape::rest(&topology);
        let beside = |tip| BladePoint {
            tip,
            axis: Vec3::z(),
            depth_m: 20e-3,
        };
        for tip in [
            Vec3::new(50e-3, 20e-3, 5e-3),
            Vec3::new(20e-3, 20e-3, 33e-3),
            Vec3::new(1.0, 1.0, 1.0),
            Vec3::new(f64::NAN, 0.0, 0.0),
        ] {
            assert_eq!(total(&topology, &shape, &beside(tip)), (0.0, 0.0));
        }
    }

    /// Distorted cells, as at the interfaces of a real model, and a wound that ends at the blade.
    #[test]
    fn resistance_is_continuous_along_the_path_of_a_cut() {
        let mut model = Model::clone(layered(1_000.0).model());
        for (i, node) in model.nodes.iter_mut().enumerate() {
            let t = i as f64;
            *node += Vec3::new(t.sin(), (1.7 * t).cos(), (0.3 * t).sin()) * 0.9e-3;
        }
        let mut topology = Topology::new(Arc::new(model));
        let point = |y: f64| BladePoint {
            tip: Vec3::new(19.3e-3, y, 11.3e-3),
            axis: Vec3::new(0.2, 0.1, 1.0).normalize(),
            depth_m: 30e-3,
        };
        let mut track = EdgeTrack::default();
        let mut last: Option<f64> = None;
        for step in 0..260 {
            let y = 6e-3 + 0.1e-3 * f64::from(step);
            if step > 0 && step % 100 == 0 {
                let points = (0..=step).map(|i| point(6e-3 + 0.1e-3 * f64::from(i)));
                let stroke = CutStroke {
                    points: points.collect(),
                    width_m: 0.5e-3,
                };
                // The cut itself moves nodes onto the path of the blade.
                last = None;
                cut(&mut topology, &stroke).unwrap();
            }
            let shape = Shape::rest(&topology);
            let force = edge_resistance(&topology, &shape, &point(y), &mut track).newtons;
            if let Some(last) = last {
                assert!((force - last).abs() < 0.3, "at {y}: {last} {force}");
            }
            last = Some(force);
        }
    }
}
