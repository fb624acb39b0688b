//! `palpate-server build`: from a scene to a model file.

use std::path::{Path, PathBuf};
use std::time::Instant;

use indicatif::{ProgressBar, ProgressStyle};
use palpate_anatomy::{BuildReport, RegionReport, SceneInput, build};
use palpate_tissue::file::ModelFile;
use serde::{Deserialize, Serialize};

use crate::export::{Exports, keep_apart, put_in_place};
use crate::{ServerError, memory};

/// Output of `build --json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct BuildSummary {
    /// Report of the builder.
    #[serde(flatten)]
    pub report: BuildReport,
    /// Seconds from the first file read to the model in memory.
    pub seconds: f64,
    /// Peak resident memory of the process in bytes until all files were written. A model file does not hold it, nor
    /// is it known on every system.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory_bytes: Option<u64>,
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
        peak_memory_bytes: None,
    };
    let report_json = serde_json::to_string(&summary).unwrap_or_default();
    Ok((ModelFile { model, report_json }, summary))
}

/// Builds a scene and writes the model file and the requested exports: all files or none. If `strict`, it writes none
/// where the report has deviations.
pub(crate) fn build_file(
    scene: &Path,
    output: &Path,
    exports: &Exports,
    strict: bool,
) -> Result<BuildSummary, ServerError> {
    let since = Instant::now();
    let input = SceneInput::load(scene)?;
    let sources: Vec<PathBuf> = (0..input.scene.regions.len())
        .map(|region| input.scene.source_path(region))
        .collect();
    let mut read: Vec<&Path> = sources.iter().map(PathBuf::as_path).collect();
    read.push(scene);
    // Checked before the build, which can take a minute, and again afterwards.
    let places: Vec<&Path> = exports.files().chain([output]).collect();
    keep_apart(&places, &read)?;
    let (file, mut summary) = build_model(&input, since)?;
    if !(strict && summary.report.deviations > 0) {
        let mut staged = exports.stage(&file.model)?;
        staged.push(file.stage(output)?);
        put_in_place(staged, &read)?;
    }
    summary.peak_memory_bytes = memory::peak_bytes();
    Ok(summary)
}

pub(crate) fn progress_bar() -> ProgressBar {
    // indicatif draws on standard error, and only on a terminal.
    let bar = ProgressBar::new(100);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {percent:>3} % {msg}") {
        bar.set_style(style);
    }
    bar
}

/// Maximum thin and lost parts in the text report; `--json` lists all.
const THIN_PARTS_SHOWN: usize = 10;

/// The report as a text table.
pub(crate) fn describe(summary: &BuildSummary) -> String {
    use std::fmt::Write as _;
    let r = &summary.report;
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = writeln!(
        text,
        "{} nodes, {} cells at {} mm; springs: {} structural, {} shear, {} body diagonals, {} layer",
        r.nodes,
        r.cells,
        r.spacing_mm,
        r.springs.structural,
        r.springs.shear,
        r.springs.body_diagonal,
        r.springs.layer
    );
    if let Some(s) = &r.spacing_search {
        let _ = writeln!(
            text,
            "spacing found from {} distances between interfaces: {:.0} % below {:.2} mm (least \
             {:.3}); not below {:.2} mm as asked nor {:.2} mm for memory",
            s.distances,
            100.0 * s.quantile,
            s.quantile_mm,
            s.smallest_mm,
            s.threshold_mm,
            s.memory_mm
        );
    }
    describe_regions(r, &mut text);
    for layer in &r.layers {
        let _ = writeln!(
            text,
            "interface {} | {}: {} nodes, {} springs in {} layer(s), {} of them small",
            layer.inside,
            layer.outside.as_deref().unwrap_or("outside"),
            layer.nodes,
            layer.springs,
            layer.components,
            layer.small_components
        );
    }
    describe_contacts(r, &mut text);
    let _ = writeln!(
        text,
        "outer surface: {} vertices, {} triangles, {}, {} part(s), {} self-intersections",
        r.outer_surface.vertices,
        r.outer_surface.triangles,
        closed(r.outer_surface.closed),
        r.outer_surface.components,
        r.outer_surface.self_intersections
    );
    describe_quality(r, &mut text);
    describe_bars(r, &mut text);
    describe_thin_parts(r, &mut text);
    for gap in &r.gaps {
        let _ = writeln!(text, "gap: {gap}");
    }
    for warning in &r.warnings {
        let _ = writeln!(text, "warning: {warning}");
    }
    let _ = write!(text, "built in {:.2} s", summary.seconds);
    if let Some(bytes) = summary.peak_memory_bytes {
        let _ = write!(
            text,
            ", {:.0} MB of memory at most ({:.0} bytes per node)",
            bytes as f64 / 1e6,
            bytes as f64 / r.nodes.max(1) as f64
        );
    }
    text
}

fn closed(closed: bool) -> &'static str {
    if closed { "closed" } else { "NOT closed" }
}

fn describe_regions(r: &BuildReport, text: &mut String) {
    use std::fmt::Write as _;
    let _ = writeln!(
        text,
        "{:<24} {:>9} {:>12} {:>12} {:>8} {:>7} {:>8} {:>7}",
        "region", "nodes", "volume cm3", "input cm3", "error %", "Dice", "differ %", "pieces"
    );
    for region in &r.regions {
        let error = 100.0 * (region.volume_mm3 / region.input_volume_mm3 - 1.0);
        // Reports of earlier versions have neither.
        let dice = if region.dice == 0.0 && region.difference_mm3 == 0.0 {
            "-".to_owned()
        } else {
            format!("{:.4}", region.dice)
        };
        let _ = writeln!(
            text,
            "{:<24} {:>9} {:>12.3} {:>12.3} {:>8.2} {:>7} {:>8.2} {:>7}",
            region.name,
            region.nodes,
            region.volume_mm3 / 1e3,
            region.input_volume_mm3 / 1e3,
            error,
            dice,
            100.0 * region.difference_part,
            format!("{}/{}", region.components, region.input_components),
        );
    }
    let _ = writeln!(
        text,
        "  (Dice coefficient with the input; differ: volume in one of the two only; pieces: model/input, without \
         crumbs below 1 mm3)"
    );
    describe_distances(&r.regions, text);
}

fn describe_distances(regions: &[RegionReport], text: &mut String) {
    use std::fmt::Write as _;
    let _ = writeln!(
        text,
        "{:<24} {:>9} {:>8} {:>8} {:>9} {:>8} {:>8} {:>8}",
        "distances in mm", "mean", "p99", "max", "back mean", "p99", "max", "sound"
    );
    for region in regions {
        let back = |mm: Option<f64>| mm.map_or_else(|| "-".to_owned(), |mm| format!("{mm:.3}"));
        let _ = writeln!(
            text,
            "{:<24} {:>9.3} {:>8.3} {:>8.3} {:>9} {:>8} {:>8} {:>8.3}",
            region.name,
            region.surface_distance_mean_mm,
            region.surface_distance_p99_mm,
            region.surface_distance_max_mm,
            back(region.input_distance_mean_mm),
            back(region.input_distance_p99_mm),
            back(region.input_distance_max_mm),
            region.distance_max_outside_thin_mm
        );
    }
    let _ = writeln!(
        text,
        "  (model surface of each region from its input surface, and back; sound: largest either way outside of thin \
         parts)"
    );
}

fn describe_contacts(r: &BuildReport, text: &mut String) {
    use std::fmt::Write as _;
    for contact in &r.contacts {
        let [a, b] = &contact.regions;
        let _ = writeln!(
            text,
            "contact {a} | {b}: {:.1} mm2 in the model, {:.1} in the input; {:.1} created, {:.1} removed",
            contact.model_mm2, contact.input_mm2, contact.created_mm2, contact.removed_mm2
        );
    }
}

fn describe_quality(r: &BuildReport, text: &mut String) {
    use std::fmt::Write as _;
    let q = &r.quality;
    let _ = writeln!(
        text,
        "shortest spring {:.2} spacings, least corner {:.3}, {} bad cells, {} inverted; topology {}",
        q.shortest_spring, q.least_corner, q.bad_cells, q.inverted_cells, r.topology_hash
    );
    let deciles: Vec<String> = q.scaled_jacobian.iter().map(ToString::to_string).collect();
    let _ = writeln!(
        text,
        "cells by scaled Jacobian, 0 to 1 in tenths: {}",
        deciles.join(" ")
    );
    let _ = writeln!(
        text,
        "{} nodes between two near interfaces went to the nearer one, {} left theirs for good \
         cells; {} cells changed region for manifold surfaces",
        q.nodes_tied, q.nodes_let_go, q.cells_flipped
    );
}

fn describe_bars(r: &BuildReport, text: &mut String) {
    use std::fmt::Write as _;
    for bar in &r.bars {
        let [x, y, z] = bar.cells;
        let along = ["x", "y", "z"][bar.axis.min(2)];
        let percent = |measured: f64, expected: f64| 100.0 * (measured / expected - 1.0);
        let _ = match (bar.measured_kpa, bar.measured_poisson) {
            (Some(young), Some(ratio)) => writeln!(
                text,
                "bar of {}, {x} x {y} x {z} cells pulled along {along}: {:.3} kPa asked for, {young:.3} \
                 shown ({:+.1} %); Poisson's ratio {:.3} asked for, {ratio:.3} shown ({:+.1} %)",
                bar.region,
                bar.expected_kpa,
                percent(young, bar.expected_kpa),
                bar.expected_poisson,
                percent(ratio, bar.expected_poisson)
            ),
            _ if x == 0 => writeln!(
                text,
                "bar of {}: the region is too thin for one",
                bar.region
            ),
            _ => writeln!(
                text,
                "bar of {}, {x} x {y} x {z} cells pulled along {along}: found no equilibrium",
                bar.region
            ),
        };
    }
}

fn describe_thin_parts(r: &BuildReport, text: &mut String) {
    use std::fmt::Write as _;
    let parts = &r.thin.parts;
    for part in parts.iter().take(THIN_PARTS_SHOWN) {
        let _ = writeln!(text, "thin: {part}");
    }
    let more = parts.len().saturating_sub(THIN_PARTS_SHOWN) + r.thin.more;
    if more > 0 {
        let _ = writeln!(
            text,
            "thin: and {more} smaller parts (--json lists more of them)"
        );
    }
}
