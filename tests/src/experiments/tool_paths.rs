//! One target point reached along different paths (Lin 2007, fig 7.10).

use std::sync::Arc;

use palpate_device::script::{Script, WayPoint};
use palpate_haptics::ChainConfig;
use palpate_protocol::tool::ToolDescription;
use palpate_tissue::Vec3;
use serde_json::json;

use super::{Bench, Outcome, felt_and_true, panel, place, without_friction};
use crate::chart::{BLUE, Chart, GREEN, ORANGE, PURPLE};
use crate::scenario::{Scenario, path};
use crate::tool_location::ToolLocation;

const RADIUS_M: f64 = 8e-3;
const DEPTH_M: f64 = 12e-3;
/// Lateral offset of the paths' start, and length of the sweep.
const ASIDE_M: f64 = 12e-3;
/// Duration of a path, s.
const TAKES_S: f64 = 0.4;
/// Waypoints of a curve.
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

fn along(place: &ToolLocation, curve: Curve) -> Result<Script, String> {
    let at = |s: f64| -> Vec3 {
        let [depth, aside] = curve(s);
        place.middle
            + place.normal * (RADIUS_M + 1e-3 - depth * (DEPTH_M + 1e-3))
            + place.u * (aside * ASIDE_M)
    };
    let mut ways = vec![WayPoint::new(0.0, at(0.0))];
    for k in 1..=POINTS {
        let s = k as f64 / POINTS as f64;
        ways.push(WayPoint::new(0.05 + s * TAKES_S, at(s)).linear());
    }
    ways.push(WayPoint::new(0.15 + TAKES_S, at(1.0)));
    path(ways)
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = Arc::new(without_friction(&*bench.model_or("thigh")?));
    let place = place(&model)?;
    let (mut into, mut aside) = (Vec::new(), Vec::new());
    let (mut figures, mut tables, mut ends) = (Vec::new(), Vec::new(), Vec::new());
    for (name, curve, colour) in CURVES {
        let scenario = Scenario {
            model: Arc::clone(&model),
            tool: ToolDescription::probe(RADIUS_M),
            path: along(&place, curve)?,
            chain: ChainConfig::default(),
        };
        let course = bench.run(name, &scenario);
        for (lines, direction) in [(&mut into, place.normal), (&mut aside, place.u)] {
            lines.extend(felt_and_true(name, colour, &course, |p, truth| {
                let force = truth.map_or(p.felt.force, |t| t.plain.force);
                (p.t_s, force.dot(&direction))
            }));
        }
        let last = course.checked().last().map(|(_, t)| t.plain.force.norm());
        ends.extend(last);
        figures.push(json!({ "path": name, "end_n": last, "deviation": course.plain() }));
        tables.push((
            format!("tool-paths-{}", name.replace(' ', "-")),
            course.csv(),
        ));
    }
    let spread = ends
        .iter()
        .fold(0.0_f64, |m, e| m.max((e / ends[0] - 1.0).abs()));
    let chart = Chart {
        title: "Four paths of a ball of 8 mm to one point, 12 mm deep".to_owned(),
        x_label: "time (s)".to_owned(),
        panels: vec![
            panel("Force out of the tissue", "force (N)", into),
            panel("Force along the surface", "force (N)", aside),
        ],
        marks: Vec::new(),
    };
    Ok(Outcome {
        caption:
            "Without friction, an elastic tissue has no memory of the path: all paths end with one \
                  force and differ before."
                .to_owned(),
        figures: json!({ "experiment": "tool-paths", "paths": figures, "spread_of_ends": spread }),
        charts: vec![("tool-paths".to_owned(), chart)],
        tables,
    })
}
