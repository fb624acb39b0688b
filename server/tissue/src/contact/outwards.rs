//! Outward direction of the undented surface.
//!
//! The normal of a triangle or of a node turns as soon as a thin tool presses a node in, towards the walls of the dent.
//! The sum of the area normals of a patch depends on its rim alone (Stokes). Here the direction of a node sums the area
//! normals around it and around its neighbours, so its own displacement cancels.

use super::surface::{Surface, area_normal, blend};
use crate::Vec3;

/// Outward directions at the nodes of some triangles.
pub(super) struct Outwards {
    /// Sorted by node, not normalised.
    of_node: Vec<(u32, Vec3)>,
}

impl Outwards {
    /// Directions at the nodes of these triangles.
    pub(super) fn around(surface: &Surface<'_>, triangles: &[u32]) -> Self {
        let nodes_of = |t: &u32| surface.topology.triangle(*t);
        let sorted = |mut nodes: Vec<u32>| {
            nodes.sort_unstable();
            nodes.dedup();
            nodes
        };
        let beneath = sorted(triangles.iter().flat_map(nodes_of).collect());
        let fan = |node: &u32| surface.index.around(*node).iter();
        let wider = sorted(
            beneath
                .iter()
                .flat_map(|n| fan(n).flat_map(nodes_of))
                .collect(),
        );
        let area = |n: &u32| -> Vec3 { fan(n).map(|&t| area_normal(&surface.corners(t))).sum() };
        let areas: Vec<Vec3> = wider.iter().map(area).collect();
        let of_patch = |n: &u32| {
            let ring = sorted(fan(n).flat_map(nodes_of).collect());
            let known = |n: &u32| wider.binary_search(n).map_or(Vec3::zeros(), |i| areas[i]);
            (*n, ring.iter().map(known).sum())
        };
        Self {
            of_node: beneath.iter().map(of_patch).collect(),
        }
    }

    /// Unit vector at a point of a triangle; `normal` where the sum vanishes (a thin flap's rim).
    pub(super) fn at(&self, nodes: &[u32; 3], weights: &[f64; 3], normal: &Vec3) -> Vec3 {
        let of = |n: &u32| {
            let found = self.of_node.binary_search_by_key(n, |(node, _)| *node);
            found.map_or(Vec3::zeros(), |i| self.of_node[i].1)
        };
        let sum = blend(&[of(&nodes[0]), of(&nodes[1]), of(&nodes[2])], weights);
        sum.try_normalize(1e-30).unwrap_or(*normal)
    }
}
