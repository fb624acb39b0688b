//! The same sessions in real time: a server and two client processes over QUIC and a relay.

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::sleep;
use std::time::Duration;

use palpate_tissue::Model;

use super::tally::{Sat, Tally};
use crate::experiments::Bench;
use crate::network::Profile;
use crate::session::{Hosting, Left, Participant, Session, SessionError};
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
    compared: impl Fn(Sat, u64) -> Result<Tally, String>,
) -> Result<Tally, String> {
    let executable = std::env::current_exe()
        .map_err(|e| format!("cannot find this program's executable: {e}"))?;
    let subject = TestModel::of(Model::clone(model), bench.dir).map_err(|e| e.to_string())?;
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
            model: &subject.file,
            profile: profile.clone(),
            seed: bench.seed.wrapping_mul(1_000_003).wrapping_add(k),
            compensation: "adaptive",
            start_when: 2,
        };
        let sat = session(&hosting, &files, bench).map_err(|e| e.to_string())?;
        tally = tally.join(compared(sat, k)?);
    }
    Ok(tally)
}

const NAMES: [&str; 2] = ["holder", "cutter"];

fn session(
    hosting: &Hosting<'_>,
    scripts: &[PathBuf],
    bench: &Bench<'_>,
) -> Result<Sat, SessionError> {
    let session = Session::start(hosting)?;
    let mut people = Vec::new();
    for (name, script) in NAMES.into_iter().zip(scripts) {
        people.push(session.join(name, "trainee", Some(script), bench.dir)?);
    }
    for participant in &mut people {
        participant.wait_until_in(&|| false)?;
    }
    sleep(AROUND + Duration::from_secs_f64(super::SECONDS));
    for participant in &people {
        participant.program.ask_to_end();
    }
    let left: Result<Vec<Left>, _> = people.into_iter().map(Participant::leave).collect();
    let left = left?;
    let (host, _) = session.end()?;
    let hashes_equal = left
        .iter()
        .all(|l| l.summary.topology_hash == host.topology_hash);
    let mut recordings = left.into_iter().map(|l| l.recording);
    Ok(Sat {
        recordings: std::array::from_fn(|_| recordings.next().unwrap_or_default()),
        hashes_equal,
        bytes_per_s: None,
        troubles: Vec::new(),
    })
}
