//! Conversion between wire types and tissue types.

use palpate_protocol::operation::{BladePoint, CutStroke};
use palpate_protocol::request::CutRequest;
use palpate_tissue::{Shape, Topology, Vec3};

/// Converts a stroke in the rest frame to the tissue's type.
pub(crate) fn stroke_to_tissue(stroke: &CutStroke) -> palpate_tissue::CutStroke {
    palpate_tissue::CutStroke {
        points: stroke.points.iter().map(point_to_tissue).collect(),
        width_m: stroke.width_m,
    }
}

/// Maps a stroke from the deformed to the rest frame by the inverse deformation. Points outside the tissue stay
/// unchanged.
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
