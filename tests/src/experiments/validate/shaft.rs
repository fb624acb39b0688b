//! Torsion of a round shaft, whose surface crosses the lattice.

use std::f64::consts::{PI, TAU};

use palpate_anatomy::Surface;
use palpate_tissue::Vec3;

use super::comparison::Case;
use super::specimen::{Specimen, YOUNG_PA, built, shear_pa};

const RADIUS_M: f64 = 12e-3;
const LENGTH_M: f64 = 48e-3;
/// Shear strain at the surface.
const STRAIN: f64 = 2e-3;
/// Sides of the polygon: its area is 0.01 % below that of the circle.
const SIDES: usize = 256;

fn surface() -> Surface {
    let n = SIDES as u32;
    let ring = |z: f64| {
        (0..SIDES).map(move |i| {
            let angle = TAU * i as f64 / SIDES as f64;
            Vec3::new(RADIUS_M * angle.cos(), RADIUS_M * angle.sin(), z)
        })
    };
    let ends = [-0.5, 0.5].map(|s| s * LENGTH_M);
    let vertices = ring(ends[0])
        .chain(ring(ends[1]))
        .chain(ends.map(|z| Vec3::new(0.0, 0.0, z)));
    let triangles = (0..n).flat_map(|i| {
        let next = (i + 1) % n;
        [
            [i, next, n + next],
            [i, n + next, n + i],
            [2 * n, next, i],
            [2 * n + 1, n + i, n + next],
        ]
    });
    Surface {
        vertices: vertices.collect(),
        triangles: triangles.collect(),
    }
}

pub(super) fn torsion(is_fine: bool, poisson: f64) -> Result<Case, String> {
    let twist = STRAIN / RADIUS_M;
    let mut case = Case {
        name: "torsion of a shaft",
        poisson,
        quantity: "torque (N m)",
        reference: "Coulomb, T = G J θ / L",
        expected: shear_pa(poisson) * PI * RADIUS_M.powi(4) / 2.0 * twist,
        length: ("radius", RADIUS_M),
        runs: Vec::new(),
    };
    let spacings: &[f64] = if is_fine {
        &[3e-3, 2e-3, 1.5e-3, 1e-3, 0.75e-3]
    } else {
        &[3e-3, 2e-3, 1.5e-3, 1e-3]
    };
    for &spacing_m in spacings {
        let model = built(vec![(surface(), YOUNG_PA)], poisson, spacing_m)?;
        let mut specimen = Specimen::new(model);
        let is_end = |at: Vec3| at.z.abs() > LENGTH_M / 2.0 - 0.25 * spacing_m;
        let around = |at: Vec3| Vec3::z().cross(&at);
        specimen.hold(|_, at| is_end(at).then(|| around(at) * (twist * at.z)))?;
        specimen.solve(&[]);
        let torque = specimen.reaction(|_, at| (is_end(at) && at.z > 0.0).then(|| around(at)));
        case.add(&specimen, torque);
    }
    Ok(case)
}
