//! One run in virtual time: the force loop of the client, a solver beside it, and a fault in the middle.
//!
//! There are two clocks. The run time never jumps; the hand moves in it. The machine clock, which the loop and
//! the solver read, may jump. While the process is stopped, the loop and the solver pause and the device
//! continues.

use palpate_client::realtime::{DeviceCounts, HandLoop, LoopCommands, Pace, Turned};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{DeviceTime, HapticDevice};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Counters, Events};
use palpate_protocol::ClientTime;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::fault::FaultKind;
use super::faulty_device::{DeviceHandle, FaultyDevice, Jerk, Log};
use super::oracle::{Bounds, Broken, Law, Observation, Oracle};
use super::plan::Plan;
use super::tissue::{SOLVE_EVERY_US, Tissue, damaged};

/// Machine uptime when a run begins, µs.
const BOOT_US: i64 = 60_000_000;

/// Age from which a contact model counts as missed: five solve periods, µs.
const MISSED_US: i64 = 5 * SOLVE_EVERY_US;

/// Share of the fault-free force that has to return after the fault. It is small: a hand that moves while
/// forces are withheld is elsewhere, and the passivity controller returns only a tenth of the force in bone.
const BACK_SHARE: f64 = 0.05;

/// Two ticks farther apart than this enclose a pause, s.
const PAUSE_S: f64 = 0.02;

/// Smallest force at which its return is checked, N.
const WORTH_N: f64 = 0.5;

/// Variations of a run, for tests of the oracle.
#[derive(Debug, Clone, Copy, Default)]
pub struct Setup {
    pub chain: ChainConfig,
    /// Share of the slew limit that the oracle allows; `None`: all of it.
    pub step_share: Option<f64>,
    pub jerk: Option<Jerk>,
    pub keep: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    pub t_s: f64,
    pub commanded_n: f64,
    pub rendered_n: f64,
    /// Force change since the last tick, without that of the device itself, N.
    pub changed_n: f64,
    /// Height of the tool above the surface, mm; negative in contact.
    pub above_mm: f64,
    pub events: Events,
}

#[derive(Debug, Clone)]
pub struct Run {
    /// The largest change per tick that is allowed, N.
    pub step_n: f64,
    pub max_delta_n: f64,
    /// Times from a loss of the source to zero force, ms.
    pub to_zero_ms: Vec<f64>,
    /// Time from the stop request at the end to zero force, ms.
    pub stop_ms: f64,
    /// Largest force in the recovery window, N.
    pub force_after_n: f64,
    /// Counters of the chain up to the recovery window.
    pub counters: Counters,
    pub device: DeviceCounts,
    pub missed: u64,
    pub broken: Vec<Broken>,
    pub points: Vec<Point>,
}

/// Expected minimum counts, derived from the injected faults.
#[derive(Debug, Clone, Copy, Default)]
struct Expected {
    bad_models: u64,
    put_back: u64,
    link_lost: u64,
    cuts: u64,
    is_stale: bool,
    skips: bool,
}

pub fn simulate(plan: &Plan, setup: &Setup) -> Run {
    Simulation::new(plan, setup).finish()
}

struct Simulation<'a> {
    plan: &'a Plan,
    keep: bool,
    rng: Pcg64,
    /// Run time, µs.
    at_us: i64,
    /// Time for which the process was stopped, µs.
    stopped_us: i64,
    pace: Pace,
    hand: HandLoop,
    handle: DeviceHandle,
    solver: Solver,
    oracle: Oracle,
    expected: Expected,
    /// Time since when the device returns no usable reading, in running time.
    blind_since_us: Option<i64>,
    unlinked_since_us: Option<i64>,
    last_woke: ClientTime,
    force_after_n: f64,
    points: Vec<Point>,
}

impl<'a> Simulation<'a> {
    fn new(plan: &'a Plan, setup: &Setup) -> Self {
        let start = ScriptStart::at(DeviceTime::ZERO);
        let sim = SimHand::with_caps(plan.script.clone(), start, plan.caps.clone());
        let chain = Chain::new(setup.chain, sim.caps());
        let mut bounds = Bounds::of(&chain);
        bounds.step_n *= setup.step_share.unwrap_or(1.0);
        let (device, handle) = FaultyDevice::new(sim, plan.driver, setup.jerk);
        let began = ClientTime::from_micros(BOOT_US);
        let period = setup.chain.period;
        let mut hand = HandLoop::new(Box::new(device), chain, period, began);
        hand.begin();
        Self {
            plan,
            keep: setup.keep,
            // An independent stream, so that the plan of a seed stays the same.
            rng: Pcg64::seed_from_u64(!plan.seed),
            at_us: 0,
            stopped_us: 0,
            pace: Pace::new(began, period),
            hand,
            handle,
            solver: Solver::new(plan.tissue),
            oracle: Oracle::new(bounds),
            expected: Expected::default(),
            blind_since_us: None,
            unlinked_since_us: None,
            last_woke: began,
            force_after_n: 0.0,
            points: Vec::new(),
        }
    }

    fn finish(mut self) -> Run {
        while self.at_us < self.plan.length_us {
            self.step(false);
        }
        let end_us = self.at_us;
        let counters = *self.hand.chain().counters();
        let to_zero_ms = std::mem::take(&mut self.oracle.to_zero_ms);
        let mut turned = self.step(true);
        while !turned.is_over {
            turned = self.step(true);
        }
        let log = self.handle.state().log;
        if turned.frame.wrench != palpate_device::Wrench::ZERO {
            let detail = format!(
                "{:.3} N {} ms after a stop was commanded",
                turned.frame.wrench.force.norm(),
                (self.at_us - end_us) / 1000
            );
            self.oracle.report(Law::Ends, self.at_us, detail);
        }
        self.hand.close();
        self.count(&log);
        Run {
            step_n: self.hand.chain().slew_step_n(),
            max_delta_n: self.oracle.max_delta_n,
            to_zero_ms,
            stop_ms: (self.at_us - end_us) as f64 * 1e-3,
            force_after_n: self.force_after_n,
            counters,
            device: self.hand.counts(),
            missed: self.pace.missed(),
            broken: self.oracle.broken,
            points: self.points,
        }
    }

    fn clock(&self) -> ClientTime {
        let jumps = self.plan.faults.iter().filter_map(|f| match f.what {
            FaultKind::Clock { by_us } if f.from_us <= self.at_us => Some(by_us),
            _ => None,
        });
        ClientTime::from_micros(BOOT_US + self.at_us + jumps.sum::<i64>())
    }

    fn broken_now(&self) -> Vec<FaultKind> {
        let on = self.plan.faults.iter().filter(|f| f.is_on(self.at_us));
        on.map(|f| f.what).collect()
    }

    /// Sleeps until the next deadline, runs a turn, and checks it.
    fn step(&mut self, stop: bool) -> Turned {
        let sleeps_us = (self.pace.deadline() - self.clock()).as_micros().max(0);
        let late_us = self.lateness_us();
        self.pass(sleeps_us + late_us);
        let mut faults = self.broken_now();
        let link_lost = faults.contains(&FaultKind::LinkLost);
        {
            let mut shared = self.handle.state();
            shared.now_us = self.at_us;
            shared.faults.clear();
            shared.faults.append(&mut faults);
        }
        let woke = self.clock();
        let before = self.handle.state().log;
        let model = self.solver.newest;
        let turned = self
            .hand
            .turn(woke, LoopCommands { link_lost, stop }, &model);
        let log = self.handle.state().log;
        self.note(&turned, woke, link_lost || stop, &before, &log);
        self.check(&turned, &log);
        let works_us = self.rng.random_range(5..60);
        self.pass(works_us);
        self.pace.done(self.clock());
        turned
    }

    fn lateness_us(&mut self) -> i64 {
        if self.rng.random_bool(0.002) {
            self.rng.random_range(500..4_000)
        } else {
            self.rng.random_range(0..150)
        }
    }

    /// Advances the time; the solver works unless the process is stopped.
    fn pass(&mut self, us: i64) {
        let until = self.at_us + us;
        let stopped = self.plan.faults.iter().find_map(|f| {
            (f.what == FaultKind::Stopped && f.from_us < until && self.at_us < f.until_us)
                .then_some((f.from_us, f.until_us))
        });
        if let Some((from_us, continued_us)) = stopped {
            self.solve_until(from_us.max(self.at_us));
            let left_us = until - from_us.max(self.at_us);
            self.stopped_us += continued_us - from_us.max(self.at_us);
            self.solver.was_stopped_until(continued_us);
            self.at_us = continued_us;
            self.expected.skips |= continued_us - from_us > 5_000;
            // Most of the rest of the sleep has passed.
            self.pass(left_us.min(100));
            return;
        }
        self.solve_until(until);
    }

    fn solve_until(&mut self, until: i64) {
        while let Some(at_us) = self.solver.next_until(until) {
            self.at_us = at_us;
            let what = self.broken_now();
            let (clock, running_us) = (self.clock(), self.at_us - self.stopped_us);
            self.solver.turn(at_us, clock, running_us, &what);
        }
        self.at_us = until;
    }

    fn note(&mut self, turned: &Turned, woke: ClientTime, unlinked: bool, before: &Log, log: &Log) {
        let skip_us = (woke - self.last_woke).as_micros();
        self.expected.put_back += u64::from(skip_us < 0);
        self.expected.skips |= skip_us > 5_000;
        self.last_woke = woke;
        self.expected.link_lost += u64::from(unlinked);
        let events = turned.frame.events;
        let was_read = log.unread == before.unread && log.bad_poses == before.bad_poses;
        let saw_model = was_read && !events.contains(Events::FAULTED);
        let model = self.solver.newest;
        self.expected.bad_models += u64::from(saw_model && !model.is_usable());
        // A force drop by the device must exceed the change that a tick may make.
        let is_cut = log.cut_n > 1.5 * self.hand.chain().slew_step_n();
        self.expected.cuts += u64::from(is_cut);
        let running_us = self.at_us - self.stopped_us;
        let is_old = running_us - self.solver.good_since_us > 90_000;
        self.expected.is_stale |= saw_model && is_old && self.solver.was_in_contact;
        let is_blind = !was_read;
        let since = self.blind_since_us.unwrap_or(running_us);
        self.blind_since_us = is_blind.then_some(since);
        let since = self.unlinked_since_us.unwrap_or(running_us);
        self.unlinked_since_us = unlinked.then_some(since);
        self.solver.x = turned.frame.sample.pose.position;
    }

    fn check(&mut self, turned: &Turned, log: &Log) {
        let running_us = self.at_us - self.stopped_us;
        let since_model = self.solver.good_since_us;
        let no_model = (running_us - since_model > MISSED_US).then_some(since_model);
        let lost = [no_model, self.blind_since_us, self.unlinked_since_us];
        let write = {
            let mut shared = self.handle.state();
            shared.log.cut_n = 0.0;
            shared.log.write.take()
        };
        let Some(write) = write else {
            let detail = "a tick without a write".to_owned();
            self.oracle.report(Law::Ends, self.at_us, detail);
            return;
        };
        let changed_n = self.oracle.check(&Observation {
            at_us: self.at_us,
            running_us,
            write,
            cut_n: log.cut_n,
            lost_since_us: lost.into_iter().flatten().min(),
        });
        let rendered_n = write.after.force.norm();
        if self.at_us > self.plan.back_us {
            self.force_after_n = self.force_after_n.max(rendered_n);
        }
        if self.keep {
            let position = turned.frame.sample.pose.position;
            let point = Point {
                t_s: self.at_us as f64 * 1e-6,
                commanded_n: write.commanded.force.norm(),
                rendered_n,
                changed_n,
                above_mm: self.plan.tissue.normal.dot(&position) * 1e3,
                events: turned.frame.events,
            };
            self.keep_pause(point.t_s, write.before.force.norm());
            self.points.push(point);
        }
    }

    /// Two points of a pause that ends at `until_s`: the device kept its force, or dropped it to `left_n`.
    fn keep_pause(&mut self, until_s: f64, left_n: f64) {
        let Some(last) = self.points.last().copied() else {
            return;
        };
        if until_s - last.t_s < PAUSE_S {
            return;
        }
        let cut = self
            .plan
            .driver
            .watchdog
            .filter(|_| left_n < last.rendered_n);
        let cut_s = cut.map_or(until_s, |w| last.t_s + w.after_us as f64 * 1e-6);
        for (t_s, rendered_n) in [(cut_s, last.rendered_n), (cut_s, left_n), (until_s, left_n)] {
            self.points.push(Point {
                t_s,
                rendered_n,
                changed_n: 0.0,
                ..last
            });
        }
    }

    fn count(&mut self, log: &Log) {
        let (c, d) = (*self.hand.chain().counters(), self.hand.counts());
        let e = self.expected;
        let exactly = [
            ("failed readings", log.unread, d.faults),
            ("rejected writes", log.refused, d.rejected),
            ("clamped writes", log.clamped, d.saturated),
            ("invalid models", e.bad_models, c.bad_models),
            ("backward jumps of the clock", e.put_back, d.clock_put_back),
            ("ticks without a link", e.link_lost, c.link_lost),
        ];
        let wrong = exactly.into_iter().filter(|(_, there, seen)| there != seen);
        let mut missing: Vec<String> = wrong
            .map(|(what, there, seen)| format!("{there} {what}, {seen} counted"))
            .collect();
        let at_all = [
            (
                "an invalid pose",
                log.bad_poses > 0,
                c.bad_samples + c.faulted,
            ),
            ("a stale model", e.is_stale, c.stale),
            ("a force drop by the device", e.cuts > 0, d.cuts),
            ("a pause", e.skips, self.pace.missed()),
        ];
        for (what, happened, counted) in at_all {
            if happened && counted == 0 {
                missing.push(format!("{what} was not counted"));
            }
        }
        for detail in missing {
            self.oracle.report(Law::Counted, self.at_us, detail);
        }
        let forbidden = [
            ("non-finite writes", log.nan_written, Law::FiniteWrites),
            ("decreasing time stamps", log.times_back, Law::TimeGoesOn),
        ];
        for (what, times, law) in forbidden {
            if times > 0 {
                self.oracle
                    .report(law, self.at_us, format!("{what}: {times}"));
            }
        }
    }
}

impl Run {
    /// Share of the fault-free force that has returned; `None` if that force is too small to check.
    pub fn back_share(&self, without: &Self) -> Option<f64> {
        let there_n = without.force_after_n;
        (there_n > WORTH_N).then(|| self.force_after_n / there_n)
    }
}

/// Checks that the force returns after a fault, compared with the fault-free run.
pub fn check_return(plan: &Plan, run: &mut Run, without: &Run) {
    if run
        .back_share(without)
        .is_some_and(|share| share < BACK_SHARE)
    {
        run.broken.push(Broken {
            law: Law::ComesBack,
            at_ms: plan.length_us as f64 * 1e-3,
            detail: format!(
                "at most {:.3} N from {:.1} s after the fault on, without it {:.3} N",
                run.force_after_n,
                (plan.back_us - plan.over_us) as f64 * 1e-6,
                without.force_after_n
            ),
        });
    }
}

/// A solver at 250 Hz: a solve begins with the newest pose and ends a little later.
struct Solver {
    tissue: Tissue,
    next_us: i64,
    solving: Option<Solving>,
    x: nalgebra::Vector3<f64>,
    turns: u32,
    newest: ContactModel,
    /// Solve time of the newest usable model, in running time.
    good_since_us: i64,
    /// Whether that model was in contact.
    was_in_contact: bool,
}

struct Solving {
    model: ContactModel,
    done_us: i64,
    began_running_us: i64,
}

impl Solver {
    fn new(tissue: Tissue) -> Self {
        Self {
            tissue,
            next_us: tissue.phase_us,
            solving: None,
            x: tissue.above(0.02, 0.0, 0.0),
            turns: 0,
            newest: ContactModel::FREE,
            good_since_us: 0,
            was_in_contact: false,
        }
    }

    /// The next event of the solver before `until`.
    fn next_until(&self, until: i64) -> Option<i64> {
        let done = self.solving.as_ref().map(|s| s.done_us);
        let next = done.map_or(self.next_us, |done| done.min(self.next_us));
        (next < until).then_some(next)
    }

    /// Postpones due events to the end of a stop.
    fn was_stopped_until(&mut self, us: i64) {
        self.next_us = self.next_us.max(us);
        if let Some(solving) = &mut self.solving {
            solving.done_us = solving.done_us.max(us);
        }
    }

    fn turn(&mut self, at_us: i64, clock: ClientTime, running_us: i64, what: &[FaultKind]) {
        if what.contains(&FaultKind::SolverStall) {
            // A stall ends with the fault; a delay of 1 ms is enough.
            self.was_stopped_until(at_us + 1_000);
            return;
        }
        if let Some(solving) = self.solving.take_if(|s| s.done_us <= at_us) {
            if solving.model.is_usable() {
                self.good_since_us = solving.began_running_us;
                self.was_in_contact = solving.model.in_contact();
            }
            self.newest = solving.model;
        }
        if self.next_us <= at_us {
            self.next_us = at_us + SOLVE_EVERY_US;
            self.turns += 1;
            let turns = self.turns;
            let bad = what.iter().find_map(|what| match what {
                FaultKind::BadModels { how, every } if turns.is_multiple_of(*every) => Some(*how),
                _ => None,
            });
            let model = self.tissue.model(clock, &self.x);
            self.solving = Some(Solving {
                model: bad.map_or(model, |how| damaged(&model, how)),
                done_us: at_us + self.tissue.delay_us,
                began_running_us: running_us,
            });
        }
    }
}
