//! The command line: `palpate-client join` and `palpate-client devices`.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Parser, Subcommand};
use palpate_protocol::handshake::Subscription;
use palpate_transport::state::state_folder;
use palpate_view::{CLIENT_VIEW, parse_view};

use super::link_source::LinkArguments;
use super::output::{complain, print};
use crate::devices::{self, DeviceSelection, DevicesArguments, Sources};
use crate::{ClientError, JoinOptions, StartAt, StatusKind, Summary, run as join};

/// Maximum duration, s: one day. A larger number is probably in milliseconds.
const DURATION_MAX_S: f64 = 86_400.0;

/// Examples at the end of `--help`.
const EXAMPLES: &str = "\
Examples:
  Join with the link that the server printed (in quotes: it has a '&'), with a scripted hand:
    palpate-client join \"palpate://192.168.1.20:4433/trainee?cert=...&grant=...\" --script press.toml

  With the link in a file that only you can read, so that it appears neither in the list of processes nor in the history
  of your shell. `join -` reads the link from standard input, and PALPATE_LINK holds it in the environment:
    palpate-client join --link-file ~/trainee.link --script press.toml

  Only look, for ten seconds:
    palpate-client join \"palpate://192.168.1.20:4433/spectator?cert=...&grant=...\" --duration 10

  Only look, on a machine that is too slow for the tissue:
    palpate-client join \"palpate://192.168.1.20:4433/spectator?cert=...&grant=...\" --subscription thin

  Figures for a program on standard output, everything else on standard error:
    palpate-client join LINK --script press.toml --duration 20 --json > run.json

  With a recorded motion. The first line of a table names its columns: t_s,x_m,y_m,z_m[,qw,qx,qy,qz][,buttons], where t_s
  may also be called time_s; seconds, metres, a unit quaternion:
    palpate-client join LINK --motion hand.csv

  With the Touch, Inverse3, omega or Falcon that is plugged in:
    palpate-client join \"palpate://192.168.1.20:4433/trainee?cert=...&grant=...\"

  With mouse, touch and keys, in the page that this program serves:
    palpate-client join \"palpate://192.168.1.20:4433/trainee?cert=...&grant=...\" --view --device pointer

  Which devices this program drives:
    palpate-client devices

Roles are part of the link: instructor and trainee hold a tool; spectator and recorder (a program with --record) only look.

A script moves the simulated hand:
  format = \"palpate-script/1\"
  repeat = false              # true: begins again at the first way point; the last must be there
  [tool]
  kind = \"probe\"              # a ball; blade (cuts while its button is held), needle (enters soft tissue), plate, forceps
  radius_mm = 8.0             # of the ball, or half the thickness of any other tool
  # length_mm = 20.0          # of blade and needle from the tip upwards, of a plate along x, of the jaws
  # width_mm = 10.0           # of a plate or of the jaws, along y
  [hand]                      # optional, as is each line of it
  mass_kg = 0.3
  stiffness_n_per_m = 400.0   # of the spring that pulls the hand to the script
  damping_ns_per_m = 12.0
  tremor_mm = 0.0             # root mean square along each axis
  seed = 1                    # of the tremor
  [[way]]
  t_s = 0.0
  at_mm = [0.0, 100.0, 100.0]
  [[way]]
  t_s = 1.5
  at_mm = [0.0, 68.0, 100.0]
  button = true               # held from this way point on
  ease = \"minimum-jerk\"       # or \"linear\"
  quat = [1.0, 0.0, 0.0, 0.0] # w, x, y, z; without it the tool keeps its orientation
It starts at joining, or with --at session at the same moment for all participants. Begin outside the tissue.

The exit code is 0 when the session ended as it should, 2 when the command line, the link or the
script is wrong, and 1 for everything else. PALPATE_LOG=debug (or RUST_LOG) logs more to standard error.";

#[derive(Parser)]
#[command(
    name = "palpate-client",
    version,
    about = "Joins a shared operating table: feel and cut the tissue together with others",
    after_help = EXAMPLES
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Join a session
    #[command(after_help = EXAMPLES)]
    Join(JoinArguments),
    /// List, test, calibrate or plot haptic devices
    Devices(DevicesArguments),
}

#[derive(clap::Args)]
struct JoinArguments {
    #[command(flatten)]
    link: LinkArguments,
    /// The name shown to other participants
    #[arg(long, default_value_t = default_name())]
    name: String,
    /// The device to hold, for roles with a tool: an entry of `devices` (haply, or haply:ID if several are
    /// connected), or auto: sim with --script, replay with --motion, otherwise the best connected device, otherwise
    /// pointer with --view
    #[arg(long, value_name = "DEVICE", default_value = "auto")]
    device: DeviceSelection,
    /// Script of the simulated hand, used with or without a simulated device (a TOML file)
    #[arg(long, value_name = "FILE")]
    script: Option<PathBuf>,
    /// A recorded motion for the device replay: a file of --record (.json) or a table (.csv, columns below). The tool
    /// is that of --script, or a ball of 8 mm radius
    #[arg(long, value_name = "FILE")]
    motion: Option<PathBuf>,
    /// Serve the browser view at this address (default 127.0.0.1:4481); a port alone serves this machine only. Mouse,
    /// touch and keys in its page move the device pointer
    #[arg(long, value_name = "[ADDRESS:]PORT", num_args = 0..=1, default_missing_value = CLIENT_VIEW)]
    view: Option<String>,
    /// When the script or the motion starts: on joining, or with the session (see `palpate-server host --start-when`)
    #[arg(long, value_name = "MOMENT", value_enum, default_value = "joining")]
    at: StartAt,
    /// Tissue data to subscribe to: full (tools and cuts; this machine computes the tissue) or thin (surface
    /// displacements, 60 times a second, within 0.05 mm and 1 Mbit/s; this machine computes nothing). Thin is for
    /// spectators
    #[arg(long, value_name = "full|thin", default_value = "full")]
    subscription: Subscription,
    /// Leave after this number of seconds; default: stay until the session ends or Ctrl-C
    #[arg(long, value_name = "S", value_parser = seconds)]
    duration: Option<Duration>,
    /// Try again for this number of seconds when the server is busy or not reached, also after a lost connection; the
    /// server keeps the seat for 60
    #[arg(long, value_name = "S", value_parser = seconds, default_value = "60")]
    reconnect: Duration,
    /// Do not store the seat on disk: after a crash the server then rejects this name for 60 s. By default the seat
    /// is stored in `$XDG_STATE_HOME/palpate` or `~/.local/state/palpate` until this program leaves
    #[arg(long)]
    forget_seat: bool,
    /// Write the summary as one JSON object to standard output
    #[arg(long)]
    json: bool,
    /// Write forces and views to this file, as JSON
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Do not ask for real-time priority for the force loop
    #[arg(long)]
    no_realtime: bool,
}

impl JoinArguments {
    fn into_options(mut self) -> Result<JoinOptions, ClientError> {
        let view = self.view.take().map(|word| {
            let word = self.link.take_from("--view", word)?;
            Ok::<_, ClientError>(parse_view(word.as_deref().unwrap_or(CLIENT_VIEW))?)
        });
        let view = view.transpose()?;
        // Before anything is opened, because the program may start again.
        let link = self.link.read()?;
        let status = if self.json {
            StatusKind::Stderr
        } else {
            StatusKind::Stdout
        };
        Ok(JoinOptions {
            subscription: self.subscription,
            device: self.device.kind,
            device_id: self.device.which,
            sources: Sources::from_environment(),
            script: self.script,
            motion: self.motion,
            view,
            start_at: self.at,
            duration: self.duration,
            reconnect: self.reconnect,
            state: state_folder().filter(|_| !self.forget_seat),
            record: self.record,
            realtime: !self.no_realtime,
            catch_signals: true,
            status,
            ..JoinOptions::new(link, self.name)
        })
    }
}

fn default_name() -> String {
    std::env::var("USER")
        .ok()
        .filter(|name| palpate_protocol::name::normalise(name).is_ok())
        // Names are unique in a session; the process id separates two clients on one machine.
        .unwrap_or_else(|| format!("guest-{}", std::process::id()))
}

fn seconds(text: &str) -> Result<Duration, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s <= DURATION_MAX_S => Ok(Duration::from_secs_f64(s)),
        _ => Err(format!(
            "must be a number of seconds above 0 and at most {DURATION_MAX_S}"
        )),
    }
}

/// Runs the whole program. `args` begins with the program's name.
pub fn run(args: impl IntoIterator<Item = OsString>) -> ExitCode {
    let arguments = match Arguments::try_parse_from(args) {
        Ok(arguments) => arguments,
        Err(error) => {
            // A closed output stream is no error here.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    palpate_transport::start_log(palpate_transport::LevelFilter::ERROR);
    match arguments.command {
        Command::Devices(arguments) => devices::run(arguments),
        Command::Join(arguments) => {
            let json = arguments.json;
            let outcome = arguments.into_options().and_then(|options| join(&options));
            report(&outcome, json)
        }
    }
}

/// Prints the outcome of a run and returns its exit code.
fn report(outcome: &Result<Summary, ClientError>, json: bool) -> ExitCode {
    let summary = match outcome {
        Ok(summary) => Some(summary),
        Err(error) => error.summary(),
    };
    if let Some(summary) = summary {
        let text = if json {
            serde_json::to_string(summary).expect("a summary is plain data")
        } else {
            summary.to_string()
        };
        if let Err(error) = print(&format!("{text}\n")) {
            complain(&error);
            return ExitCode::FAILURE;
        }
    }
    match outcome {
        Ok(_) => ExitCode::SUCCESS,
        Err(error) => {
            complain(&error.to_string());
            ExitCode::from(error.exit_code())
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn help_names_every_option() {
        Arguments::command().debug_assert();
        let help = Arguments::command().render_help().to_string();
        for word in [
            "Examples:",
            "palpate-script/1",
            "recorder",
            "PALPATE_LOG",
            "PALPATE_LINK",
            "--link-file",
        ] {
            assert!(help.contains(word), "{word}: {help}");
        }
    }

    #[test]
    fn options_are_passed_to_the_run() {
        let line = "palpate-client join L --name Ada --script s.toml --duration 2.5 --json --no-realtime --subscription thin";
        let Command::Join(arguments) = Arguments::parse_from(line.split(' ')).command else {
            panic!("join was asked for");
        };
        let options = arguments.into_options().unwrap();
        assert_eq!((options.link.as_str(), options.name.as_str()), ("L", "Ada"));
        assert_eq!(options.duration, Some(Duration::from_millis(2500)));
        assert_eq!(options.status, StatusKind::Stderr);
        assert_eq!(options.subscription, Subscription::Thin);
        assert!(!options.realtime && options.catch_signals);
    }

    #[test]
    fn view_takes_an_address_or_nothing_and_never_the_link() {
        let view = |line: &str| {
            let words = ["palpate-client", "join"]
                .into_iter()
                .chain(line.split(' '));
            let Command::Join(arguments) = Arguments::parse_from(words).command else {
                panic!("join was asked for");
            };
            let options = arguments.into_options().unwrap();
            assert_eq!(options.link, "palpate://a", "{line}");
            options.view.map(|address| address.to_string())
        };
        assert_eq!(view("palpate://a"), None);
        for line in [
            "palpate://a --view",
            "--view palpate://a",
            "--view --device pointer palpate://a",
            "palpate://a --view 4481",
        ] {
            assert_eq!(view(line).as_deref(), Some(CLIENT_VIEW), "{line}");
        }
        assert_eq!(
            view("--view 0.0.0.0:1 palpate://a").as_deref(),
            Some("0.0.0.0:1")
        );
    }

    #[test]
    fn invalid_durations_are_rejected() {
        for text in ["0", "-1", "nan", "1e9", "soon"] {
            assert!(seconds(text).is_err(), "{text}");
        }
    }

    #[test]
    fn invalid_link_exits_with_code_2() {
        let line = ["palpate-client", "join", "http://x"].map(OsString::from);
        assert_eq!(
            format!("{:?}", run(line)),
            format!("{:?}", ExitCode::from(2))
        );
    }
}
