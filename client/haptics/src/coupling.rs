//! The virtual coupling of tissue and device, for 3 and for 6 degrees of freedom.
//!
//! The textbook coupling connects the device to a proxy by a spring in series with the tissue: 400 N/m behind a
//! coupling of 1000 N/m feels like 286 N/m, and forces depend on the device. Here the solved forces are rendered
//! unchanged, and only the SLOPE with which they follow the hand between two solves is limited. A stiff contact
//! reaches its full force a few milliseconds later.
//!
//! The limit is a stiffness cap for sampled loops ([`StiffnessCap`]). With several contact points, and for a device
//! that renders torque, the stiffness is the matrix that maps a small motion (dx, dθ) to the change of (F, T):
//!
//! ```text
//! K = Σ J_iᵀ (a_i n_i n_iᵀ + c_i (I − n_i n_iᵀ)) J_i  +  C gᵀ / N0  +  G
//! J_i = [I, −[r_i]×]                  a_i, c_i slopes along and across the normal of contact i, r_i its lever
//! g = Σ a_i J_iᵀ n_i                  gradient of the total normal force (N0 at the solve), which scales C
//! G = Σ (r_i · f_i) I − (r_i f_iᵀ + f_i r_iᵀ) / 2     held forces on levers that turn; on dθ only
//! ```
//!
//! A length ℓ makes translation and rotation comparable: dθ counts as ℓ dθ, T as T/ℓ, and the largest eigenvalue of
//! K in that metric must not exceed the cap. ℓ is the grip: a hand that holds a handle at two points, each ℓ from
//! the pivot, damps translation with b and rotation with b ℓ², so the cap of the rotation is cap ℓ². Where K is too
//! stiff, one common factor lowers the slopes of all contact points, so that the tool does not tilt. One contact
//! point at the pivot has the cap of a point.
//!
//! A device without torque has an infinite ℓ: only the translational part is left, because no rotation closes a
//! loop.

use nalgebra::{Matrix3, Matrix6, SymmetricEigen, Vector6};

use crate::{CONTACTS_MAX, ContactModel, StiffnessCap};

/// Relative tolerance of the cap, for rounding of eigenvalues.
const ROUNDING: f64 = 1e-9;

/// Sweeps of the eigenvalue iteration, several times what a 6 x 6 matrix needs.
const SWEEPS_MAX: usize = 200;

/// Stiffness with which the force of a contact point follows the hand between two solves, N/m.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Slope {
    /// Along the normal.
    pub along: f64,
    /// Across it, the tie of friction.
    pub across: f64,
}

/// Limits slopes to what device and hand can follow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Coupling {
    cap: StiffnessCap,
    /// ℓ, m.
    grip_m: f64,
}

impl Coupling {
    /// For a device that renders forces only.
    pub(crate) fn of_forces(cap: StiffnessCap) -> Self {
        Self::of_wrenches(cap, f64::INFINITY)
    }

    /// For a device that renders torques, too, held at `grip_m` (ℓ, above zero) from its pivot.
    pub(crate) fn of_wrenches(cap: StiffnessCap, grip_m: f64) -> Self {
        Self { cap, grip_m }
    }

    /// The slopes of all contact points of `model`, zero for inactive ones. Neither allocates nor waits.
    pub(crate) fn slopes(&self, model: &ContactModel) -> [Slope; CONTACTS_MAX] {
        let mut slopes = [Slope::default(); CONTACTS_MAX];
        for (slope, touch) in slopes.iter_mut().zip(&model.touches) {
            if touch.touches {
                *slope = Slope {
                    along: self.cap.apply(touch.normal_stiffness()),
                    across: self.cap.apply(touch.tangential_stiffness),
                };
            }
        }
        let share = self.share(model, &slopes);
        for slope in &mut slopes {
            slope.along *= share;
            slope.across *= share;
        }
        slopes
    }

    /// The factor that brings the slopes within the cap, 0 to 1.
    fn share(&self, model: &ContactModel, slopes: &[Slope; CONTACTS_MAX]) -> f64 {
        let followed = self.slope_stiffness(model, slopes);
        let left = self.cap.n_per_m() - self.geometric_stiffness(model);
        if followed <= left * (1.0 + ROUNDING) {
            1.0
        } else {
            (left / followed).max(0.0)
        }
    }

    /// The part that grows with the slopes: contact points and couple.
    fn slope_stiffness(&self, model: &ContactModel, slopes: &[Slope; CONTACTS_MAX]) -> f64 {
        let (mut k, mut g, mut pressed) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
        for (touch, slope) in model.touches.iter().zip(slopes) {
            if !touch.touches {
                continue;
            }
            let nn: Matrix3<f64> = touch.normal * touch.normal.transpose();
            let own = nn * slope.along + (Matrix3::identity() - nn) * slope.across;
            let arm = touch.lever / self.grip_m;
            let x = arm.cross_matrix();
            add(&mut k, 0, 0, own);
            add(&mut k, 0, 3, -own * x);
            add(&mut k, 3, 0, x * own);
            add(&mut k, 3, 3, -x * own * x);
            let n = touch.normal * slope.along;
            let turns = arm.cross(&n);
            g += Vector6::new(n.x, n.y, n.z, turns.x, turns.y, turns.z);
            pressed += touch.pressed_n.max(touch.f0.norm());
        }
        let couple = model.couple.norm() / self.grip_m;
        if couple > 0.0 && pressed > 0.0 {
            largest(&k) + couple * g.norm() / pressed
        } else {
            largest(&k)
        }
    }

    /// The part that does not: forces held on levers that turn.
    fn geometric_stiffness(&self, model: &ContactModel) -> f64 {
        let mut g = Matrix6::zeros();
        for t in model.touching() {
            let pushed = t.normal * t.normal.dot(&t.f0);
            let (r, f) = (t.lever / self.grip_m, pushed / self.grip_m);
            let across = r * f.transpose();
            let own =
                Matrix3::from_diagonal_element(r.dot(&f)) - (across + across.transpose()) * 0.5;
            add(&mut g, 3, 3, own);
        }
        largest(&g).max(0.0)
    }
}

/// Adds a block to a matrix of motions, or of turns, or of both.
fn add(k: &mut Matrix6<f64>, row: usize, column: usize, block: Matrix3<f64>) {
    let mut view = k.fixed_view_mut::<3, 3>(row, column);
    view += block;
}

/// The largest eigenvalue of a symmetric matrix, or more.
fn largest(k: &Matrix6<f64>) -> f64 {
    // The norm bounds them all, should the sweeps not be enough.
    SymmetricEigen::try_new(*k, f64::EPSILON, SWEEPS_MAX)
        .map_or_else(|| k.norm(), |e| e.eigenvalues.max())
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Matrix6, SymmetricEigen, Vector3, Vector6};
    use palpate_device::{DeviceCaps, Workspace};
    use palpate_protocol::Span;
    use proptest::prelude::*;

    use super::{Coupling, Slope};
    use crate::{CONTACTS_MAX, ContactModel, StiffnessCap, Touch};

    const GRIP: f64 = 0.05;

    /// Of 1000 N/m.
    fn cap() -> StiffnessCap {
        let half = Vector3::repeat(0.1);
        let caps = DeviceCaps {
            name: "test".to_owned(),
            dof_in: 6,
            dof_out: 6,
            workspace: Workspace {
                min: -half,
                max: half,
            },
            max_force_n: 10.0,
            continuous_force_n: 5.0,
            max_torque_nm: 0.5,
            max_stiffness_n_per_m: 3000.0,
            rate_hz: 1000.0,
        };
        StiffnessCap::new(&caps, 0.5, Span::from_millis(1))
    }

    fn couplings() -> [Coupling; 2] {
        [
            Coupling::of_forces(cap()),
            Coupling::of_wrenches(cap(), GRIP),
        ]
    }

    fn touch(lever: Vector3<f64>, normal: Vector3<f64>, force: f64, k: f64) -> Touch {
        Touch {
            lever,
            ..Touch::at_pivot(normal * force, Matrix3::from_diagonal_element(k), normal)
        }
    }

    #[test]
    fn one_contact_point_at_the_pivot_has_the_cap_of_a_point() {
        for coupling in couplings() {
            for k in [3.0, 300.0, 999.0, 1000.0, 1001.0, 1e5] {
                let slender = Matrix3::from_diagonal(&Vector3::new(0.3 * k, 0.4 * k, k));
                let at = Touch {
                    stiffness: slender,
                    ..touch(Vector3::zeros(), Vector3::z(), 2.0, k)
                };
                let expected = Slope {
                    along: cap().apply(at.normal_stiffness()),
                    across: cap().apply(at.tangential_stiffness),
                };
                let slopes = coupling.slopes(&ContactModel::single(at));
                assert_eq!(slopes[0], expected, "{k} N/m");
                assert!(slopes[1..].iter().all(|s| *s == Slope::default()));
            }
        }
    }

    #[test]
    fn sixteen_contact_points_are_no_stiffer_than_one() {
        let mut model = ContactModel::FREE;
        model.touches = [touch(Vector3::zeros(), Vector3::z(), 1.0, 800.0); CONTACTS_MAX];
        for coupling in couplings() {
            let sum: f64 = coupling.slopes(&model).iter().map(|s| s.along).sum();
            assert!((sum - 1000.0).abs() < 1e-6, "{sum} N/m");
        }
    }

    #[test]
    fn torque_rendering_lowers_the_slope_of_a_long_lever() {
        let at = touch(Vector3::new(0.1, 0.0, 0.0), Vector3::z(), 0.0, 900.0);
        let model = ContactModel::single(at);
        let [forces, wrenches] = couplings().map(|c| c.slopes(&model)[0].along);
        assert_eq!(forces, 900.0);
        // A lever of twice the grip: the stiffness in one direction is scaled by 1 + 2².
        assert!((wrenches - 200.0).abs() < 1e-6, "{wrenches} N/m");
    }

    #[test]
    fn forces_that_turn_with_the_tool_lower_the_slopes() {
        // 4 N outwards at 50 mm turn back like 0.2 N·m/rad: 80 N/m at the grip.
        let at = touch(Vector3::new(GRIP, 0.0, 0.0), Vector3::x(), 4.0, 0.0);
        let [forces, wrenches] =
            couplings().map(|c| c.geometric_stiffness(&ContactModel::single(at)));
        assert_eq!(forces, 0.0);
        assert!((wrenches - 80.0).abs() < 1e-9, "{wrenches} N/m");
    }

    fn unit() -> impl Strategy<Value = Vector3<f64>> {
        (-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0).prop_map(|(x, y, z)| {
            let v = Vector3::new(x, y, z);
            v.try_normalize(1e-3).unwrap_or_else(Vector3::z)
        })
    }

    fn models() -> impl Strategy<Value = ContactModel> {
        let touch = (unit(), 0.0f64..0.2, unit(), 0.0f64..5.0, 1.0f64..20_000.0)
            .prop_map(|(along, r, n, f, k)| touch(along * r, n, f, k));
        let touches = proptest::collection::vec(touch, 1..=CONTACTS_MAX);
        (touches, unit(), 0.0f64..0.05).prop_map(|(touches, along, c)| {
            let mut model = ContactModel {
                couple: along * c,
                ..ContactModel::FREE
            };
            model.touches[..touches.len()].copy_from_slice(&touches);
            model
        })
    }

    /// The change of (F, T/ℓ) for a small motion, summed over the contact points, without the couple.
    fn stiffness(model: &ContactModel, slopes: &[Slope; CONTACTS_MAX]) -> Matrix6<f64> {
        Matrix6::from_fn(|i, j| {
            let unit = |k: usize| Vector6::from_fn(|m, _| f64::from(u8::from(m == k)));
            let answer = |dx: Vector6<f64>| {
                let (p, turn) = (dx.fixed_rows::<3>(0), dx.fixed_rows::<3>(3) / GRIP);
                let (mut f, mut t) = (Vector3::zeros(), Vector3::zeros());
                for (touch, slope) in model.touches.iter().zip(slopes) {
                    let moved: Vector3<f64> = p + turn.cross(&touch.lever);
                    let along = touch.normal * touch.normal.dot(&moved);
                    let change = along * slope.along + (moved - along) * slope.across;
                    f += change;
                    t += touch.lever.cross(&change) / GRIP;
                }
                Vector6::new(f.x, f.y, f.z, t.x, t.y, t.z)
            };
            answer(unit(j))[i]
        })
    }

    proptest! {
        #[test]
        fn no_motion_is_stiffer_than_the_cap(model in models()) {
            for coupling in couplings() {
                let slopes = coupling.slopes(&model);
                let bound = coupling.slope_stiffness(&model, &slopes) + coupling.geometric_stiffness(&model);
                prop_assert!(bound <= 1000.0 * (1.0 + 1e-6)
                    || slopes.iter().all(|s| s.along == 0.0));
            }
            let slopes = couplings()[1].slopes(&model);
            let k = SymmetricEigen::new(stiffness(&model, &slopes)).eigenvalues.max();
            prop_assert!(k <= 1000.0 * (1.0 + 1e-6), "{k} N/m");
        }
    }
}
