//! Equal presses on soft and on stiff tissue side by side (Lin 2007, fig 4.8).

use std::sync::Arc;

use palpate_device::script::Waypoint;
use palpate_protocol::tool::ToolDescription;
use palpate_tissue::{Material, Model, Region, RegionId, Vec3, block};
use serde_json::json;

use super::tissue::{Cases, force, panel, rendered_and_converged, straight, without_friction};
use super::{Bench, Outcome};
use crate::chart::{BLUE, Chart, GREEN, ORANGE};
use crate::scenario::ScenarioResult;

const SPACING_M: f64 = 4e-3;
const CELLS: [usize; 3] = [24, 12, 9];
const RADIUS_M: f64 = 8e-3;
const DEPTH_M: f64 = 8e-3;
const SPEED_M_S: f64 = 0.05;

/// Fat on the left and muscle on the right, on a pinned base.
fn tissue() -> Result<Arc<Model>, String> {
    let of = |name: &str| Material::resolve(name, None).map_err(|e| e.to_string());
    let mut model = block(CELLS, SPACING_M, &of("fat")?, 1);
    model.regions.push(Region {
        name: "right".to_owned(),
        material: of("muscle")?,
        pinned: false,
        fibre: [0.0; 3],
    });
    let middle = 0.5 * CELLS[0] as f64 * SPACING_M;
    for cell in &mut model.cells {
        let x = cell.corners.map(|n| model.nodes[n as usize].x);
        let x = x.iter().sum::<f64>() / 8.0;
        if cell.region == RegionId(1) && x > middle {
            cell.region = RegionId(2);
        }
    }
    Ok(without_friction(&model))
}

fn press_at(share: f64) -> Vec<Waypoint> {
    let [x, y, z] = [0, 1, 2].map(|i| CELLS[i] as f64 * SPACING_M);
    let top = Vec3::new(share * x, 0.5 * y, z + RADIUS_M);
    let takes = DEPTH_M / SPEED_M_S;
    let mut path = straight(top, Vec3::z(), 1e-3, DEPTH_M, SPEED_M_S);
    path.extend([
        Waypoint::new(0.15 + takes, top - Vec3::z() * DEPTH_M),
        Waypoint::new(0.15 + 2.0 * takes, top + Vec3::z() * 1e-3).linear(),
    ]);
    path
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = tissue()?;
    let spots = [
        ("on fat", 0.25, BLUE),
        ("between", 0.5, GREEN),
        ("on muscle", 0.75, ORANGE),
    ];
    let (mut cases, mut largest) = (Cases::default(), Vec::new());
    for (name, share, colour) in spots {
        let tool = ToolDescription::probe(RADIUS_M);
        let result = bench.simulate(name, &model, tool, press_at(share))?;
        let lines = rendered_and_converged(name, colour, &result, |p, s| (p.t_s, force(p, s).z));
        cases.lines.extend(lines);
        let deviation = result.frictionless();
        largest.push(deviation.largest);
        cases.figures.push(json!({
            "spot": name, "force_n": deviation.largest, "deviation": deviation, "sideways_n": sideways(&result),
        }));
        cases.add_table("soft-hard", name, &result);
    }
    let panels = vec![panel("Force out of the tissue", "force (N)", cases.lines)];
    let title = "Soft and hard: a ball of 8 mm pressed 8 mm deep";
    let chart = Chart::new(title, "time (s)", panels);
    Ok(Outcome {
        caption: "Fat and muscle side by side on a rigid base, pressed 8 mm deep at 50 mm/s by a ball of 8 mm. \
                  Between the two, the force has an intermediate magnitude and points towards the softer \
                  side."
            .to_owned(),
        figures: json!({
            "experiment": "soft-hard", "spots": cases.figures, "stiff_over_soft": largest[2] / largest[0],
        }),
        charts: vec![("soft-hard".to_owned(), chart)],
        tables: cases.tables,
        ..Outcome::default()
    })
}

/// Largest converged force along x, from soft to stiff, N.
fn sideways(result: &ScenarioResult) -> f64 {
    let along = result.checked().map(|(_, s)| s.frictionless.force.x);
    along.fold(
        0.0,
        |most: f64, x| if x.abs() > most.abs() { x } else { most },
    )
}
