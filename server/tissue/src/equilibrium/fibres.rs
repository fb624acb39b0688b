//! Spring factors along fibres, for a given ratio of moduli.
//!
//! A spring at the angle θ to the fibres has scale (1 + β cos⁴ θ) times its strength (reconstructed). A lattice has
//! springs in thirteen directions n only, each with a weight w in `C = E Σ w n n n n` (`springs.rs`), so the effect of
//! β depends on the fibre direction. β is solved for per region: the modulus along the fibres is `ratio` times the mean
//! modulus across them, and the latter is Young's modulus.

use nalgebra::{Matrix6, Vector6};

use crate::Vec3;
use crate::springs::{BODY_SHARE, DIAGONAL_SHARE, EDGE_SHARE};

/// Maximum β: fibres far from all directions of the lattice can not be made arbitrarily stiff.
const STRENGTH_MAX: f64 = 200.0;
/// Cosines and sines of the directions across the fibres over which the modulus is averaged. They are literals, because
/// the last bit of a sine depends on the machine, and all replicas need equal stiffnesses.
const ACROSS: [(f64, f64); 8] = {
    const C: [f64; 3] = [
        0.923_879_532_511_286_7,
        std::f64::consts::FRAC_1_SQRT_2,
        0.382_683_432_365_089_8,
    ];
    [
        (1.0, 0.0),
        (C[0], C[2]),
        (C[1], C[1]),
        (C[2], C[0]),
        (0.0, 1.0),
        (-C[2], C[0]),
        (-C[1], C[1]),
        (-C[0], C[2]),
    ]
};
/// Bisection steps for β.
const HALVINGS: usize = 60;

/// The directions of a lattice's springs and their weights.
const DIRECTIONS: [([f64; 3], f64); 13] = {
    let (edge, face, body) = (4.0 * EDGE_SHARE, 2.0 * DIAGONAL_SHARE, BODY_SHARE);
    [
        ([1.0, 0.0, 0.0], edge),
        ([0.0, 1.0, 0.0], edge),
        ([0.0, 0.0, 1.0], edge),
        ([1.0, 1.0, 0.0], face),
        ([1.0, -1.0, 0.0], face),
        ([1.0, 0.0, 1.0], face),
        ([1.0, 0.0, -1.0], face),
        ([0.0, 1.0, 1.0], face),
        ([0.0, 1.0, -1.0], face),
        ([1.0, 1.0, 1.0], body),
        ([-1.0, 1.0, 1.0], body),
        ([1.0, -1.0, 1.0], body),
        ([1.0, 1.0, -1.0], body),
    ]
};

/// β and the scale for fibres along this unit vector in a lattice of cubes.
pub(crate) fn in_a_lattice(ratio: f64, fibre: &Vec3) -> (f64, f64) {
    let (mut low, mut high) = (-0.999, STRENGTH_MAX);
    for _ in 0..HALVINGS {
        let beta = 0.5 * (low + high);
        match moduli(beta, fibre) {
            Some((along, across)) if along >= ratio * across => high = beta,
            _ => low = beta,
        }
    }
    let across = moduli(low, fibre).map_or(1.0, |m| m.1);
    (low, 1.0 / across)
}

/// Young's moduli along the fibres and across them (mean), relative to the modulus without fibres.
fn moduli(beta: f64, fibre: &Vec3) -> Option<(f64, f64)> {
    let mut stiffness = Matrix6::zeros();
    for (direction, weight) in DIRECTIONS {
        let n = Vec3::from(direction).normalize();
        let (dyad, cos) = (dyad(&n), n.dot(fibre));
        let square = cos * cos;
        stiffness += dyad * dyad.transpose() * (weight * (1.0 + beta * square * square));
    }
    let compliance = stiffness.try_inverse()?;
    let young = |direction: &Vec3| {
        let pulled = dyad(direction);
        1.0 / pulled.dot(&(compliance * pulled))
    };
    let beside = fibre.cross(&Vec3::ith(fibre.iamin(), 1.0)).normalize();
    let other = fibre.cross(&beside);
    let across = ACROSS.map(|(cos, sin)| young(&(beside * cos + other * sin)));
    Some((
        young(fibre),
        across.iter().sum::<f64>() / ACROSS.len() as f64,
    ))
}

/// n n as six components, off-diagonal ones times √2, so that products of tensors are products of vectors.
pub(super) fn dyad(n: &Vec3) -> Vector6<f64> {
    let root = 2.0_f64.sqrt();
    Vector6::new(
        n.x * n.x,
        n.y * n.y,
        n.z * n.z,
        root * n.y * n.z,
        root * n.x * n.z,
        root * n.x * n.y,
    )
}

/// β and the scale for which springs of strength scale (1 + β cos⁴ θ), θ their angle to the fibres,
/// have `ratio` times the modulus along the fibres and the same across (reconstructed).
///
/// Springs in all directions make the stiffness `C_abcd = <n_a n_b n_c n_d (1 + β n_3⁴)>`, with
/// `<n_1^2a n_2^2b n_3^2c> = (2a-1)!! (2b-1)!! (2c-1)!! / (2(a+b+c)+1)!!` over the sphere.
pub(crate) fn in_all_directions(ratio: f64) -> (f64, f64) {
    let moduli = |beta: f64| {
        let c33 = 1.0 / 5.0 + beta / 9.0;
        let c11 = 1.0 / 5.0 + beta / 105.0;
        let c13 = 1.0 / 15.0 + beta / 63.0;
        let c12 = 1.0 / 15.0 + beta / 315.0;
        let along = c33 - 2.0 * c13 * c13 / (c11 + c12);
        // Pulled across: solve for the strains along the fibres and across both.
        let det = c11 * c33 - c13 * c13;
        let across = c11 - (c12 * (c12 * c33 - c13 * c13) + c13 * (c11 * c13 - c12 * c13)) / det;
        (along, across)
    };
    let plain = moduli(0.0).1;
    let (mut low, mut high) = (-0.999, 1e4);
    for _ in 0..100 {
        let beta = 0.5 * (low + high);
        let (along, across) = moduli(beta);
        if along < ratio * across {
            low = beta;
        } else {
            high = beta;
        }
    }
    (low, plain / moduli(low).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fibres_raise_only_the_modulus_along_them() {
        assert!(in_all_directions(1.0).0.abs() < 1e-9);
        for ratio in [0.5, 2.0, 5.0] {
            let (beta, scale) = in_all_directions(ratio);
            assert!(beta > -1.0 && scale > 0.0, "{ratio}: {beta} {scale}");
            assert_eq!(beta > 0.0, ratio > 1.0);
        }
    }

    #[test]
    fn fibres_give_the_requested_ratio_in_any_direction_of_a_lattice() {
        for fibre in [
            [1.0, 0.0, 0.0],
            [1.0, 1.0, 0.0],
            [0.3, 0.5, 0.8],
            [1.0, 1.0, 1.0],
        ] {
            let fibre = Vec3::from(fibre).normalize();
            assert!(in_a_lattice(1.0, &fibre).0.abs() < 1e-6);
            for ratio in [0.5, 2.0, 3.0, 5.0] {
                let (beta, scale) = in_a_lattice(ratio, &fibre);
                let (along, across) = moduli(beta, &fibre).unwrap();
                assert!((scale * across - 1.0).abs() < 1e-9);
                assert!(
                    (along / across / ratio - 1.0).abs() < 1e-6,
                    "{fibre}: {ratio}, {beta}"
                );
            }
        }
    }
}
