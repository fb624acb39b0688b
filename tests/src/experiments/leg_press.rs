//! Press into a leg with rigid bones (Lin 2007, fig 7.11), over muscle and over bone.

use std::sync::Arc;

use palpate_protocol::tool::ToolDescription;
use palpate_tissue::{Topology, Vec3};
use serde_json::json;

use super::tissue::{Cases, force_over_depth, panel, straight, without_friction};
use super::{Bench, Outcome};
use crate::chart::{BLUE, Chart, ORANGE};
use crate::scenario::ScenarioResult;
use crate::tool_location::ToolLocation;

const RADIUS_M: f64 = 8e-3;
const SPEED_M_S: f64 = 0.05;
const DEPTH_M: f64 = 15e-3;
/// Maximum press depth as a share of the tissue's thickness.
const SHARE: f64 = 0.8;

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = without_friction(&*bench.model_or("leg")?);
    let topology = Topology::new(Arc::clone(&model));
    let muscle = ToolLocation::find(&topology)?;
    let bone = ToolLocation::find_thin(&topology)?;
    let mut cases = Cases::default();
    for (name, at, colour) in [("over muscle", muscle, BLUE), ("over bone", bone, ORANGE)] {
        let depth = DEPTH_M.min(SHARE * at.depth_m);
        let top = at.middle + at.normal * RADIUS_M;
        let path = straight(top, at.normal, 1e-3, depth, SPEED_M_S);
        let result = bench.simulate(name, &model, ToolDescription::probe(RADIUS_M), path)?;
        let lines = force_over_depth(name, colour, &result, top, at.normal);
        cases.lines.extend(lines);
        let deviation = result.frictionless();
        cases.figures.push(json!({
            "spot": name, "tissue_mm": at.depth_m * 1e3, "depth_mm": depth * 1e3,
            "force_n": deviation.largest, "deviation": deviation,
            "stiffening": stiffening(&result, top, at.normal), "saturated": result.counters.saturated,
            "solve_ms": result.solve_ms,
        }));
        cases.add_table("leg-press", name, &result);
    }
    let panels = vec![panel("Force against depth", "force (N)", cases.lines)];
    let title = "A leg with rigid bones pressed by a ball of 8 mm";
    let chart = Chart::new(title, "depth (mm)", panels);
    Ok(Outcome {
        caption: "A ball pressed at 50 mm/s where the tissue over bone is thickest and where it is thinnest \
                  (to 80 % of the thickness). Over bone, springs become extreme and pass the force on \
                  (section 3.5), so the tissue bottoms out."
            .to_owned(),
        figures: json!({ "experiment": "leg-press", "nodes": model.nodes.len(), "spots": cases.figures }),
        charts: vec![("leg-press".to_owned(), chart)],
        tables: cases.tables,
        ..Outcome::default()
    })
}

/// Slope of the converged force over the last quarter of the depth, relative to the second quarter.
fn stiffening(result: &ScenarioResult, top: Vec3, normal: Vec3) -> f64 {
    let all: Vec<(f64, f64)> = result
        .checked()
        .map(|(p, s)| {
            (
                1e3 * (top - p.position).dot(&normal),
                s.frictionless.force.norm(),
            )
        })
        .filter(|(depth, _)| *depth > 0.0)
        .collect();
    let slope = |part: &[(f64, f64)]| match part {
        [first, .., last] => (last.1 - first.1) / (last.0 - first.0),
        _ => f64::NAN,
    };
    let n = all.len() / 4;
    slope(&all[3 * n..]) / slope(&all[n..2 * n])
}
