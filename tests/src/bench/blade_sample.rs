//! `bench blade-sample`: a blade that cuts a model beside a pressing ball, sample by sample.
//!
//! A sample adds 1 mm of path. A cut also contains the last three spacings of the path before it, as in a session. Processor
//! time of one thread, without other work of the program: the topology and the change of the levels on the cut thread, and
//! their adoption on the hand's thread. A sample between two layers of cells, or beside the model, opens no face.

use std::fmt;
use std::sync::Arc;

use clap::Args;
use palpate_client::realtime::worked;
use palpate_tissue::{
    BladePoint, Budget, CutError, CutPreparer, CutStroke, Tissue, Tool, Topology,
};
use serde::Serialize;

use super::work::Work;
use super::{Benchmark, OnStage, on_threads};
use crate::test_model::TestModel;
use crate::tool_location::ToolLocation;

/// Path of a sample, m.
const SAMPLE_M: f64 = 1e-3;
/// Path of earlier samples in each cut, in spacings.
const OVERLAP: f64 = 3.0;
/// Largest distance of the first strokes from the ball, and between strokes on a side, m.
const BESIDE_M: f64 = 0.014;
const APART_M: f64 = 6e-3;
/// Largest length of a stroke, m.
const LENGTH_M: f64 = 0.076;
/// Blade length outside the tissue, m.
const OUTSIDE_M: f64 = 4e-3;
/// Radius of the ball, its depth and its tremor, m.
const BALL_M: [f64; 3] = [8e-3, 4e-3, 0.05e-3];
/// Steps of the ball before the first stroke, and after each sample.
const STEPS: [usize; 2] = [50, 4];

#[derive(Debug, Clone, Args)]
pub struct BladeSample {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(default_value = "thigh")]
    model: String,
    /// Number of parallel strokes
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=8))]
    strokes: u8,
    /// Depth of the blade, mm
    #[arg(long, default_value_t = 10.0)]
    depth_mm: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct BladeSampleReport {
    pub nodes: usize,
    pub strokes: u8,
    pub depth_mm: f64,
    /// The first sample of each stroke opens the path of the overlap, and is in no other row.
    pub first: Work,
    /// Topology and levels of all other samples.
    pub samples: Work,
    /// The same of those that opened faces, and its parts.
    pub opening: Work,
    pub topology: Work,
    pub levels: Work,
    /// Adoption of opening samples on the hand's thread.
    pub hand: Work,
}

/// Processor time of a sample in ms.
struct Sample {
    is_first: bool,
    topology_ms: f64,
    /// Levels and adoption, if faces were opened.
    opened_ms: Option<[f64; 2]>,
}

impl Benchmark for BladeSample {
    type Report = BladeSampleReport;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<BladeSampleReport, String> {
        if !(1.0..=50.0).contains(&self.depth_mm) {
            let depth = self.depth_mm;
            return Err(format!("--depth-mm {depth} must be from 1 to 50"));
        }
        let model = TestModel::in_memory(&self.model, progress)?;
        on_threads(1, || self.run(&Topology::new(Arc::clone(&model)), progress))?
    }
}

impl BladeSample {
    fn run(
        &self,
        topology: &Topology,
        progress: &mut OnStage<'_>,
    ) -> Result<BladeSampleReport, String> {
        let location = ToolLocation::find(topology)?;
        let mut tissue = Tissue::new(Arc::clone(topology.model()));
        let mut preparer = tissue.preparer();
        let mut ball = Ball { location, steps: 0 };
        ball.press(&mut tissue, STEPS[0]);
        let mut samples = Vec::new();
        for i in 0..self.strokes {
            progress(&format!("stroke {} of {}", i + 1, self.strokes));
            let side = if i % 2 == 0 { 1.0 } else { -1.0 };
            let across = side * (BESIDE_M + APART_M * f64::from(i / 2)) * ball.location.scale();
            let path = self.path(&ball.location, across);
            let overlap = (OVERLAP * ball.location.spacing_m / SAMPLE_M).ceil() as usize;
            for (k, points) in path.windows(overlap + 1).enumerate() {
                let stroke = CutStroke {
                    points: points.to_vec(),
                    width_m: 0.0,
                };
                samples.push(Sample::take(k == 0, &stroke, &mut preparer, &mut tissue)?);
                ball.press(&mut tissue, STEPS[1]);
            }
        }
        let later = || samples.iter().filter(|s| !s.is_first);
        let opened = || later().filter_map(|s| Some((s.topology_ms, s.opened_ms?)));
        if opened().next().is_none() {
            let room = LENGTH_M * ball.location.scale() * 1e3;
            return Err(format!(
                "no sample opens a face: there is room for strokes of {room:.0} mm; use a finer or larger model, or a deeper blade"
            ));
        }
        let work = |times: Vec<f64>| Work::of(&times);
        Ok(BladeSampleReport {
            nodes: topology.node_count(),
            strokes: self.strokes,
            depth_mm: self.depth_mm,
            first: work(
                samples
                    .iter()
                    .filter(|s| s.is_first)
                    .map(Sample::cut_ms)
                    .collect(),
            ),
            samples: work(later().map(Sample::cut_ms).collect()),
            opening: work(
                opened()
                    .map(|(topology, [levels, _])| topology + levels)
                    .collect(),
            ),
            topology: work(opened().map(|(topology, _)| topology).collect()),
            levels: work(opened().map(|(_, [levels, _])| levels).collect()),
            hand: work(opened().map(|(_, [_, hand])| hand).collect()),
        })
    }

    /// Points of a stroke along the location's v, at a distance from its centre.
    fn path(&self, location: &ToolLocation, across: f64) -> Vec<BladePoint> {
        let depth = self.depth_mm * 1e-3;
        let length = LENGTH_M * location.scale();
        let points = (length / SAMPLE_M) as u32;
        let at = |k: u32| {
            let along = SAMPLE_M * (f64::from(k) - 0.5 * f64::from(points));
            BladePoint {
                tip: location.surface(across, along).at - location.normal * depth,
                axis: location.normal,
                depth_m: depth + OUTSIDE_M,
            }
        };
        (0..=points).map(at).collect()
    }
}

/// A ball that presses and trembles, so that every step solves.
struct Ball {
    location: ToolLocation,
    steps: usize,
}

impl Ball {
    fn press(&mut self, tissue: &mut Tissue, steps: usize) {
        let [radius, depth, tremor] = BALL_M;
        for _ in 0..steps {
            let height = radius - depth + tremor * f64::from(self.steps as u32 % 2);
            let at = self.location.middle + self.location.normal * height;
            let hand = Budget {
                near: true,
                ..Budget::new(4, 0.02)
            };
            tissue.step(&[Tool::ball(1, at, radius)], hand);
            self.steps += 1;
        }
    }
}

impl Sample {
    fn take(
        is_first: bool,
        stroke: &CutStroke,
        preparer: &mut CutPreparer,
        tissue: &mut Tissue,
    ) -> Result<Self, String> {
        let ms = |from| (worked() - from).as_secs_f64() * 1e3;
        let from = worked();
        let cut = preparer.cut(stroke);
        let topology_ms = ms(from);
        let opened_ms = match cut {
            Ok(cut) => {
                let from = worked();
                let cut = cut.finish();
                let levels = ms(from);
                let from = worked();
                let retired = tissue.succeed(cut);
                let hand = ms(from);
                drop(retired);
                Some([levels, hand])
            }
            Err(CutError::NothingNew | CutError::NoTissue) => None,
            Err(error) => return Err(error.to_string()),
        };
        Ok(Self {
            is_first,
            topology_ms,
            opened_ms,
        })
    }

    fn cut_ms(&self) -> f64 {
        self.topology_ms + self.opened_ms.map_or(0.0, |[levels, _]| levels)
    }
}

impl fmt::Display for BladeSampleReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} nodes, {} strokes of {} mm depth; processor time of one thread per sample of 1 mm, in ms",
            self.nodes, self.strokes, self.depth_mm
        )?;
        write!(
            f,
            "{:<28} {:>7} {:>7} {:>7} {:>7} {:>7}",
            "", "samples", "mean", "p50", "p99", "max"
        )?;
        for (name, work) in [
            ("first of a stroke", &self.first),
            ("all others", &self.samples),
            ("those that open faces", &self.opening),
            ("  of it topology", &self.topology),
            ("  of it levels", &self.levels),
            ("adoption by the hand", &self.hand),
        ] {
            let Work {
                count,
                mean_ms,
                p50_ms,
                p99_ms,
                max_ms,
            } = work;
            write!(
                f,
                "\n{name:<28} {count:>7} {mean_ms:>7.2} {p50_ms:>7.2} {p99_ms:>7.2} {max_ms:>7.2}"
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_model::soft_block;

    #[test]
    fn every_sample_is_timed_and_each_layer_of_cells_opens_once() {
        let model = Arc::new(soft_block([28, 20, 10], 5e-3));
        let bench = BladeSample {
            model: String::new(),
            strokes: 2,
            depth_mm: 10.0,
        };
        let report = bench.run(&Topology::new(model), &mut |_| {}).unwrap();
        assert_eq!(report.first.count, 2);
        let per_stroke = report.samples.count / 2;
        assert!((10..=76).contains(&per_stroke), "{report}");
        // 1 mm of path at a spacing of 5 mm.
        let expected = report.samples.count / 5;
        assert!(report.opening.count.abs_diff(expected) <= 4, "{report}");
        assert!(report.hand.mean_ms > 0.0 && report.topology.mean_ms > 0.0);
    }
}
