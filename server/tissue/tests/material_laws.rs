//! Effect of the stiffening curve and the fibres on a bar, and convergence of the contact force under lattice
//! refinement.

#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use palpate_tissue::{Budget, FibreAxis, Material, Model, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const SPACING: f64 = 4.0 * MM;
const YOUNG_PA: f64 = 10e3;
/// Residual of a solve; the results are accurate to 1 % or better.
const TOLERANCE: f64 = 5e-4;
/// Strain increment per step: a jump would stretch the surface cells many times as far.
const STRAIN_STEP: f64 = 0.01;

fn plain() -> Material {
    Material {
        young_pa: YOUNG_PA,
        ..Material::default()
    }
}

/// A bar of cubes with nothing pinned.
fn bar(cells: [usize; 3], material: &Material) -> Model {
    block(cells, SPACING, material, 0)
}

/// Holds the nodes that `on` selects at a field per strain, which is applied in steps; converges in each.
fn held(
    topology: &Topology,
    strain: f64,
    field: impl Fn(u32, Vec3) -> Option<Vec3>,
) -> (Tissue, Vec<u32>) {
    let mut tissue = Tissue::at_rest(topology.clone());
    let mut nodes = Vec::new();
    let steps = (strain.abs() / STRAIN_STEP).ceil().max(1.0) as usize;
    for step in 1..=steps {
        let now = strain * step as f64 / steps as f64;
        nodes.clear();
        for node in 0..topology.node_count() as u32 {
            if let Some(u) = field(node, topology.rest(node)) {
                assert!(tissue.hold(node, u * now));
                nodes.push(node);
            }
        }
        let report = tissue.step(&[], Budget::new(300, TOLERANCE));
        assert!(!report.rolled_back, "blown up at a strain of {now}");
        assert!(report.residual <= TOLERANCE, "residual {}", report.residual);
    }
    (tissue, nodes)
}

/// Work of the held nodes per unit of strain when all of the surface follows u = e z ẑ.
fn confined_work(topology: &Topology, strain: f64) -> f64 {
    let (tissue, nodes) = held(topology, strain, |node, p| {
        topology.on_boundary(node).then_some(Vec3::z() * p.z)
    });
    nodes
        .iter()
        .map(|&n| -tissue.force_on(n).z * topology.rest(n).z)
        .sum()
}

/// The same in closed form. A uniform strain of a lattice of cubes is an equilibrium, because each spring of an
/// inner node has an equal one on the other side. Every spring has the length given by the strain and pulls
/// with k l0 (exp(b e) - 1)/b. By virtual work the surface force is the sum of these, each times the change of
/// the spring's height per unit of strain.
fn closed_work(topology: &Topology, strain: f64, stiffening: f64) -> f64 {
    let mut work = 0.0;
    for node in 0..topology.node_count() as u32 {
        let springs = topology.springs_of(node);
        for spring in springs.iter().filter(|s| s.to > node) {
            let rest = topology.rest(spring.to) - topology.rest(node);
            let now = rest + Vec3::z() * (strain * rest.z);
            let own = now.norm() / rest.norm() - 1.0;
            let force = f64::from(spring.stiffness) * rest.norm() * curve(own, stiffening);
            work += force * now.z / now.norm() * rest.z;
        }
    }
    work
}

/// (exp(b e) - 1)/b, and e where b is zero.
fn curve(e: f64, b: f64) -> f64 {
    if b == 0.0 { e } else { (b * e).exp_m1() / b }
}

#[test]
fn confined_stiffening_bar_follows_the_closed_form() {
    for stiffening in [0.0, 5.0, 20.0] {
        let material = Material {
            stiffening,
            ..plain()
        };
        let topology = Topology::new(Arc::new(bar([5, 5, 12], &material)));
        for strain in [-0.15, -0.05, 0.01, 0.05, 0.15] {
            let measured = confined_work(&topology, strain);
            let closed = closed_work(&topology, strain, stiffening);
            let error = measured / closed - 1.0;
            assert!(
                error.abs() < 0.01,
                "b = {stiffening}, e = {strain}: {measured} J against {closed} J"
            );
        }
    }
}

/// Young's modulus of a bar pulled along z with free sides and clamped ends: stress in the bar over the strain
/// of its middle half.
fn young(model: Model, strain: f64) -> f64 {
    let topology = Topology::new(Arc::new(model));
    let points = || (0..topology.node_count() as u32).map(|n| topology.rest(n));
    let high = points().fold(Vec3::repeat(f64::MIN), |a, p| a.sup(&p));
    let (tissue, nodes) = held(&topology, strain, |_, p| {
        let end = p.z < 0.01 * MM || p.z > high.z - 0.01 * MM;
        end.then_some(Vec3::z() * p.z)
    });
    let pull: f64 = nodes
        .iter()
        .filter(|&&n| topology.rest(n).z > 0.5 * high.z)
        .map(|&n| -tissue.force_on(n).z)
        .sum();
    let (mut xx, mut xy, mut x, mut y, mut n) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for node in 0..topology.node_count() as u32 {
        let a = topology.rest(node).z;
        if (a - 0.5 * high.z).abs() < 0.25 * high.z {
            let b = tissue.shape().displacement[node as usize].z;
            (xx, xy, x, y, n) = (xx + a * a, xy + a * b, x + a, y + b, n + 1.0);
        }
    }
    let stretch = (n * xy - x * y) / (n * xx - x * x);
    pull / (high.x * high.y) / stretch
}

/// Modulus of a bar whose fibres run along `axis`.
fn fibred(ratio: f64, axis: [f64; 3]) -> f64 {
    let material = Material {
        fibre_ratio: ratio,
        fibre_axis: FibreAxis::Given(axis),
        ..plain()
    };
    young(bar([6, 6, 24], &material), 0.01)
}

#[test]
fn bar_moduli_along_and_across_fibres_match_the_material() {
    for ratio in [0.5, 1.0, 2.0, 3.0, 5.0] {
        let along = fibred(ratio, [0.0, 0.0, 1.0]) / YOUNG_PA;
        let across = fibred(ratio, [1.0, 0.0, 0.0]) / YOUNG_PA;
        assert!((along / ratio - 1.0).abs() < 0.02, "{ratio}: {along}");
        // The modulus is exact as the mean of all directions across; along an edge of the lattice it is
        // slightly larger.
        assert!(
            (across - 1.0).abs() < 0.02 * ratio.max(1.0),
            "{ratio}: {across}"
        );
        let error = along / across / ratio - 1.0;
        assert!(error.abs() < 0.08, "ratio {ratio}: {}", along / across);
    }
}

#[test]
fn isotropic_linear_bar_has_young_of_its_material() {
    let error = fibred(1.0, [0.0, 0.0, 1.0]) / YOUNG_PA - 1.0;
    assert!(error.abs() < 0.02, "{error}");
}

/// Converged force of a sphere of 8 mm pressed `depth` m into a pad of 48 x 48 x 32 mm on a pinned base.
fn pressed(spacing: f64, depth: f64) -> f64 {
    let cells = |length: f64| (length / spacing).round() as usize;
    // One additional layer: the base.
    let model = block(
        [cells(48.0 * MM), cells(48.0 * MM), cells(32.0 * MM) + 1],
        spacing,
        &plain(),
        1,
    );
    let topology = Topology::new(Arc::new(model));
    let mut tissue = Tissue::at_rest(topology.clone());
    let radius = 8.0 * MM;
    let steps = (depth / (0.5 * MM)).round() as usize;
    let mut force = 0.0;
    for step in 1..=steps {
        let depth = depth * step as f64 / steps as f64;
        let tool = Tool::ball(
            1,
            Vec3::new(24.0 * MM, 24.0 * MM, 32.0 * MM + spacing + radius - depth),
            radius,
        );
        let report = tissue.step(&[tool], Budget::new(300, TOLERANCE));
        assert!(report.residual <= TOLERANCE, "residual {}", report.residual);
        force = report.reactions[0].force.z;
    }
    force
}

#[test]
fn contact_force_converges_as_the_lattice_is_refined() {
    for depth in [2.0 * MM, 4.0 * MM] {
        let forces = [8.0, 4.0, 2.0].map(|s| pressed(s * MM, depth));
        let [first, second] = [0, 1].map(|i| (forces[i + 1] - forces[i]).abs());
        assert!(second < 0.8 * first, "at {} mm: {forces:?} N", depth / MM);
    }
}
