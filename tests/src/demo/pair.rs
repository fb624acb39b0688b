//! The two scripted trainees of a session: their scripts, their processes and their figures.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use palpate_device::Script;
use palpate_site::OperationRecord;
use palpate_tissue::file::write_file;

use super::DemoError;
use crate::dropout::{Dropouts, longest_gap_ms};
use crate::force_error::{ForceError, ForcePoint, over_script};
use crate::progress::{Interrupt, Progress};
use crate::reference::{self, Reference, ReferenceError, TimedCut};
use crate::report::ParticipantReport;
use crate::scripts::{Exercise, Scripts};
use crate::session::{Participant, ParticipantResult, Session, SessionError};
use crate::test_model::TestModel;

/// Time from the last join to the start of the scripts, as in the room.
pub(crate) const START_LEAD: Duration = Duration::from_secs(1);

/// Time after the scripts until the participants leave: packets arrive and views are shown.
pub(crate) const SETTLE: Duration = Duration::from_millis(1500);

/// The trainees, in script order.
pub(crate) const NAMES: [&str; 2] = ["holder", "cutter"];

/// The model and the scripts of both trainees, written into a folder.
pub(crate) struct Pair {
    pub(crate) test_model: TestModel,
    pub(crate) scripts: [Script; 2],
    dir: PathBuf,
}

impl Pair {
    /// Prepares a model and writes scripts of `seconds` for an exercise on it into `dir`.
    pub(crate) fn prepare(
        model: &str,
        (exercise, seconds): (Exercise, f64),
        dir: &Path,
        progress: &mut Progress,
    ) -> Result<Self, DemoError> {
        progress.stage(&format!("preparing the model {model}"));
        let test_model = TestModel::prepare(model, dir)?;
        let scripts = Scripts::of(exercise, &test_model.model, seconds)?;
        let files = [&scripts.holder, &scripts.cutter].map(Script::to_toml);
        for (name, text) in NAMES.iter().zip(&files) {
            write(&script_file(dir, name), text)?;
        }
        // Both sides use the rounded numbers of the file.
        let read = |text| Script::from_toml(text).map_err(|e| e.to_string());
        Ok(Self {
            test_model,
            scripts: [read(&files[0])?, read(&files[1])?],
            dir: dir.to_owned(),
        })
    }

    /// Starts both trainees and waits until they have joined.
    pub(crate) fn join(
        &self,
        session: &Session,
        progress: &mut Progress,
        interrupt: &Interrupt,
    ) -> Result<Vec<Participant>, DemoError> {
        let mut participants = Vec::new();
        for name in NAMES {
            let script = script_file(&self.dir, name);
            participants.push(session.join(name, "trainee", Some(&script), &self.dir)?);
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
        Ok(participants)
    }

    /// Number of strokes in both scripts.
    pub(crate) fn strokes(&self) -> u64 {
        self.scripts.iter().map(strokes).sum()
    }

    /// The same hands without a network, with the cuts of a session, and the computation time in s.
    pub(crate) fn reference(
        &self,
        results: &[ParticipantResult],
        progress: &mut Progress,
        interrupt: &Interrupt,
    ) -> Result<Result<(Reference, f64), ReferenceError>, DemoError> {
        progress.stage("computing the reference: the same hands without a network");
        let began = Instant::now();
        let cuts = parts_cut(results);
        let both = [&self.scripts[0], &self.scripts[1]];
        let reference = reference::run(&self.test_model.model, both, &cuts, |share| {
            progress.tick(&format!("{:.0} %", share * 100.0));
            !interrupt.is_set()
        });
        if interrupt.is_set() {
            return Err(SessionError::Interrupted.into());
        }
        Ok(reference.map(|r| (r, began.elapsed().as_secs_f64())))
    }
}

/// The parts of strokes that the session cut. All logs are equal, except that a participant who leaves early has fewer
/// entries.
fn parts_cut(results: &[ParticipantResult]) -> Vec<TimedCut> {
    let logs = results.iter().map(|l| &l.recording.operations);
    let longest: &[OperationRecord] = logs.max_by_key(|log| log.len()).map_or(&[], |log| log);
    let Some(zero_us) = longest.iter().find_map(|o| o.script_at_us) else {
        return Vec::new();
    };
    let cut = |o: &OperationRecord| {
        Some(TimedCut {
            at_s: (o.at_us - zero_us) as f64 * 1e-6,
            part: o.stroke.clone()?,
        })
    };
    longest.iter().filter_map(cut).collect()
}

pub(crate) fn file_error(path: &Path, source: std::io::Error) -> DemoError {
    DemoError::File {
        path: path.to_owned(),
        source,
    }
}

pub(super) fn write(path: &Path, text: &str) -> Result<(), DemoError> {
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

/// Removes participants that died; the others continue.
pub(crate) fn remove_dead(participants: &mut Vec<Participant>, problems: &mut Vec<String>) {
    participants.retain_mut(|p| match p.program.check_alive() {
        Ok(()) => true,
        Err(error) => {
            problems.push(error.to_string());
            false
        }
    });
}

/// Requests all participants to leave and collects their results.
pub(crate) fn leave(
    participants: Vec<Participant>,
    problems: &mut Vec<String>,
) -> Vec<ParticipantResult> {
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
    results
}

/// Figures of a participant: its summary, and those of its recording.
pub(crate) fn figures(
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
pub(super) fn reference_of<'a>(
    name: &str,
    reference: Option<&'a Reference>,
) -> Option<&'a [ForcePoint]> {
    let seat = NAMES.iter().position(|n| *n == name)?;
    Some(&reference?.forces[seat])
}
