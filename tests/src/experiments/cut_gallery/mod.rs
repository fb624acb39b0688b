//! Pictures of cuts (Lin 2007, figs 7.14 to 7.16, 7.18 to 7.20 and 5.10).
//!
//! Each picture comes with a figure of the cut and its closed form. Wounds are shown at rest, where they are closed, or
//! with the tissue pulled apart and solved.

mod on_block;
mod on_thigh;
mod opened;
mod refinement;

use palpate_server::picture::{Panel, figure};
use palpate_tissue::Topology;
use serde_json::{Value, json};

use opened::Cut;

use super::table::Column;
use super::{Bench, Outcome, Table};

const COLUMNS: [Column; 9] = [
    ("picture", "picture", 1.0),
    ("figure", "figure", 1.0),
    ("faces opened", "faces", 1.0),
    ("nodes on the path (%)", "on_path_percent", 1.0),
    ("farthest from it (spacings)", "off_path", 1.0),
    ("pieces", "components", 1.0),
    ("quantity", "quantity", 1.0),
    ("measured", "measured", 1.0),
    ("closed form", "expected", 1.0),
];

const QUALITY: [Column; 8] = [
    ("model", "model", 1.0),
    ("refinement", "refinement", 1.0),
    ("cells", "cells", 1.0),
    ("inverted cells", "inverted", 1.0),
    ("worst scaled Jacobian", "worst", 1.0),
    ("5 % below", "p5", 1.0),
    ("mean", "mean", 1.0),
    ("shortest spring / spacing", "shortest_spring", 1.0),
];

/// A node nearer to the swept surface, in spacings, is on the path: where the lattice makes a step, nodes keep this much.
const ON_PATH: f64 = 0.05;

/// A picture, and a row of the table.
struct Picture {
    name: &'static str,
    png: Vec<u8>,
    row: Value,
}

/// A figure of a cut and its closed form.
struct Check {
    quantity: &'static str,
    measured: f64,
    expected: f64,
}

impl Picture {
    /// `number` is that of the figure in the source.
    fn of(
        name: &'static str,
        number: &str,
        topology: &Topology,
        cuts: &[Cut],
        panels: &[Panel],
        check: Option<&Check>,
    ) -> Result<Self, String> {
        let off: Vec<f64> = cuts.iter().flat_map(|c| c.off_path.clone()).collect();
        let on = off.iter().filter(|d| **d <= ON_PATH).count();
        Ok(Self {
            name,
            png: figure(topology.model(), panels)?,
            row: json!({
                "picture": name,
                "figure": format!("fig {number}"),
                "faces": cuts.iter().map(|c| c.outcome.faces_opened).sum::<usize>(),
                "on_path_percent": 100.0 * on as f64 / off.len().max(1) as f64,
                "off_path": off.iter().copied().fold(0.0, f64::max),
                "components": topology.components(),
                "quantity": check.map(|c| c.quantity),
                "measured": check.map(|c| c.measured),
                "expected": check.map(|c| c.expected),
            }),
        })
    }
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let mut pictures = Vec::new();
    (bench.progress)("cutting blocks", 0.0);
    pictures.push(on_block::snapping()?);
    pictures.push(on_block::curve()?);
    pictures.push(on_block::crossing()?);
    pictures.push(on_block::piece()?);
    let (refined, mut qualities) = refinement::block()?;
    pictures.push(refined);
    let thigh = bench.model_or("thigh")?;
    (bench.progress)("cutting the thigh", 0.5);
    pictures.extend(on_thigh::pictures(&thigh)?);
    qualities.extend(refinement::thigh(&thigh)?);
    let rows: Vec<Value> = pictures.iter().map(|p| p.row.clone()).collect();
    let tables = vec![
        ("cut-gallery".to_owned(), Table::of_objects(&rows, &COLUMNS)),
        (
            "cut-gallery-quality".to_owned(),
            Table::of_objects(&qualities, &QUALITY),
        ),
    ];
    Ok(Outcome {
        caption: "Snapping of the nodes at a coarse surface (fig 7.14), an arbitrary curved cut (7.15), the cells around a \
                  cut before and after the refinement (5.10, 7.16), the layers at a cut (7.18), cuts to three depths (7.19), \
                  continued cuts that cross (7.20), and a piece cut off. Blue: the path of the blade and its nodes. Dark \
                  red: the lips of a wound. Walls of wounds have the colour of their tissue. Before the refinement, the \
                  nodes of the cut are where it puts them, and all others where they were built. The table of cells \
                  counts those with a corner that the cut moved or doubled. A node is on the path within 0.05 spacings. The \
                  closed forms are length times depth of the path, and the volume of the wedge."
            .to_owned(),
        figures: json!({ "experiment": "cut-gallery", "pictures": rows, "quality": qualities }),
        pictures: pictures
            .into_iter()
            .map(|p| (format!("cut-gallery-{}", p.name), p.png))
            .collect(),
        tables,
        ..Outcome::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cuts_of_blocks_agree_with_their_closed_forms() {
        for (picture, pieces, tolerance) in [
            (on_block::curve(), 1, 0.04),
            (on_block::crossing(), 1, 0.06),
            (on_block::piece(), 2, 0.02),
        ] {
            let Picture { name, png, row } = picture.unwrap();
            assert!(png.starts_with(b"\x89PNG"));
            assert_eq!(row["components"], pieces, "{name}");
            let figure = |key: &str| row[key].as_f64().unwrap();
            let share = figure("measured") / figure("expected");
            assert!((share - 1.0).abs() < tolerance, "{name}: {share}");
        }
    }

    #[test]
    fn coarse_surface_is_snapped_onto_the_path() {
        let row = on_block::snapping().unwrap().row;
        // Half of the nodes at 5 mm spacing would be more than a millimetre away.
        assert!(row["measured"].as_f64().unwrap() <= 0.05 * 5.0, "{row}");
        assert_eq!(row["on_path_percent"], 100.0);
    }
}
