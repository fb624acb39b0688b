//! A tool that is held still.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const CELL: f64 = 4.0 * MM;
const RADIUS: f64 = 8.0 * MM;

/// A block of 64 x 64 x 32 mm of springs alone whose lowest cells are pinned.
fn slab(pinned: usize) -> Topology {
    slab_of(pinned, Material::default().poisson)
}

fn slab_of(pinned: usize, poisson: f64) -> Topology {
    let material = Material {
        young_pa: 10e3,
        poisson,
        ..Material::default()
    };
    Topology::new(Arc::new(block([16, 16, 8], CELL, &material, pinned)))
}

/// A ball so deep in its top.
fn above(depth: f64) -> Vec3 {
    Vec3::new(33.0 * MM, 30.5 * MM, 32.0 * MM + RADIUS - depth)
}

/// A ball so deep in its side, at this height.
fn beside(depth: f64, z: f64) -> Vec3 {
    Vec3::new(depth - RADIUS, 30.5 * MM, z)
}

/// Forces in N of quick steps.
fn hold(tissue: &mut Tissue, centre: impl Fn(f64) -> Vec3, ticks: usize) -> Vec<f64> {
    let budget = || Budget {
        near: true,
        ..Budget::new(2, 0.02)
    };
    // A hand never holds quite still: 0, 0.25, 1, 1, 0.25 µm.
    let forces = (0..ticks).map(|k| {
        let tool = Tool::ball(1, centre(0.25e-6 * (k * k % 5) as f64), RADIUS);
        tissue.step(&[tool], budget()).reactions[0].force.norm()
    });
    forces.collect()
}

#[test]
fn held_ball_keeps_its_force() {
    // The side of a pinned base, 16 mm high, cannot give way; multipliers alone would grow at every step.
    for z in [7.0, 15.0, 17.0] {
        let mut tissue = Tissue::at_rest(slab(4));
        let forces = hold(&mut tissue, |by| beside(MM + by, z * MM), 100);
        let first = forces[0];
        assert!(first > 0.5, "{first}");
        assert!(
            forces.iter().all(|f| (f / first - 1.0).abs() < 0.01),
            "{z} mm: {forces:.3?}"
        );
    }

    // Tissue of one cell on a pinned base.
    let topology = slab(7);
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

/// Multipliers without a bound sum up the errors of quick steps, and the force varies by a fifth. A warm start that
/// extrapolates while the ball rests lets it oscillate by 7 and 14 %.
#[test]
fn ball_that_presses_tissue_flat_on_a_pinned_base_keeps_its_force() {
    let depth = 7.8 * MM;
    let steps = [0.2 * MM, 0.4 * MM, 2.0 * MM];
    for (step, poisson) in steps.into_iter().flat_map(|s| [(s, 0.25), (s, 0.45)]) {
        let mut tissue = Tissue::at_rest(slab_of(6, poisson));
        let steps = (depth / step).ceil() as u32;
        for k in 1..=steps {
            hold(&mut tissue, |_| above(depth.min(step * f64::from(k))), 1);
        }
        let forces = &hold(&mut tissue, |by| above(depth + by), 200)[20..];
        let (least, most) = forces.iter().fold((f64::MAX, 0.0_f64), |(least, most), f| {
            (least.min(*f), most.max(*f))
        });
        let name = format!("{step} m, {poisson}");
        assert!(least > 5.0 && most / least < 1.03, "{name}: {forces:.2?}");
    }
}

/// Such tissue accepts hardly anything of some coarse corrections. With a least step length of 0.01 the solves end in NaN.
#[test]
fn full_solves_of_a_jump_into_nearly_flat_tissue_converge() {
    for poisson in [0.25, 0.45] {
        let mut tissue = Tissue::at_rest(slab_of(6, poisson));
        for _ in 0..60 {
            let tool = Tool::ball(1, above(6.4 * MM), RADIUS);
            let report = tissue.step(&[tool], Budget::new(1, 1e-6));
            assert!(report.residual.is_finite() && !report.rolled_back);
        }
        let residual = tissue.report().residual;
        assert!(residual < 1e-4, "{residual}");
    }
}

/// A force is found to the tolerance of its own size, also after a greater one.
#[test]
fn ball_that_is_drawn_back_and_held_finds_its_force() {
    let topology = slab(1);
    let mut tissue = Tissue::at_rest(topology.clone());
    for k in (0..25).chain((7..25).rev()) {
        hold(&mut tissue, |_| above(0.4 * MM * f64::from(k)), 1);
    }
    let centre = above(2.8 * MM);
    let mut iterations = Vec::new();
    for _ in 0..150 {
        let budget = Budget {
            near: true,
            ..Budget::new(2, 0.02)
        };
        let report = tissue.step(&[Tool::ball(1, centre, RADIUS)], budget);
        iterations.push(report.iterations);
    }
    let force = tissue.report().reactions[0].force.norm();
    let mut exact = Tissue::at_rest(topology);
    exact.step(&[Tool::ball(1, centre, RADIUS)], Budget::new(200, 1e-5));
    let exact = exact.report().reactions[0].force.norm();
    assert!((force / exact - 1.0).abs() < 0.01, "{force} {exact}");
    assert!(iterations[120..].iter().all(|&n| n == 0), "{iterations:?}");
}

#[test]
fn unmoved_tool_costs_nothing_once_its_force_is_found() {
    // Tissue, one cell on a pinned base pressed flat, the side of the base, and a tool that has left.
    let places = [
        (1, above(5.0 * MM)),
        (7, above(3.5 * MM)),
        (4, beside(MM, 7.0 * MM)),
    ];
    for (pinned, centre) in places {
        let mut tissue = Tissue::at_rest(slab(pinned));
        let far = centre + Vec3::new(-0.1, 0.0, 0.1);
        for (at, is_pressed) in [(centre, true), (far, false)] {
            let mut iterations = Vec::new();
            for _ in 0..120 {
                let report = tissue.step(&[Tool::ball(1, at, RADIUS)], Budget::new(4, 0.02));
                assert!(!is_pressed || report.reactions[0].force.norm() > 0.1);
                iterations.push(report.iterations);
            }
            assert!(
                iterations[100..].iter().all(|&n| n == 0),
                "{pinned} {iterations:?}"
            );
        }
    }
}
