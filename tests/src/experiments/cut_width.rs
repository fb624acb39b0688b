//! Opening of a cut over the depth below the surface (Lin 2007, fig 7.17).
//!
//! The opening is the distance of doubled nodes along the normal of the cut. At rest it is compared with the law
//! w = w0 (1 - d / D), at most a tenth of a spacing; then retractors pull the lips apart and the tissue is solved.

use std::sync::Arc;

use palpate_tissue::limits::REST_WIDTH_MAX;
use palpate_tissue::{Budget, Model, Shape, Tissue, Topology};
use serde_json::{Value, json};

use super::cut_site::CutSite;
use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::chart::{BLUE, Chart, GREEN, GREY, Line, ORANGE, PURPLE, Panel};
use crate::test_model::soft_block;
use crate::tool_location::ToolLocation;

/// Cells of the block, 4 mm each.
const BLOCK: [usize; 3] = [20, 20, 14];
const SPACING_M: f64 = 4e-3;
/// Width at the surface and depth of each cut, in mm.
const CUTS: [(f64, f64, &str); 4] = [
    (0.2, 12.0, BLUE),
    (0.2, 24.0, GREEN),
    (0.4, 24.0, ORANGE),
    (1.0, 24.0, PURPLE),
];
const LENGTH_M: f64 = 0.04;
/// A pair whose opening is within this share of the width is on the law.
const ON_LAW: f64 = 0.01;
/// Angle between the turned cut and the lattice of the block, rad.
const TURNED: f64 = 0.45;
/// Distance of the retractors from the cut and their travel, m.
const RETRACTORS_M: [f64; 2] = [0.012, 1e-3];

const COLUMNS: [Column; 11] = [
    ("model", "model", 1.0),
    ("width (mm)", "width_mm", 1.0),
    ("depth (mm)", "depth_mm", 1.0),
    ("limit (mm)", "limit_mm", 1.0),
    ("pairs of nodes", "pairs", 1.0),
    ("on the law (%)", "on_law_percent", 1.0),
    ("largest opening (mm)", "rest_max_mm", 1.0),
    ("largest deviation (mm)", "deviation_max_mm", 1.0),
    ("of the width (%)", "deviation_percent", 1.0),
    ("retracted, surface (mm)", "retracted_surface_mm", 1.0),
    ("retracted, deepest (mm)", "retracted_deepest_mm", 1.0),
];

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let block = Arc::new(soft_block(BLOCK, SPACING_M));
    let thigh = bench.model_or("thigh")?;
    let mut rows = Vec::new();
    let mut points = Table::new("model,width_mm,depth_mm,below_mm,rest_mm,law_mm,retracted_mm");
    let mut panels = Vec::new();
    let cases = [
        ("block", &block, 0.0),
        ("block, turned", &block, TURNED),
        ("thigh", &thigh, 0.0),
    ];
    for (part, (name, model, turn)) in cases.into_iter().enumerate() {
        (bench.progress)(&format!("cutting the {name}"), part as f64 / 3.0);
        panels.extend(measure(name, model, turn, &mut rows, &mut points)?);
    }
    let title = "Opening of a cut over the depth below the surface";
    Ok(Outcome {
        caption: format!(
            "Distance of doubled nodes along the normal of a straight cut of 40 mm, by the width w0 at the surface and \
             the depth D (fig 7.17), for each pair. At rest it follows \
             w0 (1 - d/D), dashed, up to a tenth of a spacing, which bounds the rest volume that the offset takes from \
             the cells. A pair opens less where the cells beside it are at the limits of their distortion, mostly at interfaces. The block is cut \
             along its lattice, and turned by 26 degrees. The last pair of nodes is up to a cell above \
             the tip, because nodes at the front stay single. Retracted: two rows of surface nodes, {:.0} mm from the \
             cut, are held {:.0} mm farther out, and the tissue is solved.",
            RETRACTORS_M[0] * 1e3,
            RETRACTORS_M[1] * 1e3
        ),
        figures: json!({ "experiment": "cut-width", "cuts": rows }),
        charts: vec![(
            "cut-width".to_owned(),
            Chart::new(title, "depth below the surface (mm)", panels),
        )],
        tables: vec![
            ("cut-width".to_owned(), Table::of_objects(&rows, &COLUMNS)),
            ("cut-width-pairs".to_owned(), points),
        ],
        ..Outcome::default()
    })
}

fn law_m(width_m: f64, depth_m: f64, limit_m: f64, below_m: f64) -> f64 {
    (width_m * (1.0 - below_m / depth_m).clamp(0.0, 1.0)).min(limit_m)
}

/// Adds a row per cut; gives the panels at rest and retracted.
fn measure(
    name: &str,
    model: &Arc<Model>,
    turn: f64,
    rows: &mut Vec<Value>,
    points: &mut Table,
) -> Result<[Panel; 2], String> {
    let uncut = Topology::new(Arc::clone(model));
    let mut location = ToolLocation::find(&uncut)?;
    let [u, v] = [location.u, location.v];
    location.u = u * turn.cos() + v * turn.sin();
    location.v = v * turn.cos() - u * turn.sin();
    let limit_m = REST_WIDTH_MAX * model.spacing_m;
    let (mut at_rest, mut retracted) = (Vec::new(), Vec::new());
    for (width_mm, depth_mm, colour) in CUTS {
        let site = CutSite {
            location: &location,
            along_m: 0.0,
            length_m: LENGTH_M,
            depth_m: depth_mm * 1e-3,
        };
        let mut tissue = Tissue::at_rest(uncut.clone());
        let stroke = site.stroke(width_mm * 1e-3);
        let outcome = tissue.cut(&stroke).map_err(|e| format!("{name}: {e}"))?;
        let topology = tissue.topology().clone();
        let rest = site.openings(&topology, &Shape::rest(&topology), &outcome.doubled);
        let [from_m, by_m] = RETRACTORS_M;
        let held = site.retract(&mut tissue, from_m, by_m);
        let residual = tissue.step(&[], Budget::new(300, 1e-5)).residual;
        let pulled = site.openings(&topology, tissue.shape(), &outcome.doubled);
        let law = |below: f64| law_m(stroke.width_m, site.depth_m, limit_m, below);
        let off = |(below, wide): &(f64, f64)| (wide - law(*below)).abs();
        let deviation = rest.iter().map(off).fold(0.0, f64::max);
        let on_law = rest
            .iter()
            .filter(|p| off(p) <= ON_LAW * stroke.width_m)
            .count();
        let pairs = |of: &[(f64, f64)]| -> Vec<(f64, f64)> {
            of.iter().map(|p| (p.0 * 1e3, p.1 * 1e3)).collect()
        };
        let ends =
            [rest.first(), rest.last()].map(|end| mean_at(&pulled, end, model.spacing_m / 4.0));
        rows.push(json!({
            "model": name,
            "width_mm": width_mm,
            "depth_mm": depth_mm,
            "limit_mm": limit_m * 1e3,
            "pairs": rest.len(),
            "on_law_percent": 100.0 * on_law as f64 / rest.len().max(1) as f64,
            "rest_max_mm": rest.iter().map(|p| p.1).fold(0.0, f64::max) * 1e3,
            "deviation_max_mm": deviation * 1e3,
            "deviation_percent": 100.0 * deviation / stroke.width_m,
            "retracted_surface_mm": ends[0] * 1e3,
            "retracted_deepest_mm": ends[1] * 1e3,
            "held_nodes": held,
            "residual": residual,
        }));
        for ((below, wide), (_, pulled)) in rest.iter().zip(&pulled) {
            let figures = [*below, *wide, law(*below), *pulled].map(|v| format!("{:.6}", v * 1e3));
            let case = [name.to_owned(), width_mm.to_string(), depth_mm.to_string()];
            points.rows.push(case.into_iter().chain(figures).collect());
        }
        let case = format!("{width_mm} mm wide, {depth_mm} mm deep");
        at_rest.push(Line::new(case.clone(), colour, pairs(&rest)).dots());
        let law_points = (0..=48).map(|i| f64::from(i) / 48.0 * site.depth_m);
        let law_name = if at_rest.len() == 1 { "law" } else { "" };
        let law_line = law_points.map(|below| (below * 1e3, law(below) * 1e3));
        at_rest.push(Line::new(law_name, GREY, law_line).dashed(true));
        retracted.push(Line::new(
            case,
            colour,
            means(&pulled, model.spacing_m / 2.0),
        ));
    }
    let spacing = model.spacing_m * 1e3;
    Ok([
        Panel::new(
            format!("At rest, {name}, spacing {spacing} mm"),
            "opening (mm)",
            at_rest,
        ),
        Panel::new(format!("Retracted, {name}"), "opening (mm)", retracted),
    ])
}

/// Mean depth and opening, in mm, of the pairs within each range of depth.
fn means(openings: &[(f64, f64)], range_m: f64) -> Vec<(f64, f64)> {
    let bin = |p: &(f64, f64)| (p.0 / range_m).round() as i64;
    let mean = |bin: &[(f64, f64)]| {
        let scale = 1e3 / bin.len() as f64;
        let sum = bin.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
        (sum.0 * scale, sum.1 * scale)
    };
    let bins = openings.chunk_by(|a, b| bin(a) == bin(b));
    bins.map(mean).collect()
}

/// Mean opening of the pairs as deep as one of them, within `range_m`; NaN without one.
fn mean_at(openings: &[(f64, f64)], pair: Option<&(f64, f64)>, range_m: f64) -> f64 {
    let depth = pair.map_or(f64::NAN, |p| p.0);
    let near = openings.iter().filter(|p| (p.0 - depth).abs() <= range_m);
    let [sum, count] = near.fold([0.0; 2], |[s, n], p| [s + p.1, n + 1.0]);
    sum / count
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn block_follows_the_width_law_at_rest_and_gapes_when_retracted() {
        let model = Arc::new(soft_block(BLOCK, SPACING_M));
        for (turn, share) in [(0.0, 100.0), (TURNED, 95.0)] {
            let mut rows = Vec::new();
            let mut points = Table::new("a,b,c,d,e,f,g");
            measure("block", &model, turn, &mut rows, &mut points).unwrap();
            assert_eq!(rows.len(), CUTS.len());
            for row in &rows {
                let figure = |name: &str| row[name].as_f64().unwrap();
                assert!(figure("on_law_percent") >= share, "{row}");
                assert!(figure("deviation_percent") < 2.0, "{row}");
                assert!(figure("pairs") > 20.0 && figure("held_nodes") > 20.0);
                let retracted = |at: &str| figure(&format!("retracted_{at}_mm"));
                let [top, deep] = ["surface", "deepest"].map(retracted);
                assert!(
                    top > figure("rest_max_mm") + 0.2 && deep < 0.5 * top,
                    "{row}"
                );
            }
        }
    }
}
