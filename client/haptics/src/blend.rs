//! Interpolates from one contact model to the next without a force step.
//!
//! A model arrives every 4 to 10 ms. Tissue is nonlinear, so at the tool's present pose the new model gives another
//! force than the old one. Over the interval between the two solves the normal force of each contact point is
//! interpolated between the two contact laws (`contact_law`):
//!
//! ```text
//! N(x) = (1 − w) N_old(x) + w N_new(x),   w from 0 to 1
//! ```
//!
//! A new contact point grows from zero, an ended one fades to zero; levers and normals are interpolated too. Both
//! laws follow the tool, so the blend delays the change of model by at most one interval and never the response to
//! a motion. If a third model arrives during the blend, the present mixture becomes the old law, so the force is
//! continuous.
//!
//! The couple of a model is scaled by the ratio of the present normal force to that at its solve, at most one: a
//! tool that lifts off gets no residual torque.
//!
//! Only the normal part of a model is used here; tangential forces come from the friction stage (`friction`). With
//! a constant k the normal force of a contact point is a function of one coordinate, so it creates no energy on any
//! path.

use nalgebra::Vector3;
use palpate_protocol::{ClientTime, Span};

use crate::contact_law::{Law, Response};
use crate::motion::Motion;
use crate::{CONTACTS_MAX, Contact, ContactModel, Coupling};

/// Maximum blend time. Models further apart are late, and the newest one should take effect soon.
pub(crate) const BLEND_MAX: Span = Span::from_millis(10);

/// Minimum blend time: one tick.
const BLEND_MIN: Span = Span::from_millis(1);

/// The contact laws of all contact points of one model.
#[derive(Debug, Clone, Copy)]
struct Laws {
    points: [Law; CONTACTS_MAX],
    /// C, N·m.
    couple: Vector3<f64>,
    /// Sum of the normal forces for which C holds, N.
    pressed: f64,
}

impl Laws {
    const FREE: Self = Self {
        points: [Law::FREE; CONTACTS_MAX],
        couple: Vector3::new(0.0, 0.0, 0.0),
        pressed: 0.0,
    };

    fn of(model: &ContactModel, coupling: &Coupling) -> Self {
        let slopes = coupling.slopes(model);
        let mut points = [Law::FREE; CONTACTS_MAX];
        let mut pressed = 0.0;
        for i in 0..CONTACTS_MAX {
            points[i] = Law::of(model, i, &slopes[i]);
            pressed += points[i].total_normal_force_at_solve();
        }
        Self {
            points,
            couple: model.couple,
            pressed,
        }
    }

    /// The couple at a total normal force of `pressed` newtons, N·m.
    fn couple_at(&self, pressed: f64) -> Vector3<f64> {
        if self.pressed > 0.0 {
            self.couple * (pressed / self.pressed).min(1.0)
        } else {
            Vector3::zeros()
        }
    }
}

/// One active contact point, at the present pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ActiveContact {
    /// Its index on the tool.
    pub(crate) index: usize,
    /// From the pivot, m, along the scene's axes.
    pub(crate) lever: Vector3<f64>,
    /// Force along the normal, N; negative only where tissue squeezes from two sides.
    pub(crate) normal_force: f64,
    /// Stiffness of the tissue along the normal, N/m.
    pub(crate) stiffness: f64,
    /// Validity of the law, m.
    pub(crate) reach: f64,
    /// Input of the friction stage.
    pub(crate) contact: Contact,
}

/// The contacts at the present pose, continuous over model arrivals.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Blend {
    coupling: Coupling,
    model: ContactModel,
    old: Laws,
    new: Laws,
    began: ClientTime,
    length: Span,
}

impl Blend {
    pub(crate) fn new(coupling: Coupling) -> Self {
        Self {
            coupling,
            model: ContactModel::absent_at(ClientTime::ZERO, 0),
            old: Laws::FREE,
            new: Laws::FREE,
            began: ClientTime::ZERO,
            length: BLEND_MIN,
        }
    }

    /// The model that was accepted last.
    pub(crate) fn model(&self) -> &ContactModel {
        &self.model
    }

    /// The time at which the chain accepted the model.
    pub(crate) fn taken_at(&self) -> ClientTime {
        self.began
    }

    /// Accepts `model`, which is usable, if it is new or its contact has begun or ended; returns whether it did.
    pub(crate) fn take(&mut self, model: &ContactModel, now: ClientTime, motion: &Motion) -> bool {
        let contact = |m: &ContactModel| (m.is_absent, m.in_contact());
        let id = |m: &ContactModel| (m.topology_version, m.solved_at, contact(m));
        if id(model) == id(&self.model) {
            return false;
        }
        self.old = self.mixture(now, &motion.held());
        self.new = Laws::of(model, &self.coupling);
        for (old, new) in self.old.points.iter().zip(&mut self.new.points) {
            new.align_normal(old);
        }
        self.length = (model.solved_at - self.model.solved_at).clamp(BLEND_MIN, BLEND_MAX);
        self.began = now;
        self.model = *model;
        true
    }

    /// Calls `each` for every active contact point of a tool in `motion`, in order; returns the couple, N·m.
    pub(crate) fn for_each_contact(
        &self,
        now: ClientTime,
        motion: &Motion,
        mut each: impl FnMut(ActiveContact),
    ) -> Vector3<f64> {
        let (a, b) = self.weights(now);
        let (mut pressed_old, mut pressed_new) = (0.0, 0.0);
        for index in 0..CONTACTS_MAX {
            let (old, new) = (&self.old.points[index], &self.new.points[index]);
            if !(old.touches || new.touches) {
                continue;
            }
            let responses = [old.evaluate(motion), new.evaluate(motion)];
            pressed_old += responses[0].pressed;
            pressed_new += responses[1].pressed;
            each(self.mix(now, index, responses));
        }
        self.old.couple_at(pressed_old) * a + self.new.couple_at(pressed_new) * b
    }

    /// The interpolated response of a contact point to the two laws.
    fn mix(
        &self,
        now: ClientTime,
        index: usize,
        [response_old, response_new]: [Response; 2],
    ) -> ActiveContact {
        let (old, new) = (&self.old.points[index], &self.new.points[index]);
        let (a, b) = self.weights(now);
        let (a_t, b_t) = self.weights_of_touching(now, index);
        let mix_t = |old: f64, new: f64| a_t * old + b_t * new;
        let squeeze = a * old.squeeze + b * new.squeeze;
        let normal_force = a * response_old.normal_force + b * response_new.normal_force;
        let normal = old.normal * a_t + new.normal * b_t;
        ActiveContact {
            index,
            lever: response_old.lever * a_t + response_new.lever * b_t,
            normal_force,
            stiffness: mix_t(old.stiffness, new.stiffness),
            reach: old.reach.max(new.reach),
            contact: Contact {
                normal: normal.try_normalize(0.1).unwrap_or(new.normal),
                pressed: normal_force.abs() + squeeze,
                stiffness: mix_t(old.tangential, new.tangential),
                damping: mix_t(old.damping, new.damping),
                mu_static: mix_t(old.mu_static, new.mu_static),
                mu_dynamic: mix_t(old.mu_dynamic, new.mu_dynamic),
            },
        }
    }

    /// Weights of the old and the new law.
    fn weights(&self, now: ClientTime) -> (f64, f64) {
        let w = (now - self.began).as_secs_f64() / self.length.as_secs_f64();
        let w = w.clamp(0.0, 1.0);
        (1.0 - w, w)
    }

    /// The same among active laws only: an inactive contact point has no surface to interpolate.
    fn weights_of_touching(&self, now: ClientTime, index: usize) -> (f64, f64) {
        match (
            self.old.points[index].touches,
            self.new.points[index].touches,
        ) {
            (true, false) => (1.0, 0.0),
            (false, _) => (0.0, 1.0),
            (true, true) => self.weights(now),
        }
    }

    /// The interpolated laws at `now`, relinearised around the pose `held`.
    fn mixture(&self, now: ClientTime, held: &Motion) -> Laws {
        let (a, b) = self.weights(now);
        let mut laws = Laws::FREE;
        let couple = self.for_each_contact(now, held, |felt| {
            let (old, new) = (&self.old.points[felt.index], &self.new.points[felt.index]);
            let contact = felt.contact;
            let law = Law {
                touches: contact.pressed > 0.0,
                value: felt.normal_force,
                gradient: old.slope_at(held) * a + new.slope_at(held) * b,
                reach: felt.reach,
                normal: contact.normal,
                damping: contact.damping,
                stiffness: felt.stiffness,
                tangential: contact.stiffness,
                squeeze: a * old.squeeze + b * new.squeeze,
                mu_static: contact.mu_static,
                mu_dynamic: contact.mu_dynamic,
                ..Law::FREE
            };
            laws.points[felt.index] = law.relinearised_at(&held.pose(), felt.lever);
            laws.pressed += contact.pressed;
        });
        laws.couple = couple;
        laws
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, UnitQuaternion, Vector3};
    use palpate_protocol::{ClientTime, Span};
    use proptest::prelude::*;

    use super::{ActiveContact, Blend};
    use crate::motion::Motion;
    use crate::{CONTACTS_MAX, ContactModel, Coupling, StiffnessCap, Touch};

    fn coupling() -> Coupling {
        let cap = StiffnessCap::new(
            &palpate_device::DeviceCaps {
                name: "test".to_owned(),
                dof_in: 3,
                dof_out: 3,
                workspace: palpate_device::Workspace {
                    min: Vector3::repeat(-1.0),
                    max: Vector3::repeat(1.0),
                },
                max_force_n: 20.0,
                continuous_force_n: 10.0,
                max_torque_nm: 0.0,
                max_stiffness_n_per_m: 2000.0,
                rate_hz: 1000.0,
            },
            10.0,
            Span::from_millis(1),
        );
        Coupling::of_wrenches(cap, 0.05)
    }

    /// A tool that rests at `x`, turned by `turn` (rotation vector, rad).
    fn resting(x: Vector3<f64>, turn: Vector3<f64>) -> Motion {
        Motion {
            x,
            turn: UnitQuaternion::new(turn),
            v: Vector3::zeros(),
            w: Vector3::zeros(),
        }
    }

    fn height(z: f64) -> Motion {
        resting(Vector3::new(0.0, 0.0, z), Vector3::zeros())
    }

    /// Normal force of the only contact point, N.
    fn normal_force(blend: &Blend, us: i64, motion: &Motion) -> f64 {
        let mut sum = 0.0;
        blend.for_each_contact(at(us), motion, |felt: ActiveContact| {
            sum += felt.normal_force;
        });
        sum
    }

    /// Force and torque of all contact points without friction.
    fn wrench(blend: &Blend, us: i64, motion: &Motion) -> (Vector3<f64>, Vector3<f64>) {
        let (mut force, mut torque) = (Vector3::zeros(), Vector3::zeros());
        let couple = blend.for_each_contact(at(us), motion, |felt: ActiveContact| {
            let push = felt.contact.normal * felt.normal_force;
            force += push;
            torque += felt.lever.cross(&push);
        });
        (force, torque + couple)
    }

    fn at(us: i64) -> ClientTime {
        ClientTime::from_micros(us)
    }

    fn model(us: i64, z: f64, force: f64, k: f64) -> ContactModel {
        let f0 = Vector3::new(0.0, 0.0, force);
        ContactModel {
            solved_at: at(us),
            x0: Vector3::new(0.0, 0.0, z),
            radius: 0.01,
            ..ContactModel::single(Touch {
                mu_static: 0.4,
                mu_dynamic: 0.3,
                ..Touch::at_pivot(f0, Matrix3::from_diagonal_element(k), Vector3::z())
            })
        }
    }

    fn vector(size: f64) -> impl Strategy<Value = Vector3<f64>> {
        let c = -size..size;
        (c.clone(), c.clone(), c).prop_map(|(x, y, z)| Vector3::new(x, y, z))
    }

    /// Models of tools with a random set of active contact points.
    fn models() -> impl Strategy<Value = ContactModel> {
        let touch = (
            vector(0.1),
            vector(1.0),
            0.0f64..8.0,
            any::<bool>(),
            0.0f64..2.0,
        );
        let touch = touch.prop_map(|(lever, along, force, touches, squeeze)| {
            let normal = along.try_normalize(1e-3).unwrap_or_else(Vector3::z);
            let k = Matrix3::from_diagonal_element(300.0);
            Touch {
                touches,
                lever,
                pressed_n: force + squeeze,
                ..Touch::at_pivot(normal * force, k, normal)
            }
        });
        let touches = proptest::collection::vec(touch, CONTACTS_MAX);
        (touches, vector(0.01), vector(0.2), vector(0.3)).prop_map(|(touches, x0, turn, couple)| {
            ContactModel {
                x0,
                turn0: UnitQuaternion::new(turn),
                touches: touches.try_into().unwrap(),
                couple,
                radius: 0.02,
                ..ContactModel::FREE
            }
        })
    }

    proptest! {
        #[test]
        fn a_new_model_changes_no_force_in_its_first_tick(
            arrivals in proptest::collection::vec((1i64..12, models(), vector(0.01), vector(0.3)), 2..12),
        ) {
            let mut blend = Blend::new(coupling());
            let mut us = 1_000_000;
            for (ms, model, x, turn) in arrivals {
                us += ms * 1000;
                let motion = resting(x, turn);
                let before = wrench(&blend, us, &motion);
                blend.take(&ContactModel { solved_at: at(us), ..model }, at(us), &motion);
                let after = wrench(&blend, us, &motion);
                prop_assert!((before.0 - after.0).norm() < 1e-9, "{before:?} became {after:?}");
                prop_assert!((before.1 - after.1).norm() < 1e-9, "{before:?} became {after:?}");
            }
        }

        #[test]
        fn the_force_never_pulls(z in -0.05f64..0.05, vz in -1.0f64..1.0, b in 0.0f64..50.0) {
            let mut blend = Blend::new(coupling());
            let mut m = model(1000, 0.0, 1.0, 500.0);
            m.touches[0].damping = b;
            let motion = Motion { v: Vector3::new(0.0, 0.0, vz), ..height(z) };
            blend.take(&m, at(1000), &motion);
            for us in (1000..20_000).step_by(1000) {
                prop_assert!(normal_force(&blend, us, &motion) >= 0.0);
            }
        }
    }

    #[test]
    fn squeezed_contact_is_independent_of_the_sign_of_its_normal() {
        let squeezed = |us, normal| ContactModel {
            solved_at: at(us),
            radius: 0.01,
            ..ContactModel::single(Touch {
                pressed_n: 2.0,
                ..Touch::at_pivot(
                    Vector3::new(0.0, 0.0, 0.1),
                    Matrix3::from_diagonal_element(300.0),
                    normal,
                )
            })
        };
        let mut blend = Blend::new(coupling());
        let aside = height(-0.002);
        blend.take(&squeezed(4_000, Vector3::z()), at(4_500), &aside);
        blend.take(&squeezed(8_000, -Vector3::z()), at(18_500), &aside);
        for us in (18_500..=22_500).step_by(500) {
            let (force, _) = wrench(&blend, us, &aside);
            assert!((force.z - 0.7).abs() < 1e-9, "{us}: {force}");
        }
    }

    #[test]
    fn the_new_model_applies_fully_after_one_interval() {
        let (mut blend, o) = (Blend::new(coupling()), height(0.0));
        blend.take(&model(4_000, 0.0, 1.0, 500.0), at(4_500), &o);
        blend.take(&model(8_000, 0.0, 3.0, 500.0), at(18_500), &o);
        for (us, expected) in [(18_500, 1.0), (20_500, 2.0), (22_500, 3.0)] {
            assert!((normal_force(&blend, us, &o) - expected).abs() < 1e-12);
        }
    }

    #[test]
    fn a_repeated_model_starts_no_new_blend() {
        let (mut blend, o) = (Blend::new(coupling()), height(0.0));
        let m = model(4_000, 0.0, 2.0, 500.0);
        blend.take(&m, at(5_000), &o);
        blend.take(&m, at(15_000), &o);
        assert!((normal_force(&blend, 15_000, &o) - 2.0).abs() < 1e-12);
    }

    #[test]
    fn the_law_saturates_beyond_its_reach() {
        let mut blend = Blend::new(coupling());
        blend.take(&model(4_000, 0.0, 1.0, 500.0), at(5_000), &height(0.0));
        assert!((normal_force(&blend, 60_000, &height(-0.01)) - 6.0).abs() < 1e-9);
        assert!((normal_force(&blend, 60_000, &height(-0.5)) - 6.0).abs() < 1e-9);
    }

    #[test]
    fn contact_points_fade_out_and_in_over_one_interval() {
        let (mut blend, o) = (Blend::new(coupling()), height(0.0));
        let mut first = model(4_000, 0.0, 2.0, 500.0);
        blend.take(&first, at(5_000), &o);
        // The same force at another contact point, 4 ms later.
        first.touches.swap(0, 7);
        first.solved_at = at(8_000);
        blend.take(&first, at(9_000), &o);
        for (us, expected) in [(9_000, 2.0), (11_000, 1.0), (13_000, 0.0)] {
            let mut of = [0.0; CONTACTS_MAX];
            blend.for_each_contact(at(us), &o, |felt| of[felt.index] = felt.normal_force);
            assert!((of[0] - expected).abs() < 1e-12, "{us}: {} N", of[0]);
            assert!(
                (of[7] - (2.0 - expected)).abs() < 1e-12,
                "{us}: {} N",
                of[7]
            );
        }
    }

    #[test]
    fn the_couple_scales_with_the_normal_force() {
        let mut blend = Blend::new(coupling());
        let mut pressed = model(4_000, 0.0, 2.0, 500.0);
        pressed.couple = Vector3::new(0.1, 0.0, 0.0);
        blend.take(&pressed, at(5_000), &height(0.0));
        // The 2 N are halved at 2 mm and zero at 4 mm; a deeper pose leaves the couple unchanged.
        for (z, share) in [
            (-0.002, 1.0),
            (0.0, 1.0),
            (0.002, 0.5),
            (0.004, 0.0),
            (0.006, 0.0),
        ] {
            let (_, torque) = wrench(&blend, 60_000, &height(z));
            assert!(
                (torque.x - 0.1 * share).abs() < 1e-12,
                "{z} m: {} N·m",
                torque.x
            );
        }
    }
}
