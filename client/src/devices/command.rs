//! `palpate-client devices`: list, test, calibrate, plot.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Subcommand, ValueEnum};
use palpate_device::backend::sim::ScriptStart;
use palpate_device::conformance::{self, Outcome, Report};
use palpate_device::{Calibration, ClockOwner, DeviceTime, HapticDevice};
use palpate_protocol::Span;
use serde_json::json;

use super::{DeviceKind, Guide, open, plot};
use crate::realtime::{device_time, monotonic_now, sleep_until};

/// From tick to tick while hardware is tested.
const TICK: Span = Span::from_millis(1);

/// What `devices --help` shows at its end.
const EXAMPLES: &str = "\
Examples:
  Which devices this program drives, and what they can do:
    palpate-client devices

  Whether one of them keeps all laws of a haptic device (hold nothing, and do not touch it):
    palpate-client devices test five-dof

  Where the 5-DOF device can hold its probe, and how far from singular postures:
    palpate-client devices plot five-dof -o pictures";

/// Arguments of `devices`.
#[derive(Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct DevicesArguments {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// List them (the same as without a word)
    List {
        /// Print them as one JSON object
        #[arg(long)]
        json: bool,
    },
    /// Run the suite that every haptic device has to pass, and print its table
    Test {
        /// Which device
        device: DeviceKind,
        /// Print the table as one JSON object
        #[arg(long)]
        json: bool,
    },
    /// Do the calibration that this program can do, and say what is left to you
    Calibrate {
        /// Which device
        device: DeviceKind,
    },
    /// Draw where a device can go (SVG)
    Plot {
        /// Which device
        device: Plotted,
        /// The folder to write to; it is made when it is not there
        #[arg(short, long, value_name = "DIR")]
        output: PathBuf,
    },
}

/// Devices with a linkage to be drawn.
#[derive(Clone, Copy, ValueEnum)]
enum Plotted {
    /// The 5-DOF device of 2007
    FiveDof,
}

/// The command. Errors are said on standard error.
pub(crate) fn run(arguments: DevicesArguments) -> ExitCode {
    let done = match arguments.command.unwrap_or(Command::List { json: false }) {
        Command::List { json } => {
            list(json);
            Ok(())
        }
        Command::Test { device, json } => test(device, json),
        Command::Calibrate { device } => calibrate(device),
        Command::Plot {
            device: Plotted::FiveDof,
            output,
        } => plot::five_dof(&output).map(|file| say(&format!("{}\n", file.display()))),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            // Nothing is left to be told if standard error is gone.
            let _ = writeln!(std::io::stderr(), "palpate-client: {why}");
            ExitCode::FAILURE
        }
    }
}

/// Done, or a sentence that says why not.
type Done = Result<(), String>;

/// Writes to standard output; a reader that went away wants no more.
fn say(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}

/// The width of a device's word in the list.
const WORD: usize = 10;

/// A device that rests.
fn at_rest(kind: DeviceKind) -> Result<Box<dyn HapticDevice>, String> {
    let guide = if kind.is_steered() {
        Guide::held()
    } else {
        Guide::at_rest(kind == DeviceKind::Replay)?
    };
    open(kind, &guide, ScriptStart::not_yet()).map_err(|e| e.to_string())
}

fn list(json: bool) {
    let mut rows = Vec::new();
    for (kind, sentence) in DeviceKind::ALL {
        let mut device = match at_rest(kind) {
            Ok(device) => device,
            Err(why) => {
                rows.push(absent(kind, sentence, &why, json));
                continue;
            }
        };
        let caps = device.caps();
        let side = (caps.workspace.max - caps.workspace.min).min();
        if json {
            rows.push(json!({
                "device": kind.word(), "is": sentence, "name": caps.name, "present": true,
                "dof_in": caps.dof_in, "dof_out": caps.dof_out,
                "max_force_n": caps.max_force_n, "continuous_force_n": caps.continuous_force_n,
                "max_torque_nm": caps.max_torque_nm,
                "max_stiffness_n_per_m": caps.max_stiffness_n_per_m,
                "workspace_m": side, "rate_hz": caps.rate_hz,
                "clock": clock_word(device.clock()), "calibration": calibration_word(device.calibration()),
            }));
        } else {
            let forces = if caps.dof_out == 0 {
                format!("{} degrees of freedom, no force", caps.dof_in)
            } else {
                format!(
                    "{} of {} degrees of freedom push, up to {} N ({} N held) and {} N·m, {} N/m",
                    caps.dof_out,
                    caps.dof_in,
                    caps.max_force_n,
                    caps.continuous_force_n,
                    caps.max_torque_nm,
                    caps.max_stiffness_n_per_m,
                )
            };
            rows.push(json!(format!(
                "{:<WORD$} {sentence}\n{:<WORD$} {forces}; {:.0} mm to move in; {}\n",
                kind.word(),
                "",
                side * 1e3,
                calibration_word(device.calibration()),
            )));
        }
        device.close();
    }
    if json {
        say(&format!("{}\n", json!({ "devices": rows })));
    } else {
        say(&rows.iter().filter_map(|r| r.as_str()).collect::<String>());
    }
}

/// A row for a device that can not be opened now.
fn absent(kind: DeviceKind, sentence: &str, why: &str, json: bool) -> serde_json::Value {
    if json {
        json!({ "device": kind.word(), "is": sentence, "present": false, "why": why })
    } else {
        json!(format!(
            "{:<WORD$} {sentence}\n{:<WORD$} not here: {why}\n",
            kind.word(),
            ""
        ))
    }
}

fn clock_word(clock: ClockOwner) -> &'static str {
    match clock {
        ClockOwner::Ours => "ours",
        ClockOwner::DeviceCallback => "device callback",
        ClockOwner::ReplyPerMessage => "reply per message",
    }
}

fn calibration_word(calibration: Calibration) -> &'static str {
    match calibration {
        Calibration::NotNeeded => "no calibration needed",
        Calibration::Done => "calibrated",
        Calibration::NeedsUser => "not calibrated",
        Calibration::InProgress => "calibrating",
    }
}

fn test(kind: DeviceKind, json: bool) -> Done {
    let mut device = at_rest(kind)?;
    let mut us = 0;
    let mut due = monotonic_now();
    let mut clock = || {
        if kind.is_steered() {
            due = due + TICK;
            sleep_until(due);
            return device_time(monotonic_now());
        }
        // No hardware is behind the others, so time may run as fast as it can.
        us += 1000;
        DeviceTime::from_micros(us)
    };
    let options = conformance::Options {
        moves_under_force: !kind.is_steered() && kind != DeviceKind::Replay,
    };
    let report = conformance::run(device.as_mut(), &mut clock, options);
    if json {
        say(&format!("{}\n", as_json(kind, &report)));
    } else {
        say(&report.to_string());
    }
    if report.passed() {
        Ok(())
    } else {
        Err(format!("{} breaks a law of haptic devices", kind.word()))
    }
}

fn as_json(kind: DeviceKind, report: &Report) -> serde_json::Value {
    let rows = report.rows().iter().map(|row| {
        let (outcome, why) = match &row.outcome {
            Outcome::Passed => ("passed", None),
            Outcome::Skipped(why) => ("skipped", Some((*why).to_owned())),
            Outcome::Failed(why) => ("failed", Some(why.clone())),
        };
        json!({ "law": row.law, "outcome": outcome, "why": why })
    });
    json!({ "device": kind.word(), "passed": report.passed(), "laws": rows.collect::<Vec<_>>() })
}

fn calibrate(kind: DeviceKind) -> Done {
    let mut device = at_rest(kind)?;
    let state = device
        .calibrate()
        .map_err(|e| format!("{}: {e}", kind.word()))?;
    device.close();
    match state {
        Calibration::NotNeeded | Calibration::Done => {
            say(&format!("{}: {}\n", kind.word(), calibration_word(state)));
            Ok(())
        }
        Calibration::NeedsUser | Calibration::InProgress => Err(format!(
            "{} is {}; follow its maker's procedure, then try again",
            kind.word(),
            calibration_word(state)
        )),
    }
}
