//! One target point reached along different paths (Lin 2007, fig 7.10).

use palpate_device::script::Waypoint;
use palpate_protocol::tool::ToolDescription;
use palpate_tissue::Vec3;
use serde_json::json;

use super::tissue::{Cases, force, location, panel, rendered_and_converged, without_friction};
use super::{Bench, Outcome};
use crate::chart::{BLUE, Chart, GREEN, ORANGE, PURPLE};
use crate::tool_location::ToolLocation;

const RADIUS_M: f64 = 8e-3;
const DEPTH_M: f64 = 12e-3;
/// Lateral offset of the paths' start, and length of the sweep.
const ASIDE_M: f64 = 12e-3;
const TAKES_S: f64 = 0.4;
const POINTS: usize = 40;

/// A path as depth and offset along u, in units of the target depth and of [`ASIDE_M`], against relative
/// time.
type Curve = fn(f64) -> [f64; 2];

const CURVES: [(&str, Curve, &str); 4] = [
    ("straight", |s| [s, 0.0], BLUE),
    ("slanted", |s| [s, s - 1.0], GREEN),
    (
        "arc",
        |s| {
            let angle = std::f64::consts::FRAC_PI_2 * s;
            [angle.sin(), -angle.cos()]
        },
        ORANGE,
    ),
    (
        "deeper and sideways back",
        |s| {
            let u = (2.0 * s - 1.0).max(0.0);
            [(2.0 * s).min(1.0), u - 1.0]
        },
        PURPLE,
    ),
];

fn along(location: &ToolLocation, curve: Curve) -> Vec<Waypoint> {
    let at = |s: f64| -> Vec3 {
        let [depth, aside] = curve(s);
        location.middle
            + location.normal * (RADIUS_M + 1e-3 - depth * (DEPTH_M + 1e-3))
            + location.u * (aside * ASIDE_M)
    };
    let mut waypoints = vec![Waypoint::new(0.0, at(0.0))];
    for k in 1..=POINTS {
        let s = k as f64 / POINTS as f64;
        waypoints.push(Waypoint::new(0.05 + s * TAKES_S, at(s)).linear());
    }
    waypoints.push(Waypoint::new(0.15 + TAKES_S, at(1.0)));
    waypoints
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = without_friction(&*bench.model_or("thigh")?);
    let location = location(&model)?;
    let (mut cases, mut sideways, mut ends) = (Cases::default(), Vec::new(), Vec::new());
    for (name, curve, colour) in CURVES {
        let tool = ToolDescription::probe(RADIUS_M);
        let result = bench.simulate(name, &model, tool, along(&location, curve))?;
        let lines = [
            (&mut cases.lines, location.normal),
            (&mut sideways, location.u),
        ];
        for (lines, direction) in lines {
            lines.extend(rendered_and_converged(name, colour, &result, |p, s| {
                (p.t_s, force(p, s).dot(&direction))
            }));
        }
        let last = result.checked().last();
        let last = last.map(|(_, s)| s.frictionless.force.norm());
        ends.extend(last);
        cases
            .figures
            .push(json!({ "path": name, "end_n": last, "deviation": result.frictionless() }));
        cases.add_table("tool-paths", name, &result);
    }
    let spread = ends
        .iter()
        .fold(0.0_f64, |m, e| m.max((e / ends[0] - 1.0).abs()));
    let title = "Four paths of a ball of 8 mm to one point, 12 mm deep";
    let panels = vec![
        panel("Force out of the tissue", "force (N)", cases.lines),
        panel("Force along the surface", "force (N)", sideways),
    ];
    Ok(Outcome {
        caption:
            "Without friction, an elastic tissue has no memory of the path: all paths end with one \
                  force and differ before."
                .to_owned(),
        figures: json!({ "experiment": "tool-paths", "paths": cases.figures, "spread_of_ends": spread }),
        charts: vec![(
            "tool-paths".to_owned(),
            Chart::new(title, "time (s)", panels),
        )],
        tables: cases.tables,
        ..Outcome::default()
    })
}
