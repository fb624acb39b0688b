//! `bench press-cube`: a cube pressed by a disc, a published case of other engines.
//!
//! A cube of side 0.1 m with `n` nodes per edge and E = 10 kPa stands on a pinned base. The nodes within 12.5
//! mm of the centre of its top are displaced 1 mm down. Cold start: from rest until the rms displacement error
//! against the converged solution stays below 1 %. Moving: ten steps of 0.1 mm, each to 0.5 %.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use clap::Args;
use palpate_tissue::{Budget, Material, Shape, Tissue, Topology, Vec3, block};
use serde::Serialize;

use super::{Benchmark, OnStage, on_threads};

const SIDE_M: f64 = 0.1;
/// Radius of the disc, m.
const DISC_M: f64 = 0.0125;
const DEPTH_M: f64 = 1e-3;
const STEPS: usize = 10;
/// Maximum error of the cold start, and per step when moving.
const ERRORS: [f64; 2] = [0.01, 0.005];
/// Tolerance of the cold start with counted iterations.
const TOLERANCE: f64 = 1e-3;
/// Candidate tolerances of a moving step: first, last, and ratio. The loosest one that keeps all errors within
/// bounds is used.
const TOLERANCES: [f64; 3] = [3e-2, 1e-4, 0.9];
/// Tolerance of the first moving step; later steps start from its shape.
const FIRST: f64 = 1e-4;
const CONVERGED: f64 = 1e-6;
const ITERATIONS_MAX: usize = 100;
/// Timed runs; the median counts.
const RUNS: usize = 5;

#[derive(Debug, Clone, Copy, Args)]
pub struct PressCube {
    /// Nodes per edge: 20 makes 8,000 nodes, 40 64,000, 100 a million
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u16).range(4..=160))]
    pub nodes: u16,
    /// Threads
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub threads: u16,
    /// Poisson's ratio, 0.25 to 0.49; 0.25 is springs alone
    #[arg(long, default_value_t = 0.25)]
    pub poisson: f64,
    /// Also press in ten steps of 0.1 mm
    #[arg(long)]
    pub moving: bool,
}

impl Benchmark for PressCube {
    type Report = PressCubeReport;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<PressCubeReport, String> {
        if !(0.25..=0.49).contains(&self.poisson) {
            return Err(format!(
                "--poisson {} must be between 0.25 (springs alone) and 0.49",
                self.poisson
            ));
        }
        on_threads(usize::from(self.threads), || self.run(progress))
    }
}

#[derive(Debug, Clone, Serialize)]
pub struct PressCubeReport {
    pub nodes: usize,
    pub springs: usize,
    pub poisson: f64,
    /// Setup of bricks and coarse lattices, once per topology, ms.
    pub setup_ms: f64,
    /// Time from rest to an rms error below 1 %, ms; `None` if not reached.
    pub ms_to_one_percent: Option<f64>,
    pub iterations_to_one_percent: usize,
    /// Remaining error, relative.
    pub error: f64,
    /// Time from rest to a relative residual of 1e-6, ms; `None` if not reached.
    pub ms_to_converged: Option<f64>,
    pub iterations_to_converged: usize,
    pub residual: f64,
    /// Converged force on the disc, N.
    pub force_n: f64,
    pub moving: Option<MovingReport>,
}

#[derive(Debug, Clone, Serialize)]
pub struct MovingReport {
    /// Duration of the first step, from rest, ms.
    pub first_ms: f64,
    pub first_iterations: usize,
    /// Relative residual requested in the other steps.
    pub tolerance: f64,
    /// Iterations of each step; 0 if the shape was within the tolerance.
    pub iterations: Vec<usize>,
    /// Median, mean and maximum of their durations, ms.
    pub ms_per_step: [f64; 3],
    /// Largest rms displacement error after a step, relative.
    pub worst_error: f64,
}

struct Cube {
    topology: Arc<Topology>,
    disc: Vec<u32>,
}

impl Cube {
    fn new(n: usize, poisson: f64) -> Self {
        let spacing = SIDE_M / (n as f64 - 1.0);
        let material = Material {
            young_pa: 10e3,
            poisson,
            ..Material::default()
        };
        // The lowest layer is the base; the cube stands on its top nodes.
        let model = block([n - 1, n - 1, n], spacing, &material, 1);
        let topology = Arc::new(Topology::new(Arc::new(model)));
        let top = Vec3::new(0.5 * SIDE_M, 0.5 * SIDE_M, spacing + SIDE_M);
        let under = |&node: &u32| {
            let d = topology.rest(node) - top;
            d.z.abs() < 1e-3 * spacing && d.norm() <= DISC_M + 1e-9
        };
        let disc = (0..topology.node_count() as u32).filter(under).collect();
        Self { topology, disc }
    }

    fn press(&self, tissue: &mut Tissue, depth: f64) {
        for &node in &self.disc {
            tissue.hold(node, Vec3::z() * -depth);
        }
    }

    /// Solves from rest with a number of iterations; returns the tissue and the duration in ms.
    fn cold(&self, like: &Tissue, iterations: usize, tolerance: f64) -> (Tissue, f64) {
        let mut tissue = like.another();
        self.press(&mut tissue, DEPTH_M);
        let ms = step(&mut tissue, iterations, tolerance);
        (tissue, ms)
    }
}

/// Solves; returns the duration in ms.
fn step(tissue: &mut Tissue, iterations: usize, tolerance: f64) -> f64 {
    let began = Instant::now();
    tissue.step(&[], Budget::new(iterations, tolerance));
    began.elapsed().as_secs_f64() * 1e3
}

fn error(shape: &Shape, exact: &Shape) -> f64 {
    let pairs = shape.displacement.iter().zip(&exact.displacement);
    let (mut difference, mut size) = (0.0, 0.0);
    for (a, b) in pairs {
        difference += (a - b).norm_squared();
        size += b.norm_squared();
    }
    (difference / size).sqrt()
}

impl PressCube {
    pub fn run(&self, progress: &mut OnStage<'_>) -> PressCubeReport {
        progress("making the cube");
        let cube = Cube::new(usize::from(self.nodes), self.poisson);
        let began = Instant::now();
        let first = Tissue::at_rest(Arc::clone(&cube.topology));
        let setup_ms = began.elapsed().as_secs_f64() * 1e3;
        progress("converging");
        let (exact, converged_ms) = cube.cold(&first, ITERATIONS_MAX, CONVERGED);
        let report = exact.report().clone();
        let force: f64 = cube.disc.iter().map(|&n| exact.force_on(n).z).sum();
        progress("from rest to 1 %");
        let mut iterations = 1;
        let mut left = f64::INFINITY;
        while iterations < ITERATIONS_MAX {
            left = error(
                cube.cold(&first, iterations, TOLERANCE).0.shape(),
                exact.shape(),
            );
            if left < ERRORS[0] {
                break;
            }
            iterations += 1;
        }
        let times: Vec<f64> = (0..RUNS)
            .map(|_| cube.cold(&first, iterations, TOLERANCE).1)
            .collect();
        let nodes = 0..cube.topology.node_count() as u32;
        let springs: usize = nodes.map(|n| cube.topology.springs_of(n).len()).sum();
        PressCubeReport {
            nodes: usize::from(self.nodes).pow(3),
            springs: springs / 2,
            poisson: self.poisson,
            setup_ms,
            ms_to_one_percent: (left < ERRORS[0]).then(|| super::median(&times)),
            iterations_to_one_percent: iterations,
            error: left,
            ms_to_converged: (report.residual <= CONVERGED).then_some(converged_ms),
            iterations_to_converged: report.iterations,
            residual: report.residual,
            force_n: force,
            moving: self.moving.then(|| moving(&cube, &first, progress)),
        }
    }
}

/// Presses in steps. The first one solves from rest to a residual of 1e-4, so that the others begin at an
/// equilibrium; those use the loosest tolerance that keeps every error within bounds.
fn moving(cube: &Cube, like: &Tissue, progress: &mut OnStage<'_>) -> MovingReport {
    progress("converging the moving press");
    let depth = |step: usize| DEPTH_M * (step + 1) as f64 / STEPS as f64;
    let mut tissue = like.another();
    let exact: Vec<Shape> = (0..STEPS)
        .map(|s| {
            cube.press(&mut tissue, depth(s));
            step(&mut tissue, ITERATIONS_MAX, CONVERGED);
            tissue.shape().clone()
        })
        .collect();
    progress("moving");
    let run = |tolerance: f64| {
        let mut tissue = like.another();
        let mut steps: Vec<Moved> = exact
            .iter()
            .enumerate()
            .map(|(s, exact)| {
                cube.press(&mut tissue, depth(s));
                let tolerance = if s == 0 { FIRST } else { tolerance };
                let ms = step(&mut tissue, ITERATIONS_MAX, tolerance);
                Moved {
                    ms,
                    error: error(tissue.shape(), exact),
                    iterations: tissue.report().iterations,
                }
            })
            .collect();
        let first = steps.remove(0);
        (first, steps)
    };
    let good = |moved: &Moved| moved.error <= ERRORS[1];
    let [loosest, tightest, factor] = TOLERANCES;
    let tolerance = std::iter::successors(Some(loosest), |t| Some(t * factor))
        .take_while(|&t| t > tightest)
        .find(|&t| run(t).1.iter().all(good))
        .unwrap_or(tightest);
    let runs: Vec<_> = (0..RUNS).map(|_| run(tolerance)).collect();
    let firsts: Vec<f64> = runs.iter().map(|r| r.0.ms).collect();
    let steps = || runs.iter().flat_map(|r| &r.1);
    let times: Vec<f64> = steps().map(|m| m.ms).collect();
    MovingReport {
        first_ms: super::median(&firsts),
        first_iterations: runs[0].0.iterations,
        tolerance,
        iterations: runs[0].1.iter().map(|m| m.iterations).collect(),
        ms_per_step: [
            super::median(&times),
            times.iter().sum::<f64>() / times.len() as f64,
            super::quantile(&times, 1.0),
        ],
        worst_error: steps().map(|m| m.error).fold(0.0, f64::max),
    }
}

struct Moved {
    ms: f64,
    error: f64,
    iterations: usize,
}

impl fmt::Display for PressCubeReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |ms: Option<f64>| ms.map_or("not reached".to_owned(), |ms| format!("{ms:.2} ms"));
        writeln!(
            f,
            "{} nodes, {} springs, Poisson's ratio {}",
            self.nodes, self.springs, self.poisson
        )?;
        writeln!(f, "set up once          {:>12.2} ms", self.setup_ms)?;
        writeln!(
            f,
            "rms error 1 %        {:>15}   {} iterations, {:.2} % left",
            ms(self.ms_to_one_percent),
            self.iterations_to_one_percent,
            self.error * 100.0
        )?;
        writeln!(
            f,
            "residual 1e-6        {:>15}   {} iterations, {:.1e} left",
            ms(self.ms_to_converged),
            self.iterations_to_converged,
            self.residual
        )?;
        write!(f, "force on the disc    {:>12.4} N", self.force_n)?;
        if let Some(moving) = &self.moving {
            let [median, mean, longest] = moving.ms_per_step;
            write!(
                f,
                "\nmoving, first step   {:>12.2} ms   {} iterations\n\
                 moving, per step     {median:>12.2} ms   mean {mean:.2}, longest {longest:.2} ms; \
                 iterations {:?} to a residual of {:.1e}; worst error {:.2} %",
                moving.first_ms,
                moving.first_iterations,
                moving.iterations,
                moving.tolerance,
                moving.worst_error * 100.0
            )?;
        }
        Ok(())
    }
}
