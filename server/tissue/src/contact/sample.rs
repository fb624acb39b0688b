//! The points of the surface that a tool presses on.
//!
//! How closely they lie is a matter of the tool, not of the lattice: what is felt is how well they stand for the
//! sphere. Four per triangle of a lattice half as fine are as many as one.

use super::proxy::{Proxy, REACH};
use super::surface::{Surface, area_normal, blend};
use super::{FINE_RADIUS, FOUNDATION};
use crate::Vec3;

/// Barycentric weights of the four samples of a triangle, the middles of its four equal parts; its own is the first.
const SAMPLES: [[f64; 3]; 4] = [
    [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0],
    [2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0],
    [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0],
    [1.0 / 6.0, 1.0 / 6.0, 2.0 / 3.0],
];
/// Triangles per node of a surface.
const TRIANGLES_PER_NODE: f64 = 2.0;
/// Samples of all tools at most: a sphere of 40 spacings pressed in to its middle has about 20,000.
/// Beyond it triangles are left out, in the order of the search.
const SAMPLES_MAX: usize = 32_768;
/// Cosine to the centre of the tool from which on a triangle counts in full; at zero it does not.
const FACING: f64 = 0.3;

/// One point of the surface that a tool may press on.
pub(crate) struct Sample {
    pub(crate) nodes: [u32; 3],
    pub(crate) weights: [f64; 3],
    /// Where it is at rest.
    pub(super) rest: Vec3,
    /// κ in N/m, its area and facing taken in.
    pub(super) stiffness: f64,
    /// Normal out of the tissue, for a point tool.
    pub(super) flat: Option<Vec3>,
    pub(super) proxy: u32,
    pub(super) triangle: u32,
    /// How deep it was in m before the tool moved.
    pub(super) depth_before: f64,
}

impl Sample {
    /// Depth in m, below zero where it is off its tool, and direction into the tissue, at `v` from the middle of
    /// the tool.
    #[inline]
    pub(super) fn depth(&self, v: Vec3, radius: f64) -> (f64, Vec3) {
        if let Some(out) = self.flat {
            return (radius + v.dot(&out), -out);
        }
        let distance = v.norm();
        if distance == 0.0 {
            return (0.0, Vec3::zeros());
        }
        (radius - distance, v / distance)
    }
}

/// Barycentric weights of the samples of a triangle under a sphere; see [`FINE_RADIUS`].
pub(super) fn weights_of(radius: f64, spacing: f64) -> &'static [[f64; 3]] {
    if radius < FINE_RADIUS * spacing {
        &SAMPLES
    } else {
        &SAMPLES[..1]
    }
}

/// Adds the samples of a sphere: those within its reach that face it.
pub(super) fn sample_sphere(
    samples: &mut Vec<Sample>,
    surface: &Surface<'_>,
    proxy: &Proxy,
    i: usize,
    own: &[f64],
) {
    let spacing = surface.topology.model().spacing_m;
    let reach = proxy.radius + 0.5 * spacing + proxy.gap;
    let of_triangle = weights_of(proxy.radius, spacing);
    let share = FOUNDATION / (TRIANGLES_PER_NODE * of_triangle.len() as f64);
    for triangle in surface.near(proxy.at, reach) {
        if samples.len() + of_triangle.len() > SAMPLES_MAX {
            return;
        }
        let corners = surface.corners(triangle);
        let Some(normal) = area_normal(&corners).try_normalize(1e-30) else {
            continue;
        };
        let nodes = surface.topology.boundary().triangles[triangle as usize];
        let rest = nodes.map(|n| surface.topology.rest(n));
        for &weights in of_triangle {
            let x = blend(&corners, &weights);
            let v = proxy.at - x;
            let distance = v.norm();
            if distance > reach || distance == 0.0 {
                continue;
            }
            let facing = (v.dot(&normal) / distance / FACING).clamp(0.0, 1.0);
            if facing > 0.0 {
                let fade = facing * facing * (3.0 - 2.0 * facing);
                samples.push(Sample {
                    nodes,
                    weights,
                    rest: blend(&rest, &weights),
                    stiffness: share * fade * foundation(own, &nodes, &weights),
                    flat: None,
                    proxy: i as u32,
                    triangle,
                    depth_before: (proxy.radius - (proxy.before - x).norm()).max(0.0),
                });
            }
        }
    }
}

/// Adds the one sample of a point tool: the nearest point of the surface.
pub(super) fn sample_point(
    samples: &mut Vec<Sample>,
    surface: &Surface<'_>,
    proxy: &Proxy,
    i: usize,
    own: &[f64],
) {
    let reach = proxy.radius + REACH * surface.topology.model().spacing_m;
    if let Some(foot) = surface.nearest(proxy.at, reach) {
        let nodes = surface.topology.boundary().triangles[foot.triangle as usize];
        let rest = nodes.map(|n| surface.topology.rest(n));
        samples.push(Sample {
            nodes,
            weights: foot.weights,
            rest: blend(&rest, &foot.weights),
            stiffness: FOUNDATION * foundation(own, &nodes, &foot.weights),
            flat: Some(foot.normal),
            proxy: i as u32,
            triangle: foot.triangle,
            depth_before: 0.0,
        });
    }
}

fn foundation(own: &[f64], nodes: &[u32; 3], weights: &[f64; 3]) -> f64 {
    (0..3).map(|k| weights[k] * own[nodes[k] as usize]).sum()
}
