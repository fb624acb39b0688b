//! Force error of the haptic path in a press at 100 mm/s: a ball, and a line that is then dragged with
//! friction.

use std::sync::Arc;

use palpate_device::script::WayPoint;
use palpate_haptics::ChainConfig;
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_tissue::Vec3;
use serde_json::json;

use super::{Bench, Outcome, felt_and_true, panel, place, without_friction};
use crate::chart::{BLUE, Chart, ORANGE};
use crate::scenario::{Course, Scenario, path, upright};

const SPEED_M_S: f64 = 0.1;
const DEPTH_M: f64 = 15e-3;
const LINE_DEPTH_M: f64 = 8e-3;
const DRAG_M: f64 = 30e-3;
/// Drag speed of the line. A line has several times the contacts of a ball, so its model takes longer.
const DRAG_M_S: f64 = 0.05;
const RADIUS_M: f64 = 8e-3;

/// Line tool along v, held at one end.
const LINE: ToolDescription = ToolDescription {
    kind: ToolKind::Needle,
    radius_m: 8e-3,
    length_m: 30e-3,
    width_m: 0.0,
};

fn ball(bench: &mut Bench<'_>, model: &Arc<palpate_tissue::Model>) -> Result<Course, String> {
    let place = place(model)?;
    let top = place.middle + place.normal * RADIUS_M;
    let down = top - place.normal * DEPTH_M;
    let takes = DEPTH_M / SPEED_M_S;
    let scenario = Scenario {
        model: Arc::new(without_friction(model)),
        tool: ToolDescription::probe(RADIUS_M),
        path: path(vec![
            WayPoint::new(0.0, top + place.normal * 1e-3),
            WayPoint::new(0.05, top),
            WayPoint::new(0.05 + takes, down).linear(),
            WayPoint::new(0.15 + takes, down),
        ])?,
        chain: ChainConfig::default(),
    };
    Ok(bench.run("ball", &scenario))
}

fn line(
    bench: &mut Bench<'_>,
    model: &Arc<palpate_tissue::Model>,
    slides: bool,
) -> Result<Course, String> {
    let place = place(model)?;
    // The tool's z axis lies along v. Its centre is over the place, and the handle end lies half a length
    // before it.
    let turn = upright(&place.v);
    let held = place.middle - place.v * (0.5 * LINE.length_m) - place.u * (0.5 * DRAG_M);
    let top = held + place.normal * LINE.radius_m;
    let down = top - place.normal * LINE_DEPTH_M;
    let pressed = LINE_DEPTH_M / SPEED_M_S;
    let mut ways = vec![
        WayPoint::new(0.0, top + place.normal * 2e-3).turned(turn),
        WayPoint::new(0.05, top).turned(turn),
        WayPoint::new(0.05 + pressed, down).turned(turn).linear(),
    ];
    let (what, model) = if slides {
        let to = WayPoint::new(dragged_from() + DRAG_M / DRAG_M_S, down + place.u * DRAG_M);
        ways.push(to.turned(turn).linear());
        ("dragged line", Arc::clone(model))
    } else {
        ways.push(WayPoint::new(0.15 + pressed, down).turned(turn));
        ("line", Arc::new(without_friction(model)))
    };
    let scenario = Scenario {
        model,
        tool: LINE,
        path: path(ways)?,
        chain: ChainConfig::default(),
    };
    Ok(bench.run(what, &scenario))
}

/// Start time of the drag after the press, s.
fn dragged_from() -> f64 {
    0.05 + LINE_DEPTH_M / SPEED_M_S
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = bench.model_or("thigh")?;
    let ball = ball(bench, &model)?;
    let pressed = line(bench, &model, false)?;
    let line = line(bench, &model, true)?;
    let norm = |v: Vec3| v.norm();
    let of_ball = felt_and_true("ball", BLUE, &ball, |p, truth| {
        (p.t_s, norm(truth.map_or(p.felt.force, |t| t.plain.force)))
    });
    let of_line = felt_and_true("line", ORANGE, &line, |p, truth| {
        let truth = truth.map(|t| if p.slides { t.sliding() } else { t.plain });
        (p.t_s, norm(truth.map_or(p.felt.force, |t| t.force)))
    });
    let torque = felt_and_true("line", ORANGE, &line, |p, truth| {
        let truth = truth.map(|t| if p.slides { t.sliding() } else { t.plain });
        (p.t_s, 1e3 * norm(truth.map_or(p.felt.torque, |t| t.torque)))
    });
    let chart = Chart {
        title: "Pressed at 100 mm/s, solved on one thread, felt at 1 kHz".to_owned(),
        x_label: "time (s)".to_owned(),
        panels: vec![
            panel(
                "Ball of 8 mm, 15 mm deep, without friction",
                "force (N)",
                of_ball.to_vec(),
            ),
            panel(
                "Line of 30 mm and 8 mm, 8 mm deep, then dragged at 50 mm/s with friction",
                "force (N)",
                of_line.to_vec(),
            ),
            panel(
                "Torque about the held end of the line",
                "torque (mN·m)",
                torque.to_vec(),
            ),
        ],
        marks: Vec::new(),
    };
    Ok(Outcome {
        caption: "The haptic path (a model every 4 ms at best, 1 ms of work each, solved on one thread) \
                  against an independent solver that converges every 11 ms. Converged friction is drawn \
                  where the tool slides."
            .to_owned(),
        figures: json!({
            "experiment": "press", "nodes": model.nodes.len(),
            "ball": { "force": ball.plain(), "solve_ms": ball.solve_ms, "passivated": ball.counters.passivated,
                      "residuals": ball.residuals() },
            "line_pressed": { "force": pressed.plain(), "torque": pressed.plain_torque(), "solve_ms": pressed.solve_ms,
                              "passivated": pressed.counters.passivated, "residuals": pressed.residuals() },
            "line_dragged": { "force": line.sliding(), "torque": line.sliding_torque(), "slid": line.slid(dragged_from()),
                              "solve_ms": line.solve_ms, "passivated": line.counters.passivated,
                              "residuals": line.residuals() },
        }),
        charts: vec![("press".to_owned(), chart)],
        tables: vec![("press-ball".to_owned(), ball.csv()), ("press-line".to_owned(), line.csv())],
    })
}
