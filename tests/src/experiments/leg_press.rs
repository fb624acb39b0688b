//! Press into a leg with rigid bones (Lin 2007, fig 7.11), over muscle and over bone.

use std::sync::Arc;

use palpate_device::script::WayPoint;
use palpate_haptics::ChainConfig;
use palpate_protocol::tool::ToolDescription;
use palpate_tissue::Topology;
use serde_json::json;

use super::{Bench, Outcome, felt_and_true, panel, without_friction};
use crate::chart::{BLUE, Chart, ORANGE};
use crate::scenario::{Course, Scenario, path};
use crate::tool_location::ToolLocation;

const RADIUS_M: f64 = 8e-3;
const SPEED_M_S: f64 = 0.05;
const DEPTH_M: f64 = 15e-3;
/// Maximum press depth as a share of the tissue's thickness.
const SHARE: f64 = 0.8;

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = Arc::new(without_friction(&*bench.model_or("leg")?));
    let topology = Topology::new(Arc::clone(&model));
    let muscle = ToolLocation::find(&topology).map_err(|e| e.to_string())?;
    let bone = ToolLocation::find_thin(&topology).map_err(|e| e.to_string())?;
    let spots = [("over muscle", muscle, BLUE), ("over bone", bone, ORANGE)];
    let (mut lines, mut figures, mut tables) = (Vec::new(), Vec::new(), Vec::new());
    for (name, place, colour) in spots {
        let depth = DEPTH_M.min(SHARE * place.depth_m);
        let top = place.middle + place.normal * RADIUS_M;
        let scenario = Scenario {
            model: Arc::clone(&model),
            tool: ToolDescription::probe(RADIUS_M),
            path: path(vec![
                WayPoint::new(0.0, top + place.normal * 1e-3),
                WayPoint::new(0.05, top),
                WayPoint::new(0.05 + depth / SPEED_M_S, top - place.normal * depth).linear(),
            ])?,
            chain: ChainConfig::default(),
        };
        let course = bench.run(name, &scenario);
        let deep = |p: &crate::scenario::Point| 1e3 * (top - p.position).dot(&place.normal);
        lines.extend(felt_and_true(name, colour, &course, |p, truth| {
            let force = truth.map_or(p.felt.force, |t| t.plain.force);
            (deep(p), force.dot(&place.normal))
        }));
        figures.push(json!({
            "spot": name, "tissue_mm": place.depth_m * 1e3, "depth_mm": depth * 1e3,
            "force_n": course.plain().largest, "deviation": course.plain(),
            "stiffening": stiffening(&course, &deep), "saturated": course.counters.saturated,
            "solve_ms": course.solve_ms,
        }));
        tables.push((
            format!("leg-press-{}", name.replace(' ', "-")),
            course.csv(),
        ));
    }
    let chart = Chart {
        title: "A leg with rigid bones pressed by a ball of 8 mm".to_owned(),
        x_label: "depth (mm)".to_owned(),
        panels: vec![panel("Force against depth", "force (N)", lines)],
        marks: Vec::new(),
    };
    Ok(Outcome {
        caption: "A ball pressed at 50 mm/s where the tissue over bone is thickest and where it is thinnest \
                  (to 80 % of the thickness). Over bone, springs become extreme and pass the force on \
                  (section 3.5), so the tissue bottoms out."
            .to_owned(),
        figures: json!({ "experiment": "leg-press", "nodes": model.nodes.len(), "spots": figures }),
        charts: vec![("leg-press".to_owned(), chart)],
        tables,
    })
}

/// Slope of the converged force over the last quarter of the depth, relative to the second quarter.
fn stiffening(course: &Course, deep: &impl Fn(&crate::scenario::Point) -> f64) -> f64 {
    let all: Vec<(f64, f64)> = course
        .checked()
        .map(|(p, t)| (deep(p), t.plain.force.norm()))
        .filter(|(depth, _)| *depth > 0.0)
        .collect();
    let slope = |part: &[(f64, f64)]| match part {
        [first, .., last] => (last.1 - first.1) / (last.0 - first.0),
        _ => f64::NAN,
    };
    let n = all.len() / 4;
    slope(&all[3 * n..]) / slope(&all[n..2 * n])
}
