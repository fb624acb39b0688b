//! The indentation of a contact point, from which the friction stiffness follows: a function of the shape
//! alone.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Reaction, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const SPACING: f64 = 3.0 * MM;
const CELLS: [usize; 3] = [32, 32, 20];
const RADIUS: f64 = 24.0 * MM;

struct Bench {
    tissue: Tissue,
}

impl Bench {
    fn new(gravity: f64) -> Self {
        let material = Material {
            name: "test".into(),
            young_pa: 10e3,
            density_kg_m3: 1000.0,
            source: "test".into(),
            ..Material::default()
        };
        let mut model = block(CELLS, SPACING, &material, 1);
        model.gravity = [0.0, 0.0, gravity];
        let topology = Topology::new(Arc::new(model));
        let tissue = Tissue::at_rest(topology);
        Self { tissue }
    }

    /// The converged reaction on a ball `depth` m below the surface at rest, `x` m from the middle.
    fn press(&mut self, x: f64, depth: f64) -> Reaction {
        let [middle, top] = [16.0 * SPACING, 20.0 * SPACING];
        let centre = Vec3::new(middle + x, middle, top + RADIUS - depth);
        let tool = Tool::ball(1, centre, RADIUS);
        let budget = Budget::new(400, 1e-5);
        let report = self.tissue.step(&[tool], budget);
        report.reactions[0].clone()
    }

    /// F / δ of the active contact point, in N/m.
    fn secant(&mut self, x: f64, depth: f64) -> f64 {
        let reaction = self.press(x, depth);
        reaction.contact_patches[0].pressed / reaction.contact_patches[0].indentation_m
    }
}

/// Hertz: a sphere on a half-space has F ∝ d^1.5 at the depth d, and the mean indentation δ over its pressure
/// is 0.8 d, so dF/dd = 1.2 F/δ. A contact of constant area has dF/dd = F/δ: on a lattice, the area grows in
/// steps.
#[test]
fn sphere_tangent_stiffness_is_1_2_times_its_secant_stiffness() {
    let mut bench = Bench::new(0.0);
    for depth in [2.0 * MM, 3.0 * MM, 4.0 * MM] {
        let step = 0.4 * MM;
        let [less, more] = [depth - step, depth + step].map(|d| bench.press(0.0, d).force.z);
        let tangent = (more - less) / (2.0 * step);
        let ratio = tangent / bench.secant(0.0, depth);
        assert!((1.0..1.3).contains(&ratio), "{ratio} at {depth} m");
    }
}

#[test]
fn secant_stiffness_is_independent_of_the_tool_path() {
    let straight = Bench::new(0.0).secant(0.0, 3.0 * MM);
    let mut bench = Bench::new(0.0);
    for k in 0..=20 {
        bench.press(-10.0 * MM + 0.5 * MM * f64::from(k), 3.0 * MM);
    }
    let dragged = bench.secant(0.0, 3.0 * MM);
    assert!(
        (dragged / straight - 1.0).abs() < 0.02,
        "{dragged} {straight} N/m"
    );
}

#[test]
fn sag_is_not_counted_as_indentation() {
    let weightless = Bench::new(0.0).press(0.0, 3.0 * MM);
    let mut heavy = Bench::new(-9.81);
    // The surface is lower by the sag, so the tool follows it.
    let sag = -heavy
        .tissue
        .sag_of(middle_of_the_top(heavy.tissue.topology()))
        .z;
    assert!(sag > 0.3 * MM, "{sag} m");
    let sagged = heavy.press(0.0, 3.0 * MM + sag);
    let [a, b] = [&weightless, &sagged].map(|r| r.contact_patches[0].indentation_m);
    assert!((b / a - 1.0).abs() < 0.05, "{a} {b} m");
}

fn middle_of_the_top(topology: &Topology) -> u32 {
    let middle = Vec3::new(16.0, 16.0, 20.0) * SPACING;
    let nodes = &topology.model().nodes;
    let apart = |n: &usize| (Vec3::from(nodes[*n]) - middle).norm();
    let nearest = (0..nodes.len()).min_by(|a, b| apart(a).total_cmp(&apart(b)));
    nearest.expect("a block has nodes") as u32
}
