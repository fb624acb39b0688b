//! The passivity controller: the hand never gets more work back than it has put into a contact.
//!
//! An energy tank holds the net work of the hand (the observer of Hannaford and Ryu 2002):
//!
//! ```text
//! E_k = E_(k−1) − F_(k−1) · (x_k − x_(k−1)) − M_(k−1) · θ_k     F and M are held from tick to tick, so this is exact
//! ```
//!
//! with M the torque and θ the rotation vector between the two orientations.
//!
//! Their controller adds a damper when E falls below zero. Its force is as noisy as the velocity, and the slew
//! limit behind it would delay it. This controller only ever reduces force, and does so before the tank is empty.
//! Removing F takes |F|/δ ticks, with δ the step of the slew limit. Meanwhile F exerts the impulse J on a mass of
//! at least m that moves with v along it. So there must be
//!
//! ```text
//! E_k - E_0 >= J v + J²/(2 m)        J = T (|F| + |F|²/(2 δ)),  T the period
//! ```
//!
//! which is solved for |F|. A torque M has its own impulse L = T (|M| + |M|²/(2 ε)), with ε its step, on the
//! inertia I of the lightest handle, turning with ω along it. A line search finds one factor for both, so that a
//! wrench keeps its line of action:
//!
//! ```text
//! E_k - E_0 >= J v + J²/(2 m) + L ω + L²/(2 I)      at any time while they are taken away
//! ```
//!
//! The condition holds at any time, because the two ramps differ in length: a torque must not spend early the
//! energy that a fast press returns only at the end. An accelerating arm (a, never below zero) keeps accelerating
//! the handle until the ramps end; this matters for a light handle on a stiff arm. The pivot is assumed at the
//! centre of mass, as nearly is the case for a gimbal with a balanced stylus.
//!
//! A spring stores |F|²/(2 K), so the limit is inactive while |F| < 2 (δ/T) √(m/K), or 17 N for 400 N/m. Soft
//! tissue is rendered unchanged. A wall that is active because of the solver's delay loses force before it can
//! throw the hand back.
//!
//! Other participants who press on the same tissue put work into it, too, and may push this hand. Their net work
//! counts as well ([`ContactModel::external_work_j`](crate::ContactModel)), and pays for the work they do on this hand.
//!
//! Stored energy and debts decay after the contact, not at once, because a model without contact may arrive between
//! two with one: a tool off an elastic tissue has got back all its work. The tank holds at most the force over the
//! depth of any press, so that work lost to friction can not feed a later oscillation. After an unobserved motion
//! (a fault, a jump) the tissue is assumed to store the energy of a spring, |F|²/(2 K). The same holds where the tool was
//! already inside when its force began (after a pause of the session, or a late join), less what the hand has put in since.
//! Otherwise the hand would get no force, and a hand without force earns no energy.

use nalgebra::Vector3;
use palpate_device::{Pose, Wrench};
use palpate_protocol::Span;

use crate::WrenchSlew;
use crate::energy::{turned, work};

/// Reserve that must be earned before energy is returned, J: 0.06 N over 0.3 mm, below what a hand can feel. It
/// covers a hand that accelerates within a tick.
const RESERVE_J: f64 = 1e-5;
/// m: slightly below the smallest mass that a force acts on, kg: a device's handle of 0.1 kg without a hand.
const LIGHTEST_KG: f64 = 0.08;
/// I: a little less than the inertia of that handle about its pivot, kg·m²: a rod of 0.1 kg and 80 mm has 5.3e-5. About
/// its own axis a stylus is lighter by far, but there the motor and the gear turn with it.
const LIGHTEST_KG_M2: f64 = 4e-5;
/// Time constant of the tank's decay without contact, s.
const DECAY_S: f64 = 0.1;
/// Above any hand's speed, m/s: such a sample is a glitch, and its apparent work is ignored.
const JUMP_M_S: f64 = 20.0;
/// Above any hand's angular velocity, rad/s.
const JUMP_RAD_S: f64 = 100.0;
/// Maximum depth of a press on elastic tissue, m.
const DEPTH_M: f64 = 0.05;
/// The same for a rotation, rad: that depth at the end of an equally long lever.
const TURN_RAD: f64 = 1.0;
/// Smallest stiffness of tissue for which energy is assumed, N/m.
const SOFTEST_N_PER_M: f64 = 1.0;
/// Sampling times of two simultaneous ramps. A ramp has at most 50 ticks, and its work is smooth.
const RAMP_SAMPLES: usize = 16;
/// Bisections of the common factor: to a millionth.
const BISECTIONS: usize = 20;

/// State of a tool at the beginning of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ToolState {
    /// Position and orientation.
    pub pose: Pose,
    /// Velocity, m/s.
    pub v: Vector3<f64>,
    /// Angular velocity, rad/s.
    pub w: Vector3<f64>,
    /// Time since the last tick.
    pub dt: Span,
    /// Wrench of the tissue there, before any reduction.
    pub there: Wrench,
    /// Stiffness of the tissue there, N/m.
    pub stiffness_n_per_m: f64,
}

/// Output to a tool in a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ControllerOutput {
    /// Position and orientation.
    pub pose: Pose,
    /// The wrench that acts until the next tick.
    pub wrench: Wrench,
    /// The part that the soft start and a lost link withhold. A hand that presses meanwhile works against nothing,
    /// but feels the full force afterwards, so its work against the withheld wrench is credited.
    pub withheld: Wrench,
    /// Whether any contact point is active.
    pub touches: bool,
}

/// Reduces a force that would give the hand more work than it has put in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Passivity {
    period_s: f64,
    /// δ, N per tick.
    step_n: f64,
    /// ε, N·m per tick.
    step_nm: f64,
    tank_j: f64,
    /// The output of the last tick.
    last: Option<ControllerOutput>,
    /// Velocity and angular velocity then, m/s and rad/s.
    speeds: Option<[Vector3<f64>; 2]>,
    /// Accelerations since, m/s² and rad/s².
    speeding_up: [Vector3<f64>; 2],
    /// Net work of the other participants since this contact began, J; never below zero. Their earlier work may be
    /// taken back only by themselves.
    external_tank_j: f64,
    /// Net work that the hand would have done against the withheld wrench, J.
    withheld_j: f64,
    /// For a tool that was inside when its force began: the energy assumed, and the hand's net work since, J.
    assumed_j: f64,
    /// Capacity of each of them, J.
    capacity_j: f64,
    /// The last reported work of the other participants.
    external_work_j: Option<f64>,
}

impl Passivity {
    /// A controller in front of a slew limit of `step_n` newtons and `step_nm` newton metres per tick of `period`.
    pub(crate) fn new(step_n: f64, step_nm: f64, period: Span) -> Self {
        Self {
            period_s: period.as_secs_f64(),
            step_n,
            step_nm,
            tank_j: 0.0,
            last: None,
            speeds: None,
            speeding_up: [Vector3::zeros(); 2],
            external_tank_j: 0.0,
            withheld_j: 0.0,
            assumed_j: 0.0,
            capacity_j: 0.0,
            external_work_j: None,
        }
    }

    /// Net work that the hand has put in, J.
    #[cfg(test)]
    pub(crate) fn stored_j(&self) -> f64 {
        self.tank_j
    }

    /// The path is broken (a bad sample): stored energy stays, and the work since is unknown.
    pub(crate) fn interrupt(&mut self) {
        self.last = None;
        self.speeds = None;
    }

    /// Reports the net work of the other participants on the tissue since they joined, J.
    pub(crate) fn set_external_work(&mut self, external_work_j: f64) {
        let before = self
            .external_work_j
            .replace(external_work_j)
            .unwrap_or(external_work_j);
        self.external_tank_j = (self.external_tank_j + external_work_j - before).max(0.0);
    }

    /// Accounts for the motion of the tool since the last tick. `begins_inside`: whether the tool was inside the tissue when
    /// its force began, until the force is complete.
    pub(crate) fn observe(&mut self, seen: &ToolState, begins_inside: bool) {
        let there = &seen.there;
        let room = RESERVE_J + there.force.norm() * DEPTH_M + there.torque.norm() * TURN_RAD;
        self.capacity_j = room.max(self.capacity_j * self.decay(DECAY_S));
        let dt_s = seen.dt.as_secs_f64().max(self.period_s);
        let [v, w] = self
            .speeds
            .replace([seen.v, seen.w])
            .unwrap_or([seen.v, seen.w]);
        self.speeding_up = [(seen.v - v) / dt_s, (seen.w - w) / dt_s];
        let observed = self
            .last
            .filter(|last| is_plausible_motion(last, &seen.pose, dt_s));
        if let Some(last) = observed {
            self.tank_j -= work(&last.wrench, &last.pose, &seen.pose);
            let kept = self.withheld_j - work(&last.withheld, &last.pose, &seen.pose);
            self.withheld_j = kept.max(0.0);
            if last.withheld == Wrench::ZERO {
                self.tank_j += std::mem::take(&mut self.withheld_j);
            }
        }
        let n = there.force.norm();
        let spring_j = 0.5 * n * (n / seen.stiffness_n_per_m.max(SOFTEST_N_PER_M)).min(DEPTH_M);
        if !begins_inside {
            self.assumed_j = 0.0;
            if observed.is_none() {
                self.withheld_j = self.withheld_j.max(spring_j);
            }
            return self.settle();
        }
        if let Some(last) = observed {
            self.assumed_j -= work(&last.wrench, &last.pose, &seen.pose);
            self.assumed_j -= work(&last.withheld, &last.pose, &seen.pose);
        }
        // Friction alone has no stiffness along the normal, and stores nothing.
        if seen.stiffness_n_per_m >= SOFTEST_N_PER_M {
            let more = (spring_j - self.assumed_j).max(0.0);
            self.assumed_j += more;
            self.withheld_j += more;
        }
        self.settle();
    }

    /// Pays debts from the work of other participants, and limits all accounts to their capacity.
    fn settle(&mut self) {
        let debt = (-self.tank_j).max(0.0).min(self.external_tank_j);
        self.tank_j += debt;
        self.external_tank_j -= debt;
        for account in [
            &mut self.tank_j,
            &mut self.external_tank_j,
            &mut self.withheld_j,
        ] {
            *account = account.min(self.capacity_j);
        }
    }

    /// Decay factor of one tick for the time constant `s` seconds.
    fn decay(&self, s: f64) -> f64 {
        1.0 - self.period_s / s
    }

    /// Reduces `target` for a `slew` limit and a tool that moves with `v` (m/s) and turns with `w` (rad/s); returns
    /// whether it was reduced. Its line of action is kept.
    pub(crate) fn limit(
        &self,
        slew: &WrenchSlew,
        target: &Wrench,
        v: &Vector3<f64>,
        w: &Vector3<f64>,
    ) -> (Wrench, bool) {
        let there = (self.tank_j + self.external_tank_j + self.withheld_j - RESERVE_J).max(0.0);
        // The condition applies to the wrench of this tick, not to the target of the slew limit.
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

    /// The factor of a force alone, for a budget of `there` joules.
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

    /// The common factor of force and torque: the largest share of `target` within the budget. Even at a target of
    /// zero the force or torque may exceed the budget; it was paid for when it was rendered.
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
            Ramp::max_joint_work(&ramps) <= there
        };
        if is_there(1.0) {
            return 1.0;
        }
        let (mut enough, mut too_much) = (0.0, 1.0);
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (enough + too_much);
            if is_there(middle) {
                enough = middle;
            } else {
                too_much = middle;
            }
        }
        enough
    }

    /// The ramp by which a slew limit of `step` per tick removes a force (or torque) from a body of `inertia` that
    /// moves with `v` and accelerates.
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

    /// Replaces the output of the last tick by the rendered `force` (N) and, for a device with torque, `torque`
    /// (N·m): the device has clamped or removed it.
    pub(crate) fn correct(&mut self, force: Vector3<f64>, torque: Option<Vector3<f64>>) {
        if let Some(last) = &mut self.last {
            last.wrench.force = force;
            last.wrench.torque = torque.unwrap_or(last.wrench.torque);
        }
    }

    /// Records the output that acts until the next tick.
    pub(crate) fn record(&mut self, given: ControllerOutput) {
        if !given.touches {
            // Debts decay too: a hand off the tissue owes it nothing for long.
            self.tank_j *= self.decay(DECAY_S);
        }
        self.last = Some(given);
    }
}

/// A force, or torque, that decreases linearly to zero.
struct Ramp {
    lasts_s: f64,
    /// Its impulse until zero, N·s or N·m·s.
    impulse: f64,
    /// Velocity of the body along it, m/s or rad/s.
    speed: f64,
    /// By an arm, m/s² or rad/s².
    speeding_up: f64,
    /// kg or kg·m².
    inertia: f64,
}

impl Ramp {
    /// Its work after `t_s` seconds, J.
    fn work_after(&self, t_s: f64) -> f64 {
        let left = (1.0 - t_s / self.lasts_s).max(0.0);
        let impulse = self.impulse * (1.0 - left * left);
        let faster = 0.5 * self.speeding_up * t_s.min(self.lasts_s);
        impulse * (self.speed + faster) + impulse * impulse / (2.0 * self.inertia)
    }

    /// The maximum of the joint work of two ramps over time, J.
    fn max_joint_work([a, b]: &[Self; 2]) -> f64 {
        let lasts_s = a.lasts_s.max(b.lasts_s);
        (1..=RAMP_SAMPLES)
            .map(|i| lasts_s * i as f64 / RAMP_SAMPLES as f64)
            .map(|t_s| a.work_after(t_s) + b.work_after(t_s))
            .fold(0.0, f64::max)
    }
}

/// Whether a hand can have moved from `last` to `pose` in `dt_s` seconds. A rotation without torque costs no work
/// and is not checked.
fn is_plausible_motion(last: &ControllerOutput, pose: &Pose, dt_s: f64) -> bool {
    let turns = last.wrench.torque != Vector3::zeros() || last.withheld.torque != Vector3::zeros();
    (pose.position - last.pose.position).norm() <= JUMP_M_S * dt_s
        && (!turns || turned(&last.pose, pose).norm() <= JUMP_RAD_S * dt_s)
}

#[cfg(test)]
mod tests;
