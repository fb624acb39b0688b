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
    /// What the tissue does to the tool, as far as the contact model can be believed, up to
    /// [`ChainConfig::force_max_n`]; always finite. It is for those who can not render it: a device without motors
    /// hints at it, a view draws it. Nothing of it protects a hand, so it is never to be written.
    pub felt: Wrench,
    /// What happened.
    pub events: Events,
    /// Age of the contact model that was used.
    pub contact_age: Span,
}

/// The 1 kHz chain that protects the hand.
///
/// In every tick call exactly one of [`tick`](Self::tick) and, when the device could not be read,
/// [`tick_without_sample`](Self::tick_without_sample), and write the wrench. Times should not run
/// backwards; one that does counts as no time passed.
#[derive(Debug, Clone)]
pub struct Chain {
    force_limit_n: f64,
    /// The largest force that is told of without being written, N.
    felt_limit_n: f64,
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
    last_tick: Option<ClientTime>,
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
            felt_limit_n: config.force_max_n,
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
            last_tick: None,
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
        self.link.lose(now);
    }

    /// The link is back: force comes back over the soft start.
    pub fn link_restored(&mut self, now: ClientTime) {
        if self.link.is_lost() {
            let gain = self.link.restore(now);
            self.soft_start.lower_to(self.soft_start.gain() * gain);
        }
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
            self.blend.take(model, now, &x);
        } else {
            events.set(Events::BAD_MODEL, true);
        }
        let force = self.contact_force(now, dt, &x, &v);
        let touches = force != Vector3::zeros();
        self.note_grip(&mut events, was_touching);
        let (felt, _) = clamp_force(force, self.felt_limit_n);
        let (force, saturated) = clamp_force(force, self.force_limit_n);
        // A device without motors is not asked for more than it has.
        events.set(Events::SATURATED, saturated && self.force_limit_n > 0.0);
        let [trusted, open] = self.gains(now, dt, &x, &mut events);
        let felt = felt * (trusted * open);
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
        self.finish(now, force, felt, events)
    }

    /// One tick for which the device gave no sample: the force goes to zero.
    pub fn tick_without_sample(&mut self, now: ClientTime) -> Tick {
        let (now, dt) = self.step_time(now);
        let mut events = Events::NONE;
        events.set(Events::FAULTED, true);
        self.without_force(now, dt, events)
    }

    /// `now`, not before the last tick, and the time since.
    fn step_time(&mut self, now: ClientTime) -> (ClientTime, Span) {
        let last = self.last_tick.unwrap_or(now);
        let now = now.max(last);
        self.last_tick = Some(now);
        (now, now - last)
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
        let age = now - model.solved_at;
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
        self.finish(now, force, Vector3::zeros(), events)
    }

    fn finish(
        &mut self,
        now: ClientTime,
        force: Vector3<f64>,
        felt: Vector3<f64>,
        events: Events,
    ) -> Tick {
        self.counters.count(events);
        self.counters.max_force_n = self.counters.max_force_n.max(force.norm());
        self.counters.min_energy_j = self.observer.min_j();
        Tick {
            wrench: Wrench::from_force(force),
            felt: Wrench::from_force(felt),
            events,
            contact_age: now - self.blend.model().solved_at,
        }
    }
}

fn is_plausible(sample: &Sample) -> bool {
    let (x, v) = (&sample.pose.position, &sample.velocity);
    sample.is_finite() && x.iter().chain(v).all(|c| c.abs() <= SAMPLE_MAX)
}
