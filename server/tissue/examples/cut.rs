//! Time of cuts: the same strokes on a block of 62,000 nodes and on one of eight times as many. The cost of a
//! cut should depend on the cut, not on the model.

#![allow(clippy::print_stdout, clippy::disallowed_methods)]

use std::sync::Arc;
use std::time::Instant;

use palpate_tissue::snapshot::{restore, snapshot};
use palpate_tissue::{BladePoint, CutStroke, Material, Tissue, Topology, Vec3, block, cut};

const SPACING_M: f64 = 0.0025;

fn tissue() -> Material {
    Material {
        name: "muscle".into(),
        young_pa: 3e4,
        density_kg_m3: 1060.0,
        friction_static: 0.3,
        friction_dynamic: 0.2,
        source: "round numbers for a measurement".into(),
        ..Material::default()
    }
}

/// Strokes on the top of a block, `depth` deep, tilted and bent; lengths in m.
fn strokes(top: f64, steps: usize, length: f64, depth: f64) -> CutStroke {
    let axis = Vec3::new(0.25, 0.0, 1.0).normalize();
    let point = |i: usize| {
        let s = i as f64 / steps as f64;
        let x = 0.03 + 0.01 * (3.0 * s).sin();
        BladePoint {
            tip: Vec3::new(x, 0.02 + s * length, top) - axis * depth,
            axis,
            depth_m: depth + 0.004,
        }
    };
    CutStroke {
        points: (0..=steps).map(point).collect(),
        width_m: 0.0,
    }
}

fn main() {
    for cells in [39, 79] {
        let model = Arc::new(block([cells; 3], SPACING_M, &tissue(), 2));
        let top = cells as f64 * SPACING_M;
        let start = Instant::now();
        let built = Topology::new(Arc::clone(&model));
        println!(
            "\n{} nodes; topology in {:.1?}",
            built.node_count(),
            start.elapsed()
        );
        let mut warm = built.clone();
        let _ = cut(&mut warm, &strokes(top, 1, 0.01, 0.005));
        for (name, s) in [
            ("one 50 mm stroke, 20 mm deep", strokes(top, 20, 0.05, 0.02)),
            ("one 10 mm stroke, 10 mm deep", strokes(top, 5, 0.01, 0.01)),
        ] {
            let mut times = Vec::new();
            let mut outcome = None;
            for _ in 0..15 {
                let mut t = warm.clone();
                let start = Instant::now();
                outcome = cut(&mut t, &s).ok();
                times.push(start.elapsed());
            }
            times.sort();
            let o = outcome.expect("the stroke meets tissue");
            println!(
                "{name}: median {:.2?}, worst {:.2?}; {} faces, {} snapped, {} short, {} moved",
                times[7],
                times[14],
                o.faces_opened,
                o.nodes_snapped,
                o.nodes_short,
                o.moved.len()
            );
        }
        gradual(&built, top);
    }
}

/// The same 50 mm as fifty strokes of 1 mm, each continuing the last one; then as one cut of a tissue with its solver.
fn gradual(built: &Topology, top: f64) {
    let whole = strokes(top, 50, 0.05, 0.02);
    let mut t = built.clone();
    let mut times = Vec::new();
    let mut opened = 0;
    for end in 1..=50 {
        // A stroke begins one lattice step earlier, so that the sheet is never narrower than two cells.
        let from = usize::saturating_sub(end, 8);
        let points = whole.points[from..=end].to_vec();
        let stroke = CutStroke {
            points,
            width_m: 0.0,
        };
        let start = Instant::now();
        if let Ok(outcome) = cut(&mut t, &stroke) {
            opened += outcome.faces_opened;
        }
        times.push(start.elapsed());
    }
    times.sort();
    println!(
        "50 samples of 1 mm: median {:.2?}, p90 {:.2?}, worst {:.2?}; {opened} faces",
        times[25], times[45], times[49]
    );
    let mut tissue = Tissue::at_rest(built.clone());
    let start = Instant::now();
    let parts = tissue.cut(&whole).is_ok();
    println!("tissue with solver: {:.2?}, cut: {parts}", start.elapsed());
    let (t, history) = (tissue.topology(), tissue.history());
    let start = Instant::now();
    let bytes = snapshot(t, history);
    let taken = start.elapsed();
    let start = Instant::now();
    let restored = restore(history.uncut(), &bytes);
    let same = restored.is_ok_and(|r| r.0.hash() == t.hash());
    println!(
        "snapshot {} bytes in {taken:.1?}, restored in {:.1?}, same hash: {same}",
        bytes.len(),
        start.elapsed()
    );
}
