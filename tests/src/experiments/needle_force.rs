//! Force of a needle that enters tissue and leaves it.

use std::f64::consts::PI;
use std::sync::Arc;

use palpate_device::Script;
use palpate_device::script::{Tool, ToolKind, Waypoint};
use palpate_tissue::{Material, Model, Vec3, block};
use serde_json::{Value, json};

use super::cut_force::{HAND, add_layers, idle, resolve};
use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::chart::{BLUE, Chart, GREEN, GREY, Line, ORANGE, Panel};
use crate::reference;

const SPACING_M: f64 = 2e-3;
/// 48 x 48 x 48 mm.
const CELLS: [usize; 3] = [24, 24, 24];
/// Layers of the layered block from the top: tissue and thickness in cells; the last one reaches the base.
const LAYERS: [(&str, usize); 3] = [("skin", 1), ("fat", 4), ("muscle", 19)];
/// Tissues that are pierced alone.
const TISSUES: [(&str, &str); 3] = [("fat", ORANGE), ("muscle", GREEN), ("liver", BLUE)];
/// Of gauge 18: 1.27 mm wide.
const RADIUS_M: f64 = 0.635e-3;
const LENGTH_M: f64 = 80e-3;
const SPEED_M_S: f64 = 0.02;
const DEPTH_M: f64 = 30e-3;
/// Depths of the mean force on the way in, and on the way out, m.
const PLATEAU_M: [f64; 2] = [24e-3, 30e-3];
const PULL_M: [f64; 2] = [12e-3, 18e-3];

const COLUMNS: [Column; 9] = [
    ("tissue", "tissue", 1.0),
    ("puncture (N)", "puncture_n", 1.0),
    ("closed form (N)", "puncture_form_n", 1.0),
    ("at 24 to 30 mm (N)", "plateau_n", 1.0),
    ("closed form (N)", "plateau_form_n", 1.0),
    ("friction of it (%)", "friction_percent", 1.0),
    ("out at 18 to 12 mm (N)", "pull_n", 1.0),
    ("closed form (N)", "pull_form_n", 1.0),
    ("work (mJ)", "work_mj", 1.0),
];

fn top_m() -> f64 {
    CELLS[2] as f64 * SPACING_M
}

/// Tissues from the top down, each with its thickness in m.
type Layers = Vec<(Material, f64)>;

/// Force of the tip and friction of the shaft at a depth in undeformed layers, in closed form, N.
fn closed_form_n(layers: &Layers, depth_m: f64) -> [f64; 2] {
    let (mut tip, mut friction, mut above_m) = (0.0, 0.0, 0.0);
    for (material, thick_m) in layers {
        let length_m = (depth_m - above_m).clamp(0.0, *thick_m);
        if length_m > 0.0 {
            tip = material.toughness_j_m2 * 2.0 * RADIUS_M;
            friction += material.needle_traction_pa()[1] * 2.0 * PI * RADIUS_M * length_m;
        }
        above_m += thick_m;
    }
    [tip, friction]
}

/// Force along the shaft in closed form, N, on the way in or out.
fn along_n(layers: &Layers, depth_m: f64, is_inward: bool) -> f64 {
    let [tip, friction] = closed_form_n(layers, depth_m);
    if is_inward { tip + friction } else { -friction }
}

/// A needle that is pushed straight in and pulled out.
fn needle() -> Result<Script, String> {
    let at = |depth: f64| Vec3::new(24.3e-3, 23.9e-3, top_m() - depth);
    let takes_s = (DEPTH_M + 5e-3) / SPEED_M_S;
    let tool = Tool {
        kind: ToolKind::Needle,
        ..Tool::blade(RADIUS_M, LENGTH_M)
    };
    let waypoints = vec![
        Waypoint::new(0.0, at(-5e-3)),
        Waypoint::new(takes_s, at(DEPTH_M)).linear(),
        Waypoint::new(takes_s + 0.3, at(DEPTH_M)),
        Waypoint::new(2.0 * takes_s + 0.3, at(-5e-3)).linear(),
    ];
    Script::new(tool, HAND, waypoints, false).map_err(|e| e.to_string())
}

/// Depth of the tip and force along the shaft, in m and N, on the way in and on the way out.
struct Pushed {
    into: Vec<[f64; 2]>,
    out: Vec<[f64; 2]>,
    work_j: f64,
}

impl Pushed {
    fn of(model: Model, bench: &mut Bench<'_>, stage: &str) -> Result<Self, String> {
        let script = needle()?;
        let other = idle(script.end_s())?;
        let reference = reference::run(&Arc::new(model), [&script, &other], &[], |done| {
            (bench.progress)(stage, done);
            true
        });
        let forces = &reference.map_err(|e| e.to_string())?.forces[0];
        let points = forces
            .iter()
            .map(|p| [top_m() - p.position_m[2], p.force_n[2]]);
        let points: Vec<[f64; 2]> = points.collect();
        let work = points
            .windows(2)
            .map(|w| 0.5 * (w[0][1] + w[1][1]) * (w[1][0] - w[0][0]));
        let deepest = (0..points.len()).max_by(|&a, &b| points[a][0].total_cmp(&points[b][0]));
        let (into, out) = points.split_at(deepest.unwrap_or(0));
        Ok(Self {
            work_j: work.sum(),
            into: into.to_vec(),
            out: out.to_vec(),
        })
    }
}

/// Means of two functions of the points at these depths.
fn means(points: &[[f64; 2]], [from, to]: [f64; 2], form: impl Fn(f64) -> f64) -> [f64; 2] {
    let within: Vec<_> = points
        .iter()
        .filter(|p| (from..to).contains(&p[0]))
        .collect();
    let count = within.len() as f64;
    let rendered = within.iter().map(|p| p[1]).sum::<f64>();
    [rendered, within.iter().map(|p| form(p[0])).sum()].map(|sum| sum / count)
}

fn figures(name: &str, layers: &Layers, pushed: &Pushed) -> Value {
    let [into, out] = [true, false].map(|way| move |depth: f64| along_n(layers, depth, way));
    let [plateau, plateau_form] = means(&pushed.into, PLATEAU_M, into);
    let [_, friction_form] = means(&pushed.into, PLATEAU_M, |depth| -out(depth));
    let [pull, pull_form] = means(&pushed.out, PULL_M, out);
    // Later forces of a homogeneous tissue exceed that of the puncture by the friction.
    let near = pushed.into.iter().filter(|p| p[0] < 16e-3);
    json!({
        "tissue": name,
        "puncture_n": near.map(|p| p[1]).fold(0.0, f64::max),
        "puncture_form_n": closed_form_n(layers, 1e-9)[0],
        "plateau_n": plateau,
        "plateau_form_n": plateau_form,
        "friction_percent": 100.0 * friction_form / plateau_form,
        "pull_n": pull,
        "pull_form_n": pull_form,
        "work_mj": 1e3 * pushed.work_j,
    })
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let (mut rows, mut lines) = (Vec::new(), Vec::new());
    let mut table = Table::new("tissue,way,depth (mm),force (N),closed form (N)");
    let mut pierce = |name: &str, layers: &Layers, model: Model| {
        let pushed = Pushed::of(model, bench, &format!("piercing {name}"))?;
        for (way, points) in [("in", &pushed.into), ("out", &pushed.out)] {
            for [depth, force] in points.iter().step_by(10) {
                let form = along_n(layers, *depth, way == "in");
                let numbers = [1e3 * depth, *force, form].map(|n| format!("{n:.4}"));
                let words = [name, way].map(str::to_owned);
                table.rows.push(words.into_iter().chain(numbers).collect());
            }
        }
        rows.push(figures(name, layers, &pushed));
        Ok::<_, String>(pushed)
    };
    let mm = |points: &[[f64; 2]]| -> Vec<(f64, f64)> {
        points.iter().map(|p| (1e3 * p[0], p[1])).collect()
    };
    for (name, colour) in TISSUES {
        let material = resolve(name)?;
        let model = block(CELLS, SPACING_M, &material, 1);
        let pushed = pierce(name, &vec![(material, top_m())], model)?;
        let all = [pushed.into, pushed.out].concat();
        lines.push(Line::new(name, colour, mm(&all)));
    }
    let layer = |(name, cells): (&str, usize)| Ok((resolve(name)?, cells as f64 * SPACING_M));
    let layers = LAYERS
        .map(layer)
        .into_iter()
        .collect::<Result<Layers, String>>()?;
    let mut model = block(CELLS, SPACING_M, &layers[2].0, 1);
    add_layers(&mut model, SPACING_M, &LAYERS[..2])?;
    let pushed = pierce("skin, fat, muscle", &layers, model)?;
    let form = |is_inward: bool, points: &[[f64; 2]]| -> Vec<(f64, f64)> {
        let force = |depth: f64| along_n(&layers, depth, is_inward);
        points.iter().map(|p| (1e3 * p[0], force(p[0]))).collect()
    };
    let in_layers = [
        Line::new("in", BLUE, mm(&pushed.into)),
        Line::new("out", ORANGE, mm(&pushed.out)),
        Line::new("closed form, undeformed", GREY, form(true, &pushed.into)).dashed(true),
        Line::new("closed form, out", GREY, form(false, &pushed.out)).dashed(true),
    ];
    let chart = |title: &str, lines: Vec<Line>| {
        let panel = Panel::new("Force along the shaft", "force (N)", lines);
        Chart::new(title, "depth of the tip (mm)", vec![panel])
    };
    let charts = vec![
        (
            "needle-force-tissues".to_owned(),
            chart("A needle of gauge 18 into three tissues and out", lines),
        ),
        (
            "needle-force-layers".to_owned(),
            chart(
                "A needle of gauge 18 through 2 mm of skin and 8 mm of fat into muscle, and out",
                in_layers.into(),
            ),
        ),
    ];
    Ok(Outcome {
        caption: "A needle enters where its tip carries the toughness times its width. Then the tip feels that of \
                  the tissue before it, and the shaft the friction on its length; on the way out the friction \
                  alone. Tissue moves with the needle, so that layers are passed deeper than at rest. The parts are those \
                  of Okamura, Simone and O'Leary 2004; no measured curve was compared."
            .to_owned(),
        figures: json!({ "experiment": "needle-force", "speed_mm_s": 1e3 * SPEED_M_S, "cases": rows }),
        tables: vec![
            ("needle-force".to_owned(), Table::of_objects(&rows, &COLUMNS)),
            ("needle-force-paths".to_owned(), table),
        ],
        charts,
        ..Outcome::default()
    })
}
