//! Figures of wounds, and tissue that is pulled apart.

use std::collections::BTreeSet;

use palpate_tissue::cell::{FACES, NO_CELL};
use palpate_tissue::{
    Budget, CutOutcome, CutStroke, FaceId, Shape, SweptSurface, Tissue, Topology, Vec3, cut,
};

/// A cut that was made.
pub(super) struct Cut {
    pub(super) outcome: CutOutcome,
    /// Distance of each node of its walls from the swept surface, in spacings.
    pub(super) off_path: Vec<f64>,
    /// Area of one of its walls in m².
    pub(super) area_m2: f64,
}

impl Cut {
    /// Cuts a topology.
    pub(super) fn make(topology: &mut Topology, stroke: &CutStroke) -> Result<Self, String> {
        let outcome = cut(topology, stroke).map_err(|e| e.to_string())?;
        let spacing = topology.model().spacing_m;
        let surface = SweptSurface::of(stroke, spacing)?;
        let faces = opened(topology, &outcome);
        let nodes = nodes_of(topology, faces);
        let off = nodes
            .iter()
            .filter_map(|&n| surface.distance_m(&topology.rest(n)));
        let off_path = off.map(|d| d / spacing).collect();
        let area_m2 = wall_area_m2(topology, faces);
        Ok(Self {
            outcome,
            off_path,
            area_m2,
        })
    }
}

/// Faces that a cut opened, on both sides, when it was the last one.
pub(super) fn opened<'a>(topology: &'a Topology, outcome: &CutOutcome) -> &'a [FaceId] {
    let faces = &topology.boundary().faces;
    &faces[faces.len() - 2 * outcome.faces_opened..]
}

/// Nodes of faces.
pub(super) fn nodes_of(topology: &Topology, faces: &[FaceId]) -> BTreeSet<u32> {
    let corners = |f: &FaceId| FACES[f.face()].map(|i| topology.corners(f.cell())[i]);
    faces.iter().flat_map(corners).collect()
}

/// Area of one side of a wound in m², from the faces of both.
fn wall_area_m2(topology: &Topology, faces: &[FaceId]) -> f64 {
    let area = |f: &FaceId| {
        let [a, b, c, d] = FACES[f.face()].map(|i| topology.rest(topology.corners(f.cell())[i]));
        (c - a).cross(&(d - b)).norm() / 2.0
    };
    faces.iter().map(area).sum::<f64>() / 2.0
}

/// The shape of a block whose sides are pulled out by a share of its extent along x and y, in equilibrium.
pub(super) fn pulled(topology: &Topology, shares: [f64; 2]) -> Shape {
    let nodes = || (0..topology.node_count() as u32).map(|n| topology.rest(n));
    let low = nodes().fold(Vec3::repeat(f64::INFINITY), |l, p| l.inf(&p));
    let high = nodes().fold(Vec3::repeat(f64::NEG_INFINITY), |h, p| h.sup(&p));
    let middle = (low + high) / 2.0;
    let edge = 1e-6 * topology.model().spacing_m;
    let mut tissue = Tissue::at_rest(topology.clone());
    for node in 0..topology.node_count() as u32 {
        let p = topology.rest(node);
        let is_side =
            (0..2).any(|a| shares[a] > 0.0 && (p[a] < low[a] + edge || p[a] > high[a] - edge));
        if is_side {
            let by = |a: usize| shares[a] * (p[a] - middle[a]);
            tissue.hold(node, Vec3::new(by(0), by(1), 0.0));
        }
    }
    tissue.step(&[], Budget::new(300, 1e-5));
    tissue.shape().clone()
}

/// The cells connected with one of them.
pub(super) fn connected(topology: &Topology, start: u32) -> BTreeSet<u32> {
    let mut cells = BTreeSet::from([start]);
    let mut stack = vec![start];
    while let Some(cell) = stack.pop() {
        for face in 0..6 {
            let next = topology.across(FaceId::new(cell, face));
            if next != NO_CELL && cells.insert(next) {
                stack.push(next);
            }
        }
    }
    cells
}
