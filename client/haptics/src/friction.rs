//! Stick-slip friction of one contact point.
//!
//! In STICK the tool is tied to the material by the tangential spring of the tissue (the tie). In SLIP the tie is
//! dragged along, so that it pulls with the dynamic coefficient. With e the stretch of the tie (tangential, m), k
//! its stiffness, N the normal force, w the tangential velocity, Δx the motion of the contact point since the last
//! tick:
//!
//! ```text
//! e ← P_t (e + Δx)                                   P_t = I − n nᵀ
//! STICK: f_t = −k e − B w, |f_t| <= μs N;          to SLIP when k |e| > μs N
//! SLIP:  e shortened to |e| = μd N / k if longer;    f_t = −k e
//!        to STICK when |w| < v0 and |f_t| < η μd N for the dwell time
//! ```
//!
//! The two coefficients and the tie are from Lin 2007, chapter 4. The velocity band, η and the dwell time are ours
//! and prevent chatter from velocity noise.
//!
//! A solver's stiffness varies by a fifth from model to model, so the tie's stiffness follows it with the time
//! constant [`FOLLOWS_IN_S`], and at once to within the ratio [`FORGIVES`]. The tool then feels the mean stiffness
//! of the tissue.
//!
//! Energy: shortening e by da along itself loses k e·da. A change of stiffness keeps the force: a rise saves the
//! energy that shortens e, a fall spends it. Without saved energy, a fall keeps k e² and loses force. The tie is
//! therefore passive, and a fluctuating stiffness costs a sticking tool nothing.

use nalgebra::Vector3;
use palpate_protocol::Span;

/// Minimum ratio of the smaller to the larger stiffness of tie and tissue.
const FORGIVES: f64 = 0.8;

/// Time constant with which the stiffness of the tie follows that of the tissue, s: some twenty models, and a tenth
/// of a stroke.
const FOLLOWS_IN_S: f64 = 0.1;

/// The constants of stick and slip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrictionConfig {
    /// Tangential speed below which the tool may stick again (v0), m/s. 1 to 2 mm/s.
    pub stick_speed: f64,
    /// Share of the dynamic friction below which the tie must pull to stick again (η), 0.6 to 0.9.
    pub stick_share: f64,
    /// How long both must hold.
    pub dwell: Span,
}

impl Default for FrictionConfig {
    fn default() -> Self {
        Self {
            stick_speed: 1.5e-3,
            stick_share: 0.8,
            dwell: Span::from_millis(5),
        }
    }
}

/// Input of the friction stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Contact {
    /// Unit normal, out of the tissue.
    pub normal: Vector3<f64>,
    /// Normal force, summed over all sides (N), N, never negative.
    pub pressed: f64,
    /// Tangential stiffness of the tissue, N/m.
    pub stiffness: f64,
    /// Tangential damping (B), N·s/m.
    pub damping: f64,
    /// μs.
    pub mu_static: f64,
    /// μd, at most μs.
    pub mu_dynamic: f64,
}

/// Contact state of the tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Grip {
    /// No contact.
    Free,
    /// Stick.
    Stick,
    /// Slip.
    Slip,
}

/// State of the stick-slip model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Friction {
    config: FrictionConfig,
    grip: Grip,
    /// e, m.
    stretch: Vector3<f64>,
    /// The tie's stiffness (k), N/m.
    stiffness: f64,
    /// Energy saved by rising stiffness and not yet spent by falling stiffness, J.
    saved_j: f64,
    slow_for: Span,
}

impl Friction {
    /// Not in contact.
    pub(crate) fn new(config: FrictionConfig) -> Self {
        Self {
            config,
            grip: Grip::Free,
            stretch: Vector3::zeros(),
            stiffness: 0.0,
            saved_j: 0.0,
            slow_for: Span::ZERO,
        }
    }

    /// The contact state.
    pub(crate) fn grip(&self) -> Grip {
        self.grip
    }

    /// Resets to no contact: the next contact starts without stretch. For broken paths (a bad sample).
    pub(crate) fn reset(&mut self) {
        *self = Self::new(self.config);
    }

    /// One tick, `dt` after the last: the contact point has moved by `moved` (m) and moves with `v` (m/s). Returns
    /// the tangential force on the tool, N.
    pub(crate) fn tick(
        &mut self,
        contact: &Contact,
        moved: &Vector3<f64>,
        v: &Vector3<f64>,
        dt: Span,
    ) -> Vector3<f64> {
        if contact.pressed <= 0.0 || contact.stiffness <= 0.0 {
            self.reset();
            return Vector3::zeros();
        }
        if self.grip == Grip::Free {
            self.grip = Grip::Stick;
            self.stiffness = contact.stiffness;
        } else {
            self.follow(contact.stiffness, dt);
            self.stretch = tangential(&(self.stretch + moved), &contact.normal);
        }
        let v_t = tangential(v, &contact.normal);
        match self.grip {
            Grip::Slip => self.slip(contact, &v_t, dt),
            Grip::Free | Grip::Stick => self.stick(contact, &v_t),
        }
    }

    /// Moves the stiffness of the tie towards that of the tissue.
    fn follow(&mut self, tissue: f64, dt: Span) {
        let dt_s = dt.as_secs_f64();
        let nearer = self.stiffness + (tissue - self.stiffness) * dt_s / (FOLLOWS_IN_S + dt_s);
        let after = nearer.clamp(tissue * FORGIVES, tissue / FORGIVES);
        let stored_j = 0.5 * self.stiffness * self.stretch.norm_squared();
        let same_force_j = stored_j * self.stiffness / after;
        if same_force_j <= stored_j + self.saved_j {
            self.stretch *= self.stiffness / after;
            self.saved_j += stored_j - same_force_j;
        } else {
            let all_j = stored_j + self.saved_j;
            self.stretch *= (self.stiffness / after * all_j / stored_j).sqrt();
            self.saved_j = 0.0;
        }
        self.stiffness = after;
    }

    fn stick(&mut self, contact: &Contact, v_t: &Vector3<f64>) -> Vector3<f64> {
        let limit = contact.mu_static * contact.pressed;
        if self.stiffness * self.stretch.norm() > limit {
            self.grip = Grip::Slip;
            self.slow_for = Span::ZERO;
            return self.drag(contact);
        }
        let pull = self.stretch * -self.stiffness - v_t * contact.damping;
        let n = pull.norm();
        if n > limit { pull * (limit / n) } else { pull }
    }

    fn slip(&mut self, contact: &Contact, v_t: &Vector3<f64>, dt: Span) -> Vector3<f64> {
        let force = self.drag(contact);
        let sliding = contact.mu_dynamic * contact.pressed;
        let is_slow = v_t.norm() < self.config.stick_speed
            && force.norm() < self.config.stick_share * sliding;
        self.slow_for = if is_slow {
            self.slow_for + dt
        } else {
            Span::ZERO
        };
        if self.slow_for >= self.config.dwell {
            self.grip = Grip::Stick;
        }
        force
    }

    /// Shortens the tie to the limit of dynamic friction; returns its force, N.
    fn drag(&mut self, contact: &Contact) -> Vector3<f64> {
        let longest = contact.mu_dynamic * contact.pressed / self.stiffness;
        let n = self.stretch.norm();
        if n > longest {
            self.stretch *= longest / n;
        }
        self.stretch * -self.stiffness
    }
}

/// The part of `v` across the unit vector `normal`.
fn tangential(v: &Vector3<f64>, normal: &Vector3<f64>) -> Vector3<f64> {
    v - normal * normal.dot(v)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_protocol::Span;
    use proptest::prelude::*;

    use super::{Contact, FrictionConfig, Grip};

    const MS: Span = Span::from_millis(1);

    /// A contact point given by its position instead of its displacement.
    struct Friction(super::Friction, Option<Vector3<f64>>);

    impl Friction {
        fn new(config: FrictionConfig) -> Self {
            Self(super::Friction::new(config), None)
        }

        fn tick(
            &mut self,
            contact: &Contact,
            x: &Vector3<f64>,
            v: &Vector3<f64>,
            dt: Span,
        ) -> Vector3<f64> {
            let moved = x - self.1.replace(*x).unwrap_or(*x);
            self.0.tick(contact, &moved, v, dt)
        }

        fn grip(&self) -> Grip {
            self.0.grip()
        }
    }

    fn pressed(n: f64) -> Contact {
        Contact {
            normal: Vector3::z(),
            pressed: n,
            stiffness: 300.0,
            damping: 0.5,
            mu_static: 0.5,
            mu_dynamic: 0.35,
        }
    }

    /// A block of 0.2 kg on a slope whose angle grows slowly to tan α = `share` μs; how far it
    /// has moved after 4 s, m, and whether it ever slipped.
    fn block_on_slope(share: f64) -> (f64, bool) {
        let (mass, g, dt) = (0.2, 9.81, 1e-3);
        let mut friction = Friction::new(FrictionConfig::default());
        let (mut x, mut v, mut slipped) = (Vector3::zeros(), Vector3::<f64>::zeros(), false);
        for i in 0..4000 {
            let alpha = (share * 0.5_f64).atan() * (f64::from(i) / 2000.0).min(1.0);
            let contact = Contact {
                damping: 2.0,
                ..pressed(mass * g * alpha.cos())
            };
            let f = friction.tick(&contact, &x, &v, MS);
            let air = v * -3.0;
            v += (f + air + Vector3::x() * (mass * g * alpha.sin())) * (dt / mass);
            x += v * dt;
            slipped |= friction.grip() == Grip::Slip;
        }
        (x.norm(), slipped)
    }

    #[test]
    fn a_block_sticks_below_the_static_angle_and_slips_above() {
        let (moved, slipped) = block_on_slope(0.95);
        // Stuck: only the tie has stretched, by at most μs N / k.
        assert!(!slipped && moved < 0.5 * 0.2 * 9.81 / 300.0, "{moved} m");
        let (moved, slipped) = block_on_slope(1.05);
        assert!(slipped && moved > 0.1, "{moved} m");
    }

    #[test]
    fn a_sliding_tool_feels_dynamic_friction() {
        let mut friction = Friction::new(FrictionConfig::default());
        let v = Vector3::new(0.05, 0.0, 0.0);
        let mut f = Vector3::zeros();
        for i in 0..1000 {
            f = friction.tick(&pressed(2.0), &(v * (f64::from(i) * 1e-3)), &v, MS);
        }
        assert_eq!(friction.grip(), Grip::Slip);
        assert!((f + Vector3::x() * (0.35 * 2.0)).norm() < 1e-9);
    }

    #[test]
    fn it_sticks_again_only_after_the_dwell_time() {
        let mut friction = Friction::new(FrictionConfig::default());
        let v = Vector3::new(0.05, 0.0, 0.0);
        let mut x = Vector3::zeros();
        for _ in 0..200 {
            x += v * 1e-3;
            friction.tick(&pressed(2.0), &x, &v, MS);
        }
        // Back by slightly less than the tie, then at rest: f_t is small and the tool is slow.
        x -= Vector3::x() * (0.35 * 2.0 / 300.0 * 0.9);
        let still = Vector3::zeros();
        for tick in 1..=5 {
            assert_eq!(friction.grip(), Grip::Slip, "tick {tick}");
            friction.tick(&pressed(2.0), &x, &still, MS);
        }
        assert_eq!(friction.grip(), Grip::Stick);
    }

    #[test]
    fn changing_stiffness_adds_no_energy_to_the_tie() {
        let still = Vector3::zeros();
        let x = Vector3::new(0.002, 0.0, 0.0);
        // The energy of the tie: |f|² / 2k.
        let energy = |f: Vector3<f64>, k: f64| f.norm_squared() / (2.0 * k);
        for stiffness in [30.0, 100.0, 600.0, 3000.0] {
            let mut friction = Friction::new(FrictionConfig::default());
            friction.tick(&pressed(5.0), &still, &still, MS);
            let before = friction.tick(&pressed(5.0), &x, &still, MS);
            let after = friction.tick(
                &Contact {
                    stiffness,
                    ..pressed(5.0)
                },
                &x,
                &still,
                MS,
            );
            assert!(after.norm() <= before.norm() + 1e-12, "{stiffness} N/m");
            assert!(
                energy(after, friction.0.stiffness) <= energy(before, 300.0) + 1e-12,
                "{stiffness} N/m"
            );
        }
    }

    #[test]
    fn fluctuating_stiffness_costs_a_sticking_tool_little_force() {
        let still = Vector3::zeros();
        let x = Vector3::new(0.002, 0.0, 0.0);
        let mut friction = Friction::new(FrictionConfig::default());
        friction.tick(&pressed(5.0), &still, &still, MS);
        let first = friction.tick(&pressed(5.0), &x, &still, MS);
        for i in 0..20_000_u32 {
            // A fifth up and down, changed every four ticks, as models are.
            let up = f64::from((i / 4).wrapping_mul(2_654_435_761) >> 16) / 65_536.0;
            let contact = Contact {
                stiffness: 300.0 * (0.8 + 0.4 * up),
                ..pressed(5.0)
            };
            let f = friction.tick(&contact, &x, &still, MS);
            assert!(
                (0.93..=1.0 + 1e-9).contains(&(f.norm() / first.norm())),
                "{i}"
            );
            assert!((0.8..1.25).contains(&(friction.0.stiffness / 300.0)), "{i}");
        }
    }

    #[test]
    fn leaving_the_surface_resets_the_tie() {
        let mut friction = Friction::new(FrictionConfig::default());
        let still = Vector3::zeros();
        friction.tick(&pressed(2.0), &still, &still, MS);
        friction.tick(&pressed(2.0), &Vector3::new(0.001, 0.0, 0.0), &still, MS);
        friction.tick(&pressed(0.0), &Vector3::new(0.001, 0.0, 0.0), &still, MS);
        assert_eq!(friction.grip(), Grip::Free);
        let f = friction.tick(&pressed(2.0), &Vector3::new(0.001, 0.0, 0.0), &still, MS);
        assert_eq!(f, Vector3::zeros());
    }

    /// Random walk in steps of at most 0.2 mm (0.2 m/s), then straight back to its start.
    fn closed_path(steps: &[(f64, f64, f64)]) -> Vec<Vector3<f64>> {
        let mut path = vec![Vector3::zeros()];
        for &(x, y, z) in steps {
            path.push(path[path.len() - 1] + Vector3::new(x, y, z) * 1e-4);
        }
        let end = path[path.len() - 1];
        let back = (end.norm() / 1e-4).ceil().max(1.0) as usize;
        path.extend((1..=back).map(|i| end * (1.0 - i as f64 / back as f64)));
        path
    }

    proptest! {
        #[test]
        fn following_the_tissue_adds_no_energy_and_no_force(
            steps in proptest::collection::vec((10.0f64..3000.0, -1.0f64..1.0, 1i64..50), 1..100),
        ) {
            let mut friction = super::Friction { stiffness: 300.0, ..super::Friction::new(FrictionConfig::default()) };
            for (tissue, moved, dt) in steps {
                friction.stretch.x += moved * 1e-3;
                let energy = |f: &super::Friction| 0.5 * f.stiffness * f.stretch.norm_squared() + f.saved_j;
                let (stored, force) = (energy(&friction), friction.stiffness * friction.stretch.norm());
                friction.follow(tissue, Span::from_millis(dt));
                prop_assert!(energy(&friction) <= stored * (1.0 + 1e-9) && friction.saved_j >= 0.0);
                prop_assert!(friction.stiffness * friction.stretch.norm() <= force * (1.0 + 1e-9));
                prop_assert!((0.8 - 1e-9..=1.25 + 1e-9).contains(&(friction.stiffness / tissue)));
            }
        }

        #[test]
        fn tangential_force_is_inside_the_cone_and_across_the_normal(
            steps in proptest::collection::vec((-20.0f64..20.0, -20.0f64..20.0, 0.0f64..5.0), 1..200),
        ) {
            let mut friction = Friction::new(FrictionConfig::default());
            let mut x = Vector3::zeros();
            for (dx, dy, n) in steps {
                let moved = Vector3::new(dx, dy, -n) * 1e-4;
                x += moved;
                let f = friction.tick(&pressed(n), &x, &(moved * 1e3), MS);
                prop_assert!(f.norm() <= 0.5 * n + 1e-12);
                prop_assert!(f.z.abs() < 1e-12);
            }
        }

        #[test]
        fn closed_path_creates_no_energy(
            steps in proptest::collection::vec((-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0), 1..400),
        ) {
            // A surface at z = 2 mm of 400 N/m, so that the path presses, slides and leaves.
            let mut friction = Friction::new(FrictionConfig::default());
            let path = closed_path(&steps);
            let (mut work, mut before) = (0.0, None::<(Vector3<f64>, Vector3<f64>)>);
            for x in &path {
                let n = (400.0 * (0.002 - x.z)).max(0.0);
                let v = before.map_or_else(Vector3::zeros, |(last, _)| (x - last) * 1e3);
                let contact = Contact { damping: 0.0, ..pressed(n) };
                let f = friction.tick(&contact, x, &v, MS) + Vector3::z() * n;
                if let Some((last, force)) = before {
                    // The trapezium is exact for a linear spring; a held force would add the energy of the
                    // sampling.
                    work += 0.5 * (f + force).dot(&(x - last));
                }
                before = Some((*x, f));
            }
            // Tolerance for the kinks of the one-sided law and of the cone: k δ² / 8 each, with δ = 0.2 mm.
            let tolerance = path.len() as f64 * 400.0 * 4e-8 / 8.0 * 1e-2 + 1e-6;
            prop_assert!(work <= tolerance, "the tool gained {work} J over {} steps", path.len());
        }
    }
}
