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
//! which is solved for |F|. A spring stores |F|²/(2 K): it never comes near while |F| < 2 (δ/T) √(m/K), or 19 N for
//! 400 N/m. So soft tissue is rendered as it is, and a wall that the delay of a solver makes lively loses force
//! before it can throw the hand back.
//!
//! Others who press on the same tissue put work into it, too, and this hand may well be pushed by them: what they have
//! put in, less what they have got back, is in the tank as well ([`ContactModel::others_j`](crate::ContactModel)).
//!
//! What is stored ends with the contact, not at once, as a model without contact may come between two with one: a tool
//! that has come off has got back all that an elastic tissue owes. Nor does the tank hold more than the force over the depth of any press, so what friction has taken up is not spent on
//! a later oscillation.

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
/// The deepest press that an elastic tissue gives back, m.
const DEPTH_M: f64 = 0.05;

/// What a tool is given in a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Given {
    /// Where it is, m.
    pub x: Vector3<f64>,
    /// What pushes it until the next tick, N.
    pub force: Vector3<f64>,
    /// What the soft start and a lost link keep from it, N. A hand that presses meanwhile works against nothing, and
    /// finds the force there when they are over: what it would have put in is counted as put in.
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

    /// The tool has come to `x` (m), where the tissue pushes it with `there_n` newtons.
    pub fn observe(&mut self, x: &Vector3<f64>, there_n: f64) {
        if let Some(last) = self.last {
            let by = x - last.x;
            self.tank_j -= last.force.dot(&by);
            self.tank_j += (-last.withheld.dot(&by)).max(0.0);
        }
        let most = RESERVE_J + there_n * DEPTH_M;
        self.tank_j = self.tank_j.min(most);
        self.lent_j = self.lent_j.min(most);
    }

    /// As much of `force` (N) as may be given to a tool that moves with `v` (m/s), and whether that is less. The
    /// direction stays.
    pub fn limit(&self, force: Vector3<f64>, v: &Vector3<f64>) -> (Vector3<f64>, bool) {
        let n = force.norm();
        if n == 0.0 {
            return (force, false);
        }
        let along = force.dot(v) / n;
        let there = (self.tank_j + self.lent_j - RESERVE_J).max(0.0);
        let impulse = LIGHTEST_KG * ((along * along + 2.0 * there / LIGHTEST_KG).sqrt() - along);
        let most =
            self.step_n * ((1.0 + 2.0 * impulse / (self.period_s * self.step_n)).sqrt() - 1.0);
        if n > most {
            (force * (most / n), true)
        } else {
            (force, false)
        }
    }

    /// What is given until the next tick.
    pub fn give(&mut self, given: Given) {
        if !given.touches && self.tank_j > 0.0 {
            self.tank_j *= 1.0 - self.period_s / FORGETS_S;
        }
        self.last = Some(given);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_protocol::Span;
    use proptest::prelude::*;

    use super::{Given, Passivity};
    use crate::Slew;

    const STEP: f64 = 0.6;

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
            p.observe(&x, force.z);
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
        p.observe(&at(-0.01), 5.0);
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
            p.observe(&at(-0.01 * f64::from(i)), 1.0);
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
        p.observe(&at(-0.01), 2.0);
        assert_eq!(p.limit(at(2.0), &Vector3::zeros()), (at(2.0), false));
        // And on the way out it is not paid twice.
        p.give(Given {
            withheld: at(2.0),
            ..given(at(-0.01), Vector3::zeros(), true)
        });
        p.observe(&at(0.0), 2.0);
        assert!((p.stored_j() - 0.02).abs() < 1e-12);
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
            for (speed, ticks, target) in ways {
                for _ in 0..ticks {
                    p.observe(&along(z), target);
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
