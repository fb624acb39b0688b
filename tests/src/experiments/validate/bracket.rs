//! A bracket of two materials beside finite elements of another program.
//!
//! A column on a rigid floor carries a softer arm, whose end is pushed down. `tests/readers/bracket.py` computes the same
//! bracket with quadratic elements of scikit-fem; a test compares the coarsest mesh with [`FINITE_ELEMENTS_N`].

use palpate_anatomy::Surface;
use palpate_tissue::Vec3;

use super::comparison::{Case, limits};
use super::specimen::{Specimen, YOUNG_PA, built};

/// Height, reach, width and thickness in m: the column and the arm are square.
const HEIGHT_M: f64 = 40e-3;
const REACH_M: f64 = 40e-3;
const WIDTH_M: f64 = 16e-3;
/// Displacement of the end in m.
const PUSH_M: f64 = 0.05e-3;
/// Young's modulus of the column over that of the arm.
const COLUMN: f64 = 3.0;
/// Elements over the thickness in scikit-fem.
const ELEMENTS: [f64; 3] = [4.0, 6.0, 8.0];
/// Forces on the end by scikit-fem 12.0.2 in N, down and along the arm away from the column, with [`ELEMENTS`], for each
/// Poisson's ratio.
const FINITE_ELEMENTS_N: [(f64, [[f64; 2]; 3]); 2] = [
    (
        0.25,
        [
            [6.676_891e-4, -4.195_492e-4],
            [6.650_081e-4, -4.173_262e-4],
            [6.638_820e-4, -4.163_858e-4],
        ],
    ),
    (
        0.45,
        [
            [6.792_582e-4, -4.250_278e-4],
            [6.706_346e-4, -4.187_976e-4],
            [6.669_391e-4, -4.160_951e-4],
        ],
    ),
];

/// A box from one corner to the other.
fn cuboid(low: Vec3, high: Vec3) -> Surface {
    let corner = |c: usize| Vec3::from_fn(|a, _| if c >> a & 1 == 1 { high[a] } else { low[a] });
    let faces = palpate_tissue::cell::FACES;
    let triangles = faces
        .iter()
        .flat_map(|f| [[f[0], f[1], f[2]], [f[0], f[2], f[3]]]);
    Surface {
        vertices: (0..8).map(corner).collect(),
        triangles: triangles.map(|t| t.map(|i| i as u32)).collect(),
    }
}

/// Column and arm.
fn parts() -> Vec<(Surface, f64)> {
    let low = [Vec3::zeros(), Vec3::new(WIDTH_M, 0.0, HEIGHT_M - WIDTH_M)];
    let high = [
        Vec3::new(WIDTH_M, WIDTH_M, HEIGHT_M),
        Vec3::new(REACH_M, WIDTH_M, HEIGHT_M),
    ];
    vec![
        (cuboid(low[0], high[0]), COLUMN * YOUNG_PA),
        (cuboid(low[1], high[1]), YOUNG_PA),
    ]
}

pub(super) fn push(is_fine: bool, poisson: f64) -> Result<[Case; 2], String> {
    let reference = FINITE_ELEMENTS_N.iter().find(|r| r.0 == poisson);
    let expected = reference.map_or([f64::NAN; 2], |r| limits(ELEMENTS, r.1));
    let case = |quantity, expected| Case {
        name: "bracket of two materials",
        poisson,
        quantity,
        reference: "finite elements (scikit-fem), extrapolated",
        expected,
        length: ("thickness", WIDTH_M),
        runs: Vec::new(),
    };
    let mut cases = [
        case("force down (N)", expected[0]),
        case("force along the arm (N)", expected[1]),
    ];
    let spacings: &[f64] = if is_fine {
        &[4e-3, 8e-3 / 3.0, 2e-3, 4e-3 / 3.0, 1e-3]
    } else {
        &[4e-3, 2e-3, 4e-3 / 3.0]
    };
    for &spacing_m in spacings {
        let mut specimen = Specimen::new(built(parts(), poisson, spacing_m)?);
        let is_end = |at: Vec3| at.x > REACH_M - 0.25 * spacing_m;
        specimen.hold(|_, at| {
            if at.z < 0.25 * spacing_m {
                return Some(Vec3::zeros());
            }
            is_end(at).then(|| Vec3::z() * -PUSH_M)
        })?;
        specimen.solve(&[]);
        for (case, along) in cases.iter_mut().zip([-Vec3::z(), Vec3::x()]) {
            let force = specimen.reaction(|_, at| is_end(at).then_some(along));
            case.add(&specimen, force);
        }
    }
    Ok(cases)
}

#[cfg(test)]
mod tests {
    use super::super::reader::forces_of;
    use super::*;

    #[test]
    fn finite_elements_of_another_program_give_the_reference_forces() {
        for (poisson, [forces, ..]) in FINITE_ELEMENTS_N {
            let numbers = [
                HEIGHT_M,
                REACH_M,
                WIDTH_M,
                PUSH_M,
                COLUMN * YOUNG_PA,
                YOUNG_PA,
                poisson,
            ];
            let Some(computed) = forces_of("bracket.py", &numbers) else {
                return;
            };
            for (computed, force) in computed.into_iter().zip(forces) {
                assert!((computed / force - 1.0).abs() < 1e-4, "{computed} {force}");
            }
        }
    }
}
