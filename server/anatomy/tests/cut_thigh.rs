//! Cuts in a model with layers and a curved skin: the built-in thigh.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "../../tissue/tests/cut_laws/mod.rs"]
mod cut_laws;

use std::sync::Arc;

use palpate_anatomy::build;
use palpate_anatomy::sample::Sample;
use palpate_tissue::cell::NO_CELL;
use palpate_tissue::file::{ModelFile, decode_model, encode_model};
use palpate_tissue::{BladePoint, CutStroke, FaceId, Topology, Vec3, block, cut};

fn thigh() -> Topology {
    let input = Sample::Thigh.input().unwrap();
    let (model, _) = build(&input, &mut |_, _| ()).unwrap();
    Topology::new(Arc::new(model))
}

fn region_volumes(t: &Topology) -> Vec<f64> {
    let mut volumes = vec![0.0; t.model().regions.len()];
    for cell in 0..t.cell_count() as u32 {
        volumes[t.region(cell).index()] += t.volume(cell);
    }
    volumes
}

/// A stroke along z over the front of the thigh, its tip `depth` under the skin.
fn incision(t: &Topology, from: f64, to: f64, depth: f64) -> CutStroke {
    let nodes = &t.model().nodes;
    let (low, high) = nodes.iter().fold(
        (Vec3::repeat(f64::MAX), Vec3::repeat(f64::MIN)),
        |(l, h), p| (l.inf(p), h.sup(p)),
    );
    let size = high - low;
    let axis = Vec3::new(0.2, 1.0, 0.1).normalize();
    let steps = 20;
    let points = (0..=steps).map(|i| {
        let s = from + (to - from) * f64::from(i) / f64::from(steps);
        let x = low.x + size.x * (0.5 + 0.05 * (4.0 * s).sin());
        let z = low.z + size.z * s;
        // The skin above x, z: the highest node around.
        let near = |p: &&Vec3| (p.x - x).hypot(p.z - z) < 1.5 * t.model().spacing_m;
        let top = nodes
            .iter()
            .filter(near)
            .map(|p| p.y)
            .fold(f64::MIN, f64::max);
        BladePoint {
            tip: Vec3::new(x, top, z) - axis * depth,
            axis,
            depth_m: depth + 0.006,
        }
    });
    CutStroke {
        points: points.collect(),
        width_m: 0.0,
    }
}

fn worst_cell(t: &Topology) -> f64 {
    let cells = (0..t.cell_count() as u32).map(|c| t.volume(c));
    cells.fold(f64::MAX, f64::min) / t.model().spacing_m.powi(3)
}

#[test]
fn incision_through_layers_keeps_surface_and_volumes() {
    let mut t = thigh();
    cut_laws::check_surface(&t);
    let (before, worst) = (region_volumes(&t), worst_cell(&t));
    for (from, to, depth) in [(0.3, 0.7, 0.012), (0.3, 0.7, 0.03), (0.5, 0.8, 0.02)] {
        let stroke = incision(&t, from, to, depth);
        let outcome = cut(&mut t, &stroke).unwrap();
        cut_laws::check_surface(&t);
        let (after, now) = (region_volumes(&t), worst_cell(&t));
        println!(
            "{} faces, {} snapped, {} short, regions {:?}, worst cell {worst:.3} -> {now:.3}",
            outcome.faces_opened, outcome.nodes_snapped, outcome.nodes_short, outcome.regions_cut
        );
        for (a, b) in after.iter().zip(&before) {
            assert!((a / b - 1.0).abs() < 5e-3, "{a} of {b}");
        }
        assert!(now > 0.0 || now >= worst);
    }
    assert_eq!(t.components(), 1);
}

#[test]
fn deep_incision_exposes_all_layers_on_both_sides() {
    let mut t = thigh();
    let built = t.boundary().faces.len();
    let stroke = incision(&t, 0.35, 0.65, 0.03);
    let outcome = cut(&mut t, &stroke).unwrap();
    assert!(outcome.regions_cut.len() >= 2, "{:?}", outcome.regions_cut);
    let opened = &t.boundary().faces[built..];
    assert_eq!(opened.len(), 2 * outcome.faces_opened);
    for &region in &outcome.regions_cut {
        let of = |f: &&FaceId| t.region(f.cell()) == region;
        assert!(opened.iter().filter(of).count() > 0);
    }
    assert!(opened.iter().all(|&f| t.across(f) == NO_CELL));
}

#[test]
fn thigh_model_file_round_trip() {
    let t = thigh();
    let bytes = encode_model(t.model());
    println!("{} nodes in {} bytes", t.node_count(), bytes.len());
    let model = decode_model(&bytes).unwrap();
    assert_eq!(&model, &**t.model());
    let other = ModelFile {
        model: block([2, 2, 2], 0.01, &cut_laws::rubber(), 0),
        report_json: String::new(),
    };
    assert_ne!(other.encode(), bytes);
}
