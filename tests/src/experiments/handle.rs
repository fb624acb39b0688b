//! A soft grip of three materials around a hard core (Lin 2007, fig 7.4).

use std::sync::Arc;

use palpate_protocol::tool::ToolDescription;
use palpate_tissue::{Material, Model};
use serde_json::json;

use super::tissue::{Cases, force_over_depth, location, panel, straight, without_friction};
use super::{Bench, Outcome};
use crate::chart::{BLUE, Chart, GREEN, ORANGE};

const RADIUS_M: f64 = 6e-3;
const SPEED_M_S: f64 = 0.02;
/// Press depth as a share of the grip's thickness.
const SHARE: f64 = 0.6;

/// Young's moduli of the grip, Pa: soft foam, firm foam, soft silicone rubber.
const GRIPS: [(&str, f64, &str); 3] = [
    ("20 kPa", 20e3, BLUE),
    ("60 kPa", 60e3, GREEN),
    ("200 kPa", 200e3, ORANGE),
];

fn with_grip(model: &Model, young_pa: f64) -> Arc<Model> {
    let mut model = Arc::unwrap_or_clone(without_friction(model));
    for region in model.regions.iter_mut().filter(|r| !r.pinned) {
        region.material = Material {
            young_pa,
            ..region.material.clone()
        };
    }
    Arc::new(model)
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let sample = bench.model_or("handle")?;
    let location = location(&sample)?;
    let depth = SHARE * location.depth_m;
    let top = location.middle + location.normal * RADIUS_M;
    let mut cases = Cases::default();
    for (name, young_pa, colour) in GRIPS {
        let path = straight(top, location.normal, 5e-4, depth, SPEED_M_S);
        let tool = ToolDescription::probe(RADIUS_M);
        let result = bench.simulate(name, &with_grip(&sample, young_pa), tool, path)?;
        let lines = force_over_depth(name, colour, &result, top, location.normal);
        cases.lines.extend(lines);
        let deviation = result.frictionless();
        cases.figures.push(json!({
            "young_kpa": young_pa * 1e-3, "depth_mm": depth * 1e3, "force_n": deviation.largest,
            "deviation": deviation, "saturated": result.counters.saturated,
        }));
        cases.add_table("handle", name, &result);
    }
    let panels = vec![panel("Force against depth", "force (N)", cases.lines)];
    let chart = Chart::new(
        "A grip of three materials around a hard core",
        "depth (mm)",
        panels,
    );
    Ok(Outcome {
        caption: format!(
            "A ball of 6 mm pressed {:.1} mm into a grip of {:.1} mm thickness over its core, at 20 mm/s.",
            depth * 1e3,
            location.depth_m * 1e3
        ),
        figures: json!({ "experiment": "handle", "materials": cases.figures }),
        charts: vec![("handle".to_owned(), chart)],
        tables: cases.tables,
        ..Outcome::default()
    })
}
