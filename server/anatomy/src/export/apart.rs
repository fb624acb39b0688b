//! Parts of the outer surface that touch or pass through each other, moved apart for STL.

use std::collections::BTreeMap;

use palpate_tissue::{Shape, Topology, Vec3};
use serde::{Deserialize, Serialize};

use crate::surface::{crossings, separations};

/// Half of the gap in m between two nodes of an STL that would be in one place.
const HALF_GAP_M: f64 = 5e-6;
/// Distance in mm that each of two triangles keeps from the plane between them.
const MARGIN_MM: f64 = 1e-3;
/// Most rounds in which triangles are separated.
const ROUNDS: usize = 40;
/// Farthest further move of a node, in spacings. Reason: beyond it the file would show another wound than the model has.
const MOVE_MAX: f64 = 0.02;
/// Projections per node, and its longest offset in half gaps.
const PROJECTIONS: usize = 20;
const OFFSET_MAX: f64 = 5.0;
/// Most places that are listed.
const PLACES_MAX: usize = 5;

/// Deviations of an STL of the outer surface from the model. Readers of STL join equal points, and edges of four triangles
/// would result, so the walls of closed wounds are moved apart by 0.01 mm. Triangles that pass through each other are
/// separated while no node moves by more than 0.02 spacings. Deeper intersections, such as those of the walls of wounds that
/// cross, stay and are listed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct StlFigures {
    /// Farthest move of a node in mm.
    pub moved_max_mm: f64,
    /// Pairs of triangles in the file of which an edge of one passes through the inside of the other.
    pub self_intersections: usize,
    /// The first places of such pairs in mm.
    pub places_mm: Vec<[f64; 3]>,
}

/// The shape with outer nodes moved apart, into their own tissue.
pub(super) fn apart(topology: &Topology, shape: &Shape) -> (Shape, StlFigures) {
    let triangles = &topology.boundary().triangles;
    let opened = opened(topology, shape);
    let mut apart = opened.clone();
    // In the precision of the file.
    let place = |apart: &Shape, node: u32| {
        let at = apart.position(topology, node) * 1e3;
        at.map(|x| f64::from(x as f32))
    };
    let side_mm = topology.model().spacing_m * 1e3;
    let find = |apart: &Shape| crossings(triangles, |n| place(apart, n), side_mm);
    let moved_mm = |from: &Shape, apart: &Shape, node: u32| {
        let node = node as usize;
        (apart.displacement[node] - from.displacement[node]).norm() * 1e3
    };
    let mut crossing = find(&apart);
    for _ in 0..ROUNDS {
        if crossing.is_empty() {
            break;
        }
        let pairs = crossing.iter().map(|p| p.map(|t| triangles[t as usize]));
        for (node, by) in separations(pairs, |n| place(&apart, n), MARGIN_MM) {
            let before = apart.displacement[node as usize];
            apart.displacement[node as usize] += by * 1e-3;
            if moved_mm(&opened, &apart, node) > MOVE_MAX * side_mm {
                apart.displacement[node as usize] = before;
            }
        }
        crossing = find(&apart);
    }
    let middle = |pair: &[u32; 2]| {
        let corners = pair.iter().flat_map(|t| triangles[*t as usize]);
        <[f64; 3]>::from(corners.map(|n| place(&apart, n)).sum::<Vec3>() / 6.0)
    };
    let nodes = triangles.iter().flatten();
    let figures = StlFigures {
        moved_max_mm: nodes
            .map(|n| moved_mm(shape, &apart, *n))
            .fold(0.0, f64::max),
        self_intersections: crossing.len(),
        places_mm: crossing.iter().take(PLACES_MAX).map(middle).collect(),
    };
    (apart, figures)
}

/// The shape with nodes that are in one place moved apart by 0.01 mm: those of the walls of a closed wound.
fn opened(topology: &Topology, shape: &Shape) -> Shape {
    let place = |node: u32| {
        let at = shape.position(topology, node) * 1e3;
        [at.x, at.y, at.z].map(|x| (x as f32 + 0.0).to_bits())
    };
    let triangles = &topology.boundary().triangles;
    let mut nodes: Vec<u32> = triangles.iter().flatten().copied().collect();
    nodes.sort_unstable();
    nodes.dedup();
    let mut placed: Vec<([u32; 3], u32)> = nodes.iter().map(|&n| (place(n), n)).collect();
    placed.sort_unstable();
    let together = placed.chunk_by(|a, b| a.0 == b.0).filter(|c| c.len() > 1);
    let mut normals: BTreeMap<u32, Vec<Vec3>> = together
        .flatten()
        .map(|&(_, node)| (node, Vec::new()))
        .collect();
    let mut opened = shape.clone();
    if normals.is_empty() {
        return opened;
    }
    for triangle in triangles {
        let [a, b, c] = triangle.map(|n| shape.position(topology, n));
        let inwards = (c - a).cross(&(b - a)).try_normalize(0.0);
        for node in triangle {
            if let (Some(normals), Some(inwards)) = (normals.get_mut(node), inwards) {
                normals.push(inwards);
            }
        }
    }
    for (node, normals) in normals {
        opened.displacement[node as usize] += offset(&normals) * HALF_GAP_M;
    }
    opened
}

/// The shortest step that moves a corner of planes by 1 along each of their normals, by projections in turn; at most
/// [`OFFSET_MAX`]. A mean of the normals would leave small triangles on the other side of the wall.
fn offset(normals: &[Vec3]) -> Vec3 {
    let mut step = Vec3::zeros();
    for _ in 0..PROJECTIONS {
        for normal in normals {
            step += normal * (1.0 - step.dot(normal)).max(0.0);
        }
        step = step.cap_magnitude(OFFSET_MAX);
    }
    step
}
