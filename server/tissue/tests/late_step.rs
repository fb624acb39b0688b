//! A step that comes late: its tool has moved far since the last one.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const RADIUS: f64 = 8.0 * MM;

/// A ball so deep in the top of a block of 64 x 64 x 32 mm.
fn ball(depth: f64) -> Tool {
    let centre = Vec3::new(33.0 * MM, 30.5 * MM, 32.0 * MM + RADIUS - depth);
    Tool::ball(1, centre, RADIUS)
}

/// The force along z in N that the force loop renders after a quick step of one iteration: that at the proxy, continued linearly
/// to the ball. One iteration is what a slow computer has time for, because of a number or because time runs out
/// while the next one is prepared.
fn felt(tissue: &mut Tissue, ball: &Tool, runs_out: bool) -> f64 {
    let mut calls = 0;
    let mut stop = || {
        calls += 1;
        calls > 1
    };
    let budget = Budget {
        near: true,
        stop: if runs_out { Some(&mut stop) } else { None },
        ..Budget::new(if runs_out { 4 } else { 1 }, 0.02)
    };
    let reaction = &tissue.step(&[*ball], budget).reactions[0];
    (reaction.force - reaction.stiffness * (ball.centre - reaction.at)).z
}

/// A proxy that moved after the last iteration would report the force of tissue that has yet to yield.
#[test]
fn force_after_a_late_step_is_not_too_high() {
    for (poisson, runs_out) in [(0.25, false), (0.45, false), (0.25, true), (0.45, true)] {
        let material = Material {
            young_pa: 10e3,
            poisson,
            ..Material::default()
        };
        let topology = Topology::new(Arc::new(block([16, 16, 8], 4.0 * MM, &material, 1)));
        for (before, late) in [(0.0, 3.0), (1.0, 1.5), (1.0, 3.0), (3.0, 3.0)] {
            let mut tissue = Tissue::at_rest(topology.clone());
            for k in 0..=10 {
                let depth = 0.1 * before * f64::from(k) - 0.1;
                felt(&mut tissue, &ball(depth * MM), runs_out);
            }
            let tool = ball((before + late) * MM);
            let mut exact = Tissue::at_rest(topology.clone());
            exact.step(&[tool], Budget::new(200, 1e-5));
            let exact = exact.report().reactions[0].force.z;
            let forces: Vec<f64> = (0..8)
                .map(|_| felt(&mut tissue, &tool, runs_out) / exact)
                .collect();
            let name = format!("{poisson}, {before} and {late} mm, {runs_out}: {forces:.2?}");
            assert!(forces.iter().all(|f| *f < 1.05), "{name}");
            assert!(forces[0] > 0.6, "{name}");
            assert!(forces[2..].iter().all(|f| *f > 0.95), "{name}");
        }
    }
}
