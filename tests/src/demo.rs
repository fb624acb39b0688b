//! The main use case from end to end: two trainees press and cut one model over a bad network, a spectator
//! joins late, and a report judges the session.

pub(crate) mod command;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use maud::{DOCTYPE, PreEscaped, html};
use palpate_client::Recording;
use palpate_device::Script;
use palpate_protocol::operation::CutStroke;
use palpate_server::host::HostSummary;
use palpate_tissue::write_file;

use crate::chart::Mark;
use crate::cpu::cpu_of;
use crate::criteria::{self, Expected};
use crate::delay_figures::{self, DelayFigures};
use crate::disagreement::{Disagreement, DisagreementPoint};
use crate::dropout::{Dropouts, longest_gap_ms};
use crate::force_error::{ForceError, over_script};
use crate::plots::{self, TraineeForces};
use crate::progress::{Interrupt, Progress};
use crate::reference::{self, Reference};
use crate::relay::{Profile, RelayStats};
use crate::report::{CutReport, ParticipantReport, ReferenceReport, Report};
use crate::scripts::{SECONDS_MAX, SECONDS_MIN, Scripts};
use crate::session::{Hosting, Participant, ParticipantResult, Session, SessionError};
use crate::stress::{PROCESSES_MAX, Stress};
use crate::test_model::TestModel;

/// Time from the last join to the start of the scripts, as in the room.
const START_LEAD: Duration = Duration::from_secs(1);

/// Time after the scripts until the participants leave: packets arrive and views are shown.
const SETTLE: Duration = Duration::from_millis(1500);

/// The trainees, in script order.
const NAMES: [&str; 2] = ["holder", "cutter"];

/// The late participant.
const LATE_NAME: &str = "spectator";

/// Options of `demo`.
#[derive(Debug, Clone, Args)]
pub struct DemoOptions {
    /// The laboratory program, which plays all roles.
    #[arg(skip)]
    pub executable: PathBuf,
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(long, default_value = "thigh")]
    pub model: String,
    /// Length of the scripts, 4 to 600 s
    #[arg(long, default_value_t = 20.0, value_name = "S")]
    pub seconds: f64,
    /// The network between server and clients
    #[arg(long, default_value = "transatlantic", value_parser = Profile::parse)]
    pub profile: Profile,
    /// Seed of the packet fates
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Artificial time compensation: adaptive, fixed:MS or none
    #[arg(long, default_value = "adaptive", value_name = "MODE")]
    pub compensation: String,
    /// Busy processes of ordinary priority beside the session: dropouts may then last 60 ms instead of 40
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=i64::from(PROCESSES_MAX)))]
    pub stress: u16,
    /// Print the report as one JSON object
    #[arg(long)]
    pub json: bool,
    /// Folder of report.txt, report.json, report.html and the plots [default: palpate-report; none with --json]
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// The share of the scripts after which the spectator joins
    #[arg(long, default_value_t = 0.4, hide = true)]
    pub late_join: f64,
}

/// Failure of a demo.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// Invalid length.
    #[error("{0} seconds are not between {SECONDS_MIN} and {SECONDS_MAX}")]
    Seconds(f64),
    /// The model or its scripts.
    #[error("{0}")]
    Model(String),
    /// The session.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A file.
    #[error("{}: {source}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
}

impl From<String> for DemoError {
    fn from(why: String) -> Self {
        Self::Model(why)
    }
}

/// Raw results of a session.
struct Run {
    host: HostSummary,
    network: RelayStats,
    results: Vec<ParticipantResult>,
    problems: Vec<String>,
}

/// Runs the demo and writes the report files if requested.
pub fn run(
    options: &DemoOptions,
    progress: &mut Progress,
    interrupt: &Interrupt,
) -> Result<Report, DemoError> {
    if !(SECONDS_MIN..=SECONDS_MAX).contains(&options.seconds) {
        return Err(DemoError::Seconds(options.seconds));
    }
    let scratch = tempfile::tempdir().map_err(|source| DemoError::File {
        path: std::env::temp_dir(),
        source,
    })?;
    let dir = options.report.as_deref().unwrap_or(scratch.path());
    std::fs::create_dir_all(dir).map_err(|source| file_error(dir, source))?;
    progress.stage(&format!("preparing the model {}", options.model));
    let test_model = TestModel::prepare(&options.model, dir)?;
    let scripts = Scripts::for_model(&test_model.model, options.seconds)?;
    let files = [&scripts.holder, &scripts.cutter].map(Script::to_toml);
    for (name, text) in NAMES.iter().zip(&files) {
        write(&script_file(dir, name), text)?;
    }
    // Both sides use the rounded numbers of the file.
    let read = |text| Script::from_toml(text).map_err(|e| e.to_string());
    let scripts = [read(&files[0])?, read(&files[1])?];
    let run = session(options, dir, &test_model, progress, interrupt)?;
    progress.stage("computing the reference: the same hands without a network");
    let began = Instant::now();
    let cuts = strokes_cut(&run);
    let both = [&scripts[0], &scripts[1]];
    let reference = reference::run(&test_model.model, both, &cuts, |share| {
        progress.tick(&format!("{:.0} %", share * 100.0));
        !interrupt.is_set()
    });
    if interrupt.is_set() {
        return Err(SessionError::Interrupted.into());
    }
    let took_s = began.elapsed().as_secs_f64();
    progress.stage("comparing the recordings");
    let strokes = scripts.iter().map(strokes).sum();
    let reference = reference.map(|r| (r, took_s));
    let (report, pictures) = conclude(options, &test_model, run, reference, strokes);
    if let Some(dir) = &options.report {
        pictures.write(dir, &report)?;
    }
    Ok(report)
}

/// The strokes that the session cut. All logs are equal, except that a participant who leaves early has fewer
/// entries.
fn strokes_cut(run: &Run) -> Vec<CutStroke> {
    let logs = run.results.iter().map(|l| &l.recording.operations);
    let longest = logs.max_by_key(|log| log.len());
    let strokes = longest.into_iter().flatten().map(|o| o.stroke.clone());
    strokes.flatten().collect()
}

fn file_error(path: &Path, source: std::io::Error) -> DemoError {
    DemoError::File {
        path: path.to_owned(),
        source,
    }
}

fn write(path: &Path, text: &str) -> Result<(), DemoError> {
    write_file(path, text).map_err(|e| file_error(path, e.source))
}

fn script_file(dir: &Path, name: &str) -> PathBuf {
    dir.join(format!("{name}.toml"))
}

/// Number of strokes in a script: intervals with the button pressed.
fn strokes(script: &Script) -> u64 {
    let mut was_held = false;
    let begins = script.waypoints().iter().filter(|way| {
        let begins = way.button && !was_held;
        was_held = way.button;
        begins
    });
    begins.count() as u64
}

/// The session, from the start of the server to its end.
fn session(
    options: &DemoOptions,
    dir: &Path,
    test_model: &TestModel,
    progress: &mut Progress,
    interrupt: &Interrupt,
) -> Result<Run, DemoError> {
    progress.stage(&format!(
        "a server with {} nodes, two trainees, network {}",
        test_model.model.nodes.len(),
        options.profile.name
    ));
    let mut session = Session::start(&Hosting {
        executable: &options.executable,
        model: &test_model.file,
        profile: options.profile.clone(),
        seed: options.seed,
        compensation: &options.compensation,
        start_when: 2,
    })?;
    let mut stress =
        Stress::start(&options.executable, options.stress).map_err(SessionError::from)?;
    let mut participants = Vec::new();
    for name in NAMES {
        let script = script_file(dir, name);
        participants.push(session.join(name, "trainee", Some(&script), dir)?);
    }
    for participant in &mut participants {
        let joined = participant.wait_until_in(&|| interrupt.is_set());
        joined.inspect_err(|_| {
            let said = session.server.tail();
            if !said.is_empty() {
                progress.stage(&format!("server log:\n{said}"));
            }
        })?;
    }
    let beside = match options.stress {
        0 => String::new(),
        n => format!(" beside {n} busy process(es)"),
    };
    progress.stage(&format!(
        "the scripts run for {:.0} s{beside}",
        options.seconds
    ));
    let began = Instant::now();
    let late = START_LEAD + Duration::from_secs_f64(options.seconds * options.late_join);
    let end = START_LEAD + Duration::from_secs_f64(options.seconds) + SETTLE;
    let mut problems = Vec::new();
    let mut has_spectator = false;
    while began.elapsed() < end {
        if interrupt.is_set() {
            return Err(SessionError::Interrupted.into());
        }
        if !has_spectator && began.elapsed() >= late {
            participants.push(session.join(LATE_NAME, "spectator", None, dir)?);
            has_spectator = true;
        }
        session.server.check_alive().map_err(SessionError::from)?;
        stress.check_alive().map_err(SessionError::from)?;
        remove_dead(&mut participants, &mut problems);
        let s = began.elapsed().saturating_sub(START_LEAD).as_secs();
        progress.tick(&format!("{s} of {:.0} s", options.seconds));
        std::thread::sleep(Duration::from_millis(20));
    }
    // On a bad network the late participant may still be joining.
    if let Some(last) = participants
        .iter_mut()
        .find(|p| p.program.name().ends_with(LATE_NAME))
    {
        match last.wait_until_in(&|| interrupt.is_set()) {
            Err(SessionError::Interrupted) => return Err(SessionError::Interrupted.into()),
            // A dead participant is reported when all leave.
            Ok(()) | Err(_) => std::thread::sleep(SETTLE),
        }
    }
    progress.stage("participants leave and write their recordings");
    drop(stress);
    finish(session, participants, problems)
}

/// Removes participants that died; the others continue.
fn remove_dead(participants: &mut Vec<Participant>, problems: &mut Vec<String>) {
    participants.retain_mut(|p| match p.program.check_alive() {
        Ok(()) => true,
        Err(error) => {
            problems.push(error.to_string());
            false
        }
    });
}

fn finish(
    session: Session,
    participants: Vec<Participant>,
    mut problems: Vec<String>,
) -> Result<Run, DemoError> {
    for participant in &participants {
        participant.program.ask_to_end();
    }
    let mut results = Vec::new();
    for participant in participants {
        match participant.leave() {
            Ok(figures) => results.push(figures),
            Err(error) => problems.push(error.to_string()),
        }
    }
    let (host, network) = session.end()?;
    Ok(Run {
        host,
        network,
        results,
        problems,
    })
}

/// The plots of a report.
struct Pictures {
    forces: String,
    views: String,
}

/// Computes the report; the reference comes with its computation time in s.
fn conclude(
    options: &DemoOptions,
    test_model: &TestModel,
    run: Run,
    reference: Result<(Reference, f64), reference::ReferenceError>,
    strokes: u64,
) -> (Report, Pictures) {
    let mut report = Report {
        nodes: test_model.model.nodes.len(),
        seconds: options.seconds,
        stress: options.stress,
        network: run.network,
        problems: run.problems,
        server: run.host.clone(),
        ..Report::default()
    };
    let reference = match reference {
        Ok((reference, seconds)) => {
            report.reference = Some(ReferenceReport::of(&reference, seconds));
            Some(reference)
        }
        Err(error) => {
            report
                .notes
                .push(format!("the reference is missing: {error}"));
            None
        }
    };
    report.participants = run
        .results
        .iter()
        .map(|l| participant(l, reference.as_ref(), options.seconds))
        .collect();
    let recordings: Vec<&Recording> = run.results.iter().map(|l| &l.recording).collect();
    report.delay = DelayFigures::of(&recordings, options.seconds);
    let cpu = run
        .results
        .iter()
        .map(|l| cpu_of(&l.summary.name, &l.summary));
    let cpu = cpu.chain([cpu_of(criteria::SERVER, &run.host)]);
    report.cpu = cpu.flatten().collect();
    report.cut = CutReport {
        strokes,
        operations: run.host.cuts,
        components: run.host.components,
        boundary_closed: run.host.boundary_closed,
        applied_after_ms: applied_after(&recordings),
    };
    let disagreement = Disagreement::between(&recordings);
    let pictures = draw(
        &recordings,
        &report,
        reference.as_ref(),
        &disagreement.over_time,
    );
    report.set_disagreement(&disagreement);
    judge(&mut report, options);
    (report, pictures)
}

/// Judges a report; a note names the criteria that are not judged.
fn judge(report: &mut Report, options: &DemoOptions) {
    let strokes = report.cut.strokes;
    let is_adaptive = options.compensation == "adaptive";
    let delay_limit_ms = delay_figures::limit_ms(&options.profile).filter(|_| is_adaptive);
    let is_covered = delay_figures::is_covered(&options.profile);
    if !is_adaptive {
        let note = "the playout delay D is not judged: the command line sets it";
        report.notes.push(note.to_owned());
    } else if delay_limit_ms.is_none() {
        report.notes.push(format!(
            "the playout delay D is not judged: mean and deviation do not describe the network {}",
            options.profile.name
        ));
    }
    if !is_covered {
        report.notes.push(format!(
            "demotions are not judged: the network {} can need more delay than the cap allows",
            options.profile.name
        ));
    }
    report.judge(&Expected {
        trainees: &NAMES,
        others: &[LATE_NAME],
        strokes,
        delay_limit_ms,
        is_covered,
    });
}

/// Figures of a participant: its summary, and those of its recording.
fn participant(
    result: &ParticipantResult,
    reference: Option<&Reference>,
    seconds: f64,
) -> ParticipantReport {
    let recording = &result.recording;
    let expected = reference_of(&recording.name, reference);
    let points = recording
        .script_started_us
        .map(|began| over_script(&recording.haptic, began));
    let both = points.as_ref().zip(expected);
    let d = recording.dropped;
    let force_error = both.and_then(|(c, r)| ForceError::between(c, r));
    ParticipantReport {
        dropouts: both.and_then(|(c, r)| Dropouts::between(c, r)),
        recording_gap_ms: points.map(|c| longest_gap_ms(&c, seconds)),
        records_dropped: d.haptic + d.views + d.view_nodes + d.operations,
        ..ParticipantReport::of(result.summary.clone(), force_error)
    }
}

/// Reference force of a participant, by name.
fn reference_of<'a>(
    name: &str,
    reference: Option<&'a Reference>,
) -> Option<&'a [crate::force_error::ForcePoint]> {
    let seat = NAMES.iter().position(|n| *n == name)?;
    Some(&reference?.forces[seat])
}

/// Time at which each participant applied the first cut, relative to the first one. Late participants, which
/// receive the cut with the log, are excluded.
fn applied_after(recordings: &[&Recording]) -> Vec<(String, f64)> {
    let cut = |r: &Recording| {
        let cut = r.operations.iter().find(|o| o.version == 1)?;
        let was_there = r.views.first()?.shown_us < cut.applied_us;
        was_there.then_some((r.name.clone(), cut.applied_us))
    };
    let cuts: Vec<(String, i64)> = recordings.iter().filter_map(|r| cut(r)).collect();
    let first = cuts.iter().map(|c| c.1).min().unwrap_or(0);
    cuts.into_iter()
        .map(|(name, us)| (name, (us - first) as f64 * 1e-3))
        .collect()
}

fn draw(
    recordings: &[&Recording],
    report: &Report,
    reference: Option<&Reference>,
    over_time: &[DisagreementPoint],
) -> Pictures {
    let zero_us = recordings
        .iter()
        .find_map(|r| r.script_started_us)
        .or(over_time.first().map(|p| p.t_us))
        .unwrap_or(0);
    let seconds = |us: i64| (us - zero_us) as f64 * 1e-6;
    let mut marks = Vec::new();
    let cuts = recordings.first().into_iter().flat_map(|r| &r.operations);
    let mut version = 0;
    for operation in cuts {
        if operation.version > version {
            version = operation.version;
            marks.push(Mark {
                x: seconds(operation.applied_us),
                label: "cut applied".to_owned(),
            });
        }
    }
    let late = recordings.iter().find(|r| r.name == LATE_NAME);
    if let Some(view) = late.and_then(|r| r.views.first()) {
        marks.push(Mark {
            x: seconds(view.shown_us),
            label: "spectator joins".to_owned(),
        });
    }
    let forces: Vec<_> = recordings
        .iter()
        .filter_map(|r| {
            Some((
                r.name.as_str(),
                over_script(&r.haptic, r.script_started_us?),
            ))
        })
        .collect();
    let dropouts_of = |name: &str| {
        let of = report.participants.iter().find(|p| p.summary.name == name);
        of.and_then(|p| p.dropouts.as_ref())
            .map_or(&[][..], |d| &d.spans_s)
    };
    let trainees: Vec<TraineeForces<'_>> = forces
        .iter()
        .map(|(name, session)| TraineeForces {
            name,
            session,
            reference: reference_of(name, reference).unwrap_or_default(),
            dropouts: dropouts_of(name),
        })
        .collect();
    Pictures {
        forces: plots::forces(&trainees, marks.clone()).to_svg(),
        views: plots::views(over_time, zero_us, marks).to_svg(),
    }
}

impl Pictures {
    fn write(&self, dir: &Path, report: &Report) -> Result<(), DemoError> {
        let json = serde_json::to_string_pretty(report).expect("a report is plain data");
        let text = format!("{report}\n\n{}\n", crate::report::DEFINITIONS);
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    title { "Palpate demo" }
                }
                body style="font-family:sans-serif;max-width:1000px;margin:auto" {
                    h1 { "Palpate demo" }
                    pre style="overflow-x:auto" { (text) }
                    @for chart in [&self.forces, &self.views] { (PreEscaped(chart)) }
                }
            }
        };
        write(&dir.join("report.json"), &json)?;
        write(&dir.join("report.txt"), &text)?;
        write(&dir.join("report.html"), &page.into_string())?;
        write(&dir.join("force.svg"), &self.forces)?;
        write(&dir.join("view_disagreement.svg"), &self.views)
    }
}
