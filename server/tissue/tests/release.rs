//! Fast release, and a solver that misses ticks: forces of single quick iterations against converged ones.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const RADIUS: f64 = 8.0 * MM;

/// 64 by 64 by 32 mm of soft tissue, which bottoms out or not.
fn slab(bottoms_out: bool) -> Topology {
    let material = Material {
        young_pa: 10e3,
        bottoms_out,
        ..Material::default()
    };
    Topology::new(Arc::new(block([16, 16, 8], 4.0 * MM, &material, 1)))
}

/// Tool position at tick `k`: 6 mm in at 100 mm/s, held, 10 mm out at 150 mm/s.
fn tool(k: usize) -> Tool {
    let k = k as f64;
    let depth = (0.4 * k).min(6.0).min(6.0 - 0.6 * (k - 30.0)).max(-4.0);
    // Off the nodes, and slightly oblique.
    let centre = Vec3::new(
        33.0 * MM + 0.01 * MM * k,
        30.5 * MM,
        32.0 * MM + RADIUS - depth * MM,
    );
    Tool::ball(1, centre, RADIUS)
}

/// Tool position on a press to 18 mm at 100 mm/s.
fn deep_tool(k: usize) -> Tool {
    let depth = 0.4 * k as f64;
    Tool::ball(
        1,
        Vec3::new(33.0 * MM, 30.5 * MM, 32.0 * MM + RADIUS - depth * MM),
        RADIUS,
    )
}

/// Tool position on a press to 15 mm and back, at 100 mm/s.
fn there_and_back_tool(k: usize) -> Tool {
    let depth = (0.4 * k as f64).min(15.0).min(0.4 * (85.0 - k as f64));
    Tool::ball(
        1,
        Vec3::new(33.0 * MM, 30.5 * MM, 32.0 * MM + RADIUS - depth * MM),
        RADIUS,
    )
}

const TICKS: usize = 48;
const DEEP_TICKS: usize = 45;

/// Force along z at the ticks `at` of a tool, solved with a budget.
fn press(
    topology: &Topology,
    tool: fn(usize) -> Tool,
    at: &[usize],
    near: bool,
    iterations: usize,
    tolerance: f64,
) -> Vec<f64> {
    let mut tissue = Tissue::at_rest(topology.clone());
    at.iter()
        .map(|&k| {
            let budget = Budget {
                near,
                ..Budget::new(iterations, tolerance)
            };
            let report = tissue.step(&[tool(k)], budget);
            report.reactions[0].force.z
        })
        .collect()
}

/// Relative root mean square error against the converged forces, and the largest error relative to the largest
/// force.
fn errors(at: &[usize], iterations: usize, bottoms_out: bool) -> (f64, f64) {
    let topology = slab(bottoms_out);
    let exact = press(&topology, tool, at, false, 100, 1e-5);
    let quick = press(&topology, tool, at, true, iterations, 0.03);
    let apart: Vec<f64> = exact.iter().zip(&quick).map(|(e, q)| q - e).collect();
    let rms = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>().sqrt();
    let most = |v: &[f64]| v.iter().map(|v| v.abs()).fold(0.0, f64::max);
    (rms(&apart) / rms(&exact), most(&apart) / most(&exact))
}

/// Checks tissue that bottoms out and tissue that does not.
fn assert_below(at: &[usize], iterations: usize, (rms_max, most_max): (f64, f64)) {
    for bottoms_out in [false, true] {
        let (rms, most) = errors(at, iterations, bottoms_out);
        assert!(
            rms < rms_max && most < most_max,
            "bottoms out: {bottoms_out}, rms {rms:.3}, most {most:.3}"
        );
    }
}

#[test]
fn one_quick_iteration_per_tick_tracks_press_and_release() {
    let every: Vec<usize> = (1..=TICKS).collect();
    assert_below(&every, 1, (0.032, 0.08));
}

#[test]
fn two_quick_iterations_per_tick_track_closely() {
    let every: Vec<usize> = (1..=TICKS).collect();
    assert_below(&every, 2, (0.025, 0.065));
}

#[test]
fn missed_ticks_cause_no_force_peaks() {
    // Gaps of up to 12 ticks.
    let some = [3, 4, 9, 10, 18, 19, 20, 27, 33, 35, 38, 39, 44, 46];
    assert_below(&some, 2, (0.12, 0.25));
}

#[test]
fn node_with_invalid_position_is_reset_without_delay() {
    let topology = slab(true);
    let mut tissue = Tissue::at_rest(topology.clone());
    let step = |k: usize, tissue: &mut Tissue| {
        let budget = Budget {
            near: true,
            ..Budget::new(2, 0.03)
        };
        let report = tissue.step(&[tool(k)], budget);
        (report.rolled_back, report.reactions[0].force.z)
    };
    let mut before = 0.0;
    for k in 0..10 {
        let (rolled_back, force) = step(k, &mut tissue);
        assert!(!rolled_back);
        before = force;
    }
    let lost = (0..topology.node_count() as u32)
        .rfind(|&n| tissue.shape().displacement[n as usize].norm() > MM)
        .unwrap();
    tissue.displace(&[(lost, Vec3::y() * f64::NAN)]);
    // The shape is that before but for this node, and so is the force.
    let (rolled_back, force) = step(9, &mut tissue);
    assert!(
        rolled_back && (force / before - 1.0).abs() < 0.2,
        "{force} {before}"
    );
    step(10, &mut tissue);
    for k in 11..30 {
        step(k, &mut tissue);
    }
    let (rolled_back, force) = step(30, &mut tissue);
    let whole = press(
        &topology,
        tool,
        &(0..=30).collect::<Vec<_>>(),
        true,
        2,
        0.03,
    );
    let error = force / whole.last().unwrap() - 1.0;
    assert!(!rolled_back && error.abs() < 0.1, "{error}");
    assert!(
        tissue
            .shape()
            .displacement
            .iter()
            .all(|u| u.norm().is_finite())
    );
}

#[test]
fn fine_tissue_tracks_a_deep_release_without_suction() {
    let material = Material {
        young_pa: 10e3,
        ..Material::default()
    };
    let topology = Topology::new(Arc::new(block([32, 32, 16], 2.0 * MM, &material, 1)));
    let every: Vec<usize> = (1..=84).collect();
    let quick = press(&topology, there_and_back_tool, &every, true, 1, 0.03);
    assert!(quick.iter().all(|f| *f >= 0.0), "{quick:?}");
    let some: Vec<usize> = (46..=82).step_by(4).collect();
    let exact = press(&topology, there_and_back_tool, &some, false, 100, 1e-3);
    let apart: Vec<f64> = some
        .iter()
        .zip(&exact)
        .map(|(&k, e)| quick[k - 1] / e - 1.0)
        .collect();
    let rms = (apart.iter().map(|e| e * e).sum::<f64>() / apart.len() as f64).sqrt();
    assert!(rms < 0.1, "{apart:?}");
}

#[test]
fn press_after_release_is_bit_equal_to_the_first() {
    let topology = slab(true);
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut press = || -> Vec<u64> {
        let tick = |k: usize| {
            let budget = Budget {
                near: true,
                ..Budget::new(1, 0.03)
            };
            let report = tissue.step(&[tool(k)], budget);
            report.reactions[0].force.z.to_bits()
        };
        (1..=TICKS).map(tick).collect()
    };
    let first = press();
    assert!(f64::from_bits(first[20]) > 0.1);
    assert_eq!(press(), first);
    assert!(
        tissue
            .shape()
            .displacement
            .iter()
            .all(|u| *u == Vec3::zeros())
    );
}

#[test]
fn tool_below_the_rest_surface_waits_for_recovering_tissue() {
    // It withdraws 5 mm at once and stays 5 mm below the surface at rest.
    let topology = slab(true);
    let at = |depth: f64| Tool {
        centre: Vec3::new(33.0 * MM, 30.5 * MM, 32.0 * MM + RADIUS - depth * MM),
        ..tool(0)
    };
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut step = |depth: f64| {
        let budget = Budget {
            near: true,
            ..Budget::new(1, 0.03)
        };
        let report = tissue.step(&[at(depth)], budget);
        report.reactions[0].force.z
    };
    for k in 0..25 {
        step(0.4 * f64::from(k));
    }
    let forces: Vec<f64> = (0..40).map(|k| step(5.0 + 1e-6 * f64::from(k))).collect();
    let mut tissue = Tissue::at_rest(topology.clone());
    let report = tissue.step(&[at(5.0)], Budget::new(200, 1e-4));
    let exact = report.reactions[0].force.z;
    assert!(
        forces.iter().all(|f| *f < 2.0 * exact),
        "{forces:?} {exact}"
    );
    let error = forces[39] / exact - 1.0;
    assert!(error.abs() < 0.05, "{error}");
}

#[test]
fn one_quick_iteration_per_tick_bounds_the_error_in_a_deep_press() {
    let topology = slab(true);
    let every: Vec<usize> = (1..=DEEP_TICKS).collect();
    let exact = press(&topology, deep_tool, &every, false, 100, 1e-3);
    let quick = press(&topology, deep_tool, &every, true, 1, 0.03);
    for (k, (exact, quick)) in exact.iter().zip(&quick).enumerate() {
        let error = quick / exact - 1.0;
        assert!(error.abs() < 0.04, "tick {k}: {error:.3}");
    }
}

/// Skin of one cell over soft tissue that hardly changes its volume, pressed to 8 mm and released, at 0.4 mm per iteration.
#[test]
fn stiff_skin_is_felt_within_a_tenth_on_the_way_in() {
    let material = Material {
        young_pa: 12e3,
        poisson: 0.45,
        ..Material::default()
    };
    let mut model = block([40, 40, 14], 2.0 * MM, &material, 1);
    let mut skin = model.regions[0].clone();
    skin.material.young_pa = 130e3;
    skin.pinned = false;
    model.regions.push(skin);
    let skin = palpate_tissue::RegionId(model.regions.len() as u16 - 1);
    for cell in 0..model.cells.len() {
        if model.corners_of(cell).iter().all(|p| p.z > 25.5 * MM) {
            model.cells[cell].region = skin;
        }
    }
    let ball = |k: usize| {
        let depth = 0.4 * MM * k as f64;
        Tool::ball(
            1,
            Vec3::new(40.0 * MM, 40.0 * MM, 28.0 * MM + RADIUS - depth),
            RADIUS,
        )
    };
    let mut quick = Tissue::at_rest(Topology::new(Arc::new(model)));
    let mut exact = quick.another();
    let at = [2, 6, 10, 14, 18];
    let exact = at.map(|k| {
        exact.step(&[ball(k)], Budget::new(100, 1e-3)).reactions[0]
            .force
            .z
    });
    let mut square = [0.0; 2];
    for (k, back) in (1..=20)
        .map(|k| (k, 0))
        .chain((1..20).rev().map(|k| (k, 1)))
    {
        let budget = Budget {
            near: true,
            ..Budget::new(1, 0.02)
        };
        let force = quick.step(&[ball(k)], budget).reactions[0].force.z;
        if let Some(i) = at.iter().position(|&a| a == k) {
            square[back] += (force / exact[i] - 1.0).powi(2) / at.len() as f64;
        }
    }
    let [press, release] = square.map(f64::sqrt);
    assert!(press < 0.1 && release < 0.2, "{press} {release}");
}
