//! One run in virtual time: the loop that users run, a solver beside it, and a fault in the middle.
//!
//! There are two times. That of the run never jumps: the hand lives in it. The clock of the machine
//! is what the loop and the solver see; it may jump. While the process is stopped neither of the two does
//! anything, and the device goes on by itself.

use palpate_client::realtime::{DeviceCounts, HandLoop, Pace, Turned, Wishes};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{DeviceTime, HapticDevice};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Counters, Events};
use palpate_protocol::ClientTime;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::fault::What;
use super::oracle::{Bounds, Broken, Law, Look, Oracle};
use super::plan::Plan;
use super::rig::{Hold, Jerk, Log, Rig};
use super::tissue::{SOLVE_EVERY_US, Tissue, spoilt};

/// The machine has been up for a while when a run begins, µs.
const BOOT_US: i64 = 60_000_000;

/// Models of this age count as missed: five of them, µs.
const MISSED_US: i64 = 5 * SOLVE_EVERY_US;

/// What of the force without faults has to be back afterwards. Not all of it: a hand that goes on
/// while forces are withheld is elsewhere, and one that rests in bone then is left a tenth of it by the
/// passivity controller, as nobody knows what it has put in.
const BACK_SHARE: f64 = 0.05;

/// Ticks that are farther apart than this, s, have a pause between them.
const PAUSE_S: f64 = 0.02;

/// A force that is worth looking for, N.
const WORTH_N: f64 = 0.5;

/// How a run is made; other than by default only to see that those who look can see.
#[derive(Debug, Clone, Copy, Default)]
pub struct Setup {
    /// The chain.
    pub chain: ChainConfig,
    /// Of the slew limit, what the oracle allows; `None`: all of it.
    pub step_share: Option<f64>,
    /// A device that jerks.
    pub jerk: Option<Jerk>,
    /// Whether every tick is kept.
    pub keep: bool,
}

/// A tick that was kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// When, s of the run.
    pub t_s: f64,
    /// What was asked of the device, N.
    pub asked_n: f64,
    /// What it rendered, N.
    pub rendered_n: f64,
    /// What of the change since the last tick was ours, N.
    pub changed_n: f64,
    /// How far the tool was above the surface, mm; below zero it presses.
    pub above_mm: f64,
    /// What happened.
    pub events: Events,
}

/// What a run was like.
#[derive(Debug, Clone)]
pub struct Run {
    /// The largest change per tick that is allowed, N.
    pub step_n: f64,
    /// The largest there was, N.
    pub max_delta_n: f64,
    /// From losses of the source to zero force, ms.
    pub to_zero_ms: Vec<f64>,
    /// From the wish to stop, at the end, to zero force, ms.
    pub stop_ms: f64,
    /// The largest force when everything should be well again, N.
    pub force_after_n: f64,
    /// What the chain counted until then.
    pub counters: Counters,
    /// What the loop counted.
    pub device: DeviceCounts,
    /// Deadlines that were skipped.
    pub missed: u64,
    /// Laws that were broken.
    pub broken: Vec<Broken>,
    /// The ticks, where they were kept.
    pub points: Vec<Point>,
}

/// What has to be counted, as the run has seen it from outside.
#[derive(Debug, Clone, Copy, Default)]
struct Expected {
    bad_models: u64,
    put_back: u64,
    link_lost: u64,
    cuts: u64,
    is_stale: bool,
    skips: bool,
}

/// Runs a plan.
pub fn run(plan: &Plan, setup: &Setup) -> Run {
    Course::new(plan, setup).finish()
}

struct Course<'a> {
    plan: &'a Plan,
    keep: bool,
    rng: Pcg64,
    /// The time of the run, µs.
    at_us: i64,
    /// How much of it the process was stopped.
    stopped_us: i64,
    pace: Pace,
    hand: HandLoop,
    hold: Hold,
    solver: Solver,
    oracle: Oracle,
    expected: Expected,
    /// Since when the device says nothing that can be used, in running time.
    blind_since_us: Option<i64>,
    unlinked_since_us: Option<i64>,
    last_woke: ClientTime,
    force_after_n: f64,
    points: Vec<Point>,
}

impl<'a> Course<'a> {
    fn new(plan: &'a Plan, setup: &Setup) -> Self {
        let start = ScriptStart::at(DeviceTime::ZERO);
        let sim = SimHand::with_caps(plan.script.clone(), start, plan.caps.clone());
        let chain = Chain::new(setup.chain, sim.caps());
        let mut bounds = Bounds::of(&chain);
        bounds.step_n *= setup.step_share.unwrap_or(1.0);
        let (rig, hold) = Rig::new(sim, plan.driver, setup.jerk);
        let began = ClientTime::from_micros(BOOT_US);
        let period = setup.chain.period;
        let mut hand = HandLoop::new(Box::new(rig), chain, period, began);
        hand.begin();
        Self {
            plan,
            keep: setup.keep,
            // Another stream than the plan's own.
            rng: Pcg64::seed_from_u64(!plan.seed),
            at_us: 0,
            stopped_us: 0,
            pace: Pace::new(began, period),
            hand,
            hold,
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
        let log = self.hold.bench().log;
        if turned.frame.wrench != palpate_device::Wrench::ZERO {
            let detail = format!(
                "{:.3} N {} ms after a stop was asked for",
                turned.frame.wrench.force.norm(),
                (self.at_us - end_us) / 1000
            );
            self.oracle.accuse(Law::Ends, self.at_us, detail);
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

    /// The machine's clock now.
    fn clock(&self) -> ClientTime {
        let jumps = self.plan.faults.iter().filter_map(|f| match f.what {
            What::Clock { by_us } if f.from_us <= self.at_us => Some(by_us),
            _ => None,
        });
        ClientTime::from_micros(BOOT_US + self.at_us + jumps.sum::<i64>())
    }

    /// What is broken now.
    fn broken_now(&self) -> Vec<What> {
        let on = self.plan.faults.iter().filter(|f| f.is_on(self.at_us));
        on.map(|f| f.what).collect()
    }

    /// Sleeps until the next deadline, takes a turn, and looks at it.
    fn step(&mut self, stop: bool) -> Turned {
        let sleeps_us = (self.pace.deadline() - self.clock()).as_micros().max(0);
        let late_us = self.lateness_us();
        self.pass(sleeps_us + late_us);
        let mut faults = self.broken_now();
        let link_lost = faults.contains(&What::LinkLost);
        {
            let mut bench = self.hold.bench();
            bench.now_us = self.at_us;
            bench.faults.clear();
            bench.faults.append(&mut faults);
        }
        let woke = self.clock();
        let before = self.hold.bench().log;
        let model = self.solver.newest;
        let turned = self.hand.turn(woke, Wishes { link_lost, stop }, &model);
        let log = self.hold.bench().log;
        self.note(&turned, woke, link_lost || stop, &before, &log);
        self.look(&turned, &log);
        let works_us = self.rng.random_range(5..60);
        self.pass(works_us);
        self.pace.done(self.clock());
        turned
    }

    /// Ticks are late by a little, and now and then by more.
    fn lateness_us(&mut self) -> i64 {
        if self.rng.random_bool(0.002) {
            self.rng.random_range(500..4_000)
        } else {
            self.rng.random_range(0..150)
        }
    }

    /// Lets time pass in which the solver works, or in which nobody does.
    fn pass(&mut self, us: i64) {
        let until = self.at_us + us;
        let stopped = self.plan.faults.iter().find_map(|f| {
            (f.what == What::Stopped && f.from_us < until && self.at_us < f.until_us)
                .then_some((f.from_us, f.until_us))
        });
        if let Some((from_us, continued_us)) = stopped {
            self.solve_until(from_us.max(self.at_us));
            let left_us = until - from_us.max(self.at_us);
            self.stopped_us += continued_us - from_us.max(self.at_us);
            self.solver.was_stopped_until(continued_us);
            self.at_us = continued_us;
            self.expected.skips |= continued_us - from_us > 5_000;
            // Of its sleep the rest has mostly passed.
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

    /// What a tick has to have counted.
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
        // What a cut took has to stand out from what a tick may change.
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
        self.solver.hears(&turned.frame.sample.pose.position);
    }

    fn look(&mut self, turned: &Turned, log: &Log) {
        let running_us = self.at_us - self.stopped_us;
        let since_model = self.solver.good_since_us;
        let no_model = (running_us - since_model > MISSED_US).then_some(since_model);
        let lost = [no_model, self.blind_since_us, self.unlinked_since_us];
        let write = {
            let mut bench = self.hold.bench();
            bench.log.cut_n = 0.0;
            bench.log.write.take()
        };
        let Some(write) = write else {
            let detail = "a tick without a write".to_owned();
            self.oracle.accuse(Law::Ends, self.at_us, detail);
            return;
        };
        let changed_n = self.oracle.look(&Look {
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
                asked_n: write.asked.force.norm(),
                rendered_n,
                changed_n,
                above_mm: self.plan.tissue.normal.dot(&position) * 1e3,
                events: turned.frame.events,
            };
            self.keep_pause(point.t_s, write.before.force.norm());
            self.points.push(point);
        }
    }

    /// Two points of a pause that ends at `until_s`, in which the device rendered on, or cut the force down to `left_n`.
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

    /// Compares what was counted with what happened.
    fn count(&mut self, log: &Log) {
        let (c, d) = (*self.hand.chain().counters(), self.hand.counts());
        let e = self.expected;
        let exactly = [
            ("readings that failed", log.unread, d.faults),
            ("refused writes", log.refused, d.rejected),
            ("clamped writes", log.clamped, d.saturated),
            ("models that are none", e.bad_models, c.bad_models),
            ("times the clock was put back", e.put_back, d.clock_put_back),
            ("ticks without a link", e.link_lost, c.link_lost),
        ];
        let wrong = exactly.into_iter().filter(|(_, there, seen)| there != seen);
        let mut missing: Vec<String> = wrong
            .map(|(what, there, seen)| format!("{there} {what}, {seen} counted"))
            .collect();
        let at_all = [
            ("a bad pose", log.bad_poses > 0, c.bad_samples + c.faulted),
            ("an old model", e.is_stale, c.stale),
            ("a force that the device took away", e.cuts > 0, d.cuts),
            ("a pause", e.skips, self.pace.missed()),
        ];
        for (what, happened, counted) in at_all {
            if happened && counted == 0 {
                missing.push(format!("{what} was not counted"));
            }
        }
        for detail in missing {
            self.oracle.accuse(Law::Counted, self.at_us, detail);
        }
        let told = [
            ("written", log.nan_written, Law::FiniteWrites),
            ("told", log.times_back, Law::TimeGoesOn),
        ];
        for (what, times, law) in told {
            if times > 0 {
                self.oracle
                    .accuse(law, self.at_us, format!("{what} {times} times"));
            }
        }
    }
}

impl Run {
    /// The part of the force without faults that is back; `None` where there is none worth looking for.
    pub fn back_share(&self, without: &Self) -> Option<f64> {
        let there_n = without.force_after_n;
        (there_n > WORTH_N).then(|| self.force_after_n / there_n)
    }
}

/// Whether the force is back after a run, compared with the same run without faults.
pub fn comes_back(plan: &Plan, run: &mut Run, without: &Run) {
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

/// Solves at 250 Hz what the loop feels: begins with the newest pose, and is done a little later.
struct Solver {
    tissue: Tissue,
    next_us: i64,
    solving: Option<Solving>,
    x: nalgebra::Vector3<f64>,
    turns: u32,
    newest: ContactModel,
    /// When the newest usable model was solved, in running time.
    good_since_us: i64,
    /// Whether that one was in contact.
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

    /// The next moment at which it has something to do, if that is before `until`.
    fn next_until(&self, until: i64) -> Option<i64> {
        let done = self.solving.as_ref().map(|s| s.done_us);
        let next = done.map_or(self.next_us, |done| done.min(self.next_us));
        (next < until).then_some(next)
    }

    fn hears(&mut self, x: &nalgebra::Vector3<f64>) {
        self.x = *x;
    }

    /// What it would have done meanwhile, it does now.
    fn was_stopped_until(&mut self, us: i64) {
        self.next_us = self.next_us.max(us);
        if let Some(solving) = &mut self.solving {
            solving.done_us = solving.done_us.max(us);
        }
    }

    fn turn(&mut self, at_us: i64, clock: ClientTime, running_us: i64, what: &[What]) {
        if what.contains(&What::SolverStall) {
            // Whatever holds it up is over with the stall, a millisecond more or less.
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
                What::BadModels { how, every } if turns.is_multiple_of(*every) => Some(*how),
                _ => None,
            });
            let model = self.tissue.model(clock, &self.x);
            self.solving = Some(Solving {
                model: bad.map_or(model, |how| spoilt(&model, how)),
                done_us: at_us + self.tissue.delay_us,
                began_running_us: running_us,
            });
        }
    }
}
