//! Converged solves during a reference run, and the force change by them.

use palpate_haptics::ContactModel;

/// Relative residual of a check. A third of it changes forces on the thigh by 0.5 %.
pub(super) const TOLERANCE: f64 = 1e-2;
/// Maximum iterations of a check: with 30 the abdominal wall ended at 0.04.
pub(super) const ITERATIONS: usize = 100;

#[derive(Debug, Clone, Default)]
pub(super) struct Checks {
    pub(super) count: usize,
    pub(super) residual_max: f64,
    /// Sums of squares per hand: force change by the checks, and force, N².
    squares: [[f64; 2]; 2],
}

impl Checks {
    pub(super) fn note(
        &mut self,
        residual: f64,
        before: &[ContactModel; 2],
        after: &[ContactModel; 2],
    ) {
        self.count += 1;
        self.residual_max = self.residual_max.max(residual);
        for ((square, before), after) in self.squares.iter_mut().zip(before).zip(after) {
            square[0] += (after.force() - before.force()).norm_squared();
            square[1] += after.force().norm_squared();
        }
    }

    /// Rms force change by the checks in percent of the force, per hand.
    pub(super) fn changed_percent(&self) -> [f64; 2] {
        self.squares.map(|[changed, force]| {
            if force > 0.0 {
                100.0 * (changed / force).sqrt()
            } else {
                0.0
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_haptics::{ContactModel, Touch};

    use super::Checks;

    fn model(force_n: [f64; 3]) -> ContactModel {
        ContactModel::single(Touch {
            touches: true,
            f0: Vector3::from(force_n),
            ..Touch::NONE
        })
    }

    #[test]
    fn check_change_is_relative_to_the_force_of_each_hand() {
        let mut checks = Checks::default();
        assert_eq!(checks.changed_percent(), [0.0; 2]);
        let (two, off) = (model([0.0, 0.0, 2.0]), model([0.0, 0.1, 2.0]));
        checks.note(
            0.004,
            &[off, ContactModel::FREE],
            &[two, ContactModel::FREE],
        );
        checks.note(0.009, &[two, two], &[two, two]);
        let [first, second] = checks.changed_percent();
        assert!((first - 100.0 * (0.01f64 / 8.0).sqrt()).abs() < 1e-9);
        assert_eq!((second, checks.count, checks.residual_max), (0.0, 2, 0.009));
    }
}
