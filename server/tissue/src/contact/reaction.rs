//! What a tool feels, and how that changes when it moves a little.

use nalgebra::Matrix3;

use crate::Vec3;

/// Answer of the tissue to one tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reaction {
    /// The tool.
    pub tool: u32,
    /// Force on the tool in N.
    pub force: Vec3,
    /// Estimate of -dF/dx in N/m, symmetric and positive semidefinite.
    pub stiffness: Matrix3<f64>,
    /// Out of the tissue, along the force; zero without contact.
    pub normal: Vec3,
    /// Surface samples that carry the force.
    pub contacts: u32,
    /// Coefficient of static friction of what is touched.
    pub friction_static: f64,
    /// Coefficient of dynamic friction of what is touched.
    pub friction_dynamic: f64,
    /// Estimate of the error of `force` in N, from what the last iteration changed.
    pub force_error: f64,
    /// Where the force holds: the proxy, which equals the tool's centre unless the tool jumped.
    pub at: Vec3,
}

/// Stiffness learned from pairs of poses and forces: the BFGS update of K so that K s = -ΔF for
/// the latest move s, which keeps K symmetric and positive.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Secant {
    last: Option<(Vec3, Vec3)>,
    stiffness: Option<Matrix3<f64>>,
}

impl Secant {
    pub(crate) fn clear(&mut self) {
        *self = Self::default();
    }

    pub(crate) fn is_known(&self) -> bool {
        self.stiffness.is_some()
    }

    /// Starts from a measured normal stiffness, with `across` of it in the tangent plane.
    pub(crate) fn start(&mut self, normal: &Vec3, stiffness: f64, across: f64) {
        let along = normal * normal.transpose();
        self.stiffness =
            Some(along * stiffness + (Matrix3::identity() - along) * (stiffness * across));
    }

    /// Takes in the force at a pose; moves below `least` metres are noise.
    pub(crate) fn learn(&mut self, at: Vec3, force: Vec3, least: f64) {
        let Some((x, f)) = self.last else {
            self.last = Some((at, force));
            return;
        };
        let (s, y) = (at - x, f - force);
        if s.norm() < least {
            return;
        }
        self.last = Some((at, force));
        let Some(k) = self.stiffness else {
            return;
        };
        let ks = k * s;
        let (curve, power) = (s.dot(&ks), s.dot(&y));
        if power > 1e-3 * y.norm() * s.norm() && curve > 0.0 {
            let next = k + y * y.transpose() / power - ks * ks.transpose() / curve;
            if next.iter().all(|v| v.is_finite()) {
                self.stiffness = Some((next + next.transpose()) * 0.5);
            }
        }
    }

    pub(crate) fn stiffness(&self) -> Matrix3<f64> {
        self.stiffness.unwrap_or_else(Matrix3::zeros)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_secant_finds_a_linear_law_and_stays_symmetric() {
        let law = Matrix3::new(3.0, 0.5, 0.0, 0.5, 2.0, -0.3, 0.0, -0.3, 4.0) * 100.0;
        let mut secant = Secant::default();
        secant.start(&Vec3::z(), 50.0, 0.2);
        for i in 0..60 {
            let t = f64::from(i);
            let x = Vec3::new((1.3 * t).sin(), (2.1 * t).cos(), (0.7 * t).sin()) * 1e-3;
            secant.learn(x, -law * x, 1e-5);
        }
        let k = secant.stiffness();
        assert!((k - law).norm() < 0.1 * law.norm(), "{k}");
        assert!((k - k.transpose()).norm() < 1e-9);
    }
}
