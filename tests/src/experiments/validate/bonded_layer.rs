//! A ball on a layer that is bonded to a rigid base, as cartilage to bone.

use palpate_tissue::{Tool, Vec3, block};

use super::POISSON;
use super::comparison::{Case, Curve, CurveSet};
use super::layer_theory::Layer;
use super::specimen::{Specimen, YOUNG_PA, material};

const THICKNESS_M: f64 = 8e-3;
/// Radius of the ball in contact radii.
const BALL: f64 = 100.0;
/// Distance from the contact to the free sides in thicknesses; the layer shields beyond two.
const BESIDE: f64 = 3.0;

/// Contact radii in thicknesses.
pub(super) const CONTACTS: [(f64, &str); 2] = [
    (0.5, "bonded layer, a/h = 0.5"),
    (1.0, "bonded layer, a/h = 1"),
];

fn layer(share: f64, poisson: f64) -> Layer {
    Layer {
        thickness_m: THICKNESS_M,
        contact_m: share * THICKNESS_M,
        young_pa: YOUNG_PA,
        poisson,
    }
}

/// The force over that of the same depth on a half space.
fn stiffening(force_n: f64, depth_m: f64, radius_m: f64, poisson: f64) -> f64 {
    let half_space =
        4.0 / 3.0 * YOUNG_PA / (1.0 - poisson * poisson) * radius_m.sqrt() * depth_m.powf(1.5);
    force_n / half_space
}

pub(super) fn indentation(is_fine: bool, poisson: f64, (share, name): (f64, &'static str)) -> Case {
    let layer = layer(share, poisson);
    let radius_m = BALL * layer.contact_m;
    let asked = layer.ball(radius_m);
    let mut case = Case {
        name,
        poisson,
        quantity: "force on the ball (N)",
        reference: "Hayes et al. 1972",
        expected: asked.force_n,
        length: ("contact radius", layer.contact_m),
        runs: Vec::new(),
    };
    // Cells over the thickness.
    let cells: &[usize] = if is_fine { &[4, 6, 9, 14] } else { &[4, 6, 9] };
    for &thick in cells {
        let spacing_m = THICKNESS_M / thick as f64;
        let half_m = BESIDE * THICKNESS_M + layer.contact_m;
        let half = (half_m / spacing_m).ceil() as usize;
        let model = block(
            [2 * half, 2 * half, thick + 1],
            spacing_m,
            &material(poisson),
            1,
        );
        let mut specimen = Specimen::new(model);
        let top = Vec3::new(half as f64, half as f64, (thick + 1) as f64) * spacing_m;
        let centre = top + Vec3::z() * (radius_m - asked.depth_m);
        specimen.solve(&[Tool::ball(1, centre, radius_m)]);
        case.add(&specimen, specimen.tissue.report().reactions[0].force.z);
    }
    case
}

/// The stiffening by the base at the contact radii of the finest runs, and its theory.
pub(super) fn curve(cases: &[Case]) -> Curve {
    let point = |share: f64, poisson: f64, force_n: f64| {
        let radius_m = BALL * share * THICKNESS_M;
        let depth_m = layer(share, poisson).ball(radius_m).depth_m;
        (share, stiffening(force_n, depth_m, radius_m, poisson))
    };
    let set = |poisson: f64| {
        let measured = CONTACTS.iter().flat_map(|&(share, name)| {
            let of_contact = cases
                .iter()
                .filter(move |c| c.name == name && c.poisson == poisson);
            of_contact.filter_map(move |case| Some((share, case.runs.last()?.measured)))
        });
        let reference = (1..=24).map(|i| {
            let share = f64::from(i) / 20.0;
            let found = layer(share, poisson).ball(BALL * share * THICKNESS_M);
            point(share, poisson, found.force_n)
        });
        CurveSet {
            poisson,
            measured: measured
                .map(|(share, force_n)| point(share, poisson, force_n))
                .collect(),
            reference: reference.collect(),
        }
    };
    Curve {
        name: "validate-layer",
        title: "Force of a ball on a bonded layer over that on a half space",
        axes: ["contact radius (thicknesses)", "ratio of forces"],
        sets: POISSON.map(set).into(),
    }
}
