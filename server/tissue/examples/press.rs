//! Measures the equilibrium under a press: `cargo run --release -p palpate-tissue --example press
//! -- [key=value]...`, keys as in [`Options`]. Prints the time per step, the error of the contact
//! force against the converged one, and how many nodes were active.

#![allow(clippy::print_stdout)]

use std::sync::Arc;
use std::time::Instant;

use palpate_tissue::{Budget, Material, Shape, Solver, Tool, Topology, Vec3, block};

/// What to measure; every number can be given as `key=value`.
struct Options {
    /// Cells along x, y, z.
    cells: [f64; 3],
    spacing_mm: f64,
    radius_mm: f64,
    depth_mm: f64,
    speed_mm_s: f64,
    tick_ms: f64,
    iterations: f64,
    tolerance: f64,
    budget_ms: f64,
    young_kpa: f64,
    /// 1: hold a disc of 12.5 mm on top 1 mm down, cold, instead of the press.
    cold: f64,
    /// Compare with the converged force at every n-th tick.
    every: f64,
}

fn options() -> Options {
    let mut o = Options {
        cells: [37.0, 45.0, 35.0],
        spacing_mm: 4.0,
        radius_mm: 8.0,
        depth_mm: 15.0,
        speed_mm_s: 100.0,
        tick_ms: 4.0,
        iterations: 2.0,
        tolerance: 1e-2,
        budget_ms: f64::INFINITY,
        young_kpa: 10.0,
        cold: 0.0,
        every: 1.0,
    };
    for argument in std::env::args().skip(1) {
        let Some((key, value)) = argument.split_once('=') else {
            panic!("{argument}: write key=value");
        };
        let value: f64 = value.parse().expect("a number after the equals sign");
        match key {
            "edge" => o.cells = [value; 3],
            "nx" => o.cells[0] = value,
            "ny" => o.cells[1] = value,
            "nz" => o.cells[2] = value,
            "spacing" => o.spacing_mm = value,
            "radius" => o.radius_mm = value,
            "depth" => o.depth_mm = value,
            "speed" => o.speed_mm_s = value,
            "tick" => o.tick_ms = value,
            "iterations" => o.iterations = value,
            "tolerance" => o.tolerance = value,
            "ms" => o.budget_ms = value,
            "young" => o.young_kpa = value,
            "cold" => o.cold = value,
            "every" => o.every = value,
            _ => panic!("{key}: no such option"),
        }
    }
    o
}

/// Time this thread spent on the processor in ms, where the system tells; else the time of day.
fn spent_ms(start: Instant) -> f64 {
    std::fs::read_to_string("/proc/thread-self/schedstat")
        .ok()
        .and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok())
        .map_or_else(|| start.elapsed().as_secs_f64() * 1e3, |ns| ns * 1e-6)
}

fn main() {
    let o = options();
    let material = Material {
        name: "soft".into(),
        young_pa: o.young_kpa * 1e3,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "benchmark".into(),
        ..Material::default()
    };
    let start = Instant::now();
    let model = block(
        o.cells.map(|c| c as usize),
        o.spacing_mm * 1e-3,
        &material,
        1,
    );
    let topology = Topology::new(Arc::new(model));
    let built = start.elapsed();
    let start = Instant::now();
    let solver = Solver::new(&topology);
    println!(
        "{} nodes, {} springs, topology {:.0} ms, solver {:.0} ms",
        topology.node_count(),
        topology.springs().count(),
        built.as_secs_f64() * 1e3,
        start.elapsed().as_secs_f64() * 1e3
    );
    if o.cold > 0.0 {
        cold(&o, &topology, solver);
    } else {
        press(&o, &topology, solver);
    }
}

fn cold(o: &Options, topology: &Topology, solver: Solver) {
    let side = o.spacing_mm * 1e-3;
    let [x, y, z] = o.cells.map(|c| c * side);
    let middle = Vec3::new(x / 2.0, y / 2.0, z);
    let disc: Vec<u32> = (0..topology.node_count() as u32)
        .filter(|&n| (topology.rest(n) - middle).norm() <= 12.5e-3 && topology.rest(n).z > z - 1e-6)
        .collect();
    let hold = |solver: &mut Solver, shape: &mut Shape| {
        for &node in &disc {
            solver.hold(topology, shape, node, Vec3::new(0.0, 0.0, -1e-3));
        }
    };
    let mut shape = Shape::rest(topology);
    let mut solver = solver;
    hold(&mut solver, &mut shape);
    solver.step(topology, &mut shape, &[], Budget::new(500, 1e-7));
    let (exact, report) = (shape, solver.report().clone());
    println!(
        "converged: {} iterations, {:.1e}",
        report.iterations, report.residual
    );
    for iterations in [1, 2, 3, 4, 6, 8, 12] {
        let mut solver = Solver::new(topology);
        let mut shape = Shape::rest(topology);
        let start = Instant::now();
        let before = spent_ms(start);
        hold(&mut solver, &mut shape);
        let report = solver
            .step(
                topology,
                &mut shape,
                &[],
                Budget::new(iterations, o.tolerance),
            )
            .clone();
        let spent = spent_ms(start) - before;
        let (mut error, mut size) = (0.0, 0.0);
        for (a, b) in shape.displacement.iter().zip(&exact.displacement) {
            error += (a - b).norm_squared();
            size += b.norm_squared();
        }
        println!(
            "{} iterations  {:6.2} ms  residual {:.1e}  rms error {:.2} %  active {}  visits {:?}",
            report.iterations,
            spent,
            report.residual,
            100.0 * (error / size).sqrt(),
            report.active_nodes,
            report.visits
        );
    }
}

fn press(o: &Options, topology: &Topology, mut solver: Solver) {
    let side = o.spacing_mm * 1e-3;
    let [x, y, z] = o.cells.map(|c| c * side);
    let top = Vec3::new(x / 2.0 + 0.3e-3, y / 2.0 - 0.2e-3, z + o.radius_mm * 1e-3);
    let mut shape = Shape::rest(topology);
    let mut exact = Shape::rest(topology);
    let mut judge = Solver::new(topology);
    let ticks = (o.depth_mm / o.speed_mm_s * 1e3 / o.tick_ms).round() as usize;
    let (mut times, mut errors, mut visits) = (Vec::new(), Vec::new(), 0);
    for tick in 1..=ticks + 10 {
        let depth = (o.speed_mm_s * o.tick_ms * 1e-3 * tick as f64).min(o.depth_mm) * 1e-3;
        let tool = Tool {
            id: 1,
            centre: top - Vec3::z() * depth,
            radius_m: o.radius_mm * 1e-3,
        };
        let start = Instant::now();
        let before = spent_ms(start);
        let mut stop = || spent_ms(start) - before > o.budget_ms;
        let budget = Budget {
            near: false,
            iterations: o.iterations as usize,
            tolerance: o.tolerance,
            stop: Some(&mut stop),
        };
        let report = solver.step(topology, &mut shape, &[tool], budget).clone();
        let spent = spent_ms(start) - before;
        times.push(spent);
        visits += report.visits[0];
        if tick % o.every as usize == 0 {
            let converged = judge
                .step(topology, &mut exact, &[tool], Budget::new(300, 1e-5))
                .clone();
            let (f, g) = (report.reactions[0].force, converged.reactions[0].force);
            let error = 100.0 * (f - g).norm() / g.norm();
            errors.push(error);
            println!(
                "depth {:5.2} mm  F {:.4} N  converged {:.4} N ({} it, {:.0e})  error {:6.2} %  {:.2} ms  {} it  residual {:.1e}  active {}  contacts {}  clamped {}  visits {:?}",
                depth * 1e3,
                f.norm(),
                g.norm(),
                converged.iterations,
                converged.residual,
                error,
                spent,
                report.iterations,
                report.residual,
                report.active_nodes,
                report.reactions[0].contacts,
                report.clamped,
                report.visits,
            );
        }
    }
    let mut sorted = times.clone();
    sorted.sort_by(f64::total_cmp);
    let at = |q: f64| sorted[((sorted.len() - 1) as f64 * q).round() as usize];
    println!(
        "per step: mean {:.2} ms, p50 {:.2} ms, p99 {:.2} ms, {} visits of nodes; force error: worst {:.2} %",
        times.iter().sum::<f64>() / times.len() as f64,
        at(0.5),
        at(0.99),
        visits / times.len(),
        errors.iter().fold(0.0f64, |a, &b| a.max(b))
    );
}
