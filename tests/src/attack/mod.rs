//! Attacks on a server process beside an honest session, and the damage.
//!
//! ```text
//! server process <- relay -- holder, cutter: client processes with scripts
//!                <- visitors: an observer of the log; a newcomer every 3 s
//!                <- crew: the attackers; pages among them join before the trainees
//!
//! |-- lead --|-------- scripts and attack --------|-- recovery --| leave
//! ```
//!
//! Visitors and crew are threads of this process with connections of their own, without an emulated network. The
//! same session without a crew runs first, and gives the reference of the forces for all runs.
//! [`ALL`](kinds::ALL) lists the attacks.

pub(crate) mod command;
mod crew;
pub mod kinds;
pub mod measures;
mod raw_client;
mod verdict;
mod visitors;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use palpate_client::Recording;
use palpate_client::realtime::monotonic_now;
use palpate_tissue::Topology;

use crate::cpu::{CpuRow, cpu_of};
use crate::delay_figures::DelayFigures;
use crate::demo::DemoError;
use crate::demo::pair::{self, NAMES, Pair, START_LEAD, file_error};
use crate::memory::Memory;
use crate::network::Profile;
use crate::progress::{Interrupt, Progress};
use crate::reference::Reference;
use crate::scripts::{Exercise, SECONDS_MAX, SECONDS_MIN};
use crate::session::{HERE, Hosting, Participant, ParticipantResult, Session, SessionError};
use crate::tool_location::{SurfacePoint, ToolLocation};
use crew::Crew;
use kinds::{Attack, Counts};
use measures::{Figures, HandFigures, MEMORY_MB, MemoryFigures, Newcomers, Recovery};
use visitors::{ObservedLog, Visitors};

pub use verdict::AttackReport;

/// Time between two newcomers during an attack.
const NEWCOMER_EVERY: Duration = Duration::from_secs(3);

/// The first newcomer comes this long after the begin of the attack.
const NEWCOMER_FIRST: Duration = Duration::from_millis(500);

/// Pause between two newcomers after an attack, if the first could not join.
const NEWCOMER_AGAIN: Duration = Duration::from_millis(200);

/// Observed time after an attack: at least, and at most if the service does not return.
const RECOVERY: [Duration; 2] = [Duration::from_millis(2500), Duration::from_secs(4)];

/// Period of all checks.
const STEP: Duration = Duration::from_millis(20);

/// Steps between two samples of the memory.
const MEMORY_EVERY: u32 = 5;

/// Places on the tissue for the attackers' tools.
const SPOTS: usize = 12;

/// Settings of attacks.
#[derive(Debug, Clone)]
pub struct AttackOptions {
    /// The laboratory program, which plays server and clients.
    pub executable: PathBuf,
    /// Sample, scene or model file.
    pub model: String,
    /// Length of an attack and of the scripts, s.
    pub seconds: f64,
    /// The network of the honest trainees.
    pub profile: Profile,
    /// Seed of the packet fates.
    pub seed: u64,
    /// The runs, each with the attacks that run at once.
    pub runs: Vec<Vec<Attack>>,
}

/// Runs the session without attack, then all attacks.
///
/// # Errors
///
/// If the model, the scripts or the session without attack fail, or on interruption. A session that fails under
/// attack is a result.
pub fn run(
    options: &AttackOptions,
    progress: &mut Progress,
    interrupt: &Interrupt,
) -> Result<AttackReport, DemoError> {
    if !(SECONDS_MIN..=SECONDS_MAX).contains(&options.seconds) {
        return Err(DemoError::Seconds(options.seconds));
    }
    let scratch = tempfile::tempdir().map_err(|e| file_error(&std::env::temp_dir(), e))?;
    let pair = Pair::prepare(
        &options.model,
        (Exercise::Press, options.seconds),
        scratch.path(),
        progress,
    )?;
    let topology = Topology::new(pair.test_model.model.clone());
    let spots = ToolLocation::spread(&topology, SPOTS)?;
    let mut arena = Arena {
        options,
        pair,
        spots,
        reference: None,
        quiet_delay: None,
        quiet_growth_mb: 0.0,
        interrupt,
    };
    let quiet = arena.observe(&[], progress)?;
    let mut notes = Vec::new();
    match arena.pair.reference(&quiet.results, progress, interrupt)? {
        Ok((reference, _)) => arena.reference = Some(reference),
        Err(error) => notes.push(format!("the reference is missing: {error}")),
    }
    arena.quiet_delay = quiet.delay(options.seconds);
    arena.quiet_growth_mb = quiet.memory.map_or(0.0, |m| m.growth_mb());
    let base = arena.figures(&[], &quiet);
    let mut runs = Vec::new();
    for attacks in &options.runs {
        let run = match arena.observe(attacks, progress) {
            Ok(observed) => arena.figures(attacks, &observed),
            Err(DemoError::Session(SessionError::Interrupted)) => {
                return Err(SessionError::Interrupted.into());
            }
            Err(error) => Figures {
                attacks: attacks.iter().map(|a| a.name).collect(),
                strokes: arena.pair.strokes(),
                problems: vec![error.to_string()],
                ..Figures::default()
            },
        };
        progress.stage(&verdict::line(&run, &base, options.seconds));
        runs.push(run);
    }
    let nodes = arena.pair.test_model.model.nodes.len();
    Ok(AttackReport::new(options, nodes, base, runs, notes))
}

/// Everything that the runs share.
struct Arena<'a> {
    options: &'a AttackOptions,
    pair: Pair,
    spots: Vec<SurfacePoint>,
    /// The forces without a network, with the cuts of the session without attack.
    reference: Option<Reference>,
    /// D without attack.
    quiet_delay: Option<DelayFigures>,
    /// Growth of the server's memory without attack, MB.
    quiet_growth_mb: f64,
    interrupt: &'a Interrupt,
}

/// The raw results of a run.
struct Observed {
    results: Vec<ParticipantResult>,
    problems: Vec<String>,
    /// End of the attack, on the machine's clock.
    end_us: i64,
    newcomers: Newcomers,
    newcomer_back: Option<Duration>,
    memory_back: Option<Duration>,
    memory: Option<MemoryFigures>,
    log: ObservedLog,
    server_cpu: Option<CpuRow>,
    achieved: Vec<(&'static str, Counts)>,
}

impl Observed {
    fn recordings(&self) -> Vec<&Recording> {
        self.results.iter().map(|r| &r.recording).collect()
    }

    fn delay(&self, seconds: f64) -> Option<DelayFigures> {
        DelayFigures::of(&self.recordings(), seconds)
    }
}

/// A running session that is watched.
struct Watched<'a> {
    session: Session,
    participants: Vec<Participant>,
    problems: Vec<String>,
    visitors: Visitors,
    /// The memory before the attack, and the figures since then.
    memory: Option<(Memory, MemoryFigures)>,
    steps: u32,
    interrupt: &'a Interrupt,
}

impl Watched<'_> {
    /// Waits for a step; returns the memory of the server now and then.
    fn step(&mut self) -> Result<Option<Memory>, DemoError> {
        if self.interrupt.is_set() {
            return Err(SessionError::Interrupted.into());
        }
        self.session
            .server
            .check_alive()
            .map_err(SessionError::from)?;
        pair::remove_dead(&mut self.participants, &mut self.problems);
        std::thread::sleep(STEP);
        self.steps += 1;
        if !self.steps.is_multiple_of(MEMORY_EVERY) {
            return Ok(None);
        }
        let sample = Memory::of(self.session.server.id());
        if let (Some(sample), Some((before, figures))) = (sample, &mut self.memory) {
            figures.note(sample, *before);
        }
        Ok(sample)
    }

    /// The time before the scripts.
    fn lead(&mut self) -> Result<(), DemoError> {
        let began = Instant::now();
        let mut last = None;
        while began.elapsed() < START_LEAD {
            last = self.step()?.or(last);
        }
        self.memory = last.map(|quiet| (quiet, MemoryFigures::new(quiet)));
        Ok(())
    }

    /// The scripts, with newcomers.
    fn scripts(&mut self, seconds: f64, progress: &mut Progress) -> Result<(), DemoError> {
        let began = Instant::now();
        let mut newcomer_at = NEWCOMER_FIRST;
        while began.elapsed().as_secs_f64() < seconds {
            self.step()?;
            if began.elapsed() >= newcomer_at {
                newcomer_at += NEWCOMER_EVERY;
                self.visitors.attempt();
            }
            progress.tick(&format!("{} of {seconds:.0} s", began.elapsed().as_secs()));
        }
        Ok(())
    }

    /// The time after the attack: times until a newcomer joins, and until the memory has grown by at most
    /// `growth_mb` since before the attack. The observed time takes the place of a time that is longer.
    fn recovery(&mut self, growth_mb: f64) -> Result<[Option<Duration>; 2], DemoError> {
        let end = Instant::now();
        let earlier = self.visitors.attempts().len();
        let limit_mb = self.memory.map(|(quiet, _)| quiet.resident_mb + growth_mb);
        let mut newcomer_back = None;
        let mut last_above = Duration::ZERO;
        let mut is_above = false;
        self.visitors.attempt();
        while end.elapsed() < RECOVERY[1] {
            let is_back = newcomer_back.is_some() && !is_above;
            if is_back && end.elapsed() >= RECOVERY[0] {
                break;
            }
            if let (Some(sample), Some(limit_mb)) = (self.step()?, limit_mb) {
                is_above = sample.resident_mb > limit_mb;
                if is_above {
                    last_above = end.elapsed();
                }
            }
            let attempts = self.visitors.attempts();
            let recent = &attempts[earlier..];
            let joined = recent.iter().find_map(|a| match &a.result {
                Some(Ok(took)) => Some(a.began.saturating_duration_since(end) + *took),
                _ => None,
            });
            newcomer_back = newcomer_back.or(joined);
            if let Some(last) = recent.last()
                && matches!(last.result, Some(Err(_)))
                && last.began.elapsed() > NEWCOMER_AGAIN
            {
                self.visitors.attempt();
            }
        }
        let memory_back = limit_mb.map(|_| last_above);
        Ok([newcomer_back.or(Some(end.elapsed())), memory_back])
    }
}

impl Arena<'_> {
    /// Runs a session under these attacks.
    fn observe(&self, attacks: &[Attack], progress: &mut Progress) -> Result<Observed, DemoError> {
        let o = self.options;
        let names: Vec<&str> = attacks.iter().map(|a| a.name).collect();
        let label = if names.is_empty() {
            "without attack".to_owned()
        } else {
            format!("attack {}", names.join(" + "))
        };
        progress.stage(&format!("{label}: a server and two trainees"));
        let pages = attacks.iter().find_map(|a| a.pages);
        let session = Session::start(&Hosting {
            executable: &o.executable,
            model: &self.pair.test_model.file,
            profile: o.profile.clone(),
            seed: o.seed,
            compensation: "adaptive",
            start_when: 2,
            view: pages.map(|_| HERE),
            seats: pages.map(|pages| pages.seats),
        })?;
        let early = self.start_early(attacks, &session)?;
        let participants = self.pair.join(&session, progress, self.interrupt)?;
        let visitors = Visitors::start(&session, attacks.iter().any(|a| a.takes_seats))?;
        let mut watched = Watched {
            session,
            participants,
            problems: Vec::new(),
            visitors,
            memory: None,
            steps: 0,
            interrupt: self.interrupt,
        };
        watched.lead()?;
        progress.stage(&format!("{label}: {:.0} s", o.seconds));
        let crew = match early {
            Some(crew) => crew,
            None => Crew::start(attacks, &watched.session, &self.spots)?,
        };
        watched.scripts(o.seconds, progress)?;
        crew.stop();
        let end = Instant::now();
        let end_us = monotonic_now().as_micros();
        let achieved = crew.counts();
        let [newcomer_back, memory_back] = watched.recovery(self.quiet_growth_mb + MEMORY_MB)?;
        let attempts = watched.visitors.attempts();
        let during = attempts.iter().filter(|a| a.began < end);
        let unfinished = Err("not complete at the end of the observation".to_owned());
        let newcomers = Newcomers::of(during.map(|a| a.result.as_ref().unwrap_or(&unfinished)));
        let log = watched.visitors.log();
        let mut problems = watched.problems;
        let results = pair::leave(watched.participants, &mut problems);
        let server_cpu = match watched.session.end() {
            Ok((summary, _)) => cpu_of("server", &summary),
            Err(error) => {
                problems.push(error.to_string());
                None
            }
        };
        Ok(Observed {
            results,
            problems,
            end_us,
            newcomers,
            newcomer_back,
            memory_back,
            memory: watched.memory.map(|(_, figures)| figures),
            log,
            server_cpu,
            achieved,
        })
    }

    /// Starts attackers that join before the trainees, and waits until they have joined.
    fn start_early(
        &self,
        attacks: &[Attack],
        session: &Session,
    ) -> Result<Option<Crew>, DemoError> {
        let leads = attacks.iter().filter_map(|a| a.pages).map(|p| p.lead);
        let lead = leads.max().unwrap_or_default();
        if lead.is_zero() {
            return Ok(None);
        }
        let crew = Crew::start(attacks, session, &self.spots)?;
        let began = Instant::now();
        while began.elapsed() < lead {
            if self.interrupt.is_set() {
                return Err(SessionError::Interrupted.into());
            }
            std::thread::sleep(STEP);
        }
        Ok(Some(crew))
    }

    fn figures(&self, attacks: &[Attack], observed: &Observed) -> Figures {
        let seconds = self.options.seconds;
        let of =
            |result: &ParticipantResult| pair::figures(result, self.reference.as_ref(), seconds);
        let reports: Vec<_> = observed.results.iter().map(of).collect();
        let hand = |name: &'static str| {
            let report = reports.iter().find(|p| p.summary.name == name);
            let dropouts = report.and_then(|p| p.dropouts.as_ref());
            HandFigures {
                name,
                force_error_percent: report.and_then(|p| p.force_error_rms),
                dropouts: dropouts.map(|d| d.count),
                longest_dropout_ms: dropouts.map(|d| d.longest_ms),
            }
        };
        let demotions = reports.iter().map(|p| p.summary.demotions).sum();
        let limit_ms = self
            .quiet_delay
            .map(|d| measures::limit(d.median_ms, measures::DELAY_FLOOR_MS));
        let recordings = observed.recordings();
        let delay_s =
            limit_ms.and_then(|ms| measures::delay_back_s(&recordings, observed.end_us, ms));
        let seconds_of = |d: Duration| d.as_secs_f64();
        let mut problems = observed.problems.clone();
        if let Some(why) = &observed.log.ended {
            problems.push(format!("the observer lost its connection: {why}"));
        }
        Figures {
            attacks: attacks.iter().map(|a| a.name).collect(),
            hands: NAMES.map(hand).into(),
            delay: observed.delay(seconds),
            demotions: (reports.len() == NAMES.len()).then_some(demotions),
            newcomers: observed.newcomers.clone(),
            memory: observed.memory,
            recovery: Recovery {
                newcomer_s: observed.newcomer_back.map(seconds_of),
                delay_s,
                memory_s: observed.memory_back.map(seconds_of),
            },
            strokes: self.pair.strokes(),
            honest_cuts: observed.log.cuts_by(&NAMES),
            operations: Some(observed.log.operations),
            server_cpu: observed.server_cpu.clone(),
            achieved: observed.achieved.clone(),
            problems,
        }
    }
}
