//! A square beam: a load at the tip of a cantilever, and pure bending.

use palpate_tissue::{Vec3, block};

use super::comparison::{Case, Curve, CurveSet};
use super::specimen::{Specimen, YOUNG_PA, material, shear_pa};

const HEIGHT_M: f64 = 10e-3;
/// Length of the beam in heights.
const SLENDER: usize = 10;
/// Deflection of the tip in heights: axial forces from larger ones stiffen the beam by 3 (w/h)².
const DEFLECTION: f64 = 0.01;
/// Strain at the surface in pure bending.
const STRAIN: f64 = 1e-3;

/// Cells over the height.
fn cells(is_fine: bool) -> &'static [usize] {
    if is_fine {
        &[4, 6, 10, 16]
    } else {
        &[4, 6, 10]
    }
}

fn beam(across: usize, poisson: f64) -> Specimen {
    let spacing_m = HEIGHT_M / across as f64;
    let cells = [SLENDER * across, across, across];
    Specimen::new(block(cells, spacing_m, &material(poisson), 0))
}

/// Second moment of area in m⁴.
fn second_moment() -> f64 {
    HEIGHT_M.powi(4) / 12.0
}

fn length_m() -> f64 {
    SLENDER as f64 * HEIGHT_M
}

/// Deflection in m at `x` by a force of 1 N at the tip (Timoshenko 1921; shear coefficient of Cowper 1966).
fn compliance(x: f64, poisson: f64) -> f64 {
    let shear_coefficient = 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson);
    let bending = x * x * (3.0 * length_m() - x) / (6.0 * YOUNG_PA * second_moment());
    bending + x / (shear_coefficient * shear_pa(poisson) * HEIGHT_M * HEIGHT_M)
}

fn is_at(x: f64, plane: f64) -> bool {
    (x - plane).abs() < 1e-6 * HEIGHT_M
}

pub(super) fn cantilever(is_fine: bool, poisson: f64, curve: &mut Curve) -> Result<Case, String> {
    let mut case = Case {
        name: "cantilever",
        poisson,
        quantity: "stiffness at the tip (N/m)",
        reference: "Timoshenko 1921, with shear",
        expected: 1.0 / compliance(length_m(), poisson),
        length: ("height", HEIGHT_M),
        runs: Vec::new(),
    };
    for &across in cells(is_fine) {
        let mut specimen = beam(across, poisson);
        let middle_m = HEIGHT_M / 2.0;
        // A row of nodes in the middle of the end, so that the end turns freely.
        let is_loaded = |at: Vec3| is_at(at.x, length_m()) && is_at(at.z, middle_m);
        specimen.hold(|_, at| {
            let load = Vec3::new(0.0, 0.0, -DEFLECTION * HEIGHT_M);
            if is_at(at.x, 0.0) {
                return Some(Vec3::zeros());
            }
            is_loaded(at).then_some(load)
        })?;
        specimen.solve(&[]);
        let force = specimen.reaction(|_, at| is_loaded(at).then(|| -Vec3::z()));
        let deflections = deflections(&specimen);
        let tip = deflections.last().map_or(f64::NAN, |d| d.1);
        case.add(&specimen, force / tip);
        if across == *cells(is_fine).last().unwrap_or(&0) {
            let in_units = |p: (f64, f64)| (p.0 / HEIGHT_M, 1e6 * p.1);
            let places = (0..=50).map(|i| f64::from(i) / 50.0 * length_m());
            let reference = places.map(|x| in_units((x, force * compliance(x, poisson))));
            curve.sets.push(CurveSet {
                poisson,
                measured: deflections.into_iter().map(in_units).collect(),
                reference: reference.collect(),
            });
        }
    }
    Ok(case)
}

/// Mean deflection of each section in m, by its distance from the clamp. Nodes at edges count for the smaller area that
/// they have.
fn deflections(specimen: &Specimen) -> Vec<(f64, f64)> {
    let spacing = specimen.spacing_m();
    let sections = (length_m() / spacing).round() as usize + 1;
    let mut sums = vec![[0.0; 2]; sections];
    for (node, at) in specimen.nodes() {
        let inside = |x: f64| {
            if is_at(x, 0.0) || is_at(x, HEIGHT_M) {
                0.5
            } else {
                1.0
            }
        };
        let area = inside(at.y) * inside(at.z);
        let sum = &mut sums[(at.x / spacing).round() as usize];
        sum[0] -= area * specimen.displacement(node).z;
        sum[1] += area;
    }
    let mean = |(i, sum): (usize, [f64; 2])| (i as f64 * spacing, sum[0] / sum[1]);
    sums.into_iter().enumerate().map(mean).collect()
}

/// Both ends have the displacements of the exact solution, which are polynomials.
pub(super) fn bending(is_fine: bool, poisson: f64) -> Result<Case, String> {
    let curvature = 2.0 * STRAIN / HEIGHT_M;
    let mut case = Case {
        name: "pure bending",
        poisson,
        quantity: "moment (N m)",
        reference: "Saint-Venant, M = E I / r",
        expected: YOUNG_PA * second_moment() * curvature,
        length: ("height", HEIGHT_M),
        runs: Vec::new(),
    };
    let middle = Vec3::new(length_m(), HEIGHT_M, HEIGHT_M) / 2.0;
    for &across in cells(is_fine) {
        let mut specimen = beam(across, poisson);
        specimen.hold(|_, at| {
            let p = at - middle;
            let across = poisson * (p.z * p.z - p.y * p.y);
            let field = Vec3::new(p.x * p.z, -poisson * p.y * p.z, -0.5 * (p.x * p.x + across));
            let is_end = is_at(at.x, 0.0) || is_at(at.x, length_m());
            is_end.then_some(field * curvature)
        })?;
        specimen.solve(&[]);
        let moment = specimen
            .reaction(|_, at| is_at(at.x, length_m()).then(|| Vec3::x() * (at.z - middle.z)));
        case.add(&specimen, moment);
    }
    Ok(case)
}

pub(super) fn curve() -> Curve {
    Curve {
        name: "validate-cantilever",
        title: "Deflection of a cantilever under a load at its tip",
        axes: ["distance from the clamp (heights)", "deflection (µm)"],
        sets: Vec::new(),
    }
}
