//! Between the words on the wire and the tissue.

use palpate_protocol::operation::{BladePoint, CutStroke};
use palpate_protocol::request::CutRequest;
use palpate_tissue::{Shape, Topology, Vec3};

/// A stroke in the rest frame as the tissue takes it.
pub(crate) fn stroke_to_tissue(stroke: &CutStroke) -> palpate_tissue::CutStroke {
    palpate_tissue::CutStroke {
        points: stroke.points.iter().map(point_to_tissue).collect(),
        width_m: stroke.width_m,
    }
}

/// Takes a stroke from the deformed into the rest frame, through the inverse of the deformation.
/// Where the blade is outside the tissue there is no deformation, and its place stays as it is.
pub(crate) fn stroke_at_rest(
    request: &CutRequest,
    topology: &Topology,
    shape: &Shape,
) -> CutStroke {
    let points = request
        .points
        .iter()
        .map(
            |p| match point_to_tissue(&p.blade).to_rest(topology, shape) {
                Some(rest) => BladePoint {
                    tip_m: rest.tip.into(),
                    axis: rest.axis.into(),
                    depth_m: rest.depth_m,
                },
                None => p.blade,
            },
        )
        .collect();
    CutStroke {
        points,
        width_m: request.width_m,
    }
}

fn point_to_tissue(p: &BladePoint) -> palpate_tissue::BladePoint {
    palpate_tissue::BladePoint {
        tip: Vec3::from(p.tip_m),
        axis: Vec3::from(p.axis),
        depth_m: p.depth_m,
    }
}
