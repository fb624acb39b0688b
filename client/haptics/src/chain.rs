//! The tick: all stages in order.

use nalgebra::Vector3;
use palpate_device::{DeviceCaps, Faults, Pose, Sample, Wrench};
use palpate_protocol::{ClientTime, Span};

use crate::blend::Blend;
use crate::contact_points::{ContactPoints, Grips};
use crate::motion::Motion;
use crate::passivity::{ControllerOutput, ToolState};
use crate::watchdog::Watched;
use crate::{
    ContactModel, Counters, Coupling, EnergyObserver, Events, FrictionConfig, LinkGuard, Passivity,
    Slew, SoftStart, StiffnessCap, Watchdog, WatchdogConfig, WrenchSlew, clamp_force,
};

/// Maximum time in which the slew limit empties the largest force or torque. A larger force limit raises the slew
/// rate instead, because the watchdog's times count to zero force at the hand.
const FLUSH_MAX: Span = Span::from_millis(50);

/// Maximum time between two ticks that counts towards recovery: a pause of the thread skips no ramp.
const DT_UP_MAX: Span = Span::from_millis(10);

/// Maximum distance from the origin, in m, and maximum speed, in m/s and rad/s. A sample beyond is as faulty as a
/// non-finite one: sums could overflow and persist in the state.
const SAMPLE_MAX: f64 = 1e3;

/// Force, N, above which the hand has not entered a contact itself that a late model shows, and the time for which the solver
/// may still find it. A touch with less force is felt at once.
const BEGINS_N: f64 = 0.1;
const APPEARS: Span = Span::from_millis(150);

/// Maximum deviation of a quaternion's norm from one. Larger deviations would scale the levers.
const QUATERNION_OFF: f64 = 1e-3;

/// The constants of the chain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainConfig {
    /// The tick's period T.
    pub period: Span,
    /// Damping of device and hand in the stiffness cap (b in 2 b / T), N·s/m. 0.5 is a light desktop device held
    /// loosely.
    pub damping_ns_per_m: f64,
    /// Distance from the pivot at which a hand holds the handle and damps its rotation (ℓ of the virtual coupling), m,
    /// above zero. A pen grip rests at the fingertips and in the web of the thumb, some 100 mm apart (our
    /// estimate): 50 mm to each side of the middle.
    pub grip_m: f64,
    /// Maximum force, N, where the device's continuous force is larger.
    pub force_max_n: f64,
    /// Maximum torque, N·m, where the device's is larger: 30 N at the end of a grip.
    pub torque_max_nm: f64,
    /// Slew rate of the force, N/s. 600 is 30 N over 50 ms: a firm press into bone is unaffected, a step is
    /// limited.
    pub slew_n_per_s: f64,
    /// Slew rate of the torque, N·m/s: twice 600 N/s at the end of a grip, so that 1 N·m is emptied in the time of
    /// 10 N. A handle turns more readily than it moves, and a slower removal of torque lowers the torque that may
    /// be rendered; see the passivity controller.
    pub slew_nm_per_s: f64,
    /// Length of the soft start.
    pub soft_start: Span,
    /// Stick-slip friction.
    pub friction: FrictionConfig,
    /// Fading of forces whose source is lost.
    pub watchdog: WatchdogConfig,
    /// Whether the passivity controller is active. Off for measurements of its effect.
    pub passivity: bool,
}

impl Default for ChainConfig {
    fn default() -> Self {
        Self {
            period: Span::from_millis(1),
            damping_ns_per_m: 0.5,
            grip_m: 0.05,
            force_max_n: 30.0,
            torque_max_nm: 1.5,
            slew_n_per_s: 600.0,
            slew_nm_per_s: 60.0,
            soft_start: Span::from_millis(1000),
            friction: FrictionConfig::default(),
            watchdog: WatchdogConfig::default(),
            passivity: true,
        }
    }
}

/// Output of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tick {
    /// The wrench to write to the device; always finite.
    pub wrench: Wrench,
    /// Wrench of the tissue on the tool about its pivot, faded with the validity of the contact model, up to
    /// [`ChainConfig::force_max_n`] and [`ChainConfig::torque_max_nm`]; always finite. A device without motors
    /// shows it as a cue, a view draws it. It bypasses the hand's protection, so never write it to a device.
    pub felt: Wrench,
    /// From the device to the proxy, m: the place where the tissue would not press the tool, faded like
    /// [`felt`](Self::felt). It is zero exactly if the normal force is; see `proxy`.
    pub proxy_offset: Vector3<f64>,
    /// Events of this tick.
    pub events: Events,
    /// Age of the contact model that was used.
    pub contact_age: Span,
}

/// The 1 kHz chain that protects the hand.
///
/// In every tick call exactly one of [`tick`](Self::tick) and, after a failed read,
/// [`tick_without_sample`](Self::tick_without_sample), then write the wrench. Report a different rendered wrench
/// with [`continue_from`](Self::continue_from) or [`restart_from`](Self::restart_from).
///
/// Times should not run backwards. If one does, the chain's own time advances by one period and ages are kept: a
/// clock that was set back keeps no old force alive.
#[derive(Debug, Clone)]
pub struct Chain {
    force_limit_n: f64,
    /// `None` for a device without torque.
    torque_limit_nm: Option<f64>,
    /// Maximum force and torque of [`Tick::felt`], N and N·m.
    felt_limits: [f64; 2],
    soft_start: SoftStart,
    link: LinkGuard,
    watchdog: Watchdog,
    blend: Blend,
    contact_points: ContactPoints,
    /// `None` when switched off.
    passivity: Option<Passivity>,
    /// When contact began that the hand may not have entered itself; `None` once its force is known.
    appeared: Option<ClientTime>,
    /// Whether the tool was inside the tissue when its force began, until the end of the soft start.
    begins_inside: bool,
    slew: WrenchSlew,
    observer: EnergyObserver,
    counters: Counters,
    period: Span,
    last_tick: Option<ClientTime>,
    /// Lead of the chain's own time over the given clock; grows with every step back.
    ahead: Span,
    /// The same before the last step back, for models that were stamped before it.
    ahead_before: Span,
    /// When the model in use was solved, in the chain's own time.
    solved_at: ClientTime,
}

impl Chain {
    /// A chain at rest for a device.
    pub fn new(config: ChainConfig, caps: &DeviceCaps) -> Self {
        let force_limit_n = if caps.dof_out == 0 {
            0.0
        } else {
            caps.continuous_force_n
                .min(caps.max_force_n)
                .min(config.force_max_n)
        };
        let torque_limit_nm = (caps.dof_out > 3 && caps.max_torque_nm > 0.0)
            .then(|| caps.max_torque_nm.min(config.torque_max_nm));
        let slew = WrenchSlew {
            force: slew_of(force_limit_n, config.slew_n_per_s, config.period),
            torque: slew_of(
                torque_limit_nm.unwrap_or(0.0),
                config.slew_nm_per_s,
                config.period,
            ),
        };
        let ticks_of = |limit: f64, slew: Slew| (limit / slew.step()).ceil();
        let flush_ticks = ticks_of(force_limit_n, slew.force)
            .max(ticks_of(torque_limit_nm.unwrap_or(0.0), slew.torque));
        let flush = Span::from_secs_f64(flush_ticks * config.period.as_secs_f64());
        let cap = StiffnessCap::new(caps, config.damping_ns_per_m, config.period);
        let coupling = if torque_limit_nm.is_some() {
            Coupling::of_wrenches(cap, config.grip_m)
        } else {
            Coupling::of_forces(cap)
        };
        Self {
            force_limit_n,
            torque_limit_nm,
            felt_limits: [config.force_max_n, config.torque_max_nm],
            soft_start: SoftStart::new(config.soft_start),
            link: LinkGuard::new(&config.watchdog, flush),
            watchdog: Watchdog::new(config.watchdog, flush),
            blend: Blend::new(coupling),
            contact_points: ContactPoints::new(config.friction),
            passivity: config
                .passivity
                .then(|| Passivity::new(slew.force.step(), slew.torque.step(), config.period)),
            appeared: None,
            begins_inside: false,
            slew,
            observer: EnergyObserver::default(),
            counters: Counters::default(),
            period: config.period,
            last_tick: None,
            ahead: Span::ZERO,
            ahead_before: Span::ZERO,
            solved_at: ClientTime::ZERO,
        }
    }

    /// The force limit, N.
    pub fn force_limit_n(&self) -> f64 {
        self.force_limit_n
    }

    /// The torque limit, N·m; zero for a device without torque.
    pub fn torque_limit_nm(&self) -> f64 {
        self.torque_limit_nm.unwrap_or(0.0)
    }

    /// The slew limit of the force, N per tick.
    pub fn slew_step_n(&self) -> f64 {
        self.slew.force.step()
    }

    /// The slew limit of the torque, N·m per tick.
    pub fn slew_step_nm(&self) -> f64 {
        self.slew.torque.step()
    }

    /// Event counters since the start.
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// The session link was lost: force fades to zero in 100 ms.
    pub fn link_lost(&mut self, now: ClientTime) {
        self.link.lose(self.own_time(now));
    }

    /// The link is back: force returns over the soft start.
    pub fn link_restored(&mut self, now: ClientTime) {
        if self.link.is_lost() {
            let gain = self.link.restore(self.own_time(now));
            self.soft_start.lower_to(self.soft_start.gain() * gain);
        }
    }

    /// The device renders `wrench` instead of the last output, because it clamped or lost part of it. Slew limit
    /// and work accounting continue from `wrench`, so no step follows when the device recovers.
    pub fn continue_from(&mut self, wrench: &Wrench) {
        let limits = [self.force_limit_n, self.torque_limit_nm()];
        let [force, torque] = [(wrench.force, limits[0]), (wrench.torque, limits[1])]
            .map(|(of, limit)| clamp_force(of, limit).0);
        self.slew.begin_at(&Wrench { force, torque });
        let stands = self.slew.now();
        self.observer.correct(stands);
        if let Some(passivity) = &mut self.passivity {
            let torque = self.torque_limit_nm.map(|_| stands.torque);
            passivity.correct(stands.force, torque);
        }
    }

    /// The device reduced its force by itself to `rest`: it rejected a wrench, its motors are off, or its own
    /// watchdog acted. As [`continue_from`](Self::continue_from), and the force returns over the soft start, as after
    /// every fault.
    pub fn restart_from(&mut self, rest: &Wrench) {
        self.continue_from(rest);
        self.soft_start.lower_to(0.0);
    }

    /// One tick.
    pub fn tick(&mut self, now: ClientTime, sample: &Sample, model: &ContactModel) -> Tick {
        let mut events = Events::NONE;
        let (now, dt) = self.step_time(now);
        events.set(Events::BAD_SAMPLE, !is_plausible(sample));
        events.set(Events::FAULTED, sample.faults.forbid_force());
        if events != Events::NONE {
            return self.without_force(now, dt, events);
        }
        let motion = Motion::of(sample);
        let was_touching = self.contact_points.grips().any();
        events.set(Events::BAD_MODEL, !model.is_usable());
        let newest = if model.is_usable() {
            model
        } else {
            &self.blend.model().clone()
        };
        let valid = if newest.is_valid_for(sample.buttons) {
            newest
        } else {
            &newest.without_contact()
        };
        let may_have_sunk_in = self.may_have_sunk_in(now);
        if self.blend.take(valid, now, &motion) {
            self.follow_appearance(now, may_have_sunk_in);
            self.solved_at = self.in_own_time(newest.solved_at, now);
        }
        let (wrench, planes) = self.contact_points.tick(&self.blend, now, dt, &motion);
        let touches = wrench != Wrench::ZERO;
        note_grips(&mut events, was_touching, self.contact_points.grips());
        let felt = self.felt_wrench(&wrench);
        let there = self.clamp(&wrench, &mut events);
        let [trusted, open] = self.gains(now, dt, &sample.pose, &mut events);
        let felt = felt.scaled(trusted * open);
        let proxy_offset = planes.proxy_offset() * (trusted * open);
        if let Some(passivity) = &mut self.passivity {
            let model = self.blend.model();
            if sample.faults.contains(Faults::TIME_JUMP) {
                passivity.interrupt();
            }
            passivity.set_external_work(model.external_work_j);
            let seen = ToolState {
                pose: sample.pose,
                v: motion.v,
                w: motion.w,
                dt,
                there,
                stiffness_n_per_m: model.normal_stiffness(),
            };
            passivity.observe(&seen, self.begins_inside);
        }
        let target = there.scaled(trusted * open);
        let wrench = self.passivate(self.rendered(target), &motion, &mut events);
        let wrench = self.limit_change(&wrench, &mut events);
        let counted = self.accounted_wrench(wrench, &target);
        if let Some(passivity) = &mut self.passivity {
            passivity.record(ControllerOutput {
                pose: sample.pose,
                wrench: counted,
                withheld: there.scaled(1.0 - open),
                touches,
            });
        }
        self.observer.observe(sample.pose, wrench);
        let tick = self.finish(now, wrench, events);
        Tick {
            felt,
            proxy_offset,
            ..tick
        }
    }

    /// One tick for which the device gave no sample: the force fades to zero.
    pub fn tick_without_sample(&mut self, now: ClientTime) -> Tick {
        let (now, dt) = self.step_time(now);
        let mut events = Events::NONE;
        events.set(Events::FAULTED, true);
        self.without_force(now, dt, events)
    }

    /// `now` in the chain's own monotonic time.
    fn own_time(&self, now: ClientTime) -> ClientTime {
        let own = now + self.ahead;
        self.last_tick
            .map_or(own, |last| own.max(last + self.ahead))
    }

    /// Solve time in the chain's own time of a model accepted at `own`. A model from the future was stamped before
    /// the clock was set back.
    fn in_own_time(&self, solved_at: ClientTime, own: ClientTime) -> ClientTime {
        if solved_at + self.ahead > own {
            solved_at + self.ahead_before
        } else {
            solved_at + self.ahead
        }
    }

    /// The chain's own time at `now`, and the time since the last tick.
    fn step_time(&mut self, now: ClientTime) -> (ClientTime, Span) {
        let last = self.last_tick.unwrap_or(now);
        let before = last + self.ahead;
        if now < last {
            self.ahead_before = self.ahead;
            self.ahead = before + self.period - now;
        }
        self.last_tick = Some(now);
        let own = now + self.ahead;
        (own, own - before)
    }

    /// `wrench` limited for [`Tick::felt`].
    fn felt_wrench(&self, wrench: &Wrench) -> Wrench {
        let [force_n, torque_nm] = self.felt_limits;
        Wrench {
            force: clamp_force(wrench.force, force_n).0,
            torque: clamp_force(wrench.torque, torque_nm).0,
        }
    }

    /// `wrench` clamped to the device and to the limit of the session. A torque that the device can not render is scaled with the force.
    fn clamp(&self, wrench: &Wrench, events: &mut Events) -> Wrench {
        let limit_n = (self.force_limit_n).min(self.blend.model().force_limit_n);
        let (force, saturated) = clamp_force(wrench.force, limit_n);
        // A device without motors is never saturated.
        events.set(Events::SATURATED, saturated && self.force_limit_n > 0.0);
        let Some(limit_nm) = self.torque_limit_nm else {
            let n = wrench.force.norm();
            let share = if saturated { force.norm() / n } else { 1.0 };
            let torque = wrench.torque * share;
            return Wrench { force, torque };
        };
        let (torque, saturated) = clamp_force(wrench.torque, limit_nm);
        events.set(Events::TORQUE_SATURATED, saturated);
        Wrench { force, torque }
    }

    /// The part of `wrench` that the device renders.
    fn rendered(&self, wrench: Wrench) -> Wrench {
        if self.torque_limit_nm.is_some() {
            wrench
        } else {
            Wrench::from_force(wrench.force)
        }
    }

    /// The wrench that the work accounting uses for the output `given`. On a device without torque it includes the
    /// torque of `target`: tilting a tool into tissue takes work against that torque, even if the hand does not
    /// feel it. Otherwise the controller would see work that no hand has done.
    fn accounted_wrench(&self, given: Wrench, target: &Wrench) -> Wrench {
        let torque = if self.torque_limit_nm.is_some() {
            given.torque
        } else {
            target.torque
        };
        Wrench {
            force: given.force,
            torque,
        }
    }

    /// Whether the hand may have moved into the tissue without a force: the tool took no part, or no model came for long after
    /// one without contact.
    fn may_have_sunk_in(&self, now: ClientTime) -> bool {
        let model = self.blend.model();
        let is_late = self.watchdog.is_lost(now - self.blend.taken_at());
        model.is_absent || !model.in_contact() && is_late
    }

    /// Begins the force again, over the soft start, where a new model shows that the tool was inside. The first solves may have
    /// too little force.
    fn follow_appearance(&mut self, now: ClientTime, may_have_sunk_in: bool) {
        let model = self.blend.model();
        if may_have_sunk_in {
            self.appeared = Some(now);
        }
        let is_recent = |since: ClientTime| now - since < APPEARS;
        self.appeared = (self.appeared).filter(|t| model.in_contact() && is_recent(*t));
        if self.appeared.is_some() && model.force().norm() > BEGINS_N {
            self.appeared = None;
            self.begins_inside = true;
            self.soft_start.lower_to(0.0);
        }
    }

    /// Gain of the watchdog, and gain of soft start and link guard.
    fn gains(&mut self, now: ClientTime, dt: Span, pose: &Pose, events: &mut Events) -> [f64; 2] {
        let dt_up = dt.min(DT_UP_MAX);
        let model = self.blend.model();
        let is_outside = model.is_outside_at(pose);
        let age = now - self.solved_at;
        let Watched {
            gain,
            is_stale,
            has_left,
        } = self
            .watchdog
            .advance(age, is_outside, model.in_contact(), dt, dt_up);
        let link = self.link.gain(now);
        let soft = if self.link.is_lost() {
            self.soft_start.gain()
        } else {
            self.soft_start.advance(dt_up)
        };
        events.set(Events::STALE, is_stale);
        events.set(Events::LEFT_RADIUS, has_left);
        events.set(Events::LINK_LOST, self.link.is_lost());
        events.set(Events::SOFT_START, soft < 1.0);
        self.begins_inside &= soft < 1.0;
        [gain, link * soft]
    }

    /// `wrench` after the passivity controller.
    fn passivate(&self, wrench: Wrench, motion: &Motion, events: &mut Events) -> Wrench {
        let Some(passivity) = &self.passivity else {
            return wrench;
        };
        let (may, limited) = passivity.limit(&self.slew, &wrench, &motion.v, &motion.w);
        events.set(Events::PASSIVATED, limited);
        may
    }

    fn limit_change(&mut self, target: &Wrench, events: &mut Events) -> Wrench {
        debug_assert!(target.is_finite(), "the inputs were checked");
        let before = self.slew.now();
        let (wrench, [forced, turned]) = self.slew.towards(target);
        events.set(Events::SLEWED, forced);
        events.set(Events::TORQUE_SLEWED, turned);
        let c = &mut self.counters;
        let by = (wrench.force - before.force).norm();
        c.max_delta_force_n = c.max_delta_force_n.max(by);
        let by = (wrench.torque - before.torque).norm();
        c.max_delta_torque_nm = c.max_delta_torque_nm.max(by);
        wrench
    }

    fn without_force(&mut self, now: ClientTime, dt: Span, mut events: Events) -> Tick {
        self.contact_points.reset();
        self.observer.interrupt();
        if let Some(passivity) = &mut self.passivity {
            passivity.interrupt();
        }
        self.soft_start.lower_to(0.0);
        // The gains for age and radius continue, as if the tool stayed in place.
        let pose = self.blend.model().pose();
        self.gains(now, dt, &pose, &mut events);
        self.soft_start.lower_to(0.0);
        let wrench = self.limit_change(&Wrench::ZERO, &mut events);
        self.finish(now, wrench, events)
    }

    /// Counts a tick, without the contact.
    fn finish(&mut self, now: ClientTime, wrench: Wrench, events: Events) -> Tick {
        let c = &mut self.counters;
        c.count(events);
        c.max_force_n = c.max_force_n.max(wrench.force.norm());
        c.max_torque_nm = c.max_torque_nm.max(wrench.torque.norm());
        c.min_energy_j = self.observer.min_j();
        Tick {
            wrench,
            felt: Wrench::ZERO,
            proxy_offset: Vector3::zeros(),
            events,
            contact_age: now - self.solved_at,
        }
    }
}

/// The slew limit of a force or torque limited to `limit`: `per_s`, or faster to empty it within `FLUSH_MAX`.
fn slew_of(limit: f64, per_s: f64, period: Span) -> Slew {
    Slew::new(per_s.max(limit / FLUSH_MAX.as_secs_f64()) * period.as_secs_f64())
}

fn note_grips(events: &mut Events, was_touching: bool, grips: Grips) {
    events.set(Events::STICK, grips.sticks);
    events.set(Events::SLIP, grips.slips);
    events.set(Events::RELEASED, was_touching && !grips.any());
}

fn is_plausible(sample: &Sample) -> bool {
    let (x, v, w) = (
        &sample.pose.position,
        &sample.velocity,
        &sample.angular_velocity,
    );
    sample.is_finite()
        && x.iter().chain(v).chain(w).all(|c| c.abs() <= SAMPLE_MAX)
        && (sample.pose.orientation.coords.norm() - 1.0).abs() <= QUATERNION_OFF
}
