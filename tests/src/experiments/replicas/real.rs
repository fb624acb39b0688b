//! The same sessions in real time: a server and two client processes over QUIC and a relay.

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::sleep;
use std::time::Duration;

use palpate_tissue::Model;

use super::tally::{SessionRecord, Tally};
use crate::experiments::Bench;
use crate::network::Profile;
use crate::session::{Hosting, Participant, ParticipantResult, Session, SessionError};
use crate::test_model::TestModel;

/// Time beyond the scripts' length: their start after both clients have joined, and packets in flight at
/// the end.
const AROUND: Duration = Duration::from_millis(2500);

/// Runs `n` sessions one after the other; `compared` evaluates a session.
pub(super) fn sessions(
    bench: &mut Bench<'_>,
    model: &Arc<Model>,
    scripts: &[String; 2],
    profile: &Profile,
    n: u64,
    compared: impl Fn(SessionRecord, u64) -> Result<Tally, String>,
) -> Result<Tally, String> {
    let executable = std::env::current_exe()
        .map_err(|e| format!("cannot find this program's executable: {e}"))?;
    let built = TestModel::of(Model::clone(model), bench.dir)?;
    let mut files = Vec::new();
    for (name, text) in NAMES.into_iter().zip(scripts) {
        let file = bench.dir.join(format!("{name}.toml"));
        std::fs::write(&file, text).map_err(|e| format!("{}: {e}", file.display()))?;
        files.push(file);
    }
    let mut tally = Tally::default();
    for k in 0..n {
        (bench.progress)("real-time sessions over QUIC", k as f64 / n as f64);
        let hosting = Hosting {
            executable: &executable,
            model: &built.file,
            profile: profile.clone(),
            seed: bench.seed().wrapping_mul(1_000_003).wrapping_add(k),
            compensation: "adaptive",
            start_when: 2,
            view: None,
            seats: None,
        };
        let record = session(&hosting, &files, bench).map_err(|e| e.to_string())?;
        tally = tally.join(compared(record, k)?);
    }
    Ok(tally)
}

const NAMES: [&str; 2] = ["holder", "cutter"];

fn session(
    hosting: &Hosting<'_>,
    scripts: &[PathBuf],
    bench: &Bench<'_>,
) -> Result<SessionRecord, SessionError> {
    let session = Session::start(hosting)?;
    let mut participants = Vec::new();
    for (name, script) in NAMES.into_iter().zip(scripts) {
        participants.push(session.join(name, "trainee", Some(script), bench.dir)?);
    }
    for participant in &mut participants {
        participant.wait_until_in(&|| false)?;
    }
    sleep(AROUND + Duration::from_secs_f64(super::SECONDS));
    for participant in &participants {
        participant.program.ask_to_end();
    }
    let results: Result<Vec<ParticipantResult>, _> =
        participants.into_iter().map(Participant::leave).collect();
    let results = results?;
    let (host, _) = session.end()?;
    let hashes_equal = results
        .iter()
        .all(|r| r.summary.topology_hash == host.topology_hash);
    let mut recordings = results.into_iter().map(|r| r.recording);
    Ok(SessionRecord {
        recordings: std::array::from_fn(|_| recordings.next().unwrap_or_default()),
        hashes_equal,
        bytes_per_s: None,
        stalls: None,
        troubles: Vec::new(),
    })
}
