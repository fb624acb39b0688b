//! Points on a model that tests press.

#![allow(clippy::unwrap_used)]

use palpate_tissue::{Topology, Vec3};

/// The surface node that is farthest along `direction` near the middle of the model.
pub(crate) fn outermost(topology: &Topology, direction: Vec3) -> Vec3 {
    let nodes = (0..topology.node_count() as u32).filter(|&n| topology.on_boundary(n));
    let points: Vec<Vec3> = nodes.map(|n| topology.rest(n)).collect();
    let low = points.iter().fold(Vec3::repeat(f64::MAX), |a, p| a.inf(p));
    let high = points.iter().fold(Vec3::repeat(f64::MIN), |a, p| a.sup(p));
    let middle = (low + high) / 2.0;
    let near = points.into_iter().filter(|p| {
        let from = p - middle;
        (from - direction * from.dot(&direction)).norm() < 0.015
    });
    near.max_by(|a, b| a.dot(&direction).total_cmp(&b.dot(&direction)))
        .unwrap()
}
