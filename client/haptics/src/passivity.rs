//! The passivity controller: the hand never gets more work back than it has put into a contact.
//!
//! A tank holds what the hand has put in and not got back (Hannaford and Ryu 2002, their observer):
//!
//! ```text
//! E_k = E_(k−1) − F_(k−1) · (x_k − x_(k−1)) − M_(k−1) · θ_k     F and M are held from tick to tick, so this is exact
//! ```
//!
//! with M the torque and θ the rotation vector between the two orientations.
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
//! which is solved for |F|. With a torque M its own impulse L = T (|M| + |M|²/(2 ε)), ε being its step, on the inertia I
//! of the lightest handle, turning with ω along it, is added, and one factor is looked for by which both are multiplied,
//! so that a wrench keeps the line it acts along:
//!
//! ```text
//! E_k - E_0 >= J v + J²/(2 m) + L ω + L²/(2 I)      at any time while they are taken away
//! ```
//!
//! At any time, because the two ramps have not the same length: what a fast press is going to pay at the end, a torque
//! could have spent before. And an arm that is speeding the handle up (a, never below zero) does so until the ramps
//! are over; a light handle on a stiff arm turns so quickly that this counts. (Of a handle whose pivot is its middle of
//! mass, as that of a gimbal with a balanced stylus nearly is.)
//!
//! A spring stores |F|²/(2 K): it never comes near while |F| < 2 (δ/T) √(m/K), or 17 N for
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
use palpate_device::{Pose, Wrench};
use palpate_protocol::Span;

use crate::WrenchSlew;
use crate::energy::{turned, work};

/// Energy that must be earned before any is given back, J: what 0.06 N have moved by 0.3 mm, less than a hand tells.
/// It covers a hand that is faster at the end of a tick than at its beginning.
const RESERVE_J: f64 = 1e-5;
/// m: a little less than the lightest thing that a force acts on, kg: a device's handle of 0.1 kg when the hand has let
/// go of it.
const LIGHTEST_KG: f64 = 0.08;
/// I: a little less than the inertia of that handle about its pivot, kg·m²: a rod of 0.1 kg and 80 mm has 5.3e-5. About
/// its own axis a stylus is lighter by far, but there the motor and the gear turn with it.
const LIGHTEST_KG_M2: f64 = 4e-5;
/// Time in which what is stored falls to a third when nothing is touched, s.
const FORGETS_S: f64 = 0.1;
/// Faster than any hand, m/s: such a sample is a glitch, and nobody has done the work that it seems to have taken.
const JUMPS_M_S: f64 = 20.0;
/// Turns faster than any hand, rad/s.
const JUMPS_RAD_S: f64 = 100.0;
/// The deepest press that an elastic tissue gives back, m.
const DEPTH_M: f64 = 0.05;
/// The same of a turn, rad: that depth at the end of a lever as long.
const TURN_RAD: f64 = 1.0;
/// Moments of two ramps that are looked at. A ramp has at most 50 ticks, and what it does is smooth.
const MOMENTS: usize = 16;
/// Halvings in the search for the common factor: to a millionth.
const HALVINGS: usize = 20;

/// What is known of a tool at the beginning of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Where it is, and how it is turned.
    pub pose: Pose,
    /// How fast it moves, m/s.
    pub v: Vector3<f64>,
    /// How fast it turns, rad/s.
    pub w: Vector3<f64>,
    /// Time since the last tick.
    pub dt: Span,
    /// What the tissue pushes and turns it with there, before anything is taken away.
    pub there: Wrench,
    /// Stiffness of the tissue there, N/m.
    pub stiffness_n_per_m: f64,
}

/// What a tool is given in a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Given {
    /// Where it is, and how it is turned.
    pub pose: Pose,
    /// What pushes and turns it until the next tick.
    pub wrench: Wrench,
    /// What the soft start and a lost link keep from it. A hand that presses meanwhile works against nothing, and
    /// finds the force there when they are over: what it would have put in, less what it would have got back, is
    /// counted as put in.
    pub withheld: Wrench,
    /// Whether it touches anything at all.
    pub touches: bool,
}

/// Takes force away that would give the hand more work than it has put in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passivity {
    period_s: f64,
    /// δ, N per tick.
    step_n: f64,
    /// ε, N·m per tick.
    step_nm: f64,
    tank_j: f64,
    /// What was given in the last tick.
    last: Option<Given>,
    /// How fast it moved and turned then, m/s and rad/s.
    speeds: Option<[Vector3<f64>; 2]>,
    /// How both have changed since, m/s² and rad/s².
    speeding_up: [Vector3<f64>; 2],
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
    /// In front of a slew limit of `step_n` newtons and `step_nm` newton metres per tick of `period`.
    pub fn new(step_n: f64, step_nm: f64, period: Span) -> Self {
        Self {
            period_s: period.as_secs_f64(),
            step_n,
            step_nm,
            tank_j: 0.0,
            last: None,
            speeds: None,
            speeding_up: [Vector3::zeros(); 2],
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
        self.speeds = None;
    }

    /// Others have put so much into the tissue since they began, less what they have got back, J.
    pub fn hear(&mut self, others_j: f64) {
        let before = self.others_j.replace(others_j).unwrap_or(others_j);
        self.lent_j = (self.lent_j + others_j - before).max(0.0);
    }

    /// The tool has moved.
    pub fn observe(&mut self, seen: &Seen) {
        let there = &seen.there;
        let room = RESERVE_J + there.force.norm() * DEPTH_M + there.torque.norm() * TURN_RAD;
        self.room_j = room.max(self.room_j * self.left_of(FORGETS_S));
        let dt_s = seen.dt.as_secs_f64().max(self.period_s);
        let [v, w] = self
            .speeds
            .replace([seen.v, seen.w])
            .unwrap_or([seen.v, seen.w]);
        self.speeding_up = [(seen.v - v) / dt_s, (seen.w - w) / dt_s];
        match self.last.filter(|last| is_a_way(last, &seen.pose, dt_s)) {
            Some(last) => {
                self.tank_j -= work(&last.wrench, &last.pose, &seen.pose);
                let kept = self.kept_j - work(&last.withheld, &last.pose, &seen.pose);
                self.kept_j = kept.max(0.0);
                if last.withheld == Wrench::ZERO {
                    self.tank_j += std::mem::take(&mut self.kept_j);
                }
            }
            // Nothing is known of the way here. The tissue stores what a spring does that pushes like this.
            None if there.force.norm() > 0.0 => {
                let n = there.force.norm();
                let stored = 0.5 * n * n / seen.stiffness_n_per_m.max(1.0);
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

    /// As much of `target` as may be aimed at by a `slew` limit for a tool that moves with `v` (m/s) and turns with `w`
    /// (rad/s), and whether that is less. Its line of action stays.
    pub fn limit(
        &self,
        slew: &WrenchSlew,
        target: &Wrench,
        v: &Vector3<f64>,
        w: &Vector3<f64>,
    ) -> (Wrench, bool) {
        let there = (self.tank_j + self.lent_j + self.kept_j - RESERVE_J).max(0.0);
        // What counts is the wrench of this tick, not the one that it is on the way to.
        let next = slew.peek(target);
        if next.torque == Vector3::zeros() && slew.torque.now() == Vector3::zeros() {
            let share = self.share_of_force(&next.force, v, there);
            return if share < 1.0 {
                (next.scaled(share), true)
            } else {
                (*target, false)
            };
        }
        let share = self.share_of_both(slew, target, v, w, there);
        (target.scaled(share), share < 1.0)
    }

    /// The factor of a force alone, where `there` joules may be given.
    fn share_of_force(&self, force: &Vector3<f64>, v: &Vector3<f64>, there: f64) -> f64 {
        let n = force.norm();
        if n == 0.0 {
            return 1.0;
        }
        let along = force.dot(v) / n;
        let impulse = LIGHTEST_KG * ((along * along + 2.0 * there / LIGHTEST_KG).sqrt() - along);
        let most =
            self.step_n * ((1.0 + 2.0 * impulse / (self.period_s * self.step_n)).sqrt() - 1.0);
        most / n
    }

    /// The same of force and torque: a share of `target` on the way to which they do not need more, next to one at which
    /// they do. On the way to nothing at all, the force or the torque may still be more than there is for: that was
    /// paid for when it was given.
    fn share_of_both(
        &self,
        slew: &WrenchSlew,
        target: &Wrench,
        v: &Vector3<f64>,
        w: &Vector3<f64>,
        there: f64,
    ) -> f64 {
        let is_there = |share: f64| {
            let next = slew.peek(&target.scaled(share));
            let ramps = [
                self.ramp(
                    &next.force,
                    v,
                    &self.speeding_up[0],
                    self.step_n,
                    LIGHTEST_KG,
                ),
                self.ramp(
                    &next.torque,
                    w,
                    &self.speeding_up[1],
                    self.step_nm,
                    LIGHTEST_KG_M2,
                ),
            ];
            Ramp::spend_together(&ramps) <= there
        };
        if is_there(1.0) {
            return 1.0;
        }
        let (mut enough, mut too_much) = (0.0, 1.0);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (enough + too_much);
            if is_there(middle) {
                enough = middle;
            } else {
                too_much = middle;
            }
        }
        enough
    }

    /// How a force (or torque) on something that weighs `inertia`, moves with `v` and speeds up is taken away by a slew
    /// limit of `step` per tick.
    fn ramp(
        &self,
        force: &Vector3<f64>,
        v: &Vector3<f64>,
        speeding_up: &Vector3<f64>,
        step: f64,
        inertia: f64,
    ) -> Ramp {
        let n = force.norm();
        let along = if n > 0.0 { force / n } else { *force };
        Ramp {
            lasts_s: self.period_s * (n / step + 1.0),
            impulse: self.period_s * (n + n * n / (2.0 * step)),
            speed: along.dot(v),
            speeding_up: along.dot(speeding_up).max(0.0),
            inertia,
        }
    }

    /// What pushes the tool until the next tick is `force` (N), and not what was given: the device has clamped it, or
    /// taken it away. So is what turns it `torque` (N·m), where the device renders any.
    pub fn correct(&mut self, force: Vector3<f64>, torque: Option<Vector3<f64>>) {
        if let Some(last) = &mut self.last {
            last.wrench.force = force;
            last.wrench.torque = torque.unwrap_or(last.wrench.torque);
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

/// A force, or torque, that is taken away evenly.
struct Ramp {
    lasts_s: f64,
    /// What it gives until it is gone, N·s or N·m·s.
    impulse: f64,
    /// Of what it acts on, along it, m/s or rad/s.
    speed: f64,
    /// By an arm, m/s² or rad/s².
    speeding_up: f64,
    /// kg or kg·m².
    inertia: f64,
}

impl Ramp {
    /// What it has done after `t_s` seconds, J.
    fn has_done(&self, t_s: f64) -> f64 {
        let left = (1.0 - t_s / self.lasts_s).max(0.0);
        let impulse = self.impulse * (1.0 - left * left);
        let faster = 0.5 * self.speeding_up * t_s.min(self.lasts_s);
        impulse * (self.speed + faster) + impulse * impulse / (2.0 * self.inertia)
    }

    /// The most that two have done together at any time, J.
    fn spend_together([a, b]: &[Self; 2]) -> f64 {
        let lasts_s = a.lasts_s.max(b.lasts_s);
        (1..=MOMENTS)
            .map(|i| lasts_s * i as f64 / MOMENTS as f64)
            .map(|t_s| a.has_done(t_s) + b.has_done(t_s))
            .fold(0.0, f64::max)
    }
}

/// Whether a hand can have come from `last` to `pose` in `dt_s` seconds. How a tool turned that nothing turned costs no
/// work, and does not count.
fn is_a_way(last: &Given, pose: &Pose, dt_s: f64) -> bool {
    let turns = last.wrench.torque != Vector3::zeros() || last.withheld.torque != Vector3::zeros();
    (pose.position - last.pose.position).norm() <= JUMPS_M_S * dt_s
        && (!turns || turned(&last.pose, pose).norm() <= JUMPS_RAD_S * dt_s)
}

#[cfg(test)]
mod tests;
