//! The report of `cut`.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use palpate_anatomy::export::StlFigures;
use serde::{Deserialize, Serialize};

/// Most refused strokes and components in the text; `--json` lists all.
const LINES_MAX: usize = 12;

/// Output of `cut --json`; also kept in the model file, where `inspect --json` prints it in the list `cuts`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CutSummary {
    /// Strokes of the file.
    pub operations: usize,
    /// Strokes that cut.
    pub applied: usize,
    /// Strokes that did not; they changed nothing.
    pub refused: Vec<RefusedStroke>,
    /// Connected components of the cells, the largest first.
    pub components: Vec<Component>,
    /// Volume before the first stroke.
    pub volume_before_mm3: f64,
    /// Volume after the last one.
    pub volume_after_mm3: f64,
    /// Mass before the first stroke.
    pub mass_before_kg: f64,
    /// Mass after the last one.
    pub mass_after_kg: f64,
    /// The outer surface with the walls of the wounds.
    pub boundary: BoundaryFigures,
    /// Deviations of the STL from the model, where one was asked for.
    #[serde(default)]
    pub stl: Option<StlFigures>,
    /// Cells that are inside out at a corner or as a whole.
    pub inverted_cells: usize,
    /// Shortest spring at rest.
    pub shortest_spring_mm: f64,
    /// Largest distance of a node of a sheet from the surface that its stroke swept, without nodes of pinned regions. A
    /// width moves the nodes of both sides by up to a twentieth of the spacing.
    pub path_distance_max_mm: f64,
    /// Nodes of sheets that could not reach the swept surface without damage to a cell.
    pub nodes_short: usize,
    /// Largest distance of an interface node from the interface before the cuts.
    pub interface_drift_max_mm: f64,
    /// Triangles of the walls of all wounds, by region; wounds of earlier runs count.
    pub wound_triangles: BTreeMap<String, usize>,
    /// Wall time of the strokes that cut.
    pub sample_ms: SampleTimes,
    /// Hash of wiring, cuts and rest positions, as a session with the same strokes has it.
    pub topology_hash: String,
    /// Hash of the written model, as `inspect` prints it.
    pub model_hash: String,
}

/// A stroke that was not applied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RefusedStroke {
    /// Its position in the file; the first is 0.
    pub index: usize,
    /// The reason.
    pub why: String,
}

/// A connected component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Component {
    /// Its nodes.
    pub nodes: usize,
    /// Its volume.
    pub volume_mm3: f64,
}

/// Figures of the outer surface.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct BoundaryFigures {
    /// Whether every edge belongs to exactly two triangles.
    pub closed: bool,
    /// Edges that do not.
    pub edges_not_two: usize,
    /// Pairs of triangles of which an edge of one passes through the inside of the other.
    pub self_intersections: usize,
}

/// Quantiles of the time of a whole stroke.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SampleTimes {
    /// The unit that one sample measures: always `stroke`.
    pub per: String,
    /// Median in ms.
    pub p50: f64,
    /// 99th percentile in ms.
    pub p99: f64,
    /// Longest in ms.
    pub max: f64,
}

/// The summary as text.
pub(crate) fn describe(summary: &CutSummary) -> String {
    let s = summary;
    let mut text = format!("{} of {} strokes applied", s.applied, s.operations);
    // Writing to a string does not fail.
    for refused in s.refused.iter().take(LINES_MAX) {
        let _ = write!(text, "\nstroke {} refused: {}", refused.index, refused.why);
    }
    if s.refused.len() > LINES_MAX {
        let more = s.refused.len() - LINES_MAX;
        let _ = write!(text, "\nand {more} more refused strokes (--json lists all)");
    }
    let change = 100.0 * (s.volume_after_mm3 / s.volume_before_mm3 - 1.0);
    let _ = write!(
        text,
        "\nvolume {:.3} cm3 ({change:+.4} %), mass {:.4} kg before and {:.4} kg after",
        s.volume_after_mm3 / 1e3,
        s.mass_before_kg,
        s.mass_after_kg
    );
    let _ = write!(text, "\n{} component(s)", s.components.len());
    for component in s.components.iter().take(LINES_MAX) {
        let (nodes, volume) = (component.nodes, component.volume_mm3 / 1e3);
        let _ = write!(text, "\n  {nodes:>9} nodes {volume:>12.3} cm3");
    }
    let b = &s.boundary;
    let _ = write!(
        text,
        "\nsurface {}, {} edges not in two triangles, {} self-intersections; {} inverted cells",
        if b.closed { "closed" } else { "NOT closed" },
        b.edges_not_two,
        b.self_intersections,
        s.inverted_cells
    );
    if let Some(stl) = &s.stl {
        let _ = write!(
            text,
            "\nSTL: {} self-intersections, nodes at most {:.3} mm from those of the model",
            stl.self_intersections, stl.moved_max_mm
        );
        for [x, y, z] in &stl.places_mm {
            let _ = write!(text, "\n  self-intersection at ({x:.1}, {y:.1}, {z:.1}) mm");
        }
    }
    let _ = write!(
        text,
        "\nshortest spring {:.3} mm; sheet at most {:.3} mm from the path ({} nodes short), interfaces at most {:.3} mm \
         from theirs",
        s.shortest_spring_mm, s.path_distance_max_mm, s.nodes_short, s.interface_drift_max_mm
    );
    for (region, count) in &s.wound_triangles {
        let _ = write!(text, "\n  {count:>9} wound triangles of {region}");
    }
    let t = &s.sample_ms;
    let _ = write!(
        text,
        "\ntime per stroke {:.2} ms (median), {:.2} ms (p99), {:.2} ms (longest)\ntopology {}, model {}",
        t.p50, t.p99, t.max, s.topology_hash, s.model_hash
    );
    text
}
