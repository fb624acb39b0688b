//! `palpate-server cut`: strokes of a blade on a model, without a session.
//!
//! The strokes run through the same [`cut`] as those of a session, in the order of the file. A stroke that is
//! impossible is refused and changes nothing. The cut topology is stored as a model of its own, so that a session can be
//! hosted on it.
//!
//! ```text
//! strokes_file.rs   the file           measures.rs          figures of the result
//! placement.rs      blade at rest      interface_drift.rs   distances from interfaces
//! triangle_grid.rs  triangles by place walls.rs            walls of wounds
//! report.rs         the report
//! ```

mod interface_drift;
mod measures;
mod placement;
mod report;
mod strokes_file;
mod triangle_grid;
pub(crate) mod walls;

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use clap::Args;
use hdrhistogram::Histogram;
use palpate_anatomy::export::{stage_outer_stl, stage_vtu};
use palpate_tissue::file::{ModelFile, Staged};
use palpate_tissue::snapshot::model_hash;
use palpate_tissue::{CutOutcome, CutStroke, Shape, SweptSurface, Topology, cut};
use serde_json::{Value, json};

pub(crate) use report::describe;
pub use report::{BoundaryFigures, Component, CutSummary, RefusedStroke, SampleTimes};

use crate::build::progress_bar;
use crate::export::{keep_apart, put_in_place};
use crate::{ServerError, load, picture};
use interface_drift::interface_drift_m;
use placement::EntrySurface;
use strokes_file::StrokeEntry;

const MM: f64 = 1e3;
/// Longest measured time of a stroke in µs: an hour. Longer ones count as this.
const MICROS_MAX: u64 = 3_600_000_000;

/// Options of `cut`.
#[derive(Debug, Args)]
pub(crate) struct CutOptions {
    /// The model: a model file (.palp), a scene (.toml) or a sample (thigh, abdominal-wall, leg, handle)
    model: String,
    /// The strokes (TOML); see below
    #[arg(long, value_name = "FILE.toml")]
    strokes: PathBuf,
    /// Model file to write, to be hosted, inspected or cut again
    #[arg(short, long, value_name = "FILE.palp")]
    output: PathBuf,
    /// Also write the outer surface with the walls of the wounds as STL (mm)
    #[arg(long, value_name = "FILE.stl")]
    stl: Option<PathBuf>,
    /// Also write the cells as a VTK unstructured grid (lengths in mm)
    #[arg(long, value_name = "FILE.vtu")]
    vtu: Option<PathBuf>,
    /// Also draw the walls of the wounds, coloured by tissue
    #[arg(long, value_name = "FILE.png")]
    png: Option<PathBuf>,
    /// Print the report as one JSON object
    #[arg(long)]
    pub(crate) json: bool,
}

impl CutOptions {
    /// Cuts the model and writes all files or none. Returns the report.
    pub(crate) fn run(&self) -> Result<CutSummary, ServerError> {
        let model = Path::new(&self.model);
        let mut read = vec![self.strokes.as_path()];
        read.extend(model.exists().then_some(model));
        let optional = [&self.stl, &self.vtu, &self.png];
        let optional = optional.into_iter().filter_map(Option::as_deref);
        let places: Vec<&Path> = optional.chain([self.output.as_path()]).collect();
        // Checked before the model is built, which can take a minute, and again afterwards.
        keep_apart(&places, &read)?;
        let entries = strokes_file::read(&self.strokes)?;
        let ModelFile { model, report_json } = load::model_file(&self.model)?;
        let uncut = Topology::new(Arc::new(model));
        let (topology, mut summary) = apply(&uncut, &entries);
        let model = topology.to_model();
        summary.model_hash = format!("{:016x}", model_hash(&model));
        let rest = Shape::rest(&topology);
        let mut staged = Vec::new();
        if let Some(path) = &self.stl {
            let (file, figures) = stage_outer_stl(&topology, &rest, path)?;
            staged.push(file);
            summary.stl = Some(figures);
        }
        let file = ModelFile {
            report_json: with_cut(&report_json, &summary),
            model,
        };
        staged.push(file.stage(&self.output)?);
        if let Some(path) = &self.vtu {
            staged.push(stage_vtu(&topology, &rest, path)?);
        }
        if let Some(path) = &self.png {
            let name = self.output.file_name().unwrap_or_default();
            let bytes = picture::draw_wounds(&topology, &file.model, &name.to_string_lossy())?;
            staged.push(Staged::write(path, |out| out.write_all(&bytes))?);
        }
        put_in_place(staged, &read)?;
        Ok(summary)
    }
}

/// Applies strokes to a copy of a topology, with a progress bar on a terminal.
fn apply(uncut: &Topology, entries: &[StrokeEntry]) -> (Topology, CutSummary) {
    let surface = EntrySurface::of(uncut);
    let mut topology = uncut.clone();
    let mut summary = CutSummary {
        operations: entries.len(),
        volume_before_mm3: measures::volume_mm3(uncut),
        mass_before_kg: measures::mass_kg(uncut),
        ..CutSummary::default()
    };
    let mut micros =
        Histogram::<u64>::new_with_bounds(1, MICROS_MAX, 3).expect("the bounds are valid");
    let bar = progress_bar();
    for (index, entry) in entries.iter().enumerate() {
        bar.set_message(format!("stroke {index} of {}", entries.len()));
        bar.set_position((100 * index / entries.len()) as u64);
        let placed = surface.stroke(entry);
        let applied = placed.and_then(|stroke| {
            let since = Instant::now();
            let outcome = cut(&mut topology, &stroke).map_err(|e| e.to_string())?;
            micros.saturating_record(since.elapsed().as_micros() as u64);
            Ok((stroke, outcome))
        });
        match applied {
            Ok((stroke, outcome)) => count(&mut summary, &topology, &stroke, &outcome),
            Err(why) => {
                tracing::warn!("stroke {index} refused: {why}");
                summary.refused.push(RefusedStroke { index, why });
            }
        }
    }
    bar.set_message("measuring");
    measure(&mut summary, uncut, &topology);
    bar.finish_and_clear();
    let ms = |micros: u64| micros as f64 / 1e3;
    summary.sample_ms = SampleTimes {
        per: "stroke".to_owned(),
        p50: ms(micros.value_at_quantile(0.5)),
        p99: ms(micros.value_at_quantile(0.99)),
        max: ms(micros.max()),
    };
    (topology, summary)
}

/// Adds a stroke that was applied.
fn count(summary: &mut CutSummary, topology: &Topology, stroke: &CutStroke, outcome: &CutOutcome) {
    summary.applied += 1;
    summary.nodes_short += outcome.nodes_short;
    // A stroke that was applied is valid.
    if let Ok(surface) = SweptSurface::of(stroke, topology.model().spacing_m) {
        let distance = measures::path_distance_mm(topology, outcome, &surface);
        summary.path_distance_max_mm = summary.path_distance_max_mm.max(distance);
    }
}

/// Adds the figures of the result.
fn measure(summary: &mut CutSummary, uncut: &Topology, topology: &Topology) {
    summary.components = measures::components(topology);
    summary.volume_after_mm3 = measures::volume_mm3(topology);
    summary.mass_after_kg = measures::mass_kg(topology);
    summary.boundary = measures::boundary(topology);
    summary.inverted_cells = measures::inverted_cells(topology);
    summary.shortest_spring_mm = measures::shortest_spring_mm(topology);
    summary.interface_drift_max_mm = interface_drift_m(uncut, topology) * MM;
    summary.wound_triangles = measures::wound_triangles(topology);
    summary.topology_hash = topology.hash().to_string();
}

/// The report of a model file with that of its latest cuts at the end of the list `cuts`.
fn with_cut(report_json: &str, summary: &CutSummary) -> String {
    let mut report = match serde_json::from_str(report_json) {
        Ok(Value::Object(report)) => report,
        _ => serde_json::Map::new(),
    };
    let cuts = report.entry("cuts").or_insert_with(|| json!([]));
    if let Value::Array(cuts) = cuts {
        cuts.push(json!(summary));
    }
    Value::Object(report).to_string()
}
