//! The walls of wounds as a section: seen along the axis that they face most, nearer walls before farther ones.

use palpate_tissue::{Model, Shape, Topology};

use super::Slice;
use super::section::{CellCut, Grade, MM, Section, flat};
use super::view::{SeenFace, View, seen};
use crate::cut::walls::wall_faces;

/// Margin around the walls, relative to their extent, in which the outline of the model shows.
const MARGIN: f64 = 0.25;

/// The walls of a cut topology with the outline of its model behind them; `None` without a wound.
pub(super) fn walls(topology: &Topology, model: &Model) -> Option<Section> {
    let shape = Shape::rest(topology);
    let walls: Vec<SeenFace> = wall_faces(topology)
        .into_iter()
        .map(|face| SeenFace::of(topology, &shape, face))
        .collect();
    let facing = |axis: usize| walls.iter().map(|w| w.area[axis].abs()).sum::<f64>();
    let axis = (0..3).max_by(|&a, &b| facing(a).total_cmp(&facing(b)))?;
    let seen = seen(walls, &View::along(axis));
    let first = seen.first()?;
    let at_mm = seen.iter().map(|w| w.centre()[axis]).sum::<f64>() / seen.len() as f64 * MM;
    let mut bounds = [flat(axis, first.centre()); 2];
    for p in seen.iter().flat_map(|w| w.corners) {
        let p = flat(axis, p);
        for a in 0..2 {
            bounds[0][a] = bounds[0][a].min(p[a]);
            bounds[1][a] = bounds[1][a].max(p[a]);
        }
    }
    let margin = MARGIN * (bounds[1][0] - bounds[0][0]).max(bounds[1][1] - bounds[0][1]);
    let bounds = [bounds[0].map(|v| v - margin), bounds[1].map(|v| v + margin)];
    let slice = Slice {
        axis,
        at_mm: Some(at_mm),
    };
    // The mean of the walls may lie outside of the model, which then has no outline.
    let behind = Section::through(model, slice).map_or_else(|_| Vec::new(), |s| s.cells);
    let is_inside = |line: &[[f64; 2]; 2]| {
        let is_within =
            |p: &[f64; 2]| (0..2).all(|a| (bounds[0][a]..=bounds[1][a]).contains(&p[a]));
        line.iter().all(is_within)
    };
    let outline = behind.into_iter().flat_map(|cell| cell.outline);
    let context = outline.filter(|(line, is_border)| *is_border && is_inside(line));
    Some(Section {
        axis,
        at_mm: None,
        cells: seen.iter().map(|w| piece(topology, w, axis)).collect(),
        structural: Vec::new(),
        shear: Vec::new(),
        context: context.map(|(line, _)| line).collect(),
        bounds,
        grades: [[0; 2]; 3],
    })
}

fn piece(topology: &Topology, wall: &SeenFace, axis: usize) -> CellCut {
    let [a, b, c, d] = wall.corners.map(|p| flat(axis, p));
    CellCut {
        region: topology.region(wall.face.cell()).index(),
        grade: Grade::Good,
        pieces: vec![vec![a, b, c], vec![a, c, d]],
        outline: [[a, b], [b, c], [c, d], [d, a]]
            .map(|line| (line, false))
            .into(),
    }
}
