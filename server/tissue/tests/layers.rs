//! Layers of other stiffness over muscle: forces of quick steps against converged ones, and deep presses.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Model, RegionId, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const CELL: f64 = 4.0 * MM;
const RADIUS: f64 = 8.0 * MM;
/// Ticks of a press to 12 mm at 100 mm/s, of which every third is compared.
const TICKS: usize = 30;

fn material(young_pa: f64, poisson: f64) -> Material {
    Material {
        young_pa,
        poisson,
        ..Material::default()
    }
}

/// Muscle of 12 kPa under a layer of 8 mm.
fn covered_muscle(cells: [usize; 3], layer_pa: f64, poisson: f64) -> Model {
    let mut model: Model = block(cells, CELL, &material(12e3, poisson), 1);
    let mut layer = model.regions[0].clone();
    "layer".clone_into(&mut layer.name);
    layer.material = material(layer_pa, poisson);
    layer.pinned = false;
    let id = RegionId(model.regions.len() as u16);
    model.regions.push(layer);
    let below = cells[2] as i32 - 2;
    for cell in &mut model.cells {
        if model.lattice[cell.corners[0] as usize][2] >= below {
            cell.region = id;
        }
    }
    model
}

/// Muscle, 36 mm thick, under a layer.
fn uneven_slab(layer_pa: f64) -> Topology {
    let mut model = covered_muscle([32, 32, 11], layer_pa, 0.45);
    // Cells are not exact cubes, as in models of anatomy.
    for (n, node) in model.nodes.iter_mut().enumerate() {
        let n = n as f64;
        *node += 0.02 * CELL * Vec3::new(n.sin(), (2.0 * n).sin(), (3.0 * n).sin());
    }
    Topology::new(Arc::new(model))
}

/// Forces at every third tick.
fn press(topology: &Topology, budget: impl Fn() -> Budget<'static>, every: usize) -> Vec<f64> {
    let mut tissue = Tissue::at_rest(topology.clone());
    let ticks = (every..=TICKS).step_by(every);
    let forces = ticks.map(|k| {
        let depth = 0.4 * MM * k as f64;
        // Off the nodes.
        let centre = Vec3::new(65.0 * MM, 62.5 * MM, 44.0 * MM + RADIUS - depth);
        let report = tissue.step(&[Tool::ball(1, centre, RADIUS)], budget());
        (k, report.reactions[0].force.z)
    });
    let third = forces.filter(|(k, _)| k % 3 == 0);
    third.map(|(_, force)| force).collect()
}

/// Relative errors of a press with two quick iterations per tick.
fn errors(layer_pa: f64) -> Vec<f64> {
    let topology = uneven_slab(layer_pa);
    let quick = || Budget {
        near: true,
        ..Budget::new(2, 0.02)
    };
    let exact = press(&topology, || Budget::new(100, 1e-4), 3);
    let forces = press(&topology, quick, 1);
    let errors = forces.iter().zip(&exact).map(|(f, e)| f / e - 1.0);
    errors.collect()
}

#[test]
fn quick_steps_feel_stiff_and_soft_layers() {
    // Skin over muscle, muscle alone, and a soft layer.
    for layer_pa in [130e3, 12e3, 3e3] {
        let errors = errors(layer_pa);
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        assert!(rms < 0.04, "layer of {layer_pa} Pa: {errors:.3?}");
    }
}

/// Residual forces of a deep press add no work to its withdrawal.
#[test]
fn withdrawal_refines_hardly_more_nodes_than_the_press() {
    for layer_pa in [130e3, 3e3] {
        let mut tissue = Tissue::at_rest(uneven_slab(layer_pa));
        let mut nodes = |k: i32| {
            let depth = 0.4 * MM * f64::from(k);
            let centre = Vec3::new(65.0 * MM, 62.5 * MM, 44.0 * MM + RADIUS - depth);
            let budget = Budget {
                near: true,
                ..Budget::new(2, 0.02)
            };
            let report = tissue.step(&[Tool::ball(1, centre, RADIUS)], budget);
            report.active_nodes
        };
        let pressed = (1..=37).map(&mut nodes).max().unwrap();
        let withdrawn = (0..37).rev().map(&mut nodes).max().unwrap();
        assert!(
            withdrawn < pressed * 3 / 2,
            "layer of {layer_pa} Pa: {withdrawn} and {pressed} nodes"
        );
    }
}

/// Forces in N of a press to 18 mm at 100 mm/s, and the largest depth in m of a node of the surface in the ball.
fn press_deep(topology: &Topology, budget: impl Fn() -> Budget<'static>) -> (Vec<f64>, f64) {
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut sunk: f64 = 0.0;
    let forces = (1..=45).map(|k| {
        let depth = 0.4 * MM * f64::from(k);
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
        let model = covered_muscle([24, 24, 10], 3e3, poisson);
        let topology = Topology::new(Arc::new(model));
        let (exact, sunk) = press_deep(&topology, || Budget::new(100, 1e-3));
        assert!(
            exact.windows(2).all(|f| f[1] > f[0]),
            "ν {poisson}: {exact:.3?}"
        );
        assert!(sunk < 0.1 * MM, "ν {poisson}: {sunk} m");
        let quick = || Budget {
            near: true,
            ..Budget::new(2, 0.02)
        };
        let (quick, _) = press_deep(&topology, quick);
        let apart = quick.iter().zip(&exact).map(|(q, e)| q / e - 1.0).skip(5);
        let worst = apart.map(f64::abs).fold(0.0, f64::max);
        assert!(worst < 0.1, "ν {poisson}: {worst}, {quick:.3?} {exact:.3?}");
    }
}
