//! Stick and slip of a ball and of a line tool (Lin 2007, figs 4.11 to 4.13).

use nalgebra::UnitQuaternion;
use palpate_device::script::Waypoint;
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_tissue::{Material, Vec3, block};
use serde_json::json;

use super::tissue::{Cases, panel, rendered_and_converged, with_friction};
use super::{Bench, Outcome};
use crate::chart::{BLUE, Chart, GREEN, ORANGE};
use crate::scenario::ScenarioResult;

const SPACING_M: f64 = 4e-3;
const CELLS: [usize; 3] = [26, 14, 8];
const DEPTH_M: f64 = 5e-3;
const DRAG_M: f64 = 30e-3;
/// Drag speed; a slow drag shows the elastic stretch before the slip.
const SPEED_M_S: f64 = 0.03;
const PRESS_S: f64 = 0.25;

/// Name, friction coefficients (static, dynamic) and colour.
const SURFACES: [(&str, [f64; 2], &str); 3] = [
    ("0.2 / 0.1", [0.2, 0.1], BLUE),
    ("0.4 / 0.3", [0.4, 0.3], GREEN),
    ("0.6 / 0.4", [0.6, 0.4], ORANGE),
];

fn ball() -> ToolDescription {
    ToolDescription::probe(8e-3)
}

/// Line tool along y, across the drag direction, held at its tip.
fn bar() -> ToolDescription {
    ToolDescription {
        kind: ToolKind::Needle,
        radius_m: 8e-3,
        length_m: 24e-3,
        width_m: 0.0,
    }
}

fn slip(result: &ScenarioResult, [stick, slide]: [f64; 2]) -> serde_json::Value {
    let ratios = |slides: bool| {
        let points = result.checked().filter(move |(p, _)| p.slides == slides);
        points.map(|(p, s)| p.rendered.force.x.abs() / s.pressed_n.max(1e-9))
    };
    let mean = ratios(true).sum::<f64>() / ratios(true).count().max(1) as f64;
    let peak = ratios(false).fold(0.0_f64, f64::max);
    json!({
        "static": stick, "dynamic": slide, "break_away": peak, "while_sliding": mean,
        "force": result.sliding(), "torque": result.sliding_torque(),
    })
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let muscle = Material::resolve("muscle", None).map_err(|e| e.to_string())?;
    let tissue = block(CELLS, SPACING_M, &muscle, 1);
    let [_, y, top] = [0, 1, 2].map(|i| CELLS[i] as f64 * SPACING_M);
    let flat = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), -std::f64::consts::FRAC_PI_2);
    let tools = [
        ("ball", ball(), UnitQuaternion::identity(), 0.5 * y),
        ("line", bar(), flat, 0.5 * y - 12e-3),
    ];
    let (mut cases, mut charts) = (Cases::default(), Vec::new());
    for (name, tool, turn, beside) in tools {
        let (mut drag, mut torque) = (Vec::new(), Vec::new());
        let above = Vec3::new(28e-3, beside, top + tool.radius_m);
        let down = above - Vec3::z() * DEPTH_M;
        let end_s = PRESS_S + DRAG_M / SPEED_M_S;
        for (mu, friction, colour) in SURFACES {
            let path = vec![
                Waypoint::new(0.0, above + Vec3::z() * 1e-3).turned(turn),
                Waypoint::new(PRESS_S, down).turned(turn),
                Waypoint::new(end_s, down + Vec3::x() * DRAG_M)
                    .turned(turn)
                    .linear(),
            ];
            let model = with_friction(&tissue, friction);
            let mut result = bench.simulate(&format!("{name}, {mu}"), &model, tool, path)?;
            cases
                .figures
                .push(json!({ "tool": name, "surface": slip(&result, friction) }));
            cases.add_table("friction", &format!("{name}-{}", friction[0]), &result);
            // The chart begins with the drag.
            result.points.retain(|p| p.t_s >= PRESS_S);
            let moved_mm = |x: f64| (x - down.x) * 1e3;
            drag.extend(rendered_and_converged(mu, colour, &result, |p, s| {
                let wrench = s.map_or(p.rendered, |s| s.at(true));
                (moved_mm(p.position.x), -wrench.force.x)
            }));
            torque.extend(rendered_and_converged(mu, colour, &result, |p, s| {
                let wrench = s.map_or(p.rendered, |s| s.at(true));
                (moved_mm(p.position.x), 1e3 * wrench.torque.z)
            }));
        }
        let mut panels = vec![panel("Force against the drag", "force (N)", drag)];
        if name == "line" {
            let title = "Torque about the held end, upwards";
            panels.push(panel(title, "torque (mN·m)", torque));
        }
        let title = format!("Friction: a {name} pressed 5 mm into muscle and dragged over it");
        let chart = Chart::new(title, "distance (mm)", panels);
        charts.push((format!("friction-{name}"), chart));
    }
    Ok(Outcome {
        caption: "Legends give the coefficients of static and dynamic friction. The converged solution is \
                  that of a sliding tool. The tool sticks until the drag force exceeds the static friction, \
                  then slides with the dynamic friction. The line is held at one end, so friction along it \
                  exerts a torque."
            .to_owned(),
        figures: json!({ "experiment": "friction", "cases": cases.figures }),
        charts,
        tables: cases.tables,
        ..Outcome::default()
    })
}
