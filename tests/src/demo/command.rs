//! `palpate-lab demo`.

use std::path::PathBuf;

use super::DemoOptions;
use crate::cli::{networks, note, print_line};
use crate::progress::{Interrupt, Progress};

/// Report folder without `--report`.
const REPORT_DIR: &str = "palpate-report";

/// Text at the end of `demo --help`.
pub(crate) const HELP: &str = concat!(
    "\
The demo starts a server and two clients as separate processes, with an emulated network between them. Each client
moves a simulated hand along a script: the holder presses and holds; the cutter presses, cuts between the two locations,
and presses beside the wound. With --needle the holder inserts a needle twice. A spectator joins late. The reference simulates the same hands without a network; a force
that differs from it was changed by the network or by a slow machine.

The demo takes the length of the scripts plus the time of the reference. It prints a summary of ten lines. The report
folder has report.html (open it first: figures, definitions, plots), the same as text, JSON and SVG, and the recordings.

Each figure below that is missing or beyond its limit is a line \"FAILED: criterion, value, limit\":
  force error 10 % rms; dropouts (force below 80 % for more than 20 ms in contact) 40 ms, with --stress 60 ms
  playout delay D 20 ms, or 1.3 times (round trip + 4 standard deviations of its jitter) if that is more; networks with
    bursts, steps or outages are not judged by D
  no demotion to spectator where round trip and jitter are below the 400 ms cap
  with --needle: both insertions, and each site shows another state than the holder's for 100 ms at most
  no lost cut, no dead process, equal topologies, contact of both hands, nothing left out of recordings and reference

Examples:
  palpate-lab demo                                      the thigh over the Atlantic, 20 s
  palpate-lab demo --profile lan --seed 2
  palpate-lab demo --needle                             a needle, felt by its holder and seen by all
  palpate-lab demo --stress 2                           with two busy processes beside it
  palpate-lab demo --model scene.toml --seconds 60 --report out
  palpate-lab demo --json > report.json                 for programs: no files, no summary

",
    networks!(),
    "

The exit code is 0 when every criterion is met, 2 when the command line is wrong, 1 otherwise."
);

/// Runs `demo`.
pub(crate) fn run(mut options: DemoOptions) -> Result<bool, String> {
    let interrupt = Interrupt::listen()?;
    options.executable = std::env::current_exe()
        .map_err(|e| format!("cannot find the path of this program: {e}"))?;
    if !options.json {
        options.report.get_or_insert(PathBuf::from(REPORT_DIR));
    }
    let mut progress = Progress::new();
    let report = super::run(&options, &mut progress, &interrupt).map_err(|e| e.to_string())?;
    drop(progress);
    if options.json {
        let json = serde_json::to_string(&report).expect("a report is plain data");
        print_line(&json)?;
    } else {
        print_line(&format!("\n{}", report.summary()))?;
    }
    if let Some(dir) = &options.report {
        note(&format!(
            "details, definitions and plots: {}",
            dir.join("report.html").display()
        ));
    }
    Ok(report.ok)
}
