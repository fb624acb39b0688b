//! Common parts of the experiments on tissue: models, paths, lines of rendered and converged values.

use std::sync::Arc;

use nalgebra::Vector3;
use palpate_device::script::Waypoint;
use palpate_protocol::tool::ToolDescription;
use palpate_tissue::{Model, Topology, Vec3};

use super::{Bench, Table};
use crate::chart::{GREY, Line, Panel};
use crate::scenario::{Point, Scenario, ScenarioResult, Solution};
use crate::tool_location::ToolLocation;

pub(super) fn without_friction(model: &Model) -> Arc<Model> {
    with_friction(model, [0.0; 2])
}

pub(super) fn with_friction(model: &Model, [stick, slide]: [f64; 2]) -> Arc<Model> {
    let mut model = model.clone();
    for region in &mut model.regions {
        region.material.friction_static = stick;
        region.material.friction_dynamic = slide;
    }
    Arc::new(model)
}

pub(super) fn location(model: &Arc<Model>) -> Result<ToolLocation, String> {
    ToolLocation::find(&Topology::new(Arc::clone(model)))
}

/// A straight press from `gap_m` above the contact at `top` to a depth along `normal`.
pub(super) fn straight(
    top: Vec3,
    normal: Vec3,
    gap_m: f64,
    depth_m: f64,
    speed_m_s: f64,
) -> Vec<Waypoint> {
    let takes_s = depth_m / speed_m_s;
    vec![
        Waypoint::new(0.0, top + normal * gap_m),
        Waypoint::new(0.05, top),
        Waypoint::new(0.05 + takes_s, top - normal * depth_m).linear(),
    ]
}

impl Bench<'_> {
    pub(super) fn simulate(
        &mut self,
        name: &str,
        model: &Arc<Model>,
        tool: ToolDescription,
        path: Vec<Waypoint>,
    ) -> Result<ScenarioResult, String> {
        let scenario = Scenario::new(Arc::clone(model), tool, path)?;
        Ok(scenario.run(&mut |done| (self.progress)(name, done)))
    }
}

#[derive(Default)]
pub(super) struct Cases {
    pub(super) lines: Vec<Line>,
    pub(super) figures: Vec<serde_json::Value>,
    pub(super) tables: Vec<(String, Table)>,
}

impl Cases {
    /// Adds the table of a case; `experiment` and `name` name its file.
    pub(super) fn add_table(&mut self, experiment: &str, name: &str, result: &ScenarioResult) {
        let name = name.replace(' ', "-").to_lowercase();
        self.tables
            .push((format!("{experiment}-{name}"), result.table()));
    }
}

/// The rendered value in colour, and the converged solution in dashed grey.
pub(super) fn rendered_and_converged(
    name: &str,
    colour: &'static str,
    result: &ScenarioResult,
    of: impl Fn(&Point, Option<Solution>) -> (f64, f64),
) -> [Line; 2] {
    let rendered = result.points.iter().map(|p| of(p, None));
    let solutions = result.checked().map(|(p, s)| of(p, Some(s)));
    [Line::new(name, colour, rendered), converged(solutions)]
}

/// The force along `normal` over the depth below `top`, in mm.
pub(super) fn force_over_depth(
    name: &str,
    colour: &'static str,
    result: &ScenarioResult,
    top: Vec3,
    normal: Vec3,
) -> [Line; 2] {
    rendered_and_converged(name, colour, result, |p, solution| {
        let depth_mm = 1e3 * (top - p.position).dot(&normal);
        (depth_mm, force(p, solution).dot(&normal))
    })
}

/// The converged force without friction, or the rendered one.
pub(super) fn force(point: &Point, solution: Option<Solution>) -> Vector3<f64> {
    solution.map_or(point.rendered.force, |s| s.frictionless.force)
}

/// A line of the converged solution. [`panel`] names the first one.
pub(super) fn converged(points: impl IntoIterator<Item = (f64, f64)>) -> Line {
    Line::new("", GREY, points).dashed(true)
}

/// A panel whose first converged line is named.
pub(super) fn panel(title: &str, y_label: &str, mut lines: Vec<Line>) -> Panel {
    if let Some(first) = lines.iter_mut().find(|l| l.is_dashed()) {
        "converged".clone_into(&mut first.name);
    }
    Panel::new(title, y_label, lines)
}
