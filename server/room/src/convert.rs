//! Conversion between wire types and tissue types.

use palpate_protocol::ParticipantId;
use palpate_protocol::operation::{BladePoint, CutStroke};
use palpate_protocol::request::{CutRequest, TimedBladePoint};
use palpate_tissue::{Shape, StrokePart, Topology, Vec3};

/// Converts a part of an author's stroke to the tissue's type.
pub(crate) fn part_to_tissue(author: ParticipantId, part: &CutStroke) -> StrokePart {
    StrokePart {
        path: palpate_tissue::CutStroke {
            points: part.points.iter().map(point_to_tissue).collect(),
            width_m: part.width_m,
        },
        stroke: Some(part.number(author)),
        joins: part.joins,
    }
}

/// Maps the path of a stroke from the deformed to the rest frame by the inverse deformation. Points outside the tissue stay
/// unchanged. The points are [rounded](BladePoint::rounded) as in the log.
pub(crate) fn path_at_rest(
    request: &CutRequest,
    topology: &Topology,
    shape: &Shape,
) -> Vec<BladePoint> {
    let at_rest = |p: &TimedBladePoint| {
        let blade = match point_to_tissue(&p.blade).to_rest(topology, shape) {
            Some(rest) => BladePoint {
                tip_m: rest.tip.into(),
                axis: rest.axis.into(),
                depth_m: rest.depth_m,
            },
            None => p.blade,
        };
        blade.rounded()
    };
    request.points.iter().map(at_rest).collect()
}

fn point_to_tissue(p: &BladePoint) -> palpate_tissue::BladePoint {
    palpate_tissue::BladePoint {
        tip: Vec3::from(p.tip_m),
        axis: Vec3::from(p.axis),
        depth_m: p.depth_m,
    }
}
