//! Stiff layers over soft ones: forces of quick steps against converged ones.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Model, RegionId, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const CELL: f64 = 4.0 * MM;
const RADIUS: f64 = 8.0 * MM;
/// Ticks of a press to 12 mm at 100 mm/s, of which every third is compared.
const TICKS: usize = 30;

fn material(young_pa: f64) -> Material {
    Material {
        young_pa,
        poisson: 0.45,
        ..Material::default()
    }
}

/// Muscle of 12 kPa, 36 mm thick, under a layer of 8 mm.
fn covered_muscle(layer_pa: f64) -> Topology {
    let mut model: Model = block([32, 32, 11], CELL, &material(12e3), 1);
    let mut layer = model.regions[0].clone();
    "layer".clone_into(&mut layer.name);
    layer.material = material(layer_pa);
    layer.pinned = false;
    let id = RegionId(model.regions.len() as u16);
    model.regions.push(layer);
    for cell in &mut model.cells {
        if model.lattice[cell.corners[0] as usize][2] >= 9 {
            cell.region = id;
        }
    }
    // Cells are not exact cubes, as in models of anatomy.
    for (n, node) in model.nodes.iter_mut().enumerate() {
        let n = n as f64;
        *node += 0.02 * CELL * Vec3::new(n.sin(), (2.0 * n).sin(), (3.0 * n).sin());
    }
    Topology::new(Arc::new(model))
}

/// Forces at every third tick.
fn press(topology: &Topology, budget: impl Fn() -> Budget<'static>, every: usize) -> Vec<f64> {
    let mut tissue = Tissue::at_rest(topology.clone());
    let ticks = (every..=TICKS).step_by(every);
    let forces = ticks.map(|k| {
        let depth = 0.4 * MM * k as f64;
        // Off the nodes.
        let centre = Vec3::new(65.0 * MM, 62.5 * MM, 44.0 * MM + RADIUS - depth);
        let report = tissue.step(&[Tool::ball(1, centre, RADIUS)], budget());
        (k, report.reactions[0].force.z)
    });
    let third = forces.filter(|(k, _)| k % 3 == 0);
    third.map(|(_, force)| force).collect()
}

/// Relative errors of a press with two quick iterations per tick.
fn errors(layer_pa: f64) -> Vec<f64> {
    let topology = covered_muscle(layer_pa);
    let quick = || Budget {
        near: true,
        ..Budget::new(2, 0.02)
    };
    let exact = press(&topology, || Budget::new(100, 1e-4), 3);
    let forces = press(&topology, quick, 1);
    let errors = forces.iter().zip(&exact).map(|(f, e)| f / e - 1.0);
    errors.collect()
}

#[test]
fn quick_steps_feel_stiff_and_soft_layers() {
    // Skin over muscle, muscle alone, and a soft layer.
    for layer_pa in [130e3, 12e3, 3e3] {
        let errors = errors(layer_pa);
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        assert!(rms < 0.04, "layer of {layer_pa} Pa: {errors:.3?}");
    }
}
