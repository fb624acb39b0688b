//! A cube between two glued plates beside the elastic bodies of `MuJoCo`.
//!
//! The lower plate stays; the upper one moves down and aside. `tests/readers/plates.py` finds the shape in which the
//! elastic forces of `MuJoCo` are in equilibrium. Its forces on the plate are extrapolated over three meshes; a test
//! repeats the coarsest one.

use palpate_tissue::{Vec3, block};

use super::comparison::{Case, Curve, CurveSet, limits};
use super::specimen::{Specimen, material};

const NAME: &str = "cube between glued plates";
const QUANTITIES: [&str; 2] = ["force down (N)", "force aside (N)"];
const SIDE_M: f64 = 20e-3;
/// Displacement of the upper plate in m, down and aside: strains of 1e-4, where the law of `MuJoCo` (Saint Venant and
/// Kirchhoff) differs from linear elasticity by 0.02 %.
const MOVE_M: f64 = 2e-6;
/// Cells along each edge in `MuJoCo`; each is cut into five tetrahedra.
const MUJOCO_CELLS: [f64; 3] = [12.0, 16.0, 24.0];
/// Forces on the upper plate by `MuJoCo` 4.0.0 in N, down and aside, with [`MUJOCO_CELLS`], for each Poisson's ratio.
const MUJOCO_N: [(f64, [[f64; 2]; 3]); 2] = [
    (
        0.25,
        [
            [4.191_512e-4, 1.075_511e-4],
            [4.184_304e-4, 1.066_981e-4],
            [4.177_964e-4, 1.060_166e-4],
        ],
    ),
    (
        0.45,
        [
            [4.873_731e-4, 1.036_559e-4],
            [4.812_946e-4, 1.021_273e-4],
            [4.761_155e-4, 1.007_737e-4],
        ],
    ),
];

pub(super) fn glued(is_fine: bool, poisson: f64) -> Result<[Case; 2], String> {
    let meshes = MUJOCO_N.iter().find(|row| row.0 == poisson);
    let expected = meshes.map_or([f64::NAN; 2], |row| limits(MUJOCO_CELLS, row.1));
    let case = |quantity, expected| Case {
        name: NAME,
        poisson,
        quantity,
        reference: "finite elements (MuJoCo), extrapolated",
        expected,
        length: ("side", SIDE_M),
        runs: Vec::new(),
    };
    let mut cases = [0, 1].map(|part| case(QUANTITIES[part], expected[part]));
    let cells: &[usize] = if is_fine {
        &[6, 10, 16, 24]
    } else {
        &[6, 10, 16]
    };
    for &across in cells {
        let spacing_m = SIDE_M / across as f64;
        let model = block([across; 3], spacing_m, &material(poisson), 0);
        let mut specimen = Specimen::new(model);
        let is_upper = |at: Vec3| at.z > SIDE_M - 0.25 * spacing_m;
        specimen.hold(|_, at| {
            if at.z < 0.25 * spacing_m {
                return Some(Vec3::zeros());
            }
            is_upper(at).then_some(Vec3::new(MOVE_M, 0.0, -MOVE_M))
        })?;
        specimen.solve(&[]);
        for (case, along) in cases.iter_mut().zip([-Vec3::z(), Vec3::x()]) {
            let force = specimen.reaction(|_, at| is_upper(at).then_some(along));
            case.add(&specimen, force);
        }
    }
    Ok(cases)
}

/// Force down in percent above the limit, of the tissue and of `MuJoCo`, over the cells along an edge.
pub(super) fn curve(cases: &[Case]) -> Curve {
    let set = |(poisson, meshes): (f64, [[f64; 2]; 3])| {
        let limit = limits(MUJOCO_CELLS, meshes)[0];
        let above = |force: f64| 100.0 * (force / limit - 1.0);
        let own = cases.iter().find(|case| {
            case.name == NAME && case.poisson == poisson && case.quantity == QUANTITIES[0]
        });
        let runs = own.map_or(&[][..], |case| &case.runs).iter();
        let reference = MUJOCO_CELLS.into_iter().zip(meshes);
        CurveSet {
            poisson,
            measured: runs
                .map(|run| (SIDE_M / run.spacing_m, above(run.measured)))
                .collect(),
            reference: reference
                .map(|(cells, forces)| (cells, above(forces[0])))
                .collect(),
        }
    };
    Curve {
        name: "validate-plates",
        title: "Force of a glued plate above the limit of MuJoCo (reference: MuJoCo)",
        axes: ["cells along an edge", "above the limit (%)"],
        sets: MUJOCO_N.map(set).into(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::reader::forces_of;
    use super::super::specimen::YOUNG_PA;
    use super::*;

    #[test]
    fn mujoco_gives_the_reference_forces_of_the_coarsest_mesh() {
        for (poisson, meshes) in MUJOCO_N {
            let numbers = [SIDE_M, MOVE_M, MOVE_M, YOUNG_PA, poisson, MUJOCO_CELLS[0]];
            let Some(computed) = forces_of("plates.py", &numbers) else {
                return;
            };
            for (computed, force) in computed.into_iter().zip(meshes[0]) {
                assert!((computed / force - 1.0).abs() < 1e-4, "{computed} {force}");
            }
        }
    }
}
