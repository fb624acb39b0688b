//! Four methods of topology modification on the same stroke (Lin 2007, fig 2.3).

mod figures;
mod methods;
mod sweep;
mod tetrahedra;

use std::sync::Arc;

use palpate_tissue::{BladePoint, CutStroke, Model, Topology, Vec3, cut};
use serde_json::{Value, json};

use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::chart::{BLUE, Chart, GREEN, Line, ORANGE, PURPLE, Panel};
use crate::test_model;
use methods::{Parted, crossed_cells, removal, sheet, subdivision};
use sweep::Sweep;
use tetrahedra::{Tetrahedra, quality, volume};

/// Cells of the block, 5 mm each.
const BLOCK: [usize; 3] = [20, 16, 12];
/// Points of a stroke, some 3 mm apart.
const POINTS: u32 = 17;
/// How far surfaces are continued beyond their rims, in spacings.
const BEYOND: f64 = 3.0;
/// Distance of samples of the swept surface, in spacings, and the margin along its rims without samples: a sheet ends up to
/// a cell before or after a rim.
const SAMPLES: f64 = 0.25;
const RIM: f64 = 1.0;
/// Runs of each method, of which the fastest counts.
const RUNS: usize = 3;

type Method<'a> = Box<dyn Fn() -> Result<Parted, String> + 'a>;

const COLUMNS: [Column; 11] = [
    ("model", "model", 1.0),
    ("method", "method", 1.0),
    ("volume lost (mm³)", "lost_mm3", 1.0),
    ("of the model (%)", "lost_percent", 1.0),
    ("new elements", "new_elements", 1.0),
    ("elements along the wound", "elements_along", 1.0),
    ("smallest element / mean", "smallest_share", 1.0),
    ("worst quality", "worst_quality", 1.0),
    ("rms angle (°)", "rms_angle_deg", 1.0),
    ("Hausdorff (mm)", "hausdorff_mm", 1.0),
    ("time (ms)", "time_ms", 1.0),
];

/// A stroke that turns and leans across the block: 48 mm long, 31 mm deep.
fn block_stroke() -> CutStroke {
    let axis = Vec3::new(0.2, 0.05, 1.0).normalize();
    stroke(|s| {
        let at = Vec3::new(0.047 + 6e-3 * (3.0 * s).sin(), 0.016 + 0.048 * s, 0.0291);
        (at, axis, 0.045)
    })
}

/// A stroke that turns across the front of the built-in thigh, through fat into muscle: 50 mm long, 25 mm deep.
fn thigh_stroke() -> CutStroke {
    let axis = Vec3::new(0.0, 1.0, 0.15).normalize();
    stroke(|s| {
        let at = Vec3::new(-0.0253 + 0.05 * s, 0.0521, 0.1502 + 6e-3 * (3.0 * s).sin());
        (at, axis, 0.04)
    })
}

fn stroke(at: impl Fn(f64) -> (Vec3, Vec3, f64)) -> CutStroke {
    let point = |i: u32| {
        let (tip, axis, depth_m) = at(f64::from(i) / f64::from(POINTS - 1));
        BladePoint { tip, axis, depth_m }
    };
    CutStroke {
        points: (0..POINTS).map(point).collect(),
        width_m: 0.0,
    }
}

/// The same stroke, ten metres away.
fn beside(stroke: &CutStroke) -> CutStroke {
    let mut stroke = stroke.clone();
    for point in &mut stroke.points {
        point.tip.x += 10.0;
    }
    stroke
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let block = Arc::new(test_model::soft_block(BLOCK, 5e-3));
    let thigh = bench.model_or("thigh")?;
    let mut rows = Vec::new();
    let mut panels = Vec::new();
    for (part, (name, model, stroke)) in [
        ("block", block, block_stroke()),
        ("thigh", thigh, thigh_stroke()),
    ]
    .into_iter()
    .enumerate()
    {
        (bench.progress)(&format!("cutting the {name}"), 0.5 * part as f64);
        panels.push(compare(name, &model, &stroke, &mut rows)?);
    }
    let title = "Elements along a cut, by method of topology modification";
    let table = Table::of_objects(&rows, &COLUMNS);
    Ok(Outcome {
        caption: "The same stroke by four methods (fig 2.3). The baselines cut the tetrahedra of the same lattice, six per \
                  cell; the sheet cuts its hexahedra. Quality is the mean ratio of tetrahedra with a corner on the \
                  wound (regular: 1, of a cube: 0.756, inside out: negative); each cell of the sheet counts as six. A \
                  valid cell at a curved surface may have one that is inside out. The smallest element is relative to \
                  the mean one. The angle is the root mean square between adjacent triangles of one wall. The Hausdorff \
                  distance is that between wall and swept surface, apart from its rims. The sheet makes no element and \
                  changes the volume by less than 0.001 %. Subdivision is faster and gives the smoother wall, and \
                  slivers unless it snaps. The time of the sheet includes its springs and masses, which the baselines \
                  do not have."
            .to_owned(),
        figures: json!({ "experiment": "cut-methods", "methods": rows }),
        charts: vec![("cut-methods".to_owned(), Chart::new(title, "quality (mean ratio)", panels))],
        tables: vec![("cut-methods".to_owned(), table)],
        ..Outcome::default()
    })
}

/// Adds a row per method; gives the distribution of element quality.
fn compare(
    name: &str,
    model: &Arc<Model>,
    stroke: &CutStroke,
    rows: &mut Vec<Value>,
) -> Result<Panel, String> {
    let spacing = model.spacing_m;
    let mesh = Tetrahedra::of(model);
    let mut topology = Topology::new(Arc::clone(model));
    // A stroke beside the model builds the index of cells, which a session has at its first cut.
    let far = cut(&mut topology, &beside(stroke));
    if far.is_ok() {
        return Err(format!("the stroke beside the {name} cuts it"));
    }
    let sweep = Sweep::of(stroke, BEYOND * spacing);
    let inside = crossed_cells(&mesh, &sweep);
    let samples = sweep.samples(SAMPLES * spacing, RIM * spacing);
    let whole = mesh.volume();
    let mean = whole / mesh.cells.len() as f64;
    let mut lines = Vec::new();
    let methods: [(&str, &'static str, Method<'_>); 4] = [
        (
            "element removal",
            ORANGE,
            Box::new(|| Ok(removal(&mesh, &sweep))),
        ),
        (
            "subdivision",
            GREEN,
            Box::new(|| Ok(subdivision(&mesh, &sweep, false))),
        ),
        (
            "subdivision and snapping",
            PURPLE,
            Box::new(|| Ok(subdivision(&mesh, &sweep, true))),
        ),
        (
            "sheet of doubled nodes",
            BLUE,
            Box::new(|| sheet(&topology, stroke, &sweep)),
        ),
    ];
    for (method, colour, parted) in methods {
        let mut after = parted()?;
        for _ in 1..RUNS {
            after.time_ms = after.time_ms.min(parted()?.time_ms);
        }
        let mut qualities: Vec<f64> = after.near.iter().map(quality).collect();
        qualities.sort_by(f64::total_cmp);
        let smallest = after.near.iter().map(volume).fold(f64::INFINITY, f64::min);
        let hausdorff = figures::hausdorff_m(&after.walls, &sweep, &samples, &inside);
        rows.push(json!({
            "model": name,
            "method": method,
            "lost_mm3": after.lost_m3 * 1e9,
            "lost_percent": 100.0 * after.lost_m3 / whole,
            "new_elements": after.new,
            "elements_along": after.along,
            "wound_triangles": after.walls.len(),
            "smallest_mm3": smallest * 1e9,
            "smallest_share": smallest / mean,
            "worst_quality": qualities.first(),
            "rms_angle_deg": figures::rms_angle_deg(&after.walls),
            "hausdorff_mm": hausdorff * 1e3,
            "time_ms": after.time_ms,
        }));
        lines.push(Line::new(method, colour, distribution(&qualities)));
    }
    Ok(Panel::new(
        format!("Near the cut, {name}"),
        "elements below (%)",
        lines,
    ))
}

/// Share of the elements below each quality, in percent.
fn distribution(sorted: &[f64]) -> Vec<(f64, f64)> {
    let below = |q: f64| sorted.partition_point(|v| *v < q) as f64;
    let count = sorted.len().max(1) as f64;
    (0..=50)
        .map(|i| f64::from(i) / 50.0)
        .map(|q| (q, 100.0 * below(q) / count))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_removal_loses_volume_and_only_subdivision_makes_elements() {
        let model = test_model::soft_block(BLOCK, 5e-3);
        let stroke = block_stroke();
        let sweep = Sweep::of(&stroke, BEYOND * model.spacing_m);
        let mesh = Tetrahedra::of(&model);
        let lost = |parted: &Parted| parted.lost_m3 / mesh.volume();
        let removed = removal(&mesh, &sweep);
        assert!(lost(&removed) > 0.01 && removed.new < 0);
        for snaps in [false, true] {
            let divided = subdivision(&mesh, &sweep, snaps);
            assert!(lost(&divided).abs() < 1e-12 && divided.new > 0);
            assert!(divided.near.iter().all(|t| volume(t) > 0.0));
            // Its wall is on the swept surface, and the wall of removed elements is not.
            let off = |p: &Parted| {
                let corners = p.walls.iter().flatten();
                corners.map(|c| sweep.height(c).abs()).fold(0.0, f64::max)
            };
            assert!(off(&divided) < 1e-9 && off(&removed) > 1e-3);
        }
        let ours = sheet(&Topology::new(model.into()), &stroke, &sweep).unwrap();
        assert!(lost(&ours).abs() < 1e-6 && ours.new == 0 && ours.along > 50);
        assert!(!ours.walls.is_empty());
    }
}
