//! Force error of the haptic path in a press at 100 mm/s: a ball, and a line that is then dragged with
//! friction.

use std::sync::Arc;

use palpate_device::script::Waypoint;
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_tissue::Model;
use serde_json::json;

use super::tissue::{force, location, panel, rendered_and_converged, straight, without_friction};
use super::{Bench, Outcome};
use crate::chart::{BLUE, Chart, ORANGE};
use crate::scenario::{ScenarioResult, upright};

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

fn ball(bench: &mut Bench<'_>, model: &Arc<Model>) -> Result<ScenarioResult, String> {
    let location = location(model)?;
    let top = location.middle + location.normal * RADIUS_M;
    let mut path = straight(top, location.normal, 1e-3, DEPTH_M, SPEED_M_S);
    let down = top - location.normal * DEPTH_M;
    path.push(Waypoint::new(0.15 + DEPTH_M / SPEED_M_S, down));
    let tool = ToolDescription::probe(RADIUS_M);
    bench.simulate("ball", &without_friction(model), tool, path)
}

fn line(bench: &mut Bench<'_>, model: &Arc<Model>, slides: bool) -> Result<ScenarioResult, String> {
    let location = location(model)?;
    // The tool's z axis lies along v. Its centre is over the location, and the handle end lies half a length
    // before it.
    let turn = upright(&location.v);
    let held = location.middle - location.v * (0.5 * LINE.length_m) - location.u * (0.5 * DRAG_M);
    let top = held + location.normal * LINE.radius_m;
    let down = top - location.normal * LINE_DEPTH_M;
    let mut path = straight(top, location.normal, 2e-3, LINE_DEPTH_M, SPEED_M_S);
    let (name, model) = if slides {
        let end_s = dragged_from() + DRAG_M / DRAG_M_S;
        path.push(Waypoint::new(end_s, down + location.u * DRAG_M).linear());
        ("dragged line", Arc::clone(model))
    } else {
        path.push(Waypoint::new(0.15 + LINE_DEPTH_M / SPEED_M_S, down));
        ("line", without_friction(model))
    };
    let path = path.into_iter().map(|way| way.turned(turn)).collect();
    bench.simulate(name, &model, LINE, path)
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
    let of_ball = rendered_and_converged("ball", BLUE, &ball, |p, s| (p.t_s, force(p, s).norm()));
    let of_line = rendered_and_converged("line", ORANGE, &line, |p, solution| {
        let wrench = solution.map_or(p.rendered, |s| s.at(p.slides));
        (p.t_s, wrench.force.norm())
    });
    let torque = rendered_and_converged("line", ORANGE, &line, |p, solution| {
        let wrench = solution.map_or(p.rendered, |s| s.at(p.slides));
        (p.t_s, 1e3 * wrench.torque.norm())
    });
    let ball_title = "Ball of 8 mm, 15 mm deep, without friction";
    let line_title = "Line of 30 mm and 8 mm, 8 mm deep, then dragged at 50 mm/s with friction";
    let torque_title = "Torque about the held end of the line";
    let panels = vec![
        panel(ball_title, "force (N)", of_ball.to_vec()),
        panel(line_title, "force (N)", of_line.to_vec()),
        panel(torque_title, "torque (mN·m)", torque.to_vec()),
    ];
    let title = "Pressed at 100 mm/s, solved on one thread, felt at 1 kHz";
    Ok(Outcome {
        caption: "The haptic path (a model every 4 ms at best, 1 ms of work each, solved on one thread) \
                  against an independent solver that converges every 11 ms. Converged friction is drawn \
                  where the tool slides."
            .to_owned(),
        figures: json!({
            "experiment": "press", "nodes": model.nodes.len(),
            "ball": { "force": ball.frictionless(), "solve_ms": ball.solve_ms, "passivated": ball.counters.passivated,
                      "residuals": ball.residuals() },
            "line_pressed": { "force": pressed.frictionless(), "torque": pressed.frictionless_torque(),
                              "solve_ms": pressed.solve_ms, "passivated": pressed.counters.passivated,
                              "residuals": pressed.residuals() },
            "line_dragged": { "force": line.sliding(), "torque": line.sliding_torque(), "slid": line.slid(dragged_from()),
                              "solve_ms": line.solve_ms, "passivated": line.counters.passivated,
                              "residuals": line.residuals() },
        }),
        charts: vec![("press".to_owned(), Chart::new(title, "time (s)", panels))],
        tables: vec![("press-ball".to_owned(), ball.table()), ("press-line".to_owned(), line.table())],
        ..Outcome::default()
    })
}
