//! Contact samples: the points of the surface that a tool presses on.
//!
//! The sampling density follows the resolution of the sphere, not the lattice. Four samples per triangle equal one
//! sample per triangle of a lattice of half the spacing.

use std::sync::LazyLock;

use super::ball::Ball;
use super::core::Core;
use super::outwards::Outwards;
use super::proxy::Proxy;
use super::surface::{Surface, area_normal, blend};
use super::tie::Spread;
use super::{FINE_RADIUS, PENALTY};
use crate::Vec3;

/// Maximum distance of samples along an edge, in radii of at least a spacing: edges at rest have one or two parts. With 1 a ball
/// of 6 mm that is pressed 40 mm into a thigh loses its contact in 60 of 4,000 steps, with 0.75 in 12.
const SAMPLE_PITCH: f64 = 0.75;
/// Maximum parts of an edge.
const PARTS_MAX: usize = 8;
/// Barycentric weights of the middles of the equal parts of a triangle, by the number of parts of an edge.
static WEIGHTS: LazyLock<[Vec<[f64; 3]>; PARTS_MAX + 1]> =
    LazyLock::new(|| std::array::from_fn(middles_of_parts));

fn middles_of_parts(parts: usize) -> Vec<[f64; 3]> {
    let corners = (0..parts).flat_map(|i| (0..parts - i).map(move |j| [i, j]));
    let middles = corners.flat_map(|corner| {
        // Between three parts that are oriented like the triangle lies one of the opposite orientation.
        let has_opposite = corner[0] + corner[1] + 2 <= parts;
        let thirds = if has_opposite {
            &[1.0, 2.0][..]
        } else {
            &[1.0]
        };
        thirds.iter().map(move |third| {
            let [a, b] = corner.map(|k| (k as f64 + third / 3.0) / parts as f64);
            [a, b, 1.0 - a - b]
        })
    });
    middles.collect()
}

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

/// Barycentric weights of the samples of a triangle under a sphere; see [`SAMPLE_PITCH`] and [`FINE_RADIUS`].
pub(super) fn weights_of(corners: &[Vec3; 3], radius: f64, spacing: f64) -> &'static [[f64; 3]] {
    let least = if radius < FINE_RADIUS * spacing { 2 } else { 1 };
    let longest = (0..3)
        .map(|k| (corners[k] - corners[(k + 1) % 3]).norm())
        .fold(0.0, f64::max);
    let parts = (longest / (SAMPLE_PITCH * radius.max(spacing))).ceil() as usize;
    &WEIGHTS[parts.clamp(least, PARTS_MAX)]
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
    let narrow = (WIDE * spacing / proxy.radius).max(1.0).powf(1.5);
    let triangles = within_reach(surface, &proxy.core, reach + proxy.inset);
    let outwards = (proxy.inset > 0.0).then(|| Outwards::around(surface, &triangles));
    for triangle in triangles {
        let corners = surface.corners(triangle);
        let of_triangle = weights_of(&corners, proxy.radius, spacing);
        if samples.len() + of_triangle.len() > SAMPLES_MAX {
            return;
        }
        let Some(normal) = area_normal(&corners).try_normalize(1e-30) else {
            continue;
        };
        let nodes = surface.topology.triangle(triangle);
        let rest = nodes.map(|n| surface.topology.rest(n));
        let share = PENALTY * narrow / (TRIANGLES_PER_NODE * of_triangle.len() as f64);
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
