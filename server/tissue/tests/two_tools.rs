//! Two tools on one tissue: the released tool leaves no residual force on the other.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const SPACING: f64 = 4.0 * MM;
const CELLS: [usize; 3] = [40, 28, 12];
const RADIUS: f64 = 8.0 * MM;

fn topology() -> Topology {
    let material = Material {
        name: "test".into(),
        young_pa: 10e3,
        density_kg_m3: 1000.0,
        poisson: 0.45,
        source: "test".into(),
        ..Material::default()
    };
    Topology::new(Arc::new(block(CELLS, SPACING, &material, 1)))
}

/// A ball `depth` m below the surface, `x` m from the middle.
fn ball(id: u32, x: f64, depth: f64) -> Tool {
    let [across, along, up] = [20.0, 14.0, 12.0].map(|cells| cells * SPACING);
    let centre = Vec3::new(across + x, along, up + RADIUS - depth);
    Tool::ball(id, centre, RADIUS)
}

fn hand() -> Budget<'static> {
    Budget {
        near: true,
        ..Budget::new(2, 0.02)
    }
}

#[test]
fn force_converges_after_another_tool_is_released() {
    let topology = topology();
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut step = |gentle: f64, deep: f64| {
        let tools = [ball(1, -14.0 * MM, gentle), ball(2, 14.0 * MM, deep)];
        let report = tissue.step(&tools, hand());
        report.reactions[0].force
    };
    // Both press, one three times as deep; it then withdraws at 100 mm/s.
    for k in 0..=50 {
        let share = f64::from(k) / 50.0;
        step(3.0 * MM * share, 9.0 * MM * share);
    }
    for k in 0..=60 {
        step(3.0 * MM, 9.0 * MM - 0.4 * MM * f64::from(k));
    }
    // Two seconds with the hand at rest.
    let mut felt = Vec3::zeros();
    for _ in 0..100 {
        felt = step(3.0 * MM, -15.0 * MM);
    }
    let mut tissue = Tissue::at_rest(topology.clone());
    let tools = [ball(1, -14.0 * MM, 3.0 * MM)];
    let report = tissue.step(&tools, Budget::new(400, 1e-5));
    let converged = report.reactions[0].force;
    let error = (felt - converged).norm() / converged.norm();
    assert!(error < 0.02, "{felt} {converged} N");
}

#[test]
fn free_tool_moves_without_a_step_until_contact() {
    let topology = topology();
    let mut tissue = Tissue::at_rest(topology.clone());
    let tools = [
        ball(1, -14.0 * MM, 3.0 * MM),
        ball(2, 14.0 * MM, -20.0 * MM),
    ];
    for _ in 0..5 {
        tissue.step(&tools, hand());
    }
    let hash = tissue.shape().hash();
    let free = |depth: f64| ball(2, 14.0 * MM, depth);
    assert!(tissue.move_free(&free(-10.0 * MM)));
    assert!(tissue.move_free(&free(-2.0 * MM)));
    assert!(!tissue.move_free(&free(1.0 * MM)));
    // One pressing tool, and one unknown to any step.
    assert!(!tissue.move_free(&tools[0]));
    assert!(!tissue.move_free(&ball(3, 0.0, -20.0 * MM)));
    assert_eq!(tissue.shape().hash(), hash);
    // The next step starts it at its last free position, and lets it touch.
    let report = tissue.step(&[tools[0], free(1.0 * MM)], hand());
    assert!(
        report.reactions[1].contacts > 0 && report.lag_m == 0.0,
        "{report:?}"
    );
}
