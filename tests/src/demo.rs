//! The main use case from end to end: two trainees press and cut one model over a bad network, a spectator
//! joins late, and a report judges the session.

pub(crate) mod command;
pub(crate) mod pair;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use maud::{DOCTYPE, PreEscaped, html};
use palpate_client::Recording;
use palpate_server::host::HostSummary;
use palpate_view::{SERVER_VIEW, parse_view};

use crate::chart::Mark;
use crate::cpu::cpu_of;
use crate::criteria::{self, Expected};
use crate::delay_figures::{self, DelayFigures};
use crate::disagreement::{Disagreement, DisagreementPoint};
use crate::force_error::over_script;
use crate::insertions::Insertions;
use crate::plots::{self, TraineeForces};
use crate::progress::{Interrupt, Progress};
use crate::reference::{Reference, ReferenceError};
use crate::relay::{Profile, RelayStats};
use crate::report::{CutLateness, CutReport, ReferenceReport, Report};
use crate::scripts::{Exercise, INSERTIONS, SECONDS_MAX, SECONDS_MIN};
use crate::session::{Hosting, ParticipantResult, Session, SessionError};
use crate::stress::{PROCESSES_MAX, Stress};
use pair::{NAMES, Pair, SETTLE, START_LEAD, file_error, remove_dead};

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
    /// Both trainees cut across each other all the time, instead of one press and one cut
    #[arg(long)]
    pub crossing: bool,
    /// The holder inserts a needle twice, instead of pressing a probe
    #[arg(long, conflicts_with = "crossing")]
    pub needle: bool,
    /// Show the session in a browser, as its instructor, and keep it open until Ctrl-C
    #[arg(long, value_name = "[ADDRESS:]PORT", num_args = 0..=1, default_missing_value = SERVER_VIEW, value_parser = parse_view)]
    pub view: Option<SocketAddr>,
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

impl DemoOptions {
    fn exercise(&self) -> Exercise {
        match (self.crossing, self.needle) {
            (true, _) => Exercise::Crossing,
            (false, true) => Exercise::Needle,
            (false, false) => Exercise::Press,
        }
    }
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
    let scripts = (options.exercise(), options.seconds);
    let pair = Pair::prepare(&options.model, scripts, dir, progress)?;
    let (played, mut session) = play(options, dir, &pair, progress, interrupt)?;
    let (run, reference) = if options.view.is_some() {
        let reference = pair.reference(&played.results, progress, interrupt)?;
        stay(&mut session, progress, interrupt)?;
        (played.end(session)?, reference)
    } else {
        // First, so that the server's figures end with the session.
        let run = played.end(session)?;
        let reference = pair.reference(&run.results, progress, interrupt)?;
        (run, reference)
    };
    progress.stage("comparing the recordings");
    let (report, pictures) = conclude(options, &pair, run, reference);
    if let Some(dir) = &options.report {
        pictures.write(dir, &report)?;
    }
    Ok(report)
}

/// Keeps a session with a page open until Ctrl-C.
fn stay(
    session: &mut Session,
    progress: &mut Progress,
    interrupt: &Interrupt,
) -> Result<(), DemoError> {
    let page = session.page().unwrap_or_default();
    progress.stage(&format!(
        "the session stays open; end with Ctrl-C, which prints the report: {page}"
    ));
    while !interrupt.is_set() {
        session.server.check_alive().map_err(SessionError::from)?;
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// Plays the scripts, from the start of the server until the participants have left.
fn play(
    options: &DemoOptions,
    dir: &Path,
    pair: &Pair,
    progress: &mut Progress,
    interrupt: &Interrupt,
) -> Result<(Played, Session), DemoError> {
    progress.stage(&format!(
        "a server with {} nodes, two trainees, network {}",
        pair.test_model.model.nodes.len(),
        options.profile.name
    ));
    let mut session = Session::start(&Hosting {
        executable: &options.executable,
        model: &pair.test_model.file,
        profile: options.profile.clone(),
        seed: options.seed,
        compensation: &options.compensation,
        start_when: 2,
        view: options.view,
        seats: None,
    })?;
    if let Some(page) = session.page() {
        progress.stage(&format!("the session in a browser: {page}"));
        // Without a browser the printed address serves another one.
        let _ = open::that_detached(page);
    }
    let mut stress =
        Stress::start(&options.executable, options.stress).map_err(SessionError::from)?;
    let mut participants = pair.join(&session, progress, interrupt)?;
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
    let results = pair::leave(participants, &mut problems);
    Ok((Played { results, problems }, session))
}

/// Results of the participants.
struct Played {
    results: Vec<ParticipantResult>,
    problems: Vec<String>,
}

impl Played {
    fn end(self, session: Session) -> Result<Run, DemoError> {
        let (host, network) = session.end()?;
        Ok(Run {
            host,
            network,
            results: self.results,
            problems: self.problems,
        })
    }
}

/// The plots of a report.
struct Pictures {
    forces: String,
    views: String,
}

/// Computes the report; the reference comes with its computation time in s.
fn conclude(
    options: &DemoOptions,
    pair: &Pair,
    run: Run,
    reference: Result<(Reference, f64), ReferenceError>,
) -> (Report, Pictures) {
    let mut report = Report {
        nodes: pair.test_model.model.nodes.len(),
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
        .map(|l| pair::figures(l, reference.as_ref(), options.seconds))
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
        strokes: pair.strokes(),
        operations: run.host.cuts,
        components: run.host.components,
        boundary_closed: run.host.boundary_closed,
        late_ms: recordings.iter().map(|r| CutLateness::of(r)).collect(),
    };
    if options.needle
        && let Some(holder) = recordings.iter().find(|r| r.name == NAMES[0])
    {
        let seen = recordings.iter().map(|r| Insertions::of(r, holder));
        report.insertions = seen.collect();
    }
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
    if options.needle {
        let note =
            "the residual of the reference is not judged with a needle; its estimated error is";
        report.notes.push(note.to_owned());
    }
    report.judge(&Expected {
        trainees: &NAMES,
        others: &[LATE_NAME],
        strokes,
        insertions: if options.needle { INSERTIONS } else { 0 },
        delay_limit_ms,
        is_covered,
    });
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
    let operations = recordings.first().into_iter().flat_map(|r| &r.operations);
    let mut began = None;
    for operation in operations {
        let stroke = operation.stroke.as_ref().map(|part| part.began);
        // One mark per stroke, at its first part.
        if stroke.is_some() && began != stroke {
            began = stroke;
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
            reference: pair::reference_of(name, reference).unwrap_or_default(),
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
        pair::write(&dir.join("report.json"), &json)?;
        pair::write(&dir.join("report.txt"), &text)?;
        pair::write(&dir.join("report.html"), &page.into_string())?;
        pair::write(&dir.join("force.svg"), &self.forces)?;
        pair::write(&dir.join("view_disagreement.svg"), &self.views)
    }
}
