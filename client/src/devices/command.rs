//! `palpate-client devices`: list, test, calibrate, plot.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Subcommand, ValueEnum};
use palpate_device::backend::Found;
use palpate_device::backend::sim::ScriptStart;
use palpate_device::conformance::{self, Outcome, Report};
use palpate_device::{Calibration, ClockOwner, DeviceCaps, DeviceTime, HapticDevice};
use palpate_protocol::Span;
use serde_json::json;

use super::{DeviceKind, DeviceSelection, Guide, Opened, Sources, open, owned, plot};
use crate::program::{complain, print};
use crate::realtime::{device_time, monotonic_now, sleep_until};

/// Tick period while hardware is tested.
const TICK: Span = Span::from_millis(1);

/// Column width of the device word in the list.
const WORD: usize = 12;

/// Examples at the end of `devices --help`.
const EXAMPLES: &str = "\
Examples:
  Which devices this program drives, and what they can do:
    palpate-client devices

  Calibrate the omega that is plugged in; it moves by itself, so keep your hands off:
    palpate-client devices calibrate dhd

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
    /// List devices (default)
    List {
        /// Print the list as one JSON object
        #[arg(long)]
        json: bool,
    },
    /// Run the conformance suite of haptic devices and print its table
    Test {
        /// The device; haply:ID if several are connected
        device: DeviceSelection,
        /// Print the table as one JSON object
        #[arg(long)]
        json: bool,
    },
    /// Run the automatic part of the calibration and print the remaining manual steps
    Calibrate {
        /// The device; haply:ID if several are connected
        device: DeviceSelection,
    },
    /// Plot the workspace of a device (SVG)
    Plot {
        /// The device
        device: Plotted,
        /// Output folder; created if it does not exist
        #[arg(short, long, value_name = "DIR")]
        output: PathBuf,
    },
}

/// Devices with a plottable linkage.
#[derive(Clone, Copy, ValueEnum)]
enum Plotted {
    /// The 5-DOF device of 2007
    FiveDof,
}

/// Runs the command. Errors are printed on standard error.
pub(crate) fn run(arguments: DevicesArguments) -> ExitCode {
    let done = match arguments.command.unwrap_or(Command::List { json: false }) {
        Command::List { json } => list(json),
        Command::Test { device, json } => test(&device, json),
        Command::Calibrate { device } => calibrate(&device),
        Command::Plot {
            device: Plotted::FiveDof,
            output,
        } => plot::five_dof(&output).and_then(|file| print(&format!("{}\n", file.display()))),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            complain(&why);
            ExitCode::FAILURE
        }
    }
}

/// Success, or an error message.
type Done = Result<(), String>;

/// A device at rest.
fn at_rest(choice: &DeviceSelection) -> Result<Opened, String> {
    let sources = Sources::from_environment();
    let guide = if choice.kind.is_held() {
        Guide::held(None, choice.kind)
    } else {
        Guide::at_rest(choice.kind == DeviceKind::Replay)?
    };
    open(choice, &guide, ScriptStart::not_yet(), &sources).map_err(|e| e.to_string())
}

fn list(json: bool) -> Done {
    let sources = Sources::from_environment();
    let mut rows = Vec::new();
    for (kind, sentence) in DeviceKind::ALL {
        let found = owned::find(kind, &sources).map_err(|why| why.to_string());
        let several = found.as_ref().is_ok_and(|found| found.len() > 1);
        let choice = DeviceSelection { kind, which: None };
        let opened = match &found {
            Err(why) => Err(why.clone()),
            // With several devices the choice is ambiguous, so none is opened.
            Ok(_) if several => Ok(None),
            Ok(_) => at_rest(&choice).map(Some),
        };
        let found = found.unwrap_or_default();
        rows.push(match (opened, json) {
            (Err(why), true) => {
                json!({ "device": kind.word(), "is": sentence, "present": false, "why": why })
            }
            (Err(why), false) => json!(format!(
                "{:<WORD$} {sentence}\n{:<WORD$} not here: {why}\n",
                kind.word(),
                ""
            )),
            (Ok(mut opened), is_json) => {
                let there = opened.as_ref().map(|opened| opened.device.as_ref());
                let row = if is_json {
                    as_row(kind, sentence, &found, there)
                } else {
                    json!(as_text(kind, sentence, &found, there))
                };
                if let Some(opened) = &mut opened {
                    opened.device.close();
                }
                row
            }
        });
    }
    if json {
        print(&format!("{}\n", json!({ "devices": rows })))
    } else {
        print(&rows.iter().filter_map(|r| r.as_str()).collect::<String>())
    }
}

/// One present device, or several of a kind, as JSON.
fn as_row(
    kind: DeviceKind,
    sentence: &str,
    found: &[Found],
    device: Option<&dyn HapticDevice>,
) -> serde_json::Value {
    let found: Vec<_> = found
        .iter()
        .map(|f| json!({ "id": f.id, "name": f.name }))
        .collect();
    let mut row = json!({ "device": kind.word(), "is": sentence, "present": true });
    if kind.is_owned() {
        row["found"] = json!(found);
    }
    let Some(device) = device else { return row };
    let caps = device.caps();
    let of_it = json!({
        "name": caps.name, "dof_in": caps.dof_in, "dof_out": caps.dof_out,
        "max_force_n": caps.max_force_n, "continuous_force_n": caps.continuous_force_n,
        "max_torque_nm": caps.max_torque_nm,
        "max_stiffness_n_per_m": caps.max_stiffness_n_per_m,
        "workspace_m": side_m(device), "rate_hz": caps.rate_hz,
        "clock": clock_word(device.clock()), "calibration": calibration_word(device.calibration()),
    });
    if let (Some(row), serde_json::Value::Object(of_it)) = (row.as_object_mut(), of_it) {
        row.extend(of_it);
    }
    row
}

/// The same as text.
fn as_text(
    kind: DeviceKind,
    sentence: &str,
    found: &[Found],
    device: Option<&dyn HapticDevice>,
) -> String {
    let mut lines = vec![format!("{:<WORD$} {sentence}\n", kind.word())];
    let listed = |found: &Found| format!("{:<WORD$} {}:{found}\n", "", kind.word());
    lines.extend(found.iter().map(listed));
    if let Some(device) = device {
        lines.push(format!(
            "{:<WORD$} {}; {:.0} mm to move in; {}\n",
            "",
            forces(device.caps()),
            side_m(device) * 1e3,
            calibration_word(device.calibration()),
        ));
    }
    lines.concat()
}

/// Force capabilities.
fn forces(caps: &DeviceCaps) -> String {
    if caps.dof_out == 0 {
        return format!("{} degrees of freedom, no force", caps.dof_in);
    }
    format!(
        "{} of {} degrees of freedom push, up to {} N ({} N held) and {} N·m, {} N/m",
        caps.dof_out,
        caps.dof_in,
        caps.max_force_n,
        caps.continuous_force_n,
        caps.max_torque_nm,
        caps.max_stiffness_n_per_m,
    )
}

/// Shortest side of the workspace, m.
fn side_m(device: &dyn HapticDevice) -> f64 {
    let workspace = device.caps().workspace;
    (workspace.max - workspace.min).min()
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

fn test(choice: &DeviceSelection, json: bool) -> Done {
    let kind = choice.kind;
    let mut opened = at_rest(choice)?;
    let (mut us, mut due) = (0, monotonic_now());
    let mut clock = || {
        if kind.is_held() {
            due = due + TICK;
            sleep_until(due);
            return device_time(monotonic_now());
        }
        // Simulated devices need no real time.
        us += 1000;
        DeviceTime::from_micros(us)
    };
    let options = conformance::Options {
        moves_under_force: !kind.is_held() && kind != DeviceKind::Replay,
    };
    let report = conformance::run(opened.device.as_mut(), &mut clock, options);
    if json {
        print(&format!("{}\n", as_json(kind, &report)))?;
    } else {
        print(&report.to_string())?;
    }
    if report.passed() {
        Ok(())
    } else {
        Err(format!("{} fails the conformance suite", kind.word()))
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

fn calibrate(choice: &DeviceSelection) -> Done {
    let kind = choice.kind;
    let mut device = at_rest(choice)?.device;
    let state = device
        .calibrate()
        .map_err(|e| format!("{}: {e}", kind.word()))?;
    device.close();
    match state {
        Calibration::NotNeeded | Calibration::Done => {
            print(&format!("{}: {}\n", kind.word(), calibration_word(state)))
        }
        Calibration::NeedsUser | Calibration::InProgress => Err(format!(
            "{} is {}; follow its maker's procedure, then try again",
            kind.word(),
            calibration_word(state)
        )),
    }
}
