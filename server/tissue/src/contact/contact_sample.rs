//! Contact samples: the points of the surface that a tool presses on.
//!
//! The sampling density follows the resolution of the sphere, not the lattice. Four samples per triangle equal one
//! sample per triangle of a lattice of half the spacing.

use super::ball::Ball;
use super::core::Core;
use super::outwards::Outwards;
use super::proxy::Proxy;
use super::surface::{Surface, area_normal, blend};
use super::tie::Spread;
use super::{FINE_RADIUS, PENALTY};
use crate::Vec3;

/// Barycentric weights of the four samples of a triangle, the middles of its four equal parts; the first is the centre.
const SAMPLES: [[f64; 3]; 4] = [
    [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0],
    [2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0],
    [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0],
    [1.0 / 6.0, 1.0 / 6.0, 2.0 / 3.0],
];
/// Triangles per node of a surface.
const TRIANGLES_PER_NODE: f64 = 2.0;
/// Maximum samples of all tools: a sphere of 40 spacings pressed in to its middle has about 20,000. Further triangles
/// are left out, in the order of the search.
const SAMPLES_MAX: usize = 32_768;
/// Radius in spacings below which each of the few samples under a tool is stiffened, or tissue would pass beside it.
/// With twice this radius convergence took a third more iterations.
const WIDE: f64 = 1.0;
/// Cosine to the centre of the tool from which a triangle counts in full; the weight is zero at cosine zero.
const FACING: f64 = 0.3;

/// One point of the surface that a tool may press on.
pub(crate) struct Sample {
    pub(crate) nodes: [u32; 3],
    pub(crate) weights: [f64; 3],
    /// Position at rest, minus the inset of a thin tool.
    pub(super) rest: Vec3,
    /// κ in N/m, including area and facing.
    pub(super) stiffness: f64,
    pub(super) proxy: u32,
    pub(super) triangle: u32,
    /// λ/κ in m; see [`Multipliers`](super::multipliers::Multipliers).
    pub(super) multiplier: f64,
}

impl Sample {
    /// Its nodes.
    #[inline]
    pub(super) fn spread(&self) -> Spread {
        Spread {
            nodes: self.nodes,
            weights: self.weights,
        }
    }

    /// Current position.
    #[inline]
    pub(super) fn position(&self, u: &[Vec3]) -> Vec3 {
        self.rest + blend(&self.nodes.map(|n| u[n as usize]), &self.weights)
    }

    /// Displacement by tools, relative to the equilibrium without tools.
    pub(super) fn moved(&self, u: &[Vec3], untouched: Option<&[Vec3]>) -> Vec3 {
        let by = |n: u32| {
            let n = n as usize;
            let from = untouched.and_then(|all| all.get(n));
            from.map_or(u[n], |from| u[n] - from)
        };
        blend(&self.nodes.map(by), &self.weights)
    }
}

/// Depth in m (negative: open) and direction into the tissue of a sample at `v` from the core of a tool.
#[inline]
pub(super) fn depth(v: Vec3, radius: f64) -> (f64, Vec3) {
    let distance = v.norm();
    if distance == 0.0 {
        return (0.0, Vec3::zeros());
    }
    (radius - distance, v / distance)
}

/// Barycentric weights of the samples of a triangle under a sphere; see [`FINE_RADIUS`].
pub(super) fn weights_of(radius: f64, spacing: f64) -> &'static [[f64; 3]] {
    if radius < FINE_RADIUS * spacing {
        &SAMPLES
    } else {
        &SAMPLES[..1]
    }
}

/// Adds the samples of a tool: points of the surface within its reach that face it.
pub(super) fn sample(
    samples: &mut Vec<Sample>,
    surface: &Surface<'_>,
    proxy: &Proxy,
    i: usize,
    own: &[f64],
) {
    let spacing = surface.topology.model().spacing_m;
    let reach = proxy.radius + 0.5 * spacing + proxy.gap;
    let of_triangle = weights_of(proxy.radius, spacing);
    let narrow = (WIDE * spacing / proxy.radius).max(1.0).powf(1.5);
    let share = PENALTY * narrow / (TRIANGLES_PER_NODE * of_triangle.len() as f64);
    let triangles = within_reach(surface, &proxy.core, reach + proxy.inset);
    let outwards = (proxy.inset > 0.0).then(|| Outwards::around(surface, &triangles));
    for triangle in triangles {
        if samples.len() + of_triangle.len() > SAMPLES_MAX {
            return;
        }
        let corners = surface.corners(triangle);
        let Some(normal) = area_normal(&corners).try_normalize(1e-30) else {
            continue;
        };
        let nodes = surface.topology.triangle(triangle);
        let rest = nodes.map(|n| surface.topology.rest(n));
        for &weights in of_triangle {
            let inwards = outwards.as_ref().map_or_else(Vec3::zeros, |outwards| {
                outwards.at(&nodes, &weights, &normal) * -proxy.inset
            });
            let x = blend(&corners, &weights) + inwards;
            let v = proxy.core.towards(&x);
            let distance = v.norm();
            if distance > reach || distance == 0.0 {
                continue;
            }
            let facing = (-v.dot(&normal) / distance / FACING).clamp(0.0, 1.0);
            if facing > 0.0 {
                let fade = facing * facing * (3.0 - 2.0 * facing);
                samples.push(Sample {
                    nodes,
                    weights,
                    rest: blend(&rest, &weights) + inwards,
                    stiffness: share * fade * under(own, &nodes, &weights),
                    proxy: i as u32,
                    triangle,
                    multiplier: proxy.multipliers.at(&nodes, &weights),
                });
            }
        }
    }
}

/// Triangles whose boxes may be within reach of a core, in the order of their numbers.
fn within_reach(surface: &Surface<'_>, core: &Core, reach: f64) -> Vec<u32> {
    let balls = core.cover(reach);
    if let [ball] = balls[..] {
        return surface.near(ball.centre, ball.radius);
    }
    let of_ball = |ball: &Ball| surface.near(ball.centre, ball.radius);
    let mut found: Vec<u32> = balls.iter().flat_map(of_ball).collect();
    found.sort_unstable();
    found.dedup();
    found
}

/// Stiffness of the nodes under a sample.
fn under(own: &[f64], nodes: &[u32; 3], weights: &[f64; 3]) -> f64 {
    (0..3).map(|k| weights[k] * own[nodes[k] as usize]).sum()
}
