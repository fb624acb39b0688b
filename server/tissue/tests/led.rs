//! Prescribed motion: some nodes are held at given displacements, and the rest converges to equilibrium.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Shape, Tissue, Tool, Topology, Vec3, block};

const SPACING: f64 = 5e-3;

fn cube(material: &Material) -> Topology {
    Topology::new(Arc::new(block([10, 10, 10], SPACING, material, 1)))
}

/// Nodes of the top within a radius of its middle.
fn disc(topology: &Topology, radius: f64) -> Vec<u32> {
    let middle = Vec3::new(5.0, 5.0, 10.0) * SPACING;
    let within = |&n: &u32| {
        let d = topology.rest(n) - middle;
        d.z.abs() < 1e-6 && d.norm() < radius
    };
    (0..topology.node_count() as u32).filter(within).collect()
}

/// Moves nodes to `to` relative to rest.
fn lead(tissue: &mut Tissue, nodes: &[u32], to: Vec3) {
    for &n in nodes {
        assert!(tissue.hold(n, to));
    }
}

fn converged(topology: &Topology, nodes: &[u32], to: Vec3) -> Shape {
    let mut tissue = Tissue::at_rest(topology.clone());
    lead(&mut tissue, nodes, to);
    tissue.step(&[], Budget::new(200, 1e-6));
    assert!(tissue.report().residual <= 1e-6);
    tissue.shape().clone()
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

#[test]
fn uneven_and_reversing_motion_is_followed() {
    let topology = cube(&Material::default());
    let nodes = disc(&topology, 13e-3);
    let mut tissue = Tissue::at_rest(topology.clone());
    let depths = [
        0.2, 0.4, 0.8, 1.2, 1.6, 1.6001, 2.0, 2.1, 1.9, 1.7, 1.0, 0.3,
    ];
    for depth in depths {
        let to = Vec3::new(0.3e-3, 0.0, -1e-3) * depth;
        lead(&mut tissue, &nodes, to);
        let report = tissue.step(&[], Budget::new(100, 1e-3));
        assert!(!report.rolled_back && report.residual <= 1e-3);
        let off = error(tissue.shape(), &converged(&topology, &nodes, to));
        assert!(off < 0.01, "{off} at {depth} mm");
    }
}

#[test]
fn held_node_stays_while_other_nodes_move() {
    let topology = cube(&Material::default());
    let nodes = disc(&topology, 8e-3);
    let other = disc(&topology, 40e-3)
        .into_iter()
        .find(|n| !nodes.contains(n))
        .unwrap();
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut at = Vec3::zeros();
    for step in 1..=8 {
        let to = Vec3::z() * (-2e-4 * f64::from(step));
        lead(&mut tissue, &nodes, to);
        if step == 5 {
            at = tissue.shape().displacement[other as usize];
            assert!(tissue.hold(other, at));
        }
        tissue.step(&[], Budget::new(100, 1e-2));
        if step >= 5 {
            assert_eq!(
                tissue.shape().displacement[other as usize],
                at,
                "step {step}"
            );
        }
    }
}

#[test]
fn stiff_stretch_limit_converges_below_and_above_the_limit() {
    for stretch in [0.01, 0.03] {
        let material = Material {
            stretch_limit: 1.02,
            ..Material::default()
        };
        let topology = cube(&material);
        let top = disc(&topology, 1.0);
        let mut tissue = Tissue::at_rest(topology.clone());
        let to = Vec3::z() * (stretch * 10.0 * SPACING);
        lead(&mut tissue, &top, to);
        let report = tissue.step(&[], Budget::new(300, 1e-4));
        assert!(!report.rolled_back && report.residual <= 1e-4, "{report:?}");
    }
}

#[test]
fn tool_jumping_into_held_tissue_gets_the_converged_force() {
    let topology = cube(&Material::default());
    let nodes = disc(&topology, 8e-3);
    let tool = Tool::ball(1, Vec3::new(10e-3, 10e-3, 50e-3 + 8e-3 - 2e-3), 8e-3);
    let to = Vec3::z() * -1e-3;
    let press = |steps: usize, budget: Budget<'static>| {
        let mut tissue = Tissue::at_rest(topology.clone());
        lead(&mut tissue, &nodes, to);
        tissue.step(&[], Budget::new(100, 1e-3));
        let mut budget = Some(budget);
        for _ in 0..steps {
            let budget = budget.take().unwrap_or(Budget::new(1, 1e-3));
            tissue.step(&[tool], budget);
        }
        tissue.report().reactions[0].force
    };
    let exact = press(1, Budget::new(300, 1e-5));
    let found = press(12, Budget::new(1, 1e-3));
    assert!(
        (found - exact).norm() < 0.05 * exact.norm(),
        "{found} {exact}"
    );
}
