//! `palpate-server build`: from a scene to a model file.

use std::path::Path;
use std::time::Instant;

use indicatif::{ProgressBar, ProgressStyle};
use palpate_tissue::{BuildReport, ModelFile, SceneInput, build};
use serde::{Deserialize, Serialize};

use crate::export::{Exports, put_in_place};
use crate::{ServerError, memory};

/// What `build --json` prints.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct BuildSummary {
    /// What the builder reports.
    #[serde(flatten)]
    pub report: BuildReport,
    /// Seconds from the first file read to the model in memory.
    pub seconds: f64,
    /// Largest resident memory of the process in bytes; 0 where the system does not tell.
    pub peak_memory_bytes: u64,
}

/// Builds a model from checked input, with a progress bar on a terminal.
pub fn build_model(
    input: &SceneInput,
    since: Instant,
) -> Result<(ModelFile, BuildSummary), ServerError> {
    let bar = progress_bar();
    let result = build(input, &mut |stage, part| {
        bar.set_message(stage.to_owned());
        bar.set_position((part * 100.0) as u64);
    });
    bar.finish_and_clear();
    let (model, report) = result?;
    let summary = BuildSummary {
        report,
        seconds: since.elapsed().as_secs_f64(),
        peak_memory_bytes: memory::peak_bytes().unwrap_or(0),
    };
    let report_json = serde_json::to_string(&summary).unwrap_or_default();
    Ok((ModelFile { model, report_json }, summary))
}

/// Builds a scene and writes the model file and what else is asked for: all of it, or nothing.
pub(crate) fn build_file(
    scene: &Path,
    output: &Path,
    exports: &Exports,
) -> Result<BuildSummary, ServerError> {
    let since = Instant::now();
    let input = SceneInput::load(scene)?;
    let (file, summary) = build_model(&input, since)?;
    let mut staged = exports.stage(&file.model)?;
    staged.push(file.stage(output)?);
    put_in_place(staged)?;
    Ok(summary)
}

fn progress_bar() -> ProgressBar {
    // indicatif draws on standard error, and nothing at all when that is no terminal.
    let bar = ProgressBar::new(100);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {percent:>3} % {msg}") {
        bar.set_style(style);
    }
    bar
}

/// The report as a table for a person.
pub(crate) fn describe(summary: &BuildSummary) -> String {
    use std::fmt::Write as _;
    let r = &summary.report;
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = writeln!(
        text,
        "{} nodes, {} cells at {} mm; springs: {} structural, {} shear, {} layer",
        r.nodes, r.cells, r.spacing_mm, r.springs.structural, r.springs.shear, r.springs.layer
    );
    let _ = writeln!(
        text,
        "{:<24} {:>9} {:>12} {:>12} {:>8} {:>9} {:>8}",
        "region", "nodes", "volume cm3", "input cm3", "error %", "mean mm", "max mm"
    );
    for region in &r.regions {
        let error = 100.0 * (region.volume_mm3 / region.input_volume_mm3 - 1.0);
        let _ = writeln!(
            text,
            "{:<24} {:>9} {:>12.3} {:>12.3} {:>8.2} {:>9.3} {:>8.2}",
            region.name,
            region.nodes,
            region.volume_mm3 / 1e3,
            region.input_volume_mm3 / 1e3,
            error,
            region.surface_distance_mean_mm,
            region.surface_distance_max_mm
        );
    }
    let _ = writeln!(
        text,
        "outer surface: {} vertices, {} triangles, {}, {} part(s)",
        r.outer_surface.vertices,
        r.outer_surface.triangles,
        if r.outer_surface.closed {
            "closed"
        } else {
            "NOT closed"
        },
        r.outer_surface.components
    );
    let _ = writeln!(
        text,
        "shortest spring {:.2} spacings, {} bad cells, {} inverted; topology {}",
        r.quality.shortest_spring, r.quality.bad_cells, r.quality.inverted_cells, r.topology_hash
    );
    for warning in &r.warnings {
        let _ = writeln!(text, "warning: {warning}");
    }
    let _ = write!(
        text,
        "built in {:.2} s, {:.0} MB of memory at most",
        summary.seconds,
        summary.peak_memory_bytes as f64 / 1e6
    );
    text
}
