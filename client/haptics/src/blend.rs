//! From one contact model to the next without a step.
//!
//! A model arrives every 4 to 10 ms, and tissue is not linear: at the tool's present position the
//! new one says another force than the old one. Over the time between the two solves the normal
//! force therefore goes from the one law to the other:
//!
//! ```text
//! N(x) = (1 − w) N_old(x) + w N_new(x),   w from 0 to 1
//! N_i(x) = max(0, φ_i + g_i · (x − p_i) − d),   |d| <= φ_i
//! ```
//!
//! with φ the normal force at p, g = −k n its gradient and d = B n·v the damping. Both laws follow
//! the tool, so the blend delays what is new in a model by at most one interval, and never the
//! answer to a motion. When a third model comes before the blend is over, the mixture of the
//! moment becomes the old law: it starts at exactly the force that was given.
//!
//! Only the normal part of a model is used here; what acts along the surface is friction's own
//! (see `friction`), and a frictionless surface has none. With a constant k the normal force is a
//! function of one coordinate, so it creates no energy, whatever the path.

use nalgebra::Vector3;
use palpate_protocol::{ClientTime, Span};

use crate::{Contact, ContactModel, StiffnessCap};

/// The longest blend. Models further apart than this are late, and what a late model says is
/// wanted soon.
pub const BLEND_MAX: Span = Span::from_millis(10);

/// The shortest blend: one tick.
const BLEND_MIN: Span = Span::from_millis(1);

/// One one-sided law of normal force.
#[derive(Debug, Clone, Copy)]
struct Law {
    touches: bool,
    /// p, m.
    at: Vector3<f64>,
    /// φ, N.
    value: f64,
    /// g, N/m.
    gradient: Vector3<f64>,
    /// |x − p| beyond this counts as this, m.
    reach: f64,
    normal: Vector3<f64>,
    damping: f64,
    tangential: f64,
    mu_static: f64,
    mu_dynamic: f64,
}

impl Law {
    fn of(model: &ContactModel, cap: StiffnessCap) -> Self {
        let normal = model.normal;
        Self {
            touches: model.in_contact,
            at: model.x0,
            value: normal.dot(&model.f0),
            gradient: normal * -cap.apply(model.normal_stiffness()),
            reach: model.radius,
            normal,
            damping: model.damping,
            tangential: cap.apply(model.tangential_stiffness()),
            mu_static: model.mu_static,
            mu_dynamic: model.mu_dynamic.min(model.mu_static),
        }
    }

    /// N at `x` while moving with `v`.
    fn normal_force(&self, x: &Vector3<f64>, v: &Vector3<f64>) -> f64 {
        if !self.touches {
            return 0.0;
        }
        let away = x - self.at;
        let far = away.norm();
        let within = if far > self.reach {
            away * (self.reach / far)
        } else {
            away
        };
        let spring = self.value + self.gradient.dot(&within);
        if spring <= 0.0 {
            return 0.0;
        }
        // Bounded by the spring, so that touching and leaving are not steps.
        spring - (self.damping * self.normal.dot(v)).clamp(-spring, spring)
    }
}

/// The contact at the present position, smooth over arrivals of models.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Blend {
    cap: StiffnessCap,
    model: ContactModel,
    old: Law,
    new: Law,
    began: ClientTime,
    length: Span,
}

impl Blend {
    pub(crate) fn new(cap: StiffnessCap) -> Self {
        let free = Law::of(&ContactModel::FREE, cap);
        Self {
            cap,
            model: ContactModel::FREE,
            old: free,
            new: free,
            began: ClientTime::ZERO,
            length: BLEND_MIN,
        }
    }

    /// The newest model that was taken.
    pub(crate) fn model(&self) -> &ContactModel {
        &self.model
    }

    /// Takes `model`, which is usable, if it is a new one; whether it was.
    pub(crate) fn take(&mut self, model: &ContactModel, now: ClientTime, x: &Vector3<f64>) -> bool {
        let id = |m: &ContactModel| (m.topology_version, m.solved_at);
        if id(model) == id(&self.model) {
            return false;
        }
        self.old = self.mixture(now, x);
        self.new = Law::of(model, self.cap);
        self.length = (model.solved_at - self.model.solved_at).clamp(BLEND_MIN, BLEND_MAX);
        self.began = now;
        self.model = *model;
        true
    }

    /// Contact at `x` (m), moving with `v` (m/s).
    pub(crate) fn contact(&self, now: ClientTime, x: &Vector3<f64>, v: &Vector3<f64>) -> Contact {
        let (a, b) = self.weights(now);
        let mix = |old: f64, new: f64| a * old + b * new;
        let (a_t, b_t) = self.weights_of_touching(now);
        let mix_t = |old: f64, new: f64| a_t * old + b_t * new;
        Contact {
            normal: self.normal(now),
            normal_force: mix(self.old.normal_force(x, v), self.new.normal_force(x, v)),
            stiffness: mix_t(self.old.tangential, self.new.tangential),
            damping: mix_t(self.old.damping, self.new.damping),
            mu_static: mix_t(self.old.mu_static, self.new.mu_static),
            mu_dynamic: mix_t(self.old.mu_dynamic, self.new.mu_dynamic),
        }
    }

    /// Shares of the old and the new law.
    fn weights(&self, now: ClientTime) -> (f64, f64) {
        let w = (now - self.began).as_secs_f64() / self.length.as_secs_f64();
        let w = w.clamp(0.0, 1.0);
        (1.0 - w, w)
    }

    /// The same among laws that touch: a free model has no surface to mix in.
    fn weights_of_touching(&self, now: ClientTime) -> (f64, f64) {
        match (self.old.touches, self.new.touches) {
            (true, false) => (1.0, 0.0),
            (false, _) => (0.0, 1.0),
            (true, true) => self.weights(now),
        }
    }

    fn normal(&self, now: ClientTime) -> Vector3<f64> {
        let (a, b) = self.weights_of_touching(now);
        let mixed = self.old.normal * a + self.new.normal * b;
        mixed.try_normalize(0.1).unwrap_or(self.new.normal)
    }

    /// The law that is in force at `now`, around `x`, as one.
    fn mixture(&self, now: ClientTime, x: &Vector3<f64>) -> Law {
        let still = Vector3::zeros();
        let contact = self.contact(now, x, &still);
        let (a, b) = self.weights(now);
        let slope = |law: &Law, share: f64| {
            let pushes = law.normal_force(x, &still) > 0.0;
            if pushes {
                law.gradient * share
            } else {
                Vector3::zeros()
            }
        };
        Law {
            touches: contact.normal_force > 0.0,
            at: *x,
            value: contact.normal_force,
            gradient: slope(&self.old, a) + slope(&self.new, b),
            reach: self.new.reach.max(self.old.reach),
            normal: contact.normal,
            damping: contact.damping,
            tangential: contact.stiffness,
            mu_static: contact.mu_static,
            mu_dynamic: contact.mu_dynamic,
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use palpate_protocol::{ClientTime, Span};
    use proptest::prelude::*;

    use super::Blend;
    use crate::{ContactModel, StiffnessCap};

    fn cap() -> StiffnessCap {
        StiffnessCap::new(
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
        )
    }

    fn at(us: i64) -> ClientTime {
        ClientTime::from_micros(us)
    }

    fn model(us: i64, z: f64, force: f64, k: f64) -> ContactModel {
        ContactModel {
            solved_at: at(us),
            x0: Vector3::new(0.0, 0.0, z),
            f0: Vector3::new(0.0, 0.0, force),
            stiffness: Matrix3::from_diagonal_element(k),
            damping: 0.0,
            mu_static: 0.4,
            mu_dynamic: 0.3,
            radius: 0.01,
            in_contact: true,
            ..ContactModel::FREE
        }
    }

    proptest! {
        #[test]
        fn an_arriving_model_changes_nothing_in_its_first_tick(
            arrivals in proptest::collection::vec((1i64..12, -0.01f64..0.01, 0.0f64..8.0, any::<bool>()), 2..20),
        ) {
            let (mut blend, v) = (Blend::new(cap()), Vector3::zeros());
            let mut us = 1_000_000;
            for (ms, z, force, touches) in arrivals {
                us += ms * 1000;
                let x = Vector3::new(0.0, 0.0, z * 0.3);
                let before = blend.contact(at(us), &x, &v).normal_force;
                let new = ContactModel { in_contact: touches, ..model(us, z, force, 300.0) };
                blend.take(&new, at(us), &x);
                let after = blend.contact(at(us), &x, &v).normal_force;
                prop_assert!((before - after).abs() < 1e-9, "{before} N became {after} N");
            }
        }

        #[test]
        fn the_force_never_pulls(z in -0.05f64..0.05, vz in -1.0f64..1.0, b in 0.0f64..50.0) {
            let mut blend = Blend::new(cap());
            let m = ContactModel { damping: b, ..model(1000, 0.0, 1.0, 500.0) };
            let (x, v) = (Vector3::new(0.0, 0.0, z), Vector3::new(0.0, 0.0, vz));
            blend.take(&m, at(1000), &x);
            for us in (1000..20_000).step_by(1000) {
                prop_assert!(blend.contact(at(us), &x, &v).normal_force >= 0.0);
            }
        }
    }

    #[test]
    fn the_new_model_holds_after_one_interval() {
        let (mut blend, o) = (Blend::new(cap()), Vector3::zeros());
        blend.take(&model(4_000, 0.0, 1.0, 500.0), at(4_500), &o);
        blend.take(&model(8_000, 0.0, 3.0, 500.0), at(18_500), &o);
        assert!((blend.contact(at(18_500), &o, &o).normal_force - 1.0).abs() < 1e-12);
        assert!((blend.contact(at(20_500), &o, &o).normal_force - 2.0).abs() < 1e-12);
        assert!((blend.contact(at(22_500), &o, &o).normal_force - 3.0).abs() < 1e-12);
    }

    #[test]
    fn the_same_model_again_starts_no_new_blend() {
        let (mut blend, o) = (Blend::new(cap()), Vector3::zeros());
        let m = model(4_000, 0.0, 2.0, 500.0);
        blend.take(&m, at(5_000), &o);
        blend.take(&m, at(15_000), &o);
        assert!((blend.contact(at(15_000), &o, &o).normal_force - 2.0).abs() < 1e-12);
    }

    #[test]
    fn beyond_its_reach_the_law_grows_no_further() {
        let (mut blend, o) = (Blend::new(cap()), Vector3::zeros());
        blend.take(&model(4_000, 0.0, 1.0, 500.0), at(5_000), &o);
        let force = |z| {
            blend
                .contact(at(60_000), &Vector3::new(0.0, 0.0, z), &o)
                .normal_force
        };
        assert!((force(-0.01) - 6.0).abs() < 1e-9);
        assert!((force(-0.5) - 6.0).abs() < 1e-9);
    }
}
