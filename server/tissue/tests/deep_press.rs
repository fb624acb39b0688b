//! Deep presses into soft tissue over stiffer tissue and bone.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Model, RegionId, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const CELL: f64 = 4.0 * MM;
const RADIUS: f64 = 8.0 * MM;
const TICKS: usize = 45;

fn material(young_pa: f64, poisson: f64) -> Material {
    Material {
        young_pa,
        poisson,
        ..Material::default()
    }
}

/// Muscle of 12 kPa, 32 mm thick, under 8 mm of fat.
fn fat_over_muscle(poisson: f64) -> Topology {
    let mut model: Model = block([24, 24, 10], CELL, &material(12e3, poisson), 1);
    let mut fat = model.regions[0].clone();
    "fat".clone_into(&mut fat.name);
    fat.material = material(3e3, poisson);
    fat.pinned = false;
    let id = RegionId(model.regions.len() as u16);
    model.regions.push(fat);
    for cell in &mut model.cells {
        if model.lattice[cell.corners[0] as usize][2] >= 8 {
            cell.region = id;
        }
    }
    Topology::new(Arc::new(model))
}

/// Forces in N of a press to 18 mm at 100 mm/s, and the largest depth in m of a node of the surface in the ball.
fn press(topology: &Topology, budget: impl Fn() -> Budget<'static>) -> (Vec<f64>, f64) {
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut sunk: f64 = 0.0;
    let forces = (1..=TICKS).map(|k| {
        let depth = 0.4 * MM * k as f64;
        // Off the nodes.
        let centre = Vec3::new(49.0 * MM, 46.5 * MM, 40.0 * MM + RADIUS - depth);
        let force = tissue
            .step(&[Tool::ball(1, centre, RADIUS)], budget())
            .reactions[0]
            .force;
        for n in 0..topology.node_count() as u32 {
            let now = topology.rest(n) + tissue.shape().displacement[n as usize];
            if topology.rest(n).z > 39.9 * MM {
                sunk = sunk.max(RADIUS - (now - centre).norm());
            }
        }
        force.z
    });
    (forces.collect(), sunk)
}

/// With a penalty alone the surface slid from under the ball at 13.6 mm.
#[test]
fn force_rises_while_a_ball_presses_fat_flat() {
    for poisson in [0.25, 0.45] {
        let topology = fat_over_muscle(poisson);
        let (exact, sunk) = press(&topology, || Budget::new(100, 1e-3));
        assert!(
            exact.windows(2).all(|f| f[1] > f[0]),
            "ν {poisson}: {exact:.3?}"
        );
        assert!(sunk < 0.1 * MM, "ν {poisson}: {sunk} m");
        let quick = || Budget {
            near: true,
            ..Budget::new(2, 0.02)
        };
        let (quick, _) = press(&topology, quick);
        let apart = quick.iter().zip(&exact).map(|(q, e)| q / e - 1.0).skip(5);
        let worst = apart.map(f64::abs).fold(0.0, f64::max);
        assert!(worst < 0.1, "ν {poisson}: {worst}, {quick:.3?} {exact:.3?}");
    }
}

fn hold(tissue: &mut Tissue, centre: impl Fn(f64) -> Vec3, ticks: usize) -> Vec<f64> {
    let budget = || Budget {
        near: true,
        ..Budget::new(2, 0.02)
    };
    // A hand never holds quite still.
    let forces = (0..ticks).map(|k| {
        let tool = Tool::ball(1, centre(1e-6 * (k % 2) as f64), RADIUS);
        tissue.step(&[tool], budget()).reactions[0].force.norm()
    });
    forces.collect()
}

#[test]
fn held_ball_keeps_its_force() {
    // The side of a pinned base cannot give way; multipliers alone would grow at every step.
    let topology = Topology::new(Arc::new(block([16, 16, 8], CELL, &material(10e3, 0.25), 4)));
    let mut tissue = Tissue::at_rest(topology);
    let beside = |by: f64| Vec3::new(MM - RADIUS + by, 30.5 * MM, 7.0 * MM);
    let forces = hold(&mut tissue, beside, 200);
    let last = forces[199];
    assert!(last > 0.5, "{last}");
    assert!(
        forces[40..].iter().all(|f| (f / last - 1.0).abs() < 0.01),
        "{forces:.3?}"
    );

    // Tissue of one cell on a pinned base.
    let topology = Topology::new(Arc::new(block([16, 16, 8], CELL, &material(10e3, 0.25), 7)));
    let above = |depth: f64| Vec3::new(33.0 * MM, 30.5 * MM, 32.0 * MM + RADIUS - depth);
    let mut exact = Tissue::at_rest(topology.clone());
    let mut tissue = Tissue::at_rest(topology);
    for k in 1..=15 {
        let tool = Tool::ball(1, above(0.2 * MM * f64::from(k)), RADIUS);
        exact.step(&[tool], Budget::new(200, 1e-5));
        hold(&mut tissue, |_| tool.centre, 1);
    }
    let exact = exact.report().reactions[0].force.norm();
    let forces = hold(&mut tissue, |by| above(3.0 * MM + by), 60);
    assert!(
        forces[5..].iter().all(|f| (f / exact - 1.0).abs() < 0.01),
        "{exact} {forces:.3?}"
    );
}

#[test]
fn unmoved_tool_costs_nothing_once_its_force_is_found() {
    // Tissue, one cell on a pinned base pressed flat, the side of the base, and a tool that has left.
    let above = |depth: f64| Vec3::new(33.0 * MM, 30.5 * MM, 32.0 * MM + RADIUS - depth);
    let beside = Vec3::new(MM - RADIUS, 30.5 * MM, 7.0 * MM);
    for (pinned, centre) in [(1, above(5.0 * MM)), (7, above(3.5 * MM)), (4, beside)] {
        let model = block([16, 16, 8], CELL, &material(10e3, 0.25), pinned);
        let mut tissue = Tissue::at_rest(Topology::new(Arc::new(model)));
        let far = centre + Vec3::new(-0.1, 0.0, 0.1);
        for (at, is_pressed) in [(centre, true), (far, false)] {
            let mut iterations = Vec::new();
            for _ in 0..60 {
                let report = tissue.step(&[Tool::ball(1, at, RADIUS)], Budget::new(4, 0.02));
                assert!(!is_pressed || report.reactions[0].force.norm() > 0.1);
                iterations.push(report.iterations);
            }
            assert!(
                iterations[40..].iter().all(|&n| n == 0),
                "{pinned} {iterations:?}"
            );
        }
    }
}
