//! Needles in blocks with known forces.

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::UnitQuaternion;
use palpate_tissue::{
    Budget, Form, Material, Needle, Reaction, RegionId, Tissue, Tool, Topology, Vec3, block,
};
use proptest::prelude::*;

const MM: f64 = 1e-3;
const D: f64 = 4.0 * MM;
const CELLS: [usize; 3] = [10, 10, 8];
const TOP: f64 = 8.0 * D;
const RADIUS: f64 = 0.6 * MM;
const LENGTH: f64 = 60.0 * MM;
/// Force of the tip of a needle in the block.
const CUTTING_N: f64 = 250.0 * 2.0 * RADIUS;

fn material() -> Material {
    Material {
        young_pa: 20e3,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        toughness_j_m2: 250.0,
        ..Material::default()
    }
}

/// Greatest friction per length, static and dynamic, N/m.
fn friction_n_m() -> [f64; 2] {
    material()
        .needle_traction_pa()
        .map(|p| p * 2.0 * PI * RADIUS)
}

fn needle(at: Vec3) -> Tool {
    let needle = Needle {
        is_inserted: false,
        decides: true,
    };
    Tool {
        form: Form::line(Vec3::zeros(), Vec3::z() * LENGTH),
        needle: Some(needle),
        ..Tool::ball(1, at, RADIUS)
    }
}

/// A point above the block, or in it at negative heights.
fn over(x: f64, height: f64) -> Vec3 {
    Vec3::new(5.1 * D + x, 4.9 * D, TOP + height)
}

struct Bench {
    tissue: Tissue,
    at: Vec3,
    /// Work of the hand, J, by the force at both ends of each step.
    work_j: f64,
    last: Option<Reaction>,
}

impl Bench {
    fn new() -> Self {
        Self::of(Topology::new(Arc::new(block(CELLS, D, &material(), 1))))
    }

    fn of(topology: Topology) -> Self {
        Self {
            tissue: Tissue::at_rest(topology),
            at: over(0.0, 3.0 * MM),
            work_j: 0.0,
            last: None,
        }
    }

    fn step(&mut self, tool: &Tool) -> &Reaction {
        let report = self.tissue.step(&[*tool], Budget::new(200, 1e-4));
        assert!(!report.rolled_back);
        let new = report.reactions[0].clone();
        let before = self.last.as_ref().map_or(new.force, |last| last.force);
        self.work_j -= 0.5 * (before + new.force).dot(&(tool.centre - self.at));
        self.at = tool.centre;
        self.last.insert(new)
    }

    /// Moves the needle straight to a point in steps of a quarter of a millimetre.
    fn go(&mut self, to: Vec3, mut note: impl FnMut(Vec3, &Reaction)) {
        let from = self.at;
        let steps = ((to - from).norm() / (0.25 * MM)).ceil().max(1.0) as usize;
        for k in 1..=steps {
            let at = from + (to - from) * (k as f64 / steps as f64);
            let tool = needle(at);
            note(at, self.step(&tool));
        }
    }
}

fn axial(reaction: &Reaction) -> f64 {
    reaction.force.z
}

#[test]
fn needle_punctures_at_its_cutting_force_slides_with_friction_and_leaves() {
    let mut bench = Bench::new();
    let mut forces = Vec::new();
    bench.go(over(0.0, -20.0 * MM), |_, r| {
        let length = r.shaft.map_or(0.0, |shaft| shaft.stations[1].0.z);
        forces.push((length, axial(r)));
    });
    // Up to its cutting force it dents the surface.
    let dented = forces.iter().position(|f| f.1 > 0.98 * CUTTING_N);
    let depth = dented.expect("it punctures") as f64 * 0.25 * MM - 3.0 * MM;
    assert!((1.0 * MM..8.0 * MM).contains(&depth), "{depth}");
    // The cutting force and the friction over the length in the tissue.
    let [_, sliding] = friction_n_m();
    for (length, force) in forces.iter().filter(|f| f.0 > 1.01 * D) {
        let expected = CUTTING_N + sliding * length;
        assert!(
            (0.97..1.03).contains(&(force / expected)),
            "{length}: {force} {expected}"
        );
    }
    // Back: the friction alone, after the tie has turned around.
    let mut out = Vec::new();
    bench.go(over(0.0, 10.0 * MM), |at, r| {
        out.push((TOP - at.z, axial(r), r.shaft.is_some()));
    });
    let [at_rest, _] = friction_n_m();
    let lowest = out.iter().map(|o| o.1).fold(0.0, f64::min);
    assert!(
        lowest < -0.5 * sliding * 15.0 * MM && lowest > -at_rest * 22.0 * MM,
        "{lowest}"
    );
    assert!(
        out.last().is_some_and(|o| !o.2 && o.1 == 0.0),
        "{:?}",
        out.last()
    );
    assert!(
        bench.work_j > 0.9 * CUTTING_N * 10.0 * MM,
        "{}",
        bench.work_j
    );
}

#[test]
fn blunt_tool_never_punctures() {
    let mut bench = Bench::new();
    for k in 1..=40 {
        let tool = Tool {
            needle: None,
            radius_m: 3.0 * MM,
            ..needle(over(0.0, 3.0 * MM - 0.25 * MM * f64::from(k)))
        };
        assert!(bench.step(&tool).shaft.is_none());
    }
    let deepest = bench.last.map(|r| axial(&r)).unwrap();
    assert!(deepest > 1.5 * CUTTING_N, "{deepest}");
}

#[test]
fn needle_stops_at_bone_under_soft_tissue() {
    let mut model = block(CELLS, D, &material(), 2);
    let base = &mut model.regions[0].material;
    (base.toughness_j_m2, base.young_pa) = (5_000.0, 1e9);
    let mut bench = Bench::of(Topology::new(Arc::new(model)));
    let mut deepest = 0.0;
    bench.go(over(0.0, -23.0 * MM), |_, r| deepest = axial(r));
    assert!(deepest < 3.0 * CUTTING_N, "{deepest}");
    bench.go(over(0.0, -26.0 * MM), |_, r| deepest = axial(r));
    assert!(deepest > 8.0 * CUTTING_N, "{deepest}");
}

#[test]
fn tissue_moves_with_a_needle_that_moves_sideways_and_pushes_back() {
    let mut bench = Bench::new();
    bench.go(over(0.0, -18.0 * MM), |_, _| ());
    let before = bench.last.as_ref().map(|r| r.force.x).unwrap();
    bench.go(over(2.0 * MM, -18.0 * MM), |_, _| ());
    let held = bench.last.clone().unwrap();
    assert!(
        before.abs() < 0.05 && held.force.x < -0.2,
        "{before} {}",
        held.force
    );
    let near = (0..bench.tissue.topology().node_count() as u32)
        .min_by_key(|&n| {
            let away = bench.tissue.topology().rest(n) - over(0.0, -8.0 * MM);
            (away.norm() * 1e9) as u64
        })
        .unwrap();
    let moved = bench.tissue.shape().displacement[near as usize].x;
    assert!(moved > 0.5 * MM, "{moved}");
    bench.go(over(0.0, -18.0 * MM), |_, _| ());
    let after = bench.last.as_ref().map(|r| r.force.x).unwrap();
    assert!((after - before).abs() < 0.1 * held.force.x.abs(), "{after}");
}

/// Another site does not decide, and has the same shape.
#[test]
fn shape_that_follows_the_decision_of_another_has_the_same_forces() {
    let (mut bench, mut other) = (Bench::new(), Bench::new());
    let mut differs = 0.0_f64;
    for k in 0..160 {
        let way = f64::from(if k < 80 { k } else { 160 - k });
        let tool = needle(over(0.0, 3.0 * MM - 0.25 * MM * way));
        let decided = bench.step(&tool).clone();
        let is_inserted = decided.shaft.is_some();
        let needle = Some(Needle {
            is_inserted,
            decides: false,
        });
        let follows = other.step(&Tool { needle, ..tool });
        assert_eq!(follows.shaft.is_some(), is_inserted, "{k}");
        differs = differs.max((follows.force - decided.force).norm());
    }
    assert!(differs < 0.15 * CUTTING_N, "{differs}");
    // A shape that starts with an inserted needle: a newcomer.
    let mut newcomer = Bench::new();
    bench.go(over(0.0, -18.0 * MM), |_, _| ());
    let state = Some(Needle {
        is_inserted: true,
        decides: false,
    });
    let found = newcomer.step(&Tool {
        needle: state,
        ..needle(bench.at)
    });
    assert!(
        found.shaft.is_some() && found.force.norm() < 1.2 * CUTTING_N,
        "{found:?}"
    );
}

/// The needle of a browser: its samples carry the decision of the server's shape, some steps late.
#[test]
fn late_decision_of_the_same_shape_inserts_and_withdraws() {
    const LATE: usize = 12;
    let mut bench = Bench::new();
    let mut decided = vec![false; LATE];
    let (mut held, mut pull) = (Vec::new(), 0.0_f64);
    for k in 0..220 {
        let way = f64::from(if k < 80 { k } else { (160 - k).max(-20) });
        let tool = needle(over(0.0, 3.0 * MM - 0.25 * MM * way));
        let needle = Some(Needle {
            is_inserted: decided[decided.len() - LATE],
            decides: false,
        });
        let reaction = bench.step(&Tool { needle, ..tool });
        pull = pull.min(axial(reaction));
        held.push(reaction.shaft.is_some());
        decided.push(reaction.is_inserted);
    }
    let changes = held.windows(2).filter(|w| w[0] != w[1]).count();
    assert_eq!((changes, held.last()), (2, Some(&false)), "{held:?}");
    assert!(pull < -0.1 * CUTTING_N, "{pull}");
}

#[test]
fn layer_of_tough_skin_gives_a_peak() {
    let mut model = block(CELLS, D, &material(), 1);
    let mut skin = model.regions[1].clone();
    skin.material.toughness_j_m2 = 1_000.0;
    model.regions.push(skin);
    for cell in &mut model.cells {
        let z = cell.corners.map(|n| model.nodes[n as usize].z);
        if z.iter().sum::<f64>() / 8.0 > TOP - D {
            cell.region = RegionId(2);
        }
    }
    let mut bench = Bench::of(Topology::new(Arc::new(model)));
    let mut forces = Vec::new();
    bench.go(over(0.0, -22.0 * MM), |_, r| forces.push(axial(r)));
    let peak = forces.iter().copied().fold(0.0, f64::max);
    let end = forces[forces.len() - 1];
    assert!((0.85..1.25).contains(&(peak / (4.0 * CUTTING_N))), "{peak}");
    assert!(end < 0.6 * peak, "{end}");
}

/// Without cutting and friction nothing is lost that could hide a gain.
#[test]
fn needle_that_shifts_between_two_depths_gives_no_energy() {
    let smooth = Material {
        toughness_j_m2: 0.0,
        friction_static: 0.0,
        friction_dynamic: 0.0,
        ..material()
    };
    let mut bench = Bench::of(Topology::new(Arc::new(block(CELLS, D, &smooth, 1))));
    bench.go(over(0.0, -20.0 * MM), |_, _| ());
    bench.go(over(0.0, -18.0 * MM), |_, _| ());
    bench.work_j = 0.0;
    for cycle in 0..10 {
        bench.go(over(0.0, -5.0 * MM), |_, _| ());
        bench.go(over(2.0 * MM, -5.0 * MM), |_, _| ());
        bench.go(over(2.0 * MM, -18.0 * MM), |_, _| ());
        bench.go(over(0.0, -18.0 * MM), |_, _| ());
        assert!(bench.work_j >= -1e-6, "{cycle}: {}", bench.work_j);
    }
}

#[test]
fn tip_returns_in_its_channel_without_force_and_cuts_beside_it() {
    for (degrees, cuts) in [(0.0_f64, false), (25.0, true)] {
        let mut bench = Bench::new();
        bench.go(over(0.0, -20.0 * MM), |_, _| ());
        bench.go(over(0.0, -5.0 * MM), |_, _| ());
        let mut greatest_n = 0.0_f64;
        let turned = |degrees: f64, way: f64| {
            let turn = UnitQuaternion::from_axis_angle(&Vec3::y_axis(), degrees.to_radians());
            Tool {
                turn,
                ..needle(over(0.0, -5.0 * MM) - turn * Vec3::z() * way)
            }
        };
        for k in 1..=25 {
            bench.step(&turned(degrees * f64::from(k) / 25.0, 0.0));
        }
        for k in 1..=40 {
            let shaft = bench.step(&turned(degrees, 0.25 * MM * f64::from(k))).shaft;
            let shaft = shaft.expect("it stays in");
            greatest_n = greatest_n.max(shaft.axial_n - shaft.friction_n);
        }
        assert_eq!(
            greatest_n > 0.9 * CUTTING_N,
            cuts,
            "{degrees}: {greatest_n}"
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]
    /// A hand that moves a needle about and takes it out gains no energy.
    #[test]
    fn needle_on_a_closed_path_gives_no_energy(
        path in proptest::collection::vec((-3.0..3.0f64, -20.0..4.0f64), 2..5),
    ) {
        let mut bench = Bench::new();
        let start = bench.at;
        bench.go(over(0.0, -12.0 * MM), |_, _| ());
        for (x, height) in path {
            let x = if height > 0.0 { 0.0 } else { x };
            bench.go(over(x * MM, height * MM), |_, _| ());
        }
        bench.go(over(0.0, -8.0 * MM), |_, _| ());
        bench.go(over(0.0, 12.0 * MM), |_, _| ());
        bench.go(start, |_, _| ());
        prop_assert!(bench.work_j > 0.0, "{}", bench.work_j);
    }
}
