//! A straight cut at a location of a model, and retractors that pull its lips apart.

use std::collections::BTreeSet;

use palpate_tissue::cell::NO_CELL;
use palpate_tissue::{BladePoint, CutStroke, Shape, Tissue, Topology, Vec3};

use crate::tool_location::ToolLocation;

/// Points of a stroke.
const POINTS: u32 = 40;
/// The path runs beside the middle of a location by this, in spacings: not in a plane of a block's lattice.
const BESIDE: f64 = 0.3;
/// Width of a retractor across the wound, in spacings.
const RETRACTOR: f64 = 1.5;

/// A straight cut along the stroke direction of a location, into the depth along its normal. Lengths in m.
pub(super) struct CutSite<'a> {
    pub(super) location: &'a ToolLocation,
    /// Middle of the cut from the middle of the location, along the stroke direction.
    pub(super) along_m: f64,
    pub(super) length_m: f64,
    pub(super) depth_m: f64,
}

impl CutSite<'_> {
    /// The point of the surface over a point of the cut.
    fn surface(&self, along: f64) -> Vec3 {
        let beside = BESIDE * self.location.spacing_m;
        self.location.surface(beside, along).at
    }

    /// Path of the tip.
    pub(super) fn tips(&self) -> Vec<Vec3> {
        let along = |i| self.along_m + (f64::from(i) / f64::from(POINTS) - 0.5) * self.length_m;
        let down = self.location.normal * self.depth_m;
        (0..=POINTS)
            .map(|i| self.surface(along(i)) - down)
            .collect()
    }

    /// The stroke. Its blade ends at the surface, so that its depth is that below the surface.
    pub(super) fn stroke(&self, width_m: f64) -> CutStroke {
        let point = |tip| BladePoint {
            tip,
            axis: self.location.normal,
            depth_m: self.depth_m,
        };
        CutStroke {
            points: self.tips().into_iter().map(point).collect(),
            width_m,
        }
    }

    /// Depth of a point below the surface, along the blade.
    fn depth_of(&self, p: &Vec3) -> f64 {
        let along = (p - self.location.middle).dot(&self.location.v);
        (self.surface(along) - p).dot(&self.location.normal)
    }

    /// Depth of each pair of doubled nodes and its opening along the normal of the cut, in m, by depth.
    pub(super) fn openings(
        &self,
        topology: &Topology,
        shape: &Shape,
        doubled: &[(u32, u32)],
    ) -> Vec<(f64, f64)> {
        let across = &self.location.u;
        let side = |n: u32| {
            let cells = topology.cells_around(n).into_iter();
            let corners = cells
                .filter(|&c| c != NO_CELL)
                .flat_map(|c| topology.corners(c));
            let sum: f64 = corners
                .map(|c| (topology.rest(c) - topology.rest(n)).dot(across))
                .sum();
            sum.signum()
        };
        let mut openings: Vec<(f64, f64)> = doubled
            .iter()
            .map(|&(a, b)| {
                let middle = (topology.rest(a) + topology.rest(b)) / 2.0;
                let apart = shape.position(topology, a) - shape.position(topology, b);
                (self.depth_of(&middle), apart.dot(across) * side(a))
            })
            .collect();
        openings.sort_by(|a, b| a.0.total_cmp(&b.0));
        openings
    }

    /// Two retractors along the cut, at a distance from it: they hold the surface nodes there, displaced outwards. Returns
    /// the number of held nodes.
    pub(super) fn retract(&self, tissue: &mut Tissue, from_m: f64, by_m: f64) -> usize {
        let location = self.location;
        let topology = tissue.topology().clone();
        let surface: BTreeSet<u32> = (topology.boundary().triangles.iter())
            .flatten()
            .copied()
            .collect();
        let mut held = 0;
        for node in surface {
            let p = topology.rest(node) - location.middle;
            let across = p.dot(&location.u) - BESIDE * location.spacing_m;
            let is_at = (from_m..from_m + RETRACTOR * location.spacing_m).contains(&across.abs());
            let is_beside = (p.dot(&location.v) - self.along_m).abs() <= self.length_m / 2.0;
            let is_near = p.dot(&location.normal) > -from_m;
            if is_at && is_beside && is_near {
                let by = location.u * by_m * across.signum();
                held += usize::from(tissue.hold(node, by));
            }
        }
        held
    }
}
