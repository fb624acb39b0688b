//! The tick: the stages in their order, and nothing else.

use nalgebra::Vector3;
use palpate_device::{DeviceCaps, Faults, Sample, Wrench};
use palpate_protocol::{ClientTime, Span};

use crate::blend::Blend;
use crate::passivity::{Given, Seen};
use crate::watchdog::Watched;
use crate::{
    ContactModel, Counters, EnergyObserver, Events, Friction, FrictionConfig, Grip, LinkGuard,
    Passivity, Slew, SoftStart, StiffnessCap, Watchdog, WatchdogConfig, clamp_force,
};

/// How long the slew limit may need to empty the largest force. A force limit so high that it
/// would need longer raises the slew limit instead, because the watchdog's times count to zero
/// force at the hand.
const FLUSH_MAX: Span = Span::from_millis(50);

/// The longest time between two ticks that counts towards getting force back: after a pause of
/// the thread no ramp is skipped.
const DT_UP_MAX: Span = Span::from_millis(10);

/// How far from the origin, in m, and how fast, in m/s, a tool may be. A sample beyond is as broken
/// as one that is not a number: sums of such numbers could overflow, and stay in the state.
const SAMPLE_MAX: f64 = 1e3;

/// The constants of the chain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainConfig {
    /// The tick's period T.
    pub period: Span,
    /// Damping of device and hand that stiffness is capped by (b in 2 b / T), N·s/m. 0.5 is a
    /// light desktop device held loosely.
    pub damping_ns_per_m: f64,
    /// The largest force, N, where the device's continuous force is larger.
    pub force_max_n: f64,
    /// How fast the force may change, N/s. 600 is 30 N over 50 ms: a firm press into bone is
    /// rendered as it is, a step is not.
    pub slew_n_per_s: f64,
    /// Length of the soft start.
    pub soft_start: Span,
    /// Stick and slip.
    pub friction: FrictionConfig,
    /// What takes force away.
    pub watchdog: WatchdogConfig,
    /// Whether the passivity controller works. Off for measurements of what it is good for.
    pub passivity: bool,
}

impl Default for ChainConfig {
    fn default() -> Self {
        Self {
            period: Span::from_millis(1),
            damping_ns_per_m: 0.5,
            force_max_n: 30.0,
            slew_n_per_s: 600.0,
            soft_start: Span::from_millis(1000),
            friction: FrictionConfig::default(),
            watchdog: WatchdogConfig::default(),
            passivity: true,
        }
    }
}

/// What a tick gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tick {
    /// What to write to the device; always finite.
    pub wrench: Wrench,
    /// What happened.
    pub events: Events,
    /// Age of the contact model that was used.
    pub contact_age: Span,
}

/// The 1 kHz chain that protects the hand.
///
/// In every tick call exactly one of [`tick`](Self::tick) and, when the device could not be read,
/// [`tick_without_sample`](Self::tick_without_sample), and write the wrench. What the device renders
/// instead is said with [`goes_on_from`](Self::goes_on_from) or [`cut_to`](Self::cut_to).
///
/// Times should not run backwards. Where one does, the chain's own time goes on by one period, and
/// what it knows is as old as it was: a clock that was put back keeps no old force alive.
#[derive(Debug, Clone)]
pub struct Chain {
    force_limit_n: f64,
    soft_start: SoftStart,
    link: LinkGuard,
    watchdog: Watchdog,
    blend: Blend,
    friction: Friction,
    /// `None` when it is switched off.
    passivity: Option<Passivity>,
    slew: Slew,
    observer: EnergyObserver,
    counters: Counters,
    period: Span,
    last_tick: Option<ClientTime>,
    /// How far the chain's own time is ahead of the clock that it is given; more after every step back.
    ahead: Span,
    /// The same before the last of them, for models that were stamped before it.
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
        let slew_n_per_s = config
            .slew_n_per_s
            .max(force_limit_n / FLUSH_MAX.as_secs_f64());
        let step_n = slew_n_per_s * config.period.as_secs_f64();
        let flush_ticks = (force_limit_n / step_n).ceil();
        let flush = Span::from_secs_f64(flush_ticks * config.period.as_secs_f64());
        let cap = StiffnessCap::new(caps, config.damping_ns_per_m, config.period);
        Self {
            force_limit_n,
            soft_start: SoftStart::new(config.soft_start),
            link: LinkGuard::new(&config.watchdog, flush),
            watchdog: Watchdog::new(config.watchdog, flush),
            blend: Blend::new(cap),
            friction: Friction::new(config.friction),
            passivity: config
                .passivity
                .then(|| Passivity::new(step_n, config.period)),
            slew: Slew::new(step_n),
            observer: EnergyObserver::default(),
            counters: Counters::default(),
            period: config.period,
            last_tick: None,
            ahead: Span::ZERO,
            ahead_before: Span::ZERO,
            solved_at: ClientTime::ZERO,
        }
    }

    /// The largest force it gives, N.
    pub fn force_limit_n(&self) -> f64 {
        self.force_limit_n
    }

    /// The largest change of force per tick, N.
    pub fn slew_step_n(&self) -> f64 {
        self.slew.step_n()
    }

    /// What happened so far.
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// The link to the session was lost: force goes to zero in 100 ms.
    pub fn link_lost(&mut self, now: ClientTime) {
        self.link.lose(self.own_time(now));
    }

    /// The link is back: force comes back over the soft start.
    pub fn link_restored(&mut self, now: ClientTime) {
        if self.link.is_lost() {
            let gain = self.link.restore(self.own_time(now));
            self.soft_start.lower_to(self.soft_start.gain() * gain);
        }
    }

    /// The device renders `wrench` and not the one it was given last, because it clamped that or lost
    /// some of it. What follows goes on from there: nothing steps when the device takes more again,
    /// and the work that is counted is what was done.
    pub fn goes_on_from(&mut self, wrench: &Wrench) {
        let (force, _) = clamp_force(wrench.force, self.force_limit_n);
        self.slew.begin_at(force);
        let force = self.slew.force();
        self.observer.correct(force);
        if let Some(passivity) = &mut self.passivity {
            passivity.correct(force);
        }
    }

    /// The device took its force away by itself, down to `rest`: it refused a wrench, its motors are
    /// off, or a watchdog of its own acted. As [`goes_on_from`](Self::goes_on_from), and the force
    /// comes back over the soft start, as after every other fault.
    pub fn cut_to(&mut self, rest: &Wrench) {
        self.goes_on_from(rest);
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
        let (x, v) = (sample.pose.position, sample.velocity);
        let was_touching = self.friction.grip() != Grip::Free;
        if model.is_usable() {
            if self.blend.take(model, now, &x) {
                self.solved_at = self.in_own_time(model.solved_at, now);
            }
        } else {
            events.set(Events::BAD_MODEL, true);
        }
        let force = self.contact_force(now, dt, &x, &v);
        let touches = force != Vector3::zeros();
        self.note_grip(&mut events, was_touching);
        let (force, saturated) = clamp_force(force, self.force_limit_n);
        events.set(Events::SATURATED, saturated);
        let [trusted, open] = self.gains(now, dt, &x, &mut events);
        let withheld = force * (1.0 - open);
        if let Some(passivity) = &mut self.passivity {
            let model = self.blend.model();
            if sample.faults.contains(Faults::TIME_JUMP) {
                passivity.interrupt();
            }
            passivity.hear(model.others_j);
            passivity.observe(&Seen {
                x,
                dt,
                there_n: force.norm(),
                stiffness_n_per_m: model.normal_stiffness(),
            });
        }
        let force = self.take_away(force * (trusted * open), &v, &mut events);
        let force = self.limit_change(force, &mut events);
        if let Some(passivity) = &mut self.passivity {
            passivity.give(Given {
                x,
                force,
                withheld,
                touches,
            });
        }
        self.observer.observe(x, force);
        self.finish(now, force, events)
    }

    /// One tick for which the device gave no sample: the force goes to zero.
    pub fn tick_without_sample(&mut self, now: ClientTime) -> Tick {
        let (now, dt) = self.step_time(now);
        let mut events = Events::NONE;
        events.set(Events::FAULTED, true);
        self.without_force(now, dt, events)
    }

    /// `now` in the chain's own time, which never runs backwards.
    fn own_time(&self, now: ClientTime) -> ClientTime {
        let own = now + self.ahead;
        self.last_tick
            .map_or(own, |last| own.max(last + self.ahead))
    }

    /// When a model was solved that is taken at `own` in the chain's own time: one that seems to come from the future was
    /// stamped before the clock was put back.
    fn in_own_time(&self, solved_at: ClientTime, own: ClientTime) -> ClientTime {
        if solved_at + self.ahead > own {
            solved_at + self.ahead_before
        } else {
            solved_at + self.ahead
        }
    }

    /// The chain's own time at `now`, and what of it has passed since the last tick.
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

    fn contact_force(
        &mut self,
        now: ClientTime,
        dt: Span,
        x: &Vector3<f64>,
        v: &Vector3<f64>,
    ) -> Vector3<f64> {
        let contact = self.blend.contact(now, x, v);
        let tangential = self.friction.tick(&contact, x, v, dt);
        contact.normal * contact.normal_force + tangential
    }

    fn note_grip(&self, events: &mut Events, was_touching: bool) {
        let grip = self.friction.grip();
        events.set(Events::STICK, grip == Grip::Stick);
        events.set(Events::SLIP, grip == Grip::Slip);
        events.set(Events::RELEASED, was_touching && grip == Grip::Free);
    }

    /// The watchdog's gain, and that of soft start and link.
    fn gains(
        &mut self,
        now: ClientTime,
        dt: Span,
        x: &Vector3<f64>,
        events: &mut Events,
    ) -> [f64; 2] {
        let dt_up = dt.min(DT_UP_MAX);
        let model = self.blend.model();
        let is_outside = (x - model.x0).norm() > model.radius;
        let age = now - self.solved_at;
        let Watched {
            gain,
            is_stale,
            has_left,
        } = self
            .watchdog
            .advance(age, is_outside, model.in_contact, dt, dt_up);
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
        [gain, link * soft]
    }

    /// What of `force` the passivity controller leaves.
    fn take_away(
        &self,
        force: Vector3<f64>,
        v: &Vector3<f64>,
        events: &mut Events,
    ) -> Vector3<f64> {
        let Some(passivity) = &self.passivity else {
            return force;
        };
        // What counts is the force of this tick, not the one that it is on the way to.
        let (may, limited) = passivity.limit(self.slew.peek(force), v);
        events.set(Events::PASSIVATED, limited);
        if limited { may } else { force }
    }

    fn limit_change(&mut self, target: Vector3<f64>, events: &mut Events) -> Vector3<f64> {
        debug_assert!(
            target.iter().all(|c| c.is_finite()),
            "what came in was checked"
        );
        let before = self.slew.force();
        let (force, slewed) = self.slew.towards(target);
        events.set(Events::SLEWED, slewed);
        let delta = (force - before).norm();
        self.counters.max_delta_force_n = self.counters.max_delta_force_n.max(delta);
        force
    }

    fn without_force(&mut self, now: ClientTime, dt: Span, mut events: Events) -> Tick {
        self.friction.reset();
        self.observer.interrupt();
        if let Some(passivity) = &mut self.passivity {
            passivity.interrupt();
        }
        self.soft_start.lower_to(0.0);
        // The gains behind age and radius go on, as if the tool stayed where it was.
        let x = self.blend.model().x0;
        self.gains(now, dt, &x, &mut events);
        self.soft_start.lower_to(0.0);
        let force = self.limit_change(Vector3::zeros(), &mut events);
        self.finish(now, force, events)
    }

    fn finish(&mut self, now: ClientTime, force: Vector3<f64>, events: Events) -> Tick {
        self.counters.count(events);
        self.counters.max_force_n = self.counters.max_force_n.max(force.norm());
        self.counters.min_energy_j = self.observer.min_j();
        Tick {
            wrench: Wrench::from_force(force),
            events,
            contact_age: now - self.solved_at,
        }
    }
}

fn is_plausible(sample: &Sample) -> bool {
    let (x, v) = (&sample.pose.position, &sample.velocity);
    sample.is_finite() && x.iter().chain(v).all(|c| c.abs() <= SAMPLE_MAX)
}
