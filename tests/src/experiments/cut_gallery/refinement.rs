//! Cells around a cut before and after the refinement.
//!
//! The refinement moves the nodes around a cut so that they share what its own nodes had to move. The state before it has the
//! nodes of the cut where it put them, and all others where they were built.

use std::sync::Arc;

use palpate_server::picture::Panel;
use palpate_tissue::cell::{PAIRS, cell_volume, scaled_jacobian};
use palpate_tissue::{BladePoint, CutOutcome, CutStroke, Model, Topology, Vec3};
use serde_json::{Value, json};

use super::Picture;
use super::opened::{Cut, nodes_of, opened};
use crate::bench::quantile;
use crate::test_model::soft_block;

/// A cut topology as a model without the refinement.
fn unrefined(topology: &Topology, outcome: &CutOutcome) -> Model {
    let of_cut = nodes_of(topology, opened(topology, outcome));
    let mut model = topology.to_model();
    for (node, built) in (0..).zip(&topology.model().nodes) {
        if !of_cut.contains(&node) {
            model.nodes[node as usize] = *built;
        }
    }
    model
}

/// Cells with a corner that the cut moved or doubled.
fn around(topology: &Topology, outcome: &CutOutcome) -> Vec<usize> {
    let mut nodes = nodes_of(topology, opened(topology, outcome));
    nodes.extend(outcome.moved.iter().map(|m| m.node));
    let cells = 0..topology.cell_count();
    cells
        .filter(|&c| topology.corners(c as u32).iter().any(|n| nodes.contains(n)))
        .collect()
}

fn quality(name: &str, refinement: &str, model: &Model, cells: &[usize]) -> Value {
    let corners = || cells.iter().map(|&c| model.corners_of(c));
    let jacobians: Vec<f64> = corners().map(|c| scaled_jacobian(&c)).collect();
    let springs = corners().flat_map(|x| PAIRS.map(|[a, b]| (x[a] - x[b]).norm()));
    let shortest = springs.fold(f64::INFINITY, f64::min) / model.spacing_m;
    let is_inverted = |x: &[Vec3; 8]| scaled_jacobian(x) <= 0.0 || cell_volume(x) <= 0.0;
    json!({
        "model": name,
        "refinement": refinement,
        "cells": cells.len(),
        "inverted": corners().filter(is_inverted).count(),
        "worst": quantile(&jacobians, 0.0),
        "p5": quantile(&jacobians, 0.05),
        "mean": jacobians.iter().sum::<f64>() / jacobians.len().max(1) as f64,
        "shortest_spring": shortest,
    })
}

fn rows(name: &str, topology: &Topology, outcome: &CutOutcome) -> [Value; 2] {
    let cells = around(topology, outcome);
    [
        quality(name, "before", &unrefined(topology, outcome), &cells),
        quality(name, "after", &topology.to_model(), &cells),
    ]
}

/// An oblique, turning cut through the middle of a block, in a cross-section.
pub(super) fn block() -> Result<(Picture, Vec<Value>), String> {
    let (cells, spacing) = ([18, 14, 10], 5e-3);
    let mut topology = Topology::new(soft_block(cells, spacing).into());
    let axis = Vec3::new(0.15, 0.1, 1.0).normalize();
    let points = (0..=40).map(|i| {
        let s = f64::from(i) / 40.0;
        let x = 0.012 + 0.065 * s;
        BladePoint {
            tip: Vec3::new(x, 0.0332 + 0.012 * (5.0 * s).sin(), 0.016),
            axis,
            depth_m: 0.045,
        }
    });
    let stroke = CutStroke {
        points: points.collect(),
        width_m: 0.0,
    };
    let made = Cut::make(&mut topology, &stroke)?;
    let before = unrefined(&topology, &made.outcome);
    let rows = rows("block", &topology, &made.outcome);
    // In the middle of a layer of cells.
    let at = 6.5 * spacing;
    let section = |title, model| -> Result<Panel, String> {
        let path = stroke.points.iter().map(|p| {
            let up = (at - p.tip.z) / p.axis.z;
            p.tip + p.axis * up
        });
        Ok(Panel::slice(title, model, 2, at)?.with_line(&path.collect::<Vec<_>>()))
    };
    let panels = [
        section("before the refinement", &before)?,
        section("after the refinement", &topology.to_model())?,
    ];
    let picture = Picture::of(
        "refinement",
        "5.10, 7.16",
        &topology,
        &[made],
        &panels,
        None,
    )?;
    Ok((picture, rows.into()))
}

/// Quality of the cells around a cut of the thigh.
pub(super) fn thigh(model: &Arc<Model>) -> Result<[Value; 2], String> {
    let (topology, made, _) = super::on_thigh::incised(model, 0.0, 0.05, 0.028)?;
    Ok(rows("thigh", &topology, &made.outcome))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refinement_improves_the_cells_around_a_cut() {
        let (_, rows) = block().unwrap();
        let figure = |row: usize, name: &str| rows[row][name].as_f64().unwrap();
        assert_eq!(figure(0, "cells"), figure(1, "cells"));
        assert_eq!(figure(1, "inverted"), 0.0);
        for name in ["worst", "mean"] {
            assert!(figure(1, name) > figure(0, name), "{name}: {rows:?}");
        }
        // The twentieth worst cells lie between nodes of the sheet, which do not leave it.
        assert!(figure(1, "p5") >= figure(0, "p5"), "{rows:?}");
        assert!(figure(1, "shortest_spring") >= 0.3 - 1e-9);
    }
}
