//! Force of a blade that cuts layers, and its work per area of the wound.

use std::sync::Arc;

use palpate_device::Script;
use palpate_device::script::{Hand, Tool, Waypoint};
use palpate_protocol::ParticipantId;
use palpate_site::tissue_stroke;
use palpate_tissue::{CutHistory, Material, Model, Region, RegionId, Topology, Vec3, block};
use serde_json::{Value, json};

use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::chart::{BLUE, Chart, GREEN, GREY, Line, ORANGE, PURPLE, Panel};
use crate::force_error::ForcePoint;
use crate::reference::{self, Reference};

const SPACING_M: f64 = 2e-3;
/// 72 x 28 x 32 mm.
const CELLS: [usize; 3] = [36, 14, 16];
/// Layers of the layered block from the top: tissue and thickness in cells; the last one reaches the base.
const LAYERS: [(&str, usize); 3] = [("skin", 1), ("fat", 5), ("muscle", 10)];
/// Tissues that are cut alone.
const TISSUES: [(&str, &str); 4] = [
    ("skin", BLUE),
    ("fat", ORANGE),
    ("muscle", GREEN),
    ("liver", PURPLE),
];
const SPEED_M_S: f64 = 0.04;
/// Depth of the cuts in one tissue, and the greatest one in layers.
const DEPTH_M: f64 = 8e-3;
const DEEPEST_M: f64 = 22e-3;
const BLADE_M: f64 = 40e-3;
/// A hand that follows its path within a millimetre.
pub(super) const HAND: Hand = Hand {
    mass_kg: 0.3,
    stiffness_n_per_m: 4_000.0,
    damping_ns_per_m: 40.0,
    tremor_m: 0.0,
    seed: 1,
};
/// Path after the blade has entered, until the edge pulls with its full force, m.
const ENTRY_M: f64 = 8e-3;

const COLUMNS: [Column; 7] = [
    ("tissue", "tissue", 1.0),
    ("toughness (J/m²)", "toughness_j_m2", 1.0),
    ("depth (mm)", "depth_mm", 1.0),
    ("mean force (N)", "mean_n", 1.0),
    ("closed form (N)", "closed_form_n", 1.0),
    ("rms error (%)", "error_percent", 1.0),
    ("work per area of the wound (J/m²)", "work_j_m2", 1.0),
];

/// Second strokes in muscle that a first one has cut.
const AGAIN: [Again; 4] = [
    Again {
        name: "in the same wound",
        first: [START, END],
        second: [START, END],
        new_m: 0.0,
    },
    Again {
        name: "back in it",
        first: [START, END],
        second: [END, START],
        new_m: 0.0,
    },
    Again {
        name: "in it and beyond",
        first: [START, [30e-3, 14.1e-3]],
        second: [START, END],
        new_m: 34e-3,
    },
    Again {
        name: "across it",
        first: [START, END],
        second: [[36.1e-3, -4e-3], [36.1e-3, 32e-3]],
        new_m: 28e-3,
    },
];
/// Ends of a stroke along x: outside the block, and 8 mm before its other side.
const START: [f64; 2] = [-4e-3, 14.1e-3];
const END: [f64; 2] = [64e-3, 14.1e-3];

const AGAIN_COLUMNS: [Column; 5] = [
    ("second stroke", "stroke", 1.0),
    ("work of the first (mJ)", "first_mj", 1.0),
    ("of the second (mJ)", "second_mj", 1.0),
    ("closed form of the new part (mJ)", "closed_form_mj", 1.0),
    ("second of first (%)", "of_first_percent", 1.0),
];

/// Two strokes, from one place (x, y) to another.
struct Again {
    name: &'static str,
    first: [[f64; 2]; 2],
    second: [[f64; 2]; 2],
    /// Length of the second one in uncut tissue, m.
    new_m: f64,
}

impl Again {
    /// Both strokes, and the time between them, s.
    fn script(&self) -> Result<(Script, f64), String> {
        let mut waypoints = Vec::new();
        let (mut t_s, mut between_s) = (0.0, 0.0);
        for [from, to] in [self.first, self.second] {
            let at = |[x, y]: [f64; 2], depth: f64| Vec3::new(x, y, top_m() - depth);
            between_s = t_s;
            let length_m = (to[0] - from[0]).hypot(to[1] - from[1]);
            let drawn_s = t_s + 0.7 + length_m / SPEED_M_S;
            waypoints.extend([
                Waypoint::new(t_s, at(from, -5e-3)),
                Waypoint::new(t_s + 0.5, at(from, DEPTH_M)),
                Waypoint::new(t_s + 0.7, at(from, DEPTH_M)).pressed(),
                Waypoint::new(drawn_s, at(to, DEPTH_M)).linear().pressed(),
                Waypoint::new(drawn_s + 0.3, at(to, -5e-3)).pressed(),
                Waypoint::new(drawn_s + 0.4, at(to, -5e-3)),
            ]);
            t_s = drawn_s + 1.2;
        }
        let script = Script::new(Tool::blade(3e-3, BLADE_M), HAND, waypoints, false);
        Ok((script.map_err(|e| e.to_string())?, between_s))
    }

    fn figures(&self, bench: &mut Bench<'_>) -> Result<Value, String> {
        let (script, between_s) = self.script()?;
        let muscle = resolve("muscle")?;
        let closed_form_j = muscle.toughness_j_m2 * DEPTH_M * self.new_m;
        let model = Arc::new(block(CELLS, SPACING_M, &muscle, 1));
        let stage = format!("cutting muscle {}", self.name);
        let other = idle(script.end_s())?;
        let reference = reference::run(&model, [&other, &script], &[], |done| {
            (bench.progress)(&stage, done);
            true
        });
        let forces = &reference.map_err(|e| e.to_string())?.forces[1];
        let (first, second) = forces.split_at(forces.partition_point(|p| p.t_s < between_s));
        let [first, second] = [first, second].map(work_j);
        Ok(json!({
            "stroke": self.name,
            "first_mj": 1e3 * first,
            "second_mj": 1e3 * second,
            "closed_form_mj": 1e3 * closed_form_j,
            "of_first_percent": 100.0 * second / first,
        }))
    }
}

/// Work of a hand against the force, J.
fn work_j(forces: &[ForcePoint]) -> f64 {
    let work = forces.windows(2).map(|w| {
        let [a, b] = [0, 1].map(|i| Vec3::from(w[i].position_m));
        let force = (Vec3::from(w[0].force_n) + Vec3::from(w[1].force_n)) * 0.5;
        -force.dot(&(b - a))
    });
    work.sum()
}

pub(super) fn resolve(name: &str) -> Result<Material, String> {
    Material::resolve(name, None).map_err(|e| e.to_string())
}

fn top_m() -> f64 {
    CELLS[2] as f64 * SPACING_M
}

/// Skin over fat over muscle, on a pinned base.
fn layered() -> Result<Model, String> {
    let mut model = block(CELLS, SPACING_M, &resolve(LAYERS[2].0)?, 1);
    add_layers(&mut model, SPACING_M, &LAYERS[..2])?;
    Ok(model)
}

/// Makes the uppermost cells of a block other tissues: layers from the top, each with its thickness in cells.
pub(super) fn add_layers(
    model: &mut Model,
    spacing_m: f64,
    layers: &[(&str, usize)],
) -> Result<(), String> {
    let first = model.regions.len();
    for (name, _) in layers {
        model.regions.push(Region {
            name: (*name).to_owned(),
            material: resolve(name)?,
            pinned: false,
            fibre: [0.0; 3],
        });
    }
    let mut below_m = model.nodes.iter().map(|x| x.z).fold(0.0, f64::max);
    for (layer, (_, cells)) in layers.iter().enumerate() {
        let above_m = below_m;
        below_m -= *cells as f64 * spacing_m;
        for cell in &mut model.cells {
            let z = cell.corners.map(|n| model.nodes[n as usize].z);
            let z = z.iter().sum::<f64>() / 8.0;
            if (below_m..above_m).contains(&z) {
                cell.region = RegionId((first + layer) as u16);
            }
        }
    }
    Ok(())
}

/// Resistance of a blade with its tip at this depth in the layered block, in closed form, N.
fn layered_n(depth_m: f64) -> Result<f64, String> {
    let (mut force, mut above_m) = (0.0, 0.0);
    for (name, cells) in LAYERS {
        let thick_m = cells as f64 * SPACING_M;
        force += resolve(name)?.toughness_j_m2 * (depth_m - above_m).clamp(0.0, thick_m);
        above_m += thick_m;
    }
    Ok(force)
}

/// A blade that is drawn along x from one depth to another, 8 mm to 64 mm from the edge of the block or, at one depth, from
/// outside; then it leaves upwards.
fn blade(from_m: f64, to_m: f64) -> Result<Script, String> {
    let begin_m = if from_m == to_m { -4e-3 } else { 8e-3 };
    let end_m = 64e-3;
    let at = |x: f64, depth: f64| Vec3::new(x, 14.1e-3, top_m() - depth);
    let takes_s = (end_m - begin_m) / SPEED_M_S;
    let waypoints = vec![
        Waypoint::new(0.0, at(begin_m, from_m)),
        Waypoint::new(0.2, at(begin_m, from_m)).pressed(),
        Waypoint::new(0.2 + takes_s, at(end_m, to_m))
            .linear()
            .pressed(),
        Waypoint::new(0.5 + takes_s, at(end_m, -5e-3)).pressed(),
        Waypoint::new(0.6 + takes_s, at(end_m, -5e-3)),
    ];
    Script::new(Tool::blade(3e-3, BLADE_M), HAND, waypoints, false).map_err(|e| e.to_string())
}

/// A hand that rests far from the block.
pub(super) fn idle(seconds: f64) -> Result<Script, String> {
    let away = Vec3::new(0.0, 0.0, 1.0);
    let path = vec![Waypoint::new(0.0, away), Waypoint::new(seconds, away)];
    Script::new(Tool::probe(3e-3), HAND, path, false).map_err(|e| e.to_string())
}

/// The path of a blade, with the depth of its tip and its force against the path.
struct Drawn {
    /// Path along x, depth and force, in m and N.
    points: Vec<[f64; 3]>,
    /// Work of the force in J, and area of the wound in m².
    work_j: f64,
    area_m2: f64,
}

impl Drawn {
    fn of(model: &Arc<Model>, reference: &Reference) -> Result<Self, String> {
        let forces = &reference.forces[1];
        let point = |p: &ForcePoint| [p.position_m[0], top_m() - p.position_m[2], -p.force_n[0]];
        let mut topology = Arc::new(Topology::new(Arc::clone(model)));
        let before = boundary_m2(&topology);
        let mut history = CutHistory::new(Arc::clone(&topology));
        for cut in &reference.strokes {
            let part = tissue_stroke(ParticipantId(2), &cut.part);
            history
                .cut(&mut topology, part)
                .map_err(|e| e.to_string())?;
        }
        Ok(Self {
            points: forces.iter().map(point).collect(),
            work_j: work_j(forces),
            // Both sides of the wound are new.
            area_m2: (boundary_m2(&topology) - before) / 2.0,
        })
    }

    /// Points of the draw, without its entry and its way out.
    fn drawn(&self, begin_m: f64) -> impl Iterator<Item = &[f64; 3]> {
        let within = move |p: &&[f64; 3]| (begin_m + ENTRY_M..63e-3).contains(&p[0]);
        self.points.iter().filter(within)
    }
}

fn boundary_m2(topology: &Topology) -> f64 {
    let triangles = topology.boundary().triangles.iter();
    let area = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|n| topology.rest(n));
        (b - a).cross(&(c - a)).norm() / 2.0
    };
    triangles.map(area).sum()
}

fn figures(
    name: &str,
    toughness: Option<f64>,
    drawn: &Drawn,
    begin_m: f64,
    form: impl Fn(f64) -> f64,
) -> Value {
    let pairs: Vec<(f64, f64)> = drawn.drawn(begin_m).map(|p| (p[2], form(p[1]))).collect();
    let count = pairs.len() as f64;
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / count;
    let rms = |of: &dyn Fn(&(f64, f64)) -> f64| mean(&|p| of(p).powi(2)).sqrt();
    json!({
        "tissue": name,
        "toughness_j_m2": toughness,
        "depth_mm": drawn.points.iter().map(|p| p[1] * 1e3).fold(0.0, f64::max),
        "mean_n": mean(&|p| p.0),
        "closed_form_n": mean(&|p| p.1),
        "error_percent": 100.0 * rms(&|p| p.0 - p.1) / rms(&|p| p.1),
        "work_j_m2": drawn.work_j / drawn.area_m2,
    })
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let mut cut = |name: &str, model: Model, script: &Script| {
        let model = Arc::new(model);
        let stage = format!("cutting {name}");
        let other = idle(script.end_s())?;
        let reference = reference::run(&model, [&other, script], &[], |done| {
            (bench.progress)(&stage, done);
            true
        });
        Drawn::of(&model, &reference.map_err(|e| e.to_string())?)
    };
    let (mut rows, mut lines) = (Vec::new(), Vec::new());
    let mut table = Table::new("tissue,path (mm),depth (mm),force (N),closed form (N)");
    let mut note =
        |name: &str, points: &mut dyn Iterator<Item = &[f64; 3]>, form: &dyn Fn(f64) -> f64| {
            for [x, depth, force] in points.step_by(5) {
                let numbers = [1e3 * x, 1e3 * depth, *force, form(*depth)];
                let cells = numbers.iter().map(|n| format!("{n:.4}"));
                table
                    .rows
                    .push(std::iter::once(name.to_owned()).chain(cells).collect());
            }
        };
    for (name, colour) in TISSUES {
        let material = resolve(name)?;
        let script = blade(DEPTH_M, DEPTH_M)?;
        let drawn = cut(name, block(CELLS, SPACING_M, &material, 1), &script)?;
        let form = |depth: f64| material.toughness_j_m2 * depth.max(0.0);
        rows.push(figures(
            name,
            Some(material.toughness_j_m2),
            &drawn,
            0.0,
            form,
        ));
        note(name, &mut drawn.points.iter(), &form);
        lines.push(Line::new(
            name,
            colour,
            drawn.points.iter().map(|p| (1e3 * p[0], p[2])),
        ));
    }
    let drawn = cut("layers", layered()?, &blade(-2e-3, DEEPEST_M)?)?;
    let form = |depth: f64| layered_n(depth).unwrap_or(f64::NAN);
    rows.push(figures("skin, fat, muscle", None, &drawn, 8e-3, form));
    note("layers", &mut drawn.points.iter(), &form);
    let deepest = drawn.points.iter().map(|p| p[1]).fold(0.0, f64::max);
    let into = || drawn.points.iter().take_while(|p| p[1] < deepest);
    let layers = [
        Line::new("rendered", BLUE, into().map(|p| (1e3 * p[1], p[2]))),
        Line::new(
            "closed form",
            GREY,
            into().map(|p| (1e3 * p[1], form(p[1]))),
        )
        .dashed(true),
    ];
    let again = AGAIN.iter().map(|strokes| strokes.figures(bench));
    let again = again.collect::<Result<Vec<Value>, String>>()?;
    let charts = vec![
        (
            "cut-force-tissues".to_owned(),
            Chart::new(
                "A blade drawn through four tissues at a depth of 8 mm",
                "path of the tip (mm)",
                vec![Panel::new("Force against the path", "force (N)", lines)],
            ),
        ),
        (
            "cut-force-layers".to_owned(),
            Chart::new(
                "A blade drawn ever deeper: 2 mm of skin over 10 mm of fat over muscle",
                "depth of the tip (mm)",
                vec![Panel::new("Force against the path", "force (N)", layers)],
            ),
        ),
    ];
    Ok(Outcome {
        caption: "The edge feels the toughness of each tissue times its length in it. The work per area of the \
                  wound, which the cut topology gives, is compared with the toughness: a lattice opens whole \
                  faces, and both ends of a wound are up to a cell off. Errors are those of the rendered force \
                  against the closed form, 8 mm behind the entry. Where a wound continues ahead of the edge, a \
                  second stroke parts nothing and feels no toughness."
            .to_owned(),
        figures: json!({ "experiment": "cut-force", "speed_mm_s": 1e3 * SPEED_M_S, "cases": rows, "again": again }),
        tables: vec![
            ("cut-force".to_owned(), Table::of_objects(&rows, &COLUMNS)),
            ("cut-force-again".to_owned(), Table::of_objects(&again, &AGAIN_COLUMNS)),
            ("cut-force-paths".to_owned(), table),
        ],
        charts,
        ..Outcome::default()
    })
}
