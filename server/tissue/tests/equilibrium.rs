//! Laws of the equilibrium: modulus, balance, symmetry, no hysteresis, determinism.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Shape, StepReport, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const YOUNG_PA: f64 = 10e3;

fn tissue(cells: [usize; 3], spacing_m: f64) -> Topology {
    let material = Material {
        name: "test".into(),
        young_pa: YOUNG_PA,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "test".into(),
        ..Material::default()
    };
    Topology::new(Arc::new(block(cells, spacing_m, &material, 1)))
}

fn slab() -> Tissue {
    let topology = tissue([12, 12, 8], 4.0 * MM);
    Tissue::at_rest(topology)
}

fn tool(x: f64, y: f64, depth: f64, radius: f64) -> Tool {
    Tool::ball(1, Vec3::new(x, y, 32.0 * MM + radius - depth), radius)
}

fn settle(tissue: &mut Tissue, tools: &[Tool], tolerance: f64) -> StepReport {
    tissue.step(tools, Budget::new(400, tolerance)).clone()
}

/// Presses straight down in steps of half a millimetre.
fn press(tissue: &mut Tissue, last: Tool) -> StepReport {
    let mut report = StepReport::default();
    for s in 1..=4 {
        let mut t = last;
        t.centre.z += 0.5 * MM * f64::from(4 - s);
        report = settle(tissue, &[t], 1e-6);
    }
    report
}

#[test]
fn bar_in_tension_has_young_and_poisson_of_its_material() {
    let topology = tissue([6, 6, 25], 4.0 * MM);
    let mut tissue = Tissue::at_rest(topology.clone());
    let strain = 0.01;
    // The clamped ends disturb their neighbourhood, so strain is read in the middle.
    for node in 0..topology.node_count() as u32 {
        if topology.rest(node).z > 99.9 * MM {
            assert!(tissue.hold(node, Vec3::z() * (strain * 96.0 * MM)));
        }
    }
    let report = settle(&mut tissue, &[], 1e-6);
    assert!(report.residual <= 1e-6, "{}", report.residual);
    assert!(tissue.residual_over_all() <= 2e-6);
    let node = |i: u32, j: u32, k: u32| i + 7 * (j + 7 * k);
    let u = |n: u32| tissue.shape().displacement[n as usize];
    let along = (u(node(3, 3, 17)).z - u(node(3, 3, 9)).z) / (8.0 * 4.0 * MM);
    let across = (u(node(6, 3, 13)).x - u(node(0, 3, 13)).x) / (6.0 * 4.0 * MM);
    let force: f64 = (0..topology.node_count() as u32)
        .filter(|&n| topology.rest(n).z > 99.9 * MM)
        .map(|n| -tissue.force_on(n).z)
        .sum();
    let area = (24.0 * MM).powi(2);
    let young = force / area / along;
    assert!((young / YOUNG_PA - 1.0).abs() < 0.05, "E = {young}");
    assert!(
        (-across / along - 0.25).abs() < 0.02,
        "nu = {}",
        -across / along
    );
}

#[test]
fn tool_forces_balance_the_pinned_nodes() {
    let mut tissue = slab();
    let report = press(&mut tissue, tool(23.0 * MM, 25.0 * MM, 2.0 * MM, 8.0 * MM));
    assert!(report.residual <= 1e-6);
    assert_eq!(report.clamped, 0);
    let on_tool = report.reactions[0].force;
    let mut on_pinned = Vec3::zeros();
    for node in 0..tissue.topology().node_count() as u32 {
        if tissue.topology().is_pinned(node) {
            on_pinned += tissue.force_on(node);
        }
    }
    assert!(on_tool.z > 0.05);
    assert!(
        (on_tool + on_pinned).norm() < 1e-4 * on_tool.norm(),
        "{on_tool} {on_pinned}"
    );
}

#[test]
fn released_tissue_returns_to_rest() {
    let mut tissue = slab();
    press(&mut tissue, tool(23.0 * MM, 25.0 * MM, 2.0 * MM, 8.0 * MM));
    settle(&mut tissue, &[], 1e-7);
    let left = tissue
        .shape()
        .displacement
        .iter()
        .map(Vec3::norm)
        .fold(0.0, f64::max);
    assert!(left < 1e-4 * MM, "{left}");
    let idle = tissue.step(&[], Budget::new(10, 1e-6));
    assert_eq!(idle.iterations, 0);
}

#[test]
fn press_has_no_hysteresis_and_warm_start_equals_cold_start() {
    let mut tissue = slab();
    let shallow = tool(24.0 * MM, 24.0 * MM, 1.0 * MM, 8.0 * MM);
    let deep = tool(24.0 * MM, 24.0 * MM, 2.5 * MM, 8.0 * MM);
    let before = settle(&mut tissue, &[shallow], 1e-6).reactions[0].force;
    settle(&mut tissue, &[deep], 1e-6);
    let after = settle(&mut tissue, &[shallow], 1e-6).reactions[0].force;
    assert!(
        (before - after).norm() < 1e-3 * before.norm(),
        "{before} {after}"
    );
}

#[test]
fn centred_press_is_mirror_symmetric() {
    let mut tissue = slab();
    let report = press(&mut tissue, tool(24.0 * MM, 24.0 * MM, 2.0 * MM, 8.0 * MM));
    let f = report.reactions[0].force;
    // The diagonals of the surface triangles are not symmetric, so the samples are only nearly so.
    assert!(f.x.abs() < 0.05 * f.z && f.y.abs() < 0.05 * f.z, "{f}");
}

/// A cube of twelve cells, and the nodes in the middle of its top.
fn cube() -> (Topology, Vec<u32>) {
    let topology = tissue([12, 12, 12], 4.0 * MM);
    let top = Vec3::new(24.0, 24.0, 48.0) * MM;
    let near = |&n: &u32| (topology.rest(n) - top).norm() < 6.0 * MM;
    let disc = (0..topology.node_count() as u32).filter(near).collect();
    (topology, disc)
}

fn lead(tissue: &mut Tissue, disc: &[u32], depth: f64) {
    for &node in disc {
        assert!(tissue.hold(node, -Vec3::z() * depth));
    }
}

/// Relative rms difference.
fn off(shape: &Shape, exact: &Shape) -> f64 {
    let pairs = || shape.displacement.iter().zip(&exact.displacement);
    let difference: f64 = pairs().map(|(a, b)| (a - b).norm_squared()).sum();
    (difference / pairs().map(|p| p.1.norm_squared()).sum::<f64>()).sqrt()
}

#[test]
fn held_nodes_displace_the_rest() {
    let (topology, disc) = cube();
    let led = |iterations: usize| {
        let mut tissue = Tissue::at_rest(topology.clone());
        lead(&mut tissue, &disc, 0.5 * MM);
        tissue.step(&[], Budget::new(iterations, 1e-6));
        tissue.shape().clone()
    };
    let exact = led(400);
    assert!(off(&led(1), &exact) < 0.25, "{}", off(&led(1), &exact));
    assert!(off(&led(3), &exact) < 0.02, "{}", off(&led(3), &exact));
}

#[test]
fn two_tools_press_simultaneously() {
    let mut tissue = slab();
    let mut other = tool(36.0 * MM, 36.0 * MM, 1.0 * MM, 6.0 * MM);
    other.id = 2;
    let tools = [tool(12.0 * MM, 12.0 * MM, 1.0 * MM, 6.0 * MM), other];
    let report = settle(&mut tissue, &tools, 1e-6);
    assert_eq!(report.reactions.len(), 2);
    let [a, b] = [0, 1].map(|i| report.reactions[i].force.z);
    assert!(a > 0.02 && (a / b - 1.0).abs() < 0.1, "{a} {b}");
}

#[test]
fn same_steps_give_same_bits() {
    let run = || {
        let mut tissue = slab();
        for s in 0..12 {
            let t = tool(
                20.0 * MM + 0.3 * MM * f64::from(s),
                24.0 * MM,
                0.2 * MM * f64::from(s),
                7.0 * MM,
            );
            tissue.step(&[t], Budget::new(2, 1e-2));
        }
        tissue.shape().hash()
    };
    assert_eq!(run(), run());
}
