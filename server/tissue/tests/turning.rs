//! Tissue rotating about a bone: its softest mode, and the longest propagation of a displacement to nodes far
//! from any tool.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Model, RegionId, Shape, Tissue, Topology, Vec3, block};

const MM: f64 = 1e-3;
const SPACING: f64 = 4.0 * MM;
const ACROSS: usize = 20;

/// A block of 80 by 80 by 32 mm around a pinned rod of 16 mm along z.
fn around_a_bone() -> Topology {
    let soft = Material {
        young_pa: 10e3,
        ..Material::default()
    };
    let mut model: Model = block([ACROSS, ACROSS, 8], SPACING, &soft, 0);
    let mut bone = model.regions[0].clone();
    bone.name = "rod".into();
    bone.pinned = true;
    let id = RegionId(model.regions.len() as u16);
    model.regions.push(bone);
    for cell in 0..model.cells.len() {
        let middle = model.corners_of(cell).iter().sum::<Vec3>() / 8.0;
        let from = middle - Vec3::repeat(0.5 * SPACING * ACROSS as f64);
        if from.x.abs() < 8.0 * MM && from.y.abs() < 8.0 * MM {
            model.cells[cell].region = id;
        }
    }
    Topology::new(Arc::new(model))
}

/// The shape after a number of iterations when a strip in the middle of one side is pushed along it.
fn turned(topology: &Topology, iterations: usize) -> Shape {
    let mut tissue = Tissue::at_rest(topology.clone());
    for node in 0..topology.node_count() as u32 {
        let at = topology.rest(node);
        if at.x < 0.1 * MM && (at.y - 40.0 * MM).abs() < 5.0 * MM {
            tissue.hold(node, Vec3::y() * 0.1 * MM);
        }
    }
    tissue.step(&[], Budget::new(iterations, 1e-7));
    tissue.shape().clone()
}

#[test]
fn rotation_about_a_bone_converges_in_six_cycles() {
    let topology = around_a_bone();
    let exact = turned(&topology, 200);
    let cycles = turned(&topology, 6);
    let pairs = exact.displacement.iter().zip(&cycles.displacement);
    let apart: f64 = pairs.map(|(a, b)| (a - b).norm_squared()).sum();
    let whole: f64 = exact.displacement.iter().map(Vec3::norm_squared).sum();
    let error = (apart / whole).sqrt();
    assert!(error < 0.01, "{error:.4} off");
}
