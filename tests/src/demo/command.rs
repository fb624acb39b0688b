//! `palpate-lab demo`.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::DemoOptions;
use crate::cli::{networks, note, print_line};
use crate::network::Profile;
use crate::progress::{Interrupt, Progress};
use crate::stress::PROCESSES_MAX;

/// Report folder without `--report`.
const REPORT_DIR: &str = "palpate-report";

/// Text at the end of `demo --help`.
pub(crate) const HELP: &str = concat!(
    "\
The demo starts a server and two clients as separate processes, with an emulated network between them. Each client
moves a simulated hand along a script: the holder presses and holds; the cutter presses, cuts between the two locations,
and presses beside the wound. A spectator joins late. The reference simulates the same hands without a network; a force
that differs from it was changed by the network or by a slow machine.

The demo takes the length of the scripts plus the time of the reference. It prints a summary of ten lines. The report
folder has report.html (open it first: figures, definitions, plots), the same as text, JSON and SVG, and the recordings.

Each figure below that is missing or beyond its limit is a line \"FAILED: criterion, value, limit\":
  force error 10 % rms; dropouts (force below 80 % for more than 20 ms in contact) 40 ms, with --stress 60 ms
  playout delay D 20 ms, or 1.3 times (round trip + 4 standard deviations of its jitter) if that is more; networks with
    bursts, steps or outages are not judged by D
  no demotion to spectator where round trip and jitter are below the 400 ms cap
  no lost cut, no dead process, equal topologies, contact of both hands, nothing left out of recordings and reference

Examples:
  palpate-lab demo                                      the thigh over the Atlantic, 20 s
  palpate-lab demo --profile lan --seed 2
  palpate-lab demo --stress 2                           with two busy processes beside it
  palpate-lab demo --model scene.toml --seconds 60 --report out
  palpate-lab demo --json > report.json                 for programs: no files, no summary

",
    networks!(),
    "

The exit code is 0 when every criterion is met, 2 when the command line is wrong, 1 otherwise."
);

/// Arguments of `demo`.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(long, default_value = "thigh")]
    model: String,
    /// Length of the scripts, 4 to 600 s
    #[arg(long, default_value_t = 20.0, value_name = "S")]
    seconds: f64,
    /// The network between server and clients
    #[arg(long, default_value = "transatlantic", value_parser = Profile::parse)]
    profile: Profile,
    /// Seed of the packet fates
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Artificial time compensation: adaptive, fixed:MS or none
    #[arg(long, default_value = "adaptive", value_name = "MODE")]
    compensation: String,
    /// Busy processes of ordinary priority beside the session: dropouts may then last 60 ms instead of 40
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=i64::from(PROCESSES_MAX)))]
    stress: u16,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
    /// Folder of report.txt, report.json, report.html and the plots [default: palpate-report; none with --json]
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// The share of the scripts after which the spectator joins
    #[arg(long, default_value_t = 0.4, hide = true)]
    late_join: f64,
}

/// Runs `demo`.
pub(crate) fn run(arguments: Arguments) -> Result<ExitCode, String> {
    let interrupt =
        Interrupt::listen().map_err(|e| format!("cannot install the signal handlers: {e}"))?;
    let executable = std::env::current_exe()
        .map_err(|e| format!("cannot find the path of this program: {e}"))?;
    let wants_files = arguments.report.is_some() || !arguments.json;
    let report_dir = wants_files.then(|| {
        arguments
            .report
            .unwrap_or_else(|| PathBuf::from(REPORT_DIR))
    });
    let options = DemoOptions {
        executable,
        model: arguments.model,
        seconds: arguments.seconds,
        profile: arguments.profile,
        seed: arguments.seed,
        compensation: arguments.compensation,
        late_join: arguments.late_join,
        stress: arguments.stress,
        report: report_dir,
    };
    let mut progress = Progress::new();
    let report = super::run(&options, &mut progress, &interrupt).map_err(|e| e.to_string())?;
    drop(progress);
    if arguments.json {
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
    Ok(if report.ok {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
