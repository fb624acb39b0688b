//! Cuts through the layers of the thigh: one that is held open, and three depths.

use std::collections::HashSet;
use std::sync::Arc;

use palpate_server::picture::{Panel, View};
use palpate_tissue::{Budget, FaceId, Model, Shape, Tissue, Topology, Vec3};

use super::super::cut_site::CutSite;
use super::opened::{Cut, opened};
use super::{Check, Picture};
use crate::tool_location::ToolLocation;

/// Distance of the retractors from the cut and their travel, m.
const RETRACTORS_M: [f64; 2] = [0.010, 9e-3];
/// Lengths and depths of the three cuts, m, and the distance of their middles.
const LENGTH_M: f64 = 0.022;
const DEPTHS_M: [f64; 3] = [0.008, 0.016, 0.028];
const APART_M: f64 = 0.034;
/// Part of the surface that is shown around a wound, m.
const SHOWN_M: f64 = 0.045;

/// The thigh with one cut at its location: its middle is `along_m` along the stroke.
pub(super) fn incised(
    model: &Arc<Model>,
    along_m: f64,
    length_m: f64,
    depth_m: f64,
) -> Result<(Topology, Cut, ToolLocation), String> {
    let mut topology = Topology::new(Arc::clone(model));
    let location = ToolLocation::find(&topology)?;
    let made = incise(&mut topology, &location, along_m, length_m, depth_m)?;
    Ok((topology, made, location))
}

fn incise(
    topology: &mut Topology,
    location: &ToolLocation,
    along_m: f64,
    length_m: f64,
    depth_m: f64,
) -> Result<Cut, String> {
    let site = CutSite {
        location,
        along_m,
        length_m,
        depth_m,
    };
    Cut::make(topology, &site.stroke(0.0))
}

pub(super) fn pictures(model: &Arc<Model>) -> Result<[Picture; 2], String> {
    Ok([layers(model)?, depths(model)?])
}

/// The wound held open by retractors, and one of its walls.
fn layers(model: &Arc<Model>) -> Result<Picture, String> {
    let (length_m, depth_m) = (0.05, 0.028);
    let (topology, made, location) = incised(model, 0.0, length_m, depth_m)?;
    let site = CutSite {
        location: &location,
        along_m: 0.0,
        length_m,
        depth_m,
    };
    let check = Check {
        quantity: "area of a wall (mm²)",
        measured: made.area_m2 * 1e6,
        expected: length_m * depth_m * 1e6,
    };
    let mut tissue = Tissue::at_rest(topology.clone());
    let [from_m, by_m] = RETRACTORS_M;
    site.retract(&mut tissue, from_m, by_m);
    tissue.step(&[], Budget::new(300, 1e-4));
    let near = |_: &FaceId, centre: &Vec3| (centre - location.middle).norm() < SHOWN_M;
    let (n, u, v) = (location.normal, location.u, location.v);
    let view = View::from(n + 0.55 * u - 0.25 * v, v);
    let open = Panel::surface(
        "held open by retractors",
        &topology,
        tissue.shape(),
        view,
        near,
    );
    let wall = walls(
        "wall of the wound, at rest",
        &topology,
        &location,
        opened(&topology, &made.outcome),
    );
    let wall = wall.with_line(&site.tips());
    Picture::of(
        "layers",
        "7.18",
        &topology,
        &[made],
        &[open, wall],
        Some(&check),
    )
}

/// The faces of wounds seen along their normal, at rest.
fn walls(title: &str, topology: &Topology, location: &ToolLocation, faces: &[FaceId]) -> Panel {
    let faces: HashSet<FaceId> = faces.iter().copied().collect();
    let view = View::from(location.u, location.normal);
    let shape = Shape::rest(topology);
    Panel::surface(title, topology, &shape, view, |face, _| {
        faces.contains(face)
    })
}

/// Three cuts beside each other, each deeper than the one before.
fn depths(model: &Arc<Model>) -> Result<Picture, String> {
    let mut topology = Topology::new(Arc::clone(model));
    let location = ToolLocation::find(&topology)?;
    let built = topology.boundary().faces.len();
    let (mut cuts, mut tips) = (Vec::new(), Vec::new());
    for (number, depth_m) in (-1..).zip(DEPTHS_M) {
        let along_m = f64::from(number) * APART_M;
        cuts.push(incise(
            &mut topology,
            &location,
            along_m,
            LENGTH_M,
            depth_m,
        )?);
        let site = CutSite {
            location: &location,
            along_m,
            length_m: LENGTH_M,
            depth_m,
        };
        tips.push(site.tips());
    }
    let faces = &topology.boundary().faces[built..];
    let check = Check {
        quantity: "area of a wall (mm²)",
        measured: cuts.iter().map(|c: &Cut| c.area_m2).sum::<f64>() * 1e6,
        expected: DEPTHS_M.iter().sum::<f64>() * LENGTH_M * 1e6,
    };
    let mut panel = walls(
        "walls of cuts of 8, 16 and 28 mm depth; blue: path of the tip",
        &topology,
        &location,
        faces,
    );
    for line in &tips {
        panel = panel.with_line(line);
    }
    Picture::of("depths", "7.19", &topology, &cuts, &[panel], Some(&check))
}
