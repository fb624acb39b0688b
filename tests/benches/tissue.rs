//! Cost of the tissue: a solve from rest, a tick of a press, a build, a cut. `cargo bench -p palpate-lab`.
//!
//! `palpate-lab bench` has the accuracy that goes with these times.

#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use divan::Bencher;
use palpate_anatomy::build;
use palpate_anatomy::sample::Sample;
use palpate_lab::tool_location::ToolLocation;
use palpate_lab::wound::Wound;
use palpate_tissue::{Budget, Material, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
/// Side of the cube, displacement of its top, and radius of the disc.
const SIDE: f64 = 0.1;
const DEPTH: f64 = 1.0 * MM;
const DISC: f64 = 12.5 * MM;
/// Radius of the sphere, its step per tick, and its depth range.
const RADIUS: f64 = 8.0 * MM;
const PER_TICK: f64 = 0.4 * MM;
const DEPTHS: [f64; 2] = [2.0 * MM, 8.0 * MM];

fn main() {
    divan::main();
}

fn thigh() -> Topology {
    let input = Sample::Thigh.input().unwrap();
    let (model, _) = build(&input, &mut |_, _| {}).unwrap();
    Topology::new(Arc::new(model))
}

/// A pinned cube with this many nodes per edge, from rest to a residual of 1e-3 under a displaced disc.
#[divan::bench(args = [20, 40], sample_count = 20)]
fn cube_from_rest(bencher: Bencher<'_, '_>, n: usize) {
    let spacing = SIDE / (n as f64 - 1.0);
    let model = block([n - 1, n - 1, n], spacing, &Material::default(), 1);
    let topology = Topology::new(Arc::new(model));
    let top = Vec3::new(0.5 * SIDE, 0.5 * SIDE, SIDE + spacing);
    let under = |&node: &u32| {
        let d = topology.rest(node) - top;
        d.z.abs() < 1e-3 * spacing && d.norm() <= DISC
    };
    let disc: Vec<u32> = (0..topology.node_count() as u32).filter(under).collect();
    let like = Tissue::at_rest(topology);
    let start = || {
        let mut tissue = like.another();
        for &node in &disc {
            tissue.hold(node, Vec3::z() * -DEPTH);
        }
        tissue
    };
    bencher.with_inputs(start).bench_refs(|tissue| {
        let budget = Budget::new(100, 1e-3);
        tissue.step(&[], budget).residual
    });
}

/// A tick with the limits of a hand except for time: one iteration, near the tool.
#[divan::bench(args = [false, true], sample_count = 200, sample_size = 1)]
fn press_tick_on_the_thigh(bencher: Bencher<'_, '_>, wound: bool) {
    let mut topology = thigh();
    let mut place = ToolLocation::find(&topology).unwrap();
    if wound {
        Wound::open(&mut topology, &mut place).unwrap();
    }
    let mut tissue = Tissue::at_rest(topology);
    let (mut depth, mut way) = (0.0, PER_TICK);
    bencher.bench_local(|| {
        if depth > DEPTHS[1] || (depth < DEPTHS[0] && way < 0.0) {
            way = -way;
        }
        depth += way;
        let tool = Tool::ball(1, place.middle + place.normal * (RADIUS - depth), RADIUS);
        let budget = Budget {
            near: true,
            ..Budget::new(1, 2.5e-2)
        };
        let report = tissue.step(&[tool], budget);
        report.residual
    });
}

/// The sample thigh at 4 mm, without file input.
#[divan::bench(sample_count = 10)]
fn build_of_the_thigh(bencher: Bencher<'_, '_>) {
    let input = Sample::Thigh.input().unwrap();
    bencher.bench(|| build(&input, &mut |_, _| {}).unwrap());
}

/// A wound of 50 mm through fat and muscle.
#[divan::bench(sample_count = 20)]
fn cut_into_the_thigh(bencher: Bencher<'_, '_>) {
    let topology = thigh();
    let place = ToolLocation::find(&topology).unwrap();
    bencher
        .with_inputs(|| (topology.clone(), place.clone()))
        .bench_refs(|(topology, place)| Wound::open(topology, place).unwrap().0.doubled);
}
