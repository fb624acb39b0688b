//! The width of a wound at rest (Lin 2007, figs 5.7 and 7.17; reconstructed).
//!
//! With h the height over the blade's tip, D its depth and n the normal of the swept surface, the
//! two nodes of a doubled one part by
//!
//! ```text
//! ± w/2 n,    w = w0 h / D
//! ```
//!
//! so that the wound is widest at the top and closed at its front. The width at rest is at most [`REST_WIDTH_MAX`]; a wound
//! gapes farther where its tissue is pulled.

use std::collections::{BTreeSet, HashMap};

use super::bounded_moves::Moves;
use super::cell_fans::Fans;
use super::freedom::{Freedom, freedom};
use super::part::is_parted;
use super::patch::Patch;
use super::projections::DRIFT_ALLOWED;
use super::ribbon::{Foot, Ribbon};
use super::sheet_snap::SheetNode;
use super::stroke::CutStroke;
use crate::cell::NO_CELL;
use crate::{Topology, Vec3};

/// Largest width of a wound at rest, in spacings. The offset of each side takes rest volume from the cells beside the
/// wound; at this bound no more than a twentieth of each.
pub const REST_WIDTH_MAX: f64 = 0.1;

/// Sweeps over the nodes. Each sweep moves a node at most to its place.
const SWEEPS: usize = 8;

/// Parts the doubled nodes; gives those that moved.
pub(crate) fn widen(
    topology: &mut Topology,
    stroke: &CutStroke,
    ribbon: &Ribbon,
    sheet: &[SheetNode],
    doubled: &[(u32, u32)],
) -> Vec<u32> {
    if stroke.width_m <= 0.0 {
        return Vec::new();
    }
    let spacing = topology.model.spacing_m;
    // Each with the node of the sheet that it was or was doubled from.
    let both = |&(new, old): &(u32, u32)| [(new, old), (old, old)];
    let nodes: BTreeSet<(u32, u32)> = doubled.iter().flat_map(both).collect();
    let mut moves = Moves {
        topology,
        old: HashMap::new(),
    };
    let mut targets = Vec::with_capacity(nodes.len());
    for (node, old) in nodes {
        let at = moves.rest(node);
        let Some(foot) = ribbon.nearest(&at) else {
            continue;
        };
        let offset =
            half_width(stroke, &at, &foot, spacing) * side(moves.topology, node, &foot.normal);
        let offset = match outer(moves.topology, node, &foot.normal) {
            Freedom::Free => offset,
            Freedom::Held(free) => free * offset,
            Freedom::Pinned => continue,
        };
        let own = sheet.binary_search_by_key(&old, |n| n.node);
        let part = own.map_or(1.0, |n| part_left(&sheet[n], &at, &offset, spacing));
        targets.push((node, at + offset * part));
    }
    // A node in a thin cell at a step of the lattice advances only with the other nodes of that cell.
    for _ in 0..SWEEPS {
        for &(node, target) in &targets {
            moves.advance(node, target);
        }
    }
    let mut moved: Vec<u32> = moves.old.into_keys().collect();
    moved.sort_unstable();
    moved
}

/// The part of an offset that takes a node no farther from its interfaces than it may be.
fn part_left(node: &SheetNode, at: &Vec3, offset: &Vec3, spacing: f64) -> f64 {
    let limit = (DRIFT_ALLOWED * spacing).max(node.interfaces.distance(at));
    let mut parts = [1.0, 0.5, 0.25].into_iter();
    let is_near = |part: &f64| node.interfaces.distance(&(at + offset * *part)) <= limit;
    parts.find(is_near).unwrap_or(0.0)
}

/// Half of the width of a wound at a place, along the normal of the swept surface.
fn half_width(stroke: &CutStroke, at: &Vec3, foot: &Foot, spacing: f64) -> Vec3 {
    let blade = &stroke.points[foot.step];
    let height = (at - blade.tip).dot(&blade.axis) / blade.depth_m;
    let half = stroke.width_m / 2.0 * height.clamp(0.0, 1.0);
    foot.normal * half.min(REST_WIDTH_MAX / 2.0 * spacing)
}

/// How far each node of the sheet will go to the positive side when the wound opens, if its cells allow it; `fans` are those of
/// each node once the sheet is open.
pub(crate) fn half_widths(
    patch: &Patch,
    stroke: &CutStroke,
    ribbon: &Ribbon,
    fans: &[Fans],
) -> Vec<Vec3> {
    let half = |(n, &fans): (usize, &Fans)| {
        let at = patch.start[n];
        let Some(foot) = ribbon.nearest(&at).filter(|_| is_parted(fans)) else {
            return Vec3::zeros();
        };
        let half = half_width(stroke, &at, &foot, patch.spacing);
        match patch.holds[n] {
            Freedom::Free => half,
            Freedom::Held(free) => free * half,
            Freedom::Pinned => Vec3::zeros(),
        }
    };
    fans.iter().enumerate().map(half).collect()
}

/// 1 or -1: on which side of the ribbon the cells of a node are.
fn side(topology: &Topology, node: u32, normal: &Vec3) -> f64 {
    let cells = topology.node_cells[node as usize];
    let around = cells.into_iter().filter(|&c| c != NO_CELL);
    let sum: f64 = around
        .map(|c| (topology.centre(c) - topology.rest(node)).dot(normal))
        .sum();
    if sum >= 0.0 { 1.0 } else { -1.0 }
}

/// The degrees of freedom of a node on the lip of a wound: held by the skin, but not by the cut that is being widened.
fn outer(topology: &Topology, node: u32, normal: &Vec3) -> Freedom {
    match freedom(topology, node) {
        Freedom::Held(free) => {
            // The cut's own normal is free again, except its part along other surfaces.
            let held = nalgebra::Matrix3::identity() - free - normal * normal.transpose();
            let eigen = nalgebra::SymmetricEigen::new(held);
            let mut projector = nalgebra::Matrix3::identity();
            for (value, direction) in eigen
                .eigenvalues
                .iter()
                .zip(eigen.eigenvectors.column_iter())
            {
                if *value > 0.5 {
                    projector -= direction * direction.transpose();
                }
            }
            Freedom::Held(projector)
        }
        other => other,
    }
}
