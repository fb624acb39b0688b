//! Laws of tissue under gravity: support forces and sag.

#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use palpate_tissue::{
    BladePoint, Budget, CutStroke, Material, Tissue, Tool, Topology, Vec3, block, cut,
};

const MM: f64 = 1e-3;
const SPACING: f64 = 4.0 * MM;
const YOUNG_PA: f64 = 10e3;
const DENSITY: f64 = 1000.0;
const RADIUS: f64 = 8.0 * MM;

fn heavy(cells: [usize; 3], gravity: [f64; 3]) -> Topology {
    let material = Material {
        young_pa: YOUNG_PA,
        density_kg_m3: DENSITY,
        ..Material::default()
    };
    let mut model = block(cells, SPACING, &material, 1);
    model.gravity = gravity;
    Topology::new(Arc::new(model))
}

/// Equilibrium under gravity without tools.
fn hanging(topology: &Topology) -> Tissue {
    let mut tissue = Tissue::at_rest(topology.clone());
    tissue.step(&[], Budget::new(1, 1e-3));
    tissue
}

fn nodes(topology: &Topology) -> impl Iterator<Item = u32> + use<> {
    0..topology.node_count() as u32
}

/// Force on the pinned nodes, in N.
fn carried(tissue: &Tissue) -> Vec3 {
    let topology = tissue.topology();
    nodes(topology)
        .filter(|&n| topology.is_pinned(n))
        .map(|n| tissue.force_on(n))
        .sum()
}

fn weight(topology: &Topology) -> Vec3 {
    let mass: f64 = nodes(topology).map(|n| topology.mass(n)).sum();
    Vec3::from(topology.model().gravity) * mass
}

/// A stroke along y at `x`, from `bottom` through the top; the far `uncut` along y stays uncut.
fn slit(topology: &Topology, x: f64, bottom: f64, uncut: f64) -> CutStroke {
    let far = nodes(topology)
        .map(|n| topology.rest(n).y)
        .fold(0.0, f64::max);
    let from = -2.0 * SPACING;
    let to = far - uncut;
    let points = (0..=20).map(|i| BladePoint {
        tip: Vec3::new(x, from + (to - from) * f64::from(i) / 20.0, bottom),
        axis: Vec3::z(),
        depth_m: 0.5,
    });
    CutStroke {
        points: points.collect(),
        width_m: 0.0,
    }
}

fn press(k: usize, top: f64, middle: f64) -> Tool {
    // Half a millimetre down per tick, up again, and off the surface.
    let depth = 0.5 * MM * (12.0 - (k as f64 - 12.0).abs());
    Tool::ball(
        1,
        Vec3::new(middle, middle, top + RADIUS + 0.2 * MM - depth),
        RADIUS,
    )
}

#[test]
fn column_stretches_under_its_weight_like_a_bar() {
    // Held at its lowest layer with gravity upwards, as if it hung from a ceiling.
    let gravity = 1.0;
    let topology = heavy([6, 6, 40], [0.0, 0.0, gravity]);
    let tissue = hanging(&topology);
    let sag = tissue.sag().unwrap();
    assert!(sag.residual <= 1e-4, "{sag:?}");
    let top = 40.0 * SPACING;
    let end: Vec<f64> = nodes(&topology)
        .filter(|&n| topology.rest(n).z > top - 0.1 * SPACING)
        .map(|n| tissue.shape().displacement[n as usize].z)
        .collect();
    let mean = end.iter().sum::<f64>() / end.len() as f64;
    let length = 39.0 * SPACING;
    let expected = DENSITY * gravity * length * length / (2.0 * YOUNG_PA);
    // The clamp keeps the foot from thinning over about one width: a percent of the length.
    assert!(
        (mean / expected - 1.0).abs() < 0.03,
        "{mean} m instead of {expected}"
    );
}

#[test]
fn pinned_nodes_carry_all_weight() {
    for gravity in [[0.0, 0.0, -9.81], [3.0, -2.0, 5.0]] {
        let mut topology = heavy([10, 10, 8], gravity);
        for cuts in 0..2 {
            if cuts == 1 {
                let stroke = slit(&topology, 18.3 * MM, 10.0 * MM, 0.0);
                cut(&mut topology, &stroke).unwrap();
            }
            let mut tissue = hanging(&topology);
            let (carried, weight) = (carried(&tissue), weight(&topology));
            assert!(
                (carried - weight).norm() < 1e-3 * weight.norm(),
                "{carried:?} N instead of {weight:?}, {cuts} cuts, {:?}",
                tissue.sag()
            );
            assert!(tissue.residual_over_all() < 2e-4);
        }
    }
}

#[test]
fn released_tissue_returns_to_the_same_sag_bit_for_bit() {
    let topology = heavy([16, 16, 8], [0.0, 0.0, -40.0]);
    let mut tissue = hanging(&topology);
    let (home, sag) = (tissue.shape().hash(), tissue.sag().unwrap().displaced_m);
    assert!(sag > 1.0 * MM, "{sag}");
    let at_top = nodes(&topology).filter(|&n| topology.rest(n).z > 31.9 * MM);
    let highest = at_top.map(|n| tissue.shape().position(&topology, n).z);
    let top = highest.fold(0.0, f64::max);
    let mut forces = [Vec::new(), Vec::new()];
    for forces in &mut forces {
        for k in 0..=40 {
            let budget = Budget {
                near: true,
                ..Budget::new(2, 0.03)
            };
            let tool = press(k, top, 32.0 * MM);
            let report = tissue.step(&[tool], budget);
            forces.push(report.reactions.first().map_or(0.0, |r| r.force.z));
        }
        assert_eq!(tissue.shape().hash(), home);
    }
    assert_eq!(forces[0], forces[1]);
    // The tick forces agree with those of a converged press.
    let mut exact = hanging(&topology);
    let most = forces[0].iter().copied().fold(0.0, f64::max);
    for k in 0..=12 {
        let tool = press(k, top, 32.0 * MM);
        let report = exact.step(&[tool], Budget::new(100, 1e-5));
        let force = report.reactions.first().map_or(0.0, |r| r.force.z);
        assert!(
            (force - forces[0][k]).abs() < 0.05 * most,
            "tick {k}: {} N instead of {force}, at most {most}",
            forces[0][k]
        );
    }
}

#[test]
fn flap_sag_is_equal_for_updated_and_new_solvers() {
    let topology = heavy([10, 10, 8], [-9.81, 0.0, 0.0]);
    let mut tissue = hanging(&topology);
    let (mut preparer, mut other) = (tissue.preparer(), hanging(&topology));
    let before = tissue.sag().unwrap().displaced_m;
    let stroke = slit(&topology, 18.3 * MM, 10.0 * MM, 0.0);
    tissue.cut(&stroke).unwrap();
    tissue.step(&[], Budget::new(1, 1e-3));
    other.succeed(preparer.prepare(&stroke).unwrap());
    other.step(&[], Budget::new(1, 1e-3));
    assert_eq!(tissue.shape().hash(), other.shape().hash());
    let after = tissue.sag().unwrap();
    assert!(after.displaced_m > 1.1 * before, "{before} {after:?}");
    // A solver created on the cut tissue agrees within the residual.
    let afresh = hanging(tissue.topology());
    let apart = tissue
        .shape()
        .displacement
        .iter()
        .zip(&afresh.shape().displacement);
    let apart = apart.map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    assert!(apart < 0.01 * after.displaced_m, "{apart} {after:?}");
}

#[test]
fn detached_piece_has_no_weight_and_stays() {
    let topology = heavy([8, 8, 8], [0.0, 0.0, -9.81]);
    let mut tissue = hanging(&topology);
    // A level cut through the whole block, above the base.
    let points = (0..=20).map(|i| BladePoint {
        tip: Vec3::new(
            -10.0 * MM,
            -8.0 * MM + 48.0 * MM * f64::from(i) / 20.0,
            17.7 * MM,
        ),
        axis: Vec3::x(),
        depth_m: 0.06,
    });
    let stroke = CutStroke {
        points: points.collect(),
        width_m: 0.0,
    };
    tissue.cut(&stroke).unwrap();
    assert_eq!(tissue.topology().components(), 2);
    let report = tissue.step(&[], Budget::new(50, 1e-3));
    assert!(!report.rolled_back);
    // The base carries only the tissue still connected to it.
    let mut left = weight(&topology) * (17.7 / 32.0);
    left.z -= carried(&tissue).z;
    assert!(left.norm() < 0.15 * weight(&topology).norm(), "{left:?}");
    let farthest = tissue
        .shape()
        .displacement
        .iter()
        .map(Vec3::norm)
        .fold(0.0, f64::max);
    assert!(farthest < 10.0 * MM, "{farthest}");
}

#[test]
fn sag_is_bit_equal_on_any_thread_count() {
    let topology = heavy([24, 24, 12], [1.0, 2.0, -9.0]);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| hanging(&topology).shape().hash())
    };
    let one = on(1);
    assert_eq!([one; 2], [on(2), on(4)]);
}
