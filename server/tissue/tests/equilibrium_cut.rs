//! Convergence on a cut lattice, with separated springs and doubled nodes.

#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use palpate_tissue::{
    BladePoint, Budget, CutStroke, Material, Tissue, Tool, Topology, Vec3, block, cut,
};

const MM: f64 = 1e-3;
const SPACING: f64 = 3.0 * MM;
const CELLS: [usize; 3] = [24, 24, 12];
const TOP: f64 = SPACING * CELLS[2] as f64;
const MIDDLE: f64 = 0.5 * SPACING * CELLS[0] as f64;
const RADIUS: f64 = 8.0 * MM;
/// Most iterations on the cut block, relative to the whole one.
const ALLOWED: f64 = 1.5;

fn whole() -> Topology {
    let model = block(CELLS, SPACING, &Material::default(), 1);
    Topology::new(Arc::new(model))
}

/// Two strokes that cross over the middle, through two thirds of the block.
fn parted(mut topology: Topology, crossing: bool) -> Topology {
    let strokes = if crossing { 2 } else { 1 };
    for stroke in 0..strokes {
        let points = (0..=16).map(|i| {
            let mut tip = Vec3::new(MIDDLE + 0.4 * MM, MIDDLE + 0.3 * MM, TOP / 3.0);
            tip[1 - stroke] += 3.0 * MM * f64::from(i - 8);
            BladePoint {
                tip,
                axis: Vec3::z(),
                depth_m: TOP,
            }
        });
        let stroke = CutStroke {
            points: points.collect(),
            width_m: 0.0,
        };
        let outcome = cut(&mut topology, &stroke).unwrap();
        assert!(outcome.doubled.len() > 50);
    }
    topology
}

/// Iterations of a press in steps beside the middle, each to `tolerance`.
fn iterations(topology: &Topology, tolerance: f64, step: f64, steps: usize) -> usize {
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut sum = 0;
    for s in 1..=steps {
        let depth = step * s as f64;
        let tool = Tool::ball(
            1,
            Vec3::new(MIDDLE - 6.0 * MM, MIDDLE - 5.0 * MM, TOP + RADIUS - depth),
            RADIUS,
        );
        let budget = Budget::new(400, tolerance);
        let report = tissue.step(&[tool], budget);
        assert!(report.residual <= tolerance && !report.rolled_back);
        sum += report.iterations;
    }
    sum
}

#[test]
fn cut_block_takes_at_most_half_more_iterations() {
    let uncut = whole();
    for crossing in [false, true] {
        let cut = parted(uncut.clone(), crossing);
        // In one step from rest, and in small steps like a hand.
        for (step, steps) in [(2.0 * MM, 1), (0.4 * MM, 10)] {
            for tolerance in [1e-2, 1e-4, 1e-6] {
                let [a, b] = [&uncut, &cut].map(|t| iterations(t, tolerance, step, steps));
                assert!(
                    b as f64 <= ALLOWED * a as f64,
                    "crossing {crossing}, {steps} steps to {tolerance}: {a} \
                         iterations whole, {b} cut"
                );
            }
        }
    }
}

#[test]
fn solver_updated_by_a_cut_agrees_with_a_new_one() {
    let fat = Material::built_in("fat").unwrap();
    let mut tissue = Tissue::new(Arc::new(block([14, 14, 8], 0.004, &fat, 1)));
    let tool = Tool::ball(1, Vec3::new(0.022, 0.028, 0.032 + RADIUS - 0.003), RADIUS);
    tissue.step(&[tool], Budget::new(60, 1e-4));
    let stroke = CutStroke {
        points: (0..8)
            .map(|i| BladePoint {
                tip: Vec3::new(0.0301, 0.012 + 0.004 * f64::from(i), 0.018),
                axis: Vec3::z(),
                depth_m: 0.03,
            })
            .collect(),
        width_m: 0.0,
    };
    let outcome = tissue.cut(&stroke).unwrap();
    assert!(!outcome.doubled.is_empty());
    let mut followed = 0.0;
    for _ in 0..6 {
        let report = tissue.step(&[tool], Budget::new(100, 1e-6));
        assert!(!report.rolled_back);
        followed = report.reactions[0].force.z;
    }
    assert!(tissue.residual_over_all() < 1e-4);

    let mut fresh = Tissue::at_rest(Arc::clone(tissue.topology()));
    let mut cold = 0.0;
    for tenth in 0..=30 {
        let mut tool = tool;
        tool.centre.z += 0.003 - f64::from(tenth) * 1e-4;
        let report = fresh.step(&[tool], Budget::new(100, 1e-6));
        cold = report.reactions[0].force.z;
    }
    assert!(
        (followed / cold - 1.0).abs() < 0.01,
        "after following {followed} N, from scratch {cold} N"
    );
}

/// Nodes of the tissue cease to be pinned, beside others that stay.
#[test]
fn solver_follows_tissue_that_parts_from_bone() {
    let base = SPACING;
    let points = (0..=20).map(|i| BladePoint {
        tip: Vec3::new(-SPACING, 3.0 * MM * f64::from(i - 1), base + 0.1 * SPACING),
        axis: Vec3::x(),
        depth_m: 0.7 * SPACING * CELLS[0] as f64,
    });
    let stroke = CutStroke {
        points: points.collect(),
        width_m: 0.0,
    };
    let ball = |depth: f64| {
        let at = Vec3::new(0.3 * MIDDLE, MIDDLE, TOP + RADIUS - depth);
        [Tool::ball(1, at, RADIUS)]
    };
    let mut followed = Tissue::at_rest(whole());
    followed.step(&ball(2.0 * MM), Budget::new(1000, 1e-6));
    let outcome = followed.cut(&stroke).unwrap();
    let parted = outcome.doubled.iter().filter(|d| whole().is_pinned(d.1));
    assert!(parted.count() > 200, "{}", outcome.doubled.len());
    let lifts = |t: &Tissue| {
        let lift = |d: &(u32, u32)| t.shape().displacement[d.0 as usize].norm();
        outcome.doubled.iter().map(lift).fold(0.0, f64::max)
    };
    // A parted node does not receive earlier displacements of the coarse levels.
    followed.step(&ball(2.0 * MM), Budget::new(0, 1e-6));
    assert!(lifts(&followed) == 0.0, "{}", lifts(&followed));
    let mut rebuilt = Tissue::at_rest(Arc::clone(followed.topology()));
    for tissue in [&mut followed, &mut rebuilt] {
        for depth in [1.0, 2.0, 3.0] {
            tissue.step(&ball(depth * MM), Budget::new(1000, 1e-6));
            let report = tissue.report();
            assert!(
                report.residual <= 1e-6,
                "{} after {}",
                report.residual,
                report.iterations
            );
        }
    }
    let [a, b] = [&followed, &rebuilt].map(|t| t.report().reactions[0].force);
    assert!((a - b).norm() < 1e-4 * b.norm(), "{a} {b}");
    assert!(lifts(&followed) > 0.1 * MM, "{}", lifts(&followed));
    assert!((lifts(&followed) - lifts(&rebuilt)).abs() < 1e-3 * MM);
}

/// Contacts change and corners collapse within a step: without repeated searches and without an adapted bound of the
/// smoother such solves end in limit cycles.
#[test]
fn ball_put_into_a_wound_at_once_converges() {
    let middle = Vec3::new(41.0 * MM, 40.7 * MM, 40.0 * MM);
    let axis = Vec3::new(0.5, 0.0, 1.0).normalize();
    let points = (-20..=20).map(|k| BladePoint {
        tip: middle + MM * Vec3::new(0.0, f64::from(k), 0.0) - 10.0 * MM * axis,
        axis,
        depth_m: 16.0 * MM,
    });
    let stroke = CutStroke {
        points: points.collect(),
        width_m: 0.5 * MM,
    };
    // Place of the ball beside and along the wound, and its depth, in mm.
    let springs = [[0.0, 0.3, 6.0], [0.9, 0.3, 9.0], [3.6, 2.2, 9.0]];
    let nearly_incompressible = [
        [0.0, 0.3, 9.0],
        [2.7, 0.3, 9.0],
        [4.5, 0.3, 9.0],
        [-0.9, 2.2, 9.0],
    ];
    for (poisson, places) in [(0.25, &springs[..]), (0.45, &nearly_incompressible[..])] {
        let material = Material {
            young_pa: 3e3,
            poisson,
            ..Material::default()
        };
        let model = block([20, 20, 10], 4.0 * MM, &material, 1);
        let mut topology = Topology::new(Arc::new(model));
        cut(&mut topology, &stroke).unwrap();
        let cut = Tissue::at_rest(topology);
        for &[beside, along, depth] in places {
            let centre = middle + MM * Vec3::new(beside, along, 8.0 - depth);
            let mut tissue = cut.another();
            let report = tissue.step(&[Tool::ball(1, centre, RADIUS)], Budget::new(150, 1e-4));
            assert!(
                report.residual <= 1e-4,
                "{poisson} {beside} {along} {depth} mm: {} after {}",
                report.residual,
                report.iterations
            );
        }
    }
}
