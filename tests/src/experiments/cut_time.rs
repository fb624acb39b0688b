//! Time of a blade sample over the length of a cut, against the size of the model (Lin 2007, fig 7.13).
//!
//! A blade cuts straight through the middle of a block at constant speed, under a pressing ball. Every sample adds
//! 1 mm of path; each cut also has the path of three spacings before it, so that the sheet continues. Processor time of
//! one thread, without other work: the topology and the change of the levels, the hand's tissue that follows, and its
//! next step.

use std::sync::Arc;

use palpate_client::realtime::worked;
use palpate_tissue::{BladePoint, Budget, CutError, CutStroke, Tissue, Tool, Vec3};
use rayon::ThreadPoolBuilder;
use serde::Serialize;
use serde_json::json;

use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::bench::quantile;
use crate::chart::{BLUE, Chart, GREEN, Line, ORANGE, Panel};
use crate::test_model::soft_block;

/// Nodes per edge of the blocks: 10,000, 97,000 and a million nodes. The smallest is as wide as the cut is long.
const SIZES: [(usize, &str); 3] = [(22, GREEN), (46, BLUE), (100, ORANGE)];
/// Lattice spacing, m.
const SPACING_M: f64 = 4e-3;
/// Path of a sample, m.
const SAMPLE_M: f64 = 1e-3;
/// Samples of earlier path in each cut: three spacings.
const OVERLAP: usize = 12;
const SAMPLES: usize = 60;
/// Depth of the blade, m.
const DEPTH_M: f64 = 0.018;
/// Radius and depth of the ball, m.
const BALL_M: [f64; 2] = [8e-3, 4e-3];

const COLUMNS: [Column; 16] = [
    ("nodes", "nodes", 1.0),
    ("first cut (ms)", "first_ms", 1.0),
    ("opening samples", "opening", 1.0),
    ("cut p50 (ms)", "cut.p50_ms", 1.0),
    ("cut p99", "cut.p99_ms", 1.0),
    ("cut max", "cut.max_ms", 1.0),
    ("p50 / smaller", "cut_ratio", 1.0),
    ("other samples p50 (ms)", "other.p50_ms", 1.0),
    ("other p99", "other.p99_ms", 1.0),
    ("other max", "other.max_ms", 1.0),
    ("follow p50 (ms)", "follow.p50_ms", 1.0),
    ("follow max", "follow.max_ms", 1.0),
    ("next step p50 (ms)", "step.p50_ms", 1.0),
    ("next step max", "step.max_ms", 1.0),
    ("other steps p50 (ms)", "quiet_step.p50_ms", 1.0),
    ("other steps p99", "quiet_step.p99_ms", 1.0),
];

/// Processor times in ms.
#[derive(Debug, Clone, Copy, Serialize)]
struct Times {
    p50_ms: f64,
    p99_ms: f64,
    max_ms: f64,
}

impl Times {
    fn of(times: &[f64]) -> Self {
        Self {
            p50_ms: quantile(times, 0.5),
            p99_ms: quantile(times, 0.99),
            max_ms: quantile(times, 1.0),
        }
    }
}

/// A blade sample: end of its path in mm, and processor times in ms.
struct Sample {
    path_mm: f64,
    /// Topology and change of the levels.
    cut_ms: f64,
    /// The hand's tissue follows; `None` if the sample opened no face, because it is between two planes of cells.
    follow_ms: Option<f64>,
    /// The hand's next four steps.
    steps_ms: [f64; 4],
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let mut rows = Vec::new();
    let mut course = Table::new("nodes,path_mm,cut_ms,follow_ms,step_ms");
    let (mut cuts, mut follows) = (Vec::new(), Vec::new());
    let mut smaller: Option<f64> = None;
    for (part, (edge, colour)) in SIZES.into_iter().enumerate() {
        let done = part as f64 / SIZES.len() as f64;
        (bench.progress)(&format!("cutting a block of {edge} nodes per edge"), done);
        let (nodes, samples) = measure(edge - 1, SAMPLES)?;
        let is_opening = |s: &&Sample| s.follow_ms.is_some();
        // The first cut builds the index of cells and makes the first copies.
        let (first, later) = samples.split_first().ok_or("no sample was made")?;
        let opening = || later.iter().filter(is_opening);
        let others = || later.iter().filter(|s| !is_opening(s));
        let cut = Times::of(&opening().map(|s| s.cut_ms).collect::<Vec<_>>());
        let other = Times::of(&others().map(|s| s.cut_ms).collect::<Vec<_>>());
        let follow = opening().filter_map(|s| s.follow_ms).collect::<Vec<_>>();
        let step = opening().map(|s| s.steps_ms[0]).collect::<Vec<_>>();
        let quiet = later.iter().flat_map(|s| &s.steps_ms[1..]).copied();
        let quiet = quiet.chain(others().map(|s| s.steps_ms[0]));
        rows.push(json!({
            "nodes": nodes,
            "first_ms": first.cut_ms,
            "opening": follow.len(),
            "cut": cut,
            "other": other,
            "cut_ratio": smaller.map(|ms| cut.p50_ms / ms),
            "follow": Times::of(&follow),
            "step": Times::of(&step),
            "quiet_step": Times::of(&quiet.collect::<Vec<_>>()),
        }));
        smaller = Some(cut.p50_ms);
        for s in &samples {
            let follow = s.follow_ms.map_or(String::new(), |ms| format!("{ms:.4}"));
            let figures = [s.path_mm, s.cut_ms].map(|v| format!("{v:.4}"));
            let [path, cut] = figures;
            let step = format!("{:.4}", s.steps_ms[0]);
            course
                .rows
                .push(vec![nodes.to_string(), path, cut, follow, step]);
        }
        let name = format!("{nodes} nodes");
        let points = samples.iter().map(|s| (s.path_mm, s.cut_ms));
        cuts.push(Line::new(name.clone(), colour, points));
        let points = samples
            .iter()
            .filter_map(|s| Some((s.path_mm, s.follow_ms? + s.steps_ms[0])));
        follows.push(Line::new(name, colour, points));
    }
    let panels = vec![
        Panel::new("Cut: topology and levels", "time (ms)", cuts),
        Panel::new(
            "Hand's tissue: change to the new topology, and its next step",
            "time (ms)",
            follows,
        ),
    ];
    Ok(Outcome {
        caption: "Processor time of each blade sample of 1 mm over the length of a cut of 18 mm depth at 4 mm spacing, under \
                  a pressing ball (fig 7.13). The cut runs through the middle of blocks of three sizes. Every fourth \
                  sample reaches the next plane of cells and opens faces; the others open none. The first cut also builds \
                  an index of the cells and is not in the quantiles. The ratio is that of the median of the opening \
                  samples to the one of the next smaller block. \
                  One run on this machine: other load changes the rare long samples."
            .to_owned(),
        figures: json!({ "experiment": "cut-time", "sizes": rows }),
        charts: vec![(
            "cut-time".to_owned(),
            Chart::new("Time of a blade sample", "path of the blade (mm)", panels),
        )],
        tables: vec![
            ("cut-time".to_owned(), Table::of_objects(&rows, &COLUMNS)),
            ("cut-time-samples".to_owned(), course),
        ],
        ..Outcome::default()
    })
}

/// [`samples`] on a thread whose parallel loops stay on it, like those of a cut thread.
fn measure(cells: usize, count: usize) -> Result<(usize, Vec<Sample>), String> {
    let alone = || {
        let pool = ThreadPoolBuilder::new().num_threads(1).use_current_thread();
        let _pool = pool.build().map_err(|e| e.to_string())?;
        samples(cells, count)
    };
    let measured = std::thread::scope(|scope| scope.spawn(alone).join());
    measured.map_err(|_| "the measuring thread has panicked".to_owned())?
}

/// Nodes of the block before the cut, and the samples.
fn samples(cells: usize, count: usize) -> Result<(usize, Vec<Sample>), String> {
    let model = Arc::new(soft_block([cells; 3], SPACING_M));
    let nodes = model.nodes.len();
    let side = cells as f64 * SPACING_M;
    let mut tissue = Tissue::new(model);
    let mut preparer = tissue.preparer();
    let ball = |k: usize| {
        let [radius, depth] = BALL_M;
        // It trembles, so that every step solves.
        let height = side + radius - depth + 0.05e-3 * f64::from(k as u32 % 2);
        Tool::ball(1, Vec3::new(0.5 * side, 0.5 * side + 0.012, height), radius)
    };
    let hand = || Budget {
        near: true,
        ..Budget::new(4, 0.02)
    };
    for k in 0..50 {
        tissue.step(&[ball(k)], hand());
    }
    // Off the planes of the lattice, towards the ball from 30 mm away.
    let start = Vec3::new(0.5 * side - 0.03, 0.5 * side + 0.3 * SPACING_M, side);
    let point = |k: usize| BladePoint {
        tip: start + Vec3::new(SAMPLE_M * k as f64, 0.0, -DEPTH_M),
        axis: Vec3::z(),
        depth_m: DEPTH_M + SPACING_M,
    };
    let ms = |from| (worked() - from).as_secs_f64() * 1e3;
    let mut samples = Vec::new();
    for k in OVERLAP..OVERLAP + count {
        let stroke = CutStroke {
            points: (k - OVERLAP..=k).map(point).collect(),
            width_m: 0.0,
        };
        let from = worked();
        let cut = preparer.prepare(&stroke);
        let cut_ms = ms(from);
        let follow_ms = match cut {
            Ok(cut) => {
                let from = worked();
                let retired = tissue.succeed(cut);
                let took = ms(from);
                drop(retired);
                Some(took)
            }
            Err(CutError::NothingNew) => None,
            Err(error) => return Err(error.to_string()),
        };
        let steps_ms = std::array::from_fn(|step| {
            let from = worked();
            tissue.step(&[ball(k + step)], hand());
            ms(from)
        });
        samples.push(Sample {
            path_mm: k as f64 * SAMPLE_M * 1e3,
            cut_ms,
            follow_ms,
            steps_ms,
        });
    }
    Ok((nodes, samples))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sample_is_timed_and_each_plane_of_cells_opens_once() {
        let (nodes, samples) = measure(21, 24).unwrap();
        assert_eq!((nodes, samples.len()), (22_usize.pow(3), 24));
        let opening = samples.iter().filter(|s| s.follow_ms.is_some()).count();
        // 24 mm of path at 4 mm spacing; the first sample opens its whole path.
        assert!((6..=8).contains(&opening), "{opening}");
        for sample in &samples {
            assert!(sample.cut_ms > 0.0 && sample.steps_ms.iter().all(|ms| *ms > 0.0));
        }
        let step = samples.windows(2).map(|w| w[1].path_mm - w[0].path_mm);
        assert!(step.fold(0.0, |worst: f64, s| worst.max((s - 1.0).abs())) < 1e-9);
    }
}
