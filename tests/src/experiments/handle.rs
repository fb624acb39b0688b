//! A soft grip of three materials around a hard core (Lin 2007, fig 7.4).

use std::sync::Arc;

use palpate_device::script::WayPoint;
use palpate_haptics::ChainConfig;
use palpate_protocol::tool::ToolDescription;
use palpate_tissue::{Material, Model};
use serde_json::json;

use super::{Bench, Outcome, felt_and_true, panel, place, without_friction};
use crate::chart::{BLUE, Chart, GREEN, ORANGE};
use crate::scenario::{Scenario, path};

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

fn with_grip(model: &Model, young_pa: f64) -> Model {
    let mut model = without_friction(model);
    for region in model.regions.iter_mut().filter(|r| !r.pinned) {
        region.material = Material {
            young_pa,
            ..region.material.clone()
        };
    }
    model
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let sample = bench.model_or("handle")?;
    let place = place(&sample)?;
    let depth = SHARE * place.depth_m;
    let (mut lines, mut figures, mut tables) = (Vec::new(), Vec::new(), Vec::new());
    for (name, young_pa, colour) in GRIPS {
        let top = place.middle + place.normal * RADIUS_M;
        let takes = depth / SPEED_M_S;
        let scenario = Scenario {
            model: Arc::new(with_grip(&sample, young_pa)),
            tool: ToolDescription::probe(RADIUS_M),
            path: path(vec![
                WayPoint::new(0.0, top + place.normal * 5e-4),
                WayPoint::new(0.05, top),
                WayPoint::new(0.05 + takes, top - place.normal * depth).linear(),
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
            "young_kpa": young_pa * 1e-3, "depth_mm": depth * 1e3, "force_n": course.plain().largest,
            "deviation": course.plain(), "saturated": course.counters.saturated,
        }));
        let file = format!("handle-{}", name.replace(' ', "-").to_lowercase());
        tables.push((file, course.csv()));
    }
    let chart = Chart {
        title: "A grip of three materials around a hard core".to_owned(),
        x_label: "depth (mm)".to_owned(),
        panels: vec![panel("Force against depth", "force (N)", lines)],
        marks: Vec::new(),
    };
    Ok(Outcome {
        caption: format!(
            "A ball of 6 mm pressed {:.1} mm into a grip of {:.1} mm thickness over its core, at 20 mm/s.",
            depth * 1e3,
            place.depth_m * 1e3
        ),
        figures: json!({ "experiment": "handle", "materials": figures }),
        charts: vec![("handle".to_owned(), chart)],
        tables,
    })
}
