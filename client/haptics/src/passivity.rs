//! The passivity controller: the hand never gets more work back than it has put into a contact.
//!
//! A tank holds what the hand has put in and not got back (Hannaford and Ryu 2002, their observer):
//!
//! ```text
//! E_k = E_(k−1) − F_(k−1) · (x_k − x_(k−1))          F is held from tick to tick, so this is exact
//! ```
//!
//! Their controller adds a damper when E falls below zero. A damper is a force of its own, as large as velocity is noisy,
//! and the slew limit, which comes after, would let it come too late. Here force is only ever taken away, and before
//! the tank is empty. To take F away takes |F|/δ ticks, δ being the slew limit's step; meanwhile it pushes with the
//! impulse J, and what it pushes is no lighter than m and moves with v along it. So there must be
//!
//! ```text
//! E_k - E_0 >= J v + J²/(2 m)        J = T (|F| + |F|²/(2 δ)),  T the period
//! ```
//!
//! which is solved for |F|. A spring stores |F|²/(2 K): it never comes near while |F| < 2 (δ/T) √(m/K), or 17 N for
//! 400 N/m. So soft tissue is rendered as it is, and a wall that the delay of a solver makes lively loses force
//! before it can throw the hand back.
//!
//! Others who press on the same tissue put work into it, too, and this hand may well be pushed by them: what they have
//! put in, less what they have got back, counts as well ([`ContactModel::others_j`](crate::ContactModel)), and pays for
//! what they have moved this hand by.
//!
//! What is stored, or owed, ends with the contact, not at once, as a model without contact may come between two with
//! one: a tool that has come off has got back all that an elastic tissue owes. Nor does the tank hold more than the
//! force over the depth of any press, so what friction has taken up is not spent on a later oscillation. Where nothing
//! is known of the way here (a fault, a jump) the tissue is believed to store what a spring does, |F|²/(2 K).

use nalgebra::Vector3;
use palpate_protocol::Span;

/// Energy that must be earned before any is given back, J: what 0.06 N have moved by 0.3 mm, less than a hand tells.
/// It covers a hand that is faster at the end of a tick than at its beginning.
const RESERVE_J: f64 = 1e-5;
/// m: a little less than the lightest thing that a force acts on, kg: a device's handle of 0.1 kg when the hand has let
/// go of it.
const LIGHTEST_KG: f64 = 0.08;
/// Time in which what is stored falls to a third when nothing is touched, s.
const FORGETS_S: f64 = 0.1;
/// Faster than any hand, m/s: such a sample is a glitch, and nobody has done the work that it seems to have taken.
const JUMPS_M_S: f64 = 20.0;
/// The deepest press that an elastic tissue gives back, m.
const DEPTH_M: f64 = 0.05;

/// What is known of a tool at the beginning of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Where it is, m.
    pub x: Vector3<f64>,
    /// Time since the last tick.
    pub dt: Span,
    /// What the tissue pushes it with there, before anything is taken away, N.
    pub there_n: f64,
    /// Stiffness of the tissue there, N/m.
    pub stiffness_n_per_m: f64,
}

/// What a tool is given in a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Given {
    /// Where it is, m.
    pub x: Vector3<f64>,
    /// What pushes it until the next tick, N.
    pub force: Vector3<f64>,
    /// What the soft start and a lost link keep from it, N. A hand that presses meanwhile works against nothing, and
    /// finds the force there when they are over: what it would have put in, less what it would have got back, is
    /// counted as put in.
    pub withheld: Vector3<f64>,
    /// Whether it touches anything at all.
    pub touches: bool,
}

/// Takes force away that would give the hand more work than it has put in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passivity {
    period_s: f64,
    /// δ, N per tick.
    step_n: f64,
    tank_j: f64,
    /// What was given in the last tick.
    last: Option<Given>,
    /// What others have put in beside this contact and not got back, J. What they had put in before is theirs to
    /// take back: it is never below zero.
    lent_j: f64,
    /// What the hand would have put in while forces were withheld, less what it would have got back, J.
    kept_j: f64,
    /// The most that each of them may hold, J.
    room_j: f64,
    /// What others had put in when it was last heard of.
    others_j: Option<f64>,
}

impl Passivity {
    /// In front of a slew limit of `step_n` newtons per tick of `period`.
    pub fn new(step_n: f64, period: Span) -> Self {
        Self {
            period_s: period.as_secs_f64(),
            step_n,
            tank_j: 0.0,
            last: None,
            lent_j: 0.0,
            kept_j: 0.0,
            room_j: 0.0,
            others_j: None,
        }
    }

    /// What the hand has put in and not got back, J.
    pub fn stored_j(&self) -> f64 {
        self.tank_j
    }

    /// The path is broken (a bad sample): what was stored stays, and nothing is known of the work since.
    pub fn interrupt(&mut self) {
        self.last = None;
    }

    /// Others have put so much into the tissue since they began, less what they have got back, J.
    pub fn hear(&mut self, others_j: f64) {
        let before = self.others_j.replace(others_j).unwrap_or(others_j);
        self.lent_j = (self.lent_j + others_j - before).max(0.0);
    }

    /// The tool has moved.
    pub fn observe(&mut self, seen: &Seen) {
        let room = RESERVE_J + seen.there_n * DEPTH_M;
        self.room_j = room.max(self.room_j * self.left_of(FORGETS_S));
        let dt_s = seen.dt.as_secs_f64().max(self.period_s);
        let path = self.last.map(|last| (last, seen.x - last.x));
        match path.filter(|(_, by)| by.norm() <= JUMPS_M_S * dt_s) {
            Some((last, by)) => {
                self.tank_j -= last.force.dot(&by);
                self.kept_j = (self.kept_j - last.withheld.dot(&by)).max(0.0);
                if last.withheld == Vector3::zeros() {
                    self.tank_j += std::mem::take(&mut self.kept_j);
                }
            }
            // Nothing is known of the way here. The tissue stores what a spring does that pushes like this.
            None if seen.there_n > 0.0 => {
                let stored = 0.5 * seen.there_n * seen.there_n / seen.stiffness_n_per_m.max(1.0);
                self.kept_j = self.kept_j.max(stored);
            }
            None => {}
        }
        // What others have moved this hand by, they have paid for.
        let debt = (-self.tank_j).max(0.0).min(self.lent_j);
        self.tank_j += debt;
        self.lent_j -= debt;
        for account in [&mut self.tank_j, &mut self.lent_j, &mut self.kept_j] {
            *account = account.min(self.room_j);
        }
    }

    /// What a tick leaves of something that falls to a third in `s` seconds.
    fn left_of(&self, s: f64) -> f64 {
        1.0 - self.period_s / s
    }

    /// As much of `force` (N) as may be given to a tool that moves with `v` (m/s), and whether that is less. The
    /// direction stays.
    pub fn limit(&self, force: Vector3<f64>, v: &Vector3<f64>) -> (Vector3<f64>, bool) {
        let n = force.norm();
        if n == 0.0 {
            return (force, false);
        }
        let along = force.dot(v) / n;
        let there = (self.tank_j + self.lent_j + self.kept_j - RESERVE_J).max(0.0);
        let impulse = LIGHTEST_KG * ((along * along + 2.0 * there / LIGHTEST_KG).sqrt() - along);
        let most =
            self.step_n * ((1.0 + 2.0 * impulse / (self.period_s * self.step_n)).sqrt() - 1.0);
        if n > most {
            (force * (most / n), true)
        } else {
            (force, false)
        }
    }

    /// What pushes the tool until the next tick is `force` (N), and not what was given: the device has clamped it, or
    /// taken it away.
    pub fn correct(&mut self, force: Vector3<f64>) {
        if let Some(last) = &mut self.last {
            last.force = force;
        }
    }

    /// What is given until the next tick.
    pub fn give(&mut self, given: Given) {
        if !given.touches {
            // Debts, too: a hand that is off the tissue owes it nothing for long.
            self.tank_j *= self.left_of(FORGETS_S);
        }
        self.last = Some(given);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_protocol::Span;
    use proptest::prelude::*;

    use super::{Given, Passivity, Seen};
    use crate::Slew;

    const STEP: f64 = 0.6;

    fn seen(x: &Vector3<f64>, there_n: f64) -> Seen {
        Seen {
            x: *x,
            dt: Span::from_millis(1),
            there_n,
            stiffness_n_per_m: 400.0,
        }
    }

    fn given(x: Vector3<f64>, force: Vector3<f64>, touches: bool) -> Given {
        Given {
            x,
            force,
            withheld: Vector3::zeros(),
            touches,
        }
    }

    fn passivity() -> Passivity {
        Passivity::new(STEP, Span::from_millis(1))
    }

    #[test]
    fn what_stops_the_hand_is_given_and_what_would_throw_it_back_is_not() {
        let p = passivity();
        let force = Vector3::new(0.0, 0.0, 7.0);
        // 80 g at 0.5 m/s take 40 mN·s to stop: what a force of 7 N gives while it is taken away.
        assert_eq!(
            p.limit(force, &Vector3::new(0.1, 0.0, -0.5)),
            (force, false)
        );
        let (slow, limited) = p.limit(force, &Vector3::new(0.0, 0.0, -0.1));
        assert!(limited && slow.z > 1.0 && slow.z < 7.0, "{slow:?}");
        assert_eq!(p.limit(force, &Vector3::zeros()), (Vector3::zeros(), true));
        let none = Vector3::zeros();
        assert_eq!(p.limit(none, &Vector3::x()), (none, false));
    }

    #[test]
    fn what_others_put_in_may_push_a_hand_that_rests() {
        let mut p = passivity();
        let force = Vector3::new(0.0, 0.0, 2.0);
        p.hear(5.0);
        assert!(
            p.limit(force, &Vector3::zeros()).1,
            "they began before this hand came"
        );
        p.hear(5.01);
        assert_eq!(p.limit(force, &Vector3::zeros()), (force, false));
        p.hear(5.0);
        assert!(
            p.limit(force, &Vector3::zeros()).1,
            "they have taken it back"
        );
    }

    #[test]
    fn a_spring_gives_back_what_it_stores() {
        // 500 N/m, 10 mm and back at 100 mm/s: 25 mJ. Held from tick to tick it would give back a tenth of a millimetre's
        // work more than it took; nothing is taken away but in the last two.
        let mut p = passivity();
        let way = (0..=100).chain((0..100).rev());
        let mut before: i32 = 0;
        for tenth in way {
            let z = -1e-4 * f64::from(tenth);
            let x = Vector3::new(0.0, 0.0, z);
            let v = Vector3::new(0.0, 0.0, 0.1 * f64::from((before - tenth).signum()));
            let force = Vector3::new(0.0, 0.0, -500.0 * z);
            p.observe(&seen(&x, force.z));
            let (may, limited) = p.limit(force, &v);
            assert!(!limited || tenth <= 20, "{may:?} of {force:?} at {tenth}");
            p.give(given(x, may, true));
            before = tenth;
        }
        assert!(
            p.stored_j() >= 0.0 && p.stored_j() < 1e-3,
            "{} J",
            p.stored_j()
        );
    }

    #[test]
    fn what_a_contact_has_stored_ends_with_it() {
        let mut p = passivity();
        let at = |z: f64| Vector3::new(0.0, 0.0, z);
        p.give(given(at(0.0), at(5.0), true));
        p.observe(&seen(&at(-0.01), 5.0));
        assert!((p.stored_j() - 0.05).abs() < 1e-12);
        p.give(given(at(-0.01), Vector3::zeros(), false));
        assert!(p.stored_j() > 0.049, "a tick is no end");
        for _ in 0..1000 {
            p.give(given(at(-0.01), Vector3::zeros(), false));
        }
        assert!(p.stored_j() < 1e-5);
        // And friction fills it no further than a press is deep.
        p.give(given(at(0.0), at(1.0), true));
        for i in 1..1000 {
            p.observe(&seen(&at(-0.01 * f64::from(i)), 1.0));
            p.give(given(at(-0.01 * f64::from(i)), at(1.0), true));
        }
        assert!(p.stored_j() < 0.06, "{} J", p.stored_j());
    }

    #[test]
    fn what_was_withheld_while_the_hand_pressed_is_there_when_it_is_over() {
        let mut p = passivity();
        let at = |z: f64| Vector3::new(0.0, 0.0, z);
        p.give(Given {
            withheld: at(2.0),
            ..given(at(0.0), Vector3::zeros(), true)
        });
        p.observe(&seen(&at(-0.01), 2.0));
        assert_eq!(p.limit(at(2.0), &Vector3::zeros()), (at(2.0), false));
        // Who goes out again meanwhile has put nothing in.
        p.give(Given {
            withheld: at(2.0),
            ..given(at(-0.01), Vector3::zeros(), true)
        });
        p.observe(&seen(&at(0.0), 2.0));
        assert_eq!(
            p.limit(at(2.0), &Vector3::zeros()),
            (Vector3::zeros(), true)
        );
    }

    #[test]
    fn neither_a_model_without_contact_nor_a_glitch_takes_what_is_stored() {
        let at = |z: f64| Vector3::new(0.0, 0.0, z);
        let mut p = passivity();
        p.give(given(at(0.0), at(4.0), true));
        p.observe(&seen(&at(-0.01), 4.0));
        p.give(given(at(-0.01), Vector3::zeros(), false));
        p.observe(&seen(&at(-0.01), 0.0));
        assert!(
            p.stored_j() > 0.03,
            "{} J after a tick without contact",
            p.stored_j()
        );
        p.give(given(at(-0.01), at(4.0), true));
        p.observe(&seen(&at(0.2), 0.0));
        assert!(p.stored_j() > 0.03, "{} J after a glitch", p.stored_j());
    }

    #[test]
    fn a_hand_that_others_have_moved_owes_nothing() {
        // Ten times 5 mm up at 4 N, paid for by who pushed; then off the tissue, and pressed by this hand alone.
        let at = |z: f64| Vector3::new(0.0, 0.0, z);
        let mut p = passivity();
        p.hear(0.0);
        for i in 0..10 {
            p.hear(0.025 * f64::from(i + 1));
            p.give(given(at(5e-3 * f64::from(i)), at(4.0), true));
            p.observe(&seen(&at(5e-3 * f64::from(i + 1)), 4.0));
        }
        assert!(p.stored_j() >= 0.0, "{} J", p.stored_j());
        // And with nobody to pay for it, a second off the tissue is enough.
        p.give(given(at(0.0), at(4.0), true));
        p.observe(&seen(&at(0.015), 4.0));
        for _ in 0..1000 {
            p.give(given(at(0.0), Vector3::zeros(), false));
            p.observe(&seen(&at(0.0), 0.0));
        }
        assert!(p.stored_j() > -1e-5, "{} J", p.stored_j());
    }

    #[test]
    fn after_a_gap_the_tissue_is_believed() {
        let mut p = passivity();
        let force = Vector3::new(0.0, 0.0, 3.0);
        p.interrupt();
        p.observe(&seen(&Vector3::zeros(), 3.0));
        assert_eq!(p.limit(force, &Vector3::zeros()), (force, false));
    }

    proptest! {
        #[test]
        fn along_any_path_no_more_is_gained_than_one_ramp_gives(
            ways in proptest::collection::vec((-0.4..0.4f64, 1usize..40, 0.0..20.0f64), 1..60),
        ) {
            // The tool is moved, whatever pushes it, and the force wants to be anything: no hand can do worse. One that
            // turns at once finds the force still there, as the slew limit lets nothing fall at once, but only once.
            let (mut p, mut slew) = (passivity(), Slew::new(STEP));
            let (mut z, mut work, mut most) = (0.0, 0.0, 0.0f64);
            let along = |z: f64| Vector3::new(0.0, 0.0, z);
            p.give(given(along(z), Vector3::zeros(), false));
            for (speed, ticks, target) in ways {
                for _ in 0..ticks {
                    p.observe(&seen(&along(z), target));
                    let (may, limited) = p.limit(slew.peek(along(target)), &along(speed));
                    let (force, _) = slew.towards(if limited { may } else { along(target) });
                    p.give(given(along(z), force, true));
                    z += speed * 1e-3;
                    work -= force.z * speed * 1e-3;
                    most = most.max(force.z);
                }
            }
            let ramp = (most + most * most / (2.0 * STEP)) * 1e-3 * 0.4;
            prop_assert!(work >= -ramp, "{work} J after {ramp} J");
        }
    }
}
