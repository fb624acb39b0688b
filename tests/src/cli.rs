//! The command line of `palpate-lab`.

use palpate_transport::LevelFilter;
use std::ffi::{OsStr, OsString};
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

use crate::bench::ablate as bench_ablate;
use crate::bench::bytes as bench_bytes;
use crate::bench::coding::Coding;
use crate::bench::cuts as bench_cuts;
use crate::bench::haptic_tick::HapticTick;
use crate::bench::on_threads;
use crate::bench::press_cube::PressCube;
use crate::bench::press_scene::{Comparison, PressScene};
use crate::bench::reference as bench_reference;
use crate::demo;
use crate::experiments::{command, tour};
use crate::hand;
use crate::haptic_faults::course::Setup;
use crate::haptic_faults::fault::Class;
use crate::haptic_faults::outcome::Outcome;
use crate::haptic_faults::{self, Trial, picture};
use crate::network;
use crate::program::die_with_parent;
use crate::progress::{Interrupt, Progress};
use crate::relay;
use crate::stress;
use crate::test_model::TestModel;

/// The named networks, for `--help`.
macro_rules! networks {
    () => {
        "\
Network profiles: none, lan (0.3 ms), metro (5 ms), transatlantic (60 ms one way, 2 % loss),
  intercontinental (120 ms, 2 %), satellite (300 ms, 1 %), wifi-bursts (8 ms with loss bursts),
  lte (35 ms with loss bursts), lossy (40 ms, 20 % loss), gamma (25 ms and a tail of 5 ms),
  bursts (50 and 120 ms), outages (25 ms, with outages of the link),
  steps (15, 40, 60 ms, 10 s each: 30, 80, 120 ms from one participant to another), far-steps (30, 80, 120 ms),
  or a TOML file of your own, for which `palpate-lab profiles NAME` prints a template"
    };
}
pub(crate) use networks;

/// Text at the end of `--help`.
const EXAMPLES: &str = concat!(
    "\
Examples:
  A session on this machine: a server, two trainees, a late spectator, a bad network:
    palpate-lab demo
    palpate-lab demo --model scene.toml --seconds 30 --profile satellite --report out

  A bad network in front of a server of your own; clients join the relay's address:
    palpate-lab relay --listen 127.0.0.1:5533 --to 127.0.0.1:4433 --profile transatlantic --seed 7

",
    networks!(),
    "

PALPATE_LOG=debug (or RUST_LOG) logs more to standard error, also of the programs that the demo starts.

The exit code is 0 on success, 2 when the command line is wrong, 1 otherwise."
);

const BENCHES: &str = "\
Examples:
  palpate-lab bench press-cube --nodes 40 --moving
  palpate-lab bench press-scene thigh.toml --json
  palpate-lab bench coding --round-trip-ms 200
  palpate-lab bench bytes --model thigh.palp

Compare only figures of one run on one machine; other load changes them.";

const ABLATE: &str = "\
Examples:
  palpate-lab ablate
  palpate-lab ablate thigh.toml abdominal-wall --mechanism warm-start --mechanism hardening --json

The errors of two runs are equal; times are comparable within one run.";

const FAULTS: &str = "\
A simulated hand presses into a spring tissue (200 N/m to 20 kN/m, which is bone) at up to 0.5 m/s, through the force
loop of the client, in virtual time. Faults: the solver stalls, the link is lost, contact models or poses contain
non-finite numbers, the device is unplugged, rejects writes or clamps, the process is stopped, the clock jumps, or
several of these at once. The rendered force must obey four laws:

  - it changes by at most the slew limit per tick
  - it is zero within 150 ms of the loss of its source
  - it is finite and within the force limit
  - every fault is counted, and the force returns after the fault

Seeds cycle through the classes of faults; equal seeds give equal runs.

Examples:
  palpate-lab haptic-faults                       1,000 runs, a quarter of a minute
  palpate-lab haptic-faults --seeds 100000 --json
  palpate-lab haptic-faults -o faults             also a table and a chart of one run per class
  palpate-lab haptic-faults --seed 27 -o faults   one run: its faults, figures, and every tick

The exit code is 0 when every law held, 2 when the command line is wrong, 1 otherwise.";

/// The laboratory: emulated networks, scripted hands, the demo.
#[derive(Debug, Parser)]
#[command(name = "palpate-lab", version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a session of two trainees and a spectator over a bad network, and report how well it went
    #[command(after_help = demo::command::HELP)]
    Demo(demo::command::Arguments),
    /// Relay UDP packets with delay, loss and reordering
    #[command(after_help = EXAMPLES)]
    Relay(relay::command::Arguments),
    /// List the named networks, or print one as a template for your own file
    #[command(after_help = network::command::HELP)]
    Profiles(network::command::Arguments),
    /// Write the motion of a random hand as a table, for `run --motion`
    #[command(after_help = hand::command::HELP)]
    Hand(hand::command::Arguments),
    /// Run an experiment on the network or on the rendered forces
    #[command(after_help = command::RUN_HELP)]
    Run(command::RunArguments),
    /// List the experiments
    List,
    /// Run every experiment and write one page of it, readable offline
    #[command(after_help = command::RUN_HELP)]
    All(tour::AllArguments),
    /// Inject faults into the haptic chain, and check that no fault jerks the hand
    #[command(after_help = FAULTS)]
    HapticFaults(HapticFaultsArguments),
    /// Switch off one mechanism of the solver at a time: force error and time of a press, slide and withdrawal
    #[command(after_help = ABLATE)]
    Ablate(bench_ablate::Arguments),
    /// Measure the equilibrium against its own converged solution
    #[command(subcommand, after_help = BENCHES)]
    Bench(Bench),
}

#[derive(Debug, Subcommand)]
enum Bench {
    /// A cube of side 0.1 m pressed by a disc: the time from rest to 1 % and to convergence
    PressCube(PressCubeArguments),
    /// A sphere of 8 mm pressed into a model at the speed of a hand: force error and time per tick
    PressScene(PressSceneArguments),
    /// Bits per pose and per node on the wire: this codec, deflate, raw
    Coding {
        /// Round trip after which both ends know the sent data, in ms
        #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(i64).range(0..=400))]
        round_trip_ms: i64,
        /// Seed of the hand
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// Print one JSON object
        #[arg(long)]
        json: bool,
    },
    /// Bandwidth of a session during press and cut: kbit/s per direction and part, including QUIC
    Bytes(Box<bench_bytes::Arguments>),
    /// Load of a trainee's threads while other trainees cut beside the press
    Cuts(bench_cuts::Arguments),
    /// Compute the reference of a demo, and compare it with a finer one
    Reference(bench_reference::Arguments),
    /// Time one tick of the force loop: read, compute, write
    HapticTick {
        /// Ticks of each device
        #[arg(long, default_value_t = 200_000, value_parser = clap::value_parser!(u32).range(1000..=100_000_000))]
        ticks: u32,
        /// Print one JSON object
        #[arg(long)]
        json: bool,
    },
}

#[derive(Debug, Args)]
struct PressCubeArguments {
    /// Nodes per edge: 20 makes 8,000 nodes, 40 64,000, 100 a million
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u16).range(4..=160))]
    nodes: u16,
    /// Threads
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Poisson's ratio, 0.25 to 0.49; 0.25 is springs alone
    #[arg(long, default_value_t = 0.25)]
    poisson: f64,
    /// Also press in ten steps of 0.1 mm
    #[arg(long)]
    moving: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct PressSceneArguments {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(default_value = "thigh")]
    model: String,
    /// Depth, mm
    #[arg(long, default_value_t = 15.0)]
    depth_mm: f64,
    /// Speed, mm/s
    #[arg(long, default_value_t = 100.0)]
    speed_mm_s: f64,
    /// Time budget of a tick until its last iteration begins, ms
    #[arg(long, default_value_t = 1.0)]
    budget_ms: f64,
    /// Tolerance of the converged solutions: 1e-3 leaves 0.2 % of the force, and takes minutes on half a
    /// million nodes
    #[arg(long, default_value_t = 1e-5)]
    converged: f64,
    /// Number of presses, each from rest
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=1000))]
    repeats: u16,
    /// A second model, pressed alternately with the first; reports the ratio of their tick times
    #[arg(long, value_name = "MODEL")]
    against: Option<String>,
    /// Cut through the tissue first, and press beside the wound
    #[arg(long)]
    wound: bool,
    /// Threads
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct HapticFaultsArguments {
    /// Number of runs; their seeds are 0, 1, 2, ...
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    seeds: u64,
    /// Replay one seed and print all details
    #[arg(long, value_name = "S", conflicts_with = "seeds")]
    seed: Option<u64>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// Folder for a table (CSV) and a chart (SVG) of one run per class, with every tick
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

/// Runs the command line `args`, including the program name.
pub fn run(args: impl IntoIterator<Item = OsString>) -> ExitCode {
    let args: Vec<OsString> = args.into_iter().collect();
    // The demo starts this program in its other roles, which are not for users.
    match args.get(1).map(OsString::as_os_str) {
        Some(role) if role == OsStr::new("server") => {
            die_with_parent();
            return palpate_server::cli::run(role_line("palpate-server", &args));
        }
        Some(role) if role == OsStr::new("client") => {
            die_with_parent();
            return palpate_client::cli::run(role_line("palpate-client", &args));
        }
        Some(role) if role == OsStr::new(stress::ROLE) => {
            let parent = args.get(2).and_then(|p| p.to_str()?.parse().ok());
            stress::be_busy(parent);
            return ExitCode::SUCCESS;
        }
        _ => {}
    }
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(error) => {
            // Help goes to standard output with code 0, errors to standard error with code 2.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    palpate_transport::start_log(LevelFilter::ERROR);
    let done = match cli.command {
        Command::Demo(arguments) => demo::command::run(arguments),
        Command::Relay(arguments) => relay::command::run(&arguments),
        Command::Profiles(arguments) => network::command::run(&arguments),
        Command::Hand(arguments) => hand::command::run(&arguments),
        Command::Run(arguments) => command::run(&arguments),
        Command::List => command::list(),
        Command::All(arguments) => tour::all(&arguments),
        Command::HapticFaults(arguments) => run_haptic_faults(&arguments),
        Command::Ablate(arguments) => {
            bench_ablate::run(&arguments).and_then(|all| give(&all, arguments.json))
        }
        Command::Bench(Bench::PressCube(arguments)) => run_press_cube(&arguments),
        Command::Bench(Bench::PressScene(arguments)) => run_press_scene(&arguments),
        Command::Bench(Bench::Coding {
            round_trip_ms,
            seed,
            json,
        }) => (Coding {
            round_trip_ms,
            seed,
        })
        .run()
        .and_then(|report| give(&report, json)),
        Command::Bench(Bench::Bytes(arguments)) => {
            bench_bytes::run(&arguments).and_then(|report| give(&report, arguments.json))
        }
        Command::Bench(Bench::Cuts(arguments)) => {
            bench_cuts::run(&arguments).and_then(|report| give(&report, arguments.json))
        }
        Command::Bench(Bench::Reference(arguments)) => {
            bench_reference::run(&arguments).and_then(|report| give(&report, arguments.json))
        }
        Command::Bench(Bench::HapticTick { ticks, json }) => (HapticTick {
            ticks: ticks as usize,
        })
        .run()
        .and_then(|report| give(&report, json)),
    };
    done.unwrap_or_else(|sentence| {
        note(&format!("palpate-lab: {sentence}"));
        ExitCode::FAILURE
    })
}

/// Command line of another role: its program name, and the arguments after the role.
fn role_line(name: &str, args: &[OsString]) -> Vec<OsString> {
    let rest = args.iter().skip(2).cloned();
    std::iter::once(OsString::from(name)).chain(rest).collect()
}

/// Writes a line to standard output. A closed pipe is not an error: the remaining work is still done.
pub(crate) fn say(line: &str) -> Result<(), String> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{line}").and_then(|()| out.flush()) {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(format!("cannot print the result: {e}"))
        }
        _ => Ok(()),
    }
}

/// Writes a line for the user to standard error.
pub(crate) fn note(line: &str) {
    // A closed standard error is ignored.
    let _ = writeln!(std::io::stderr(), "{line}");
}

fn run_haptic_faults(arguments: &HapticFaultsArguments) -> Result<ExitCode, String> {
    let interrupt =
        Interrupt::listen().map_err(|e| format!("cannot install the signal handlers: {e}"))?;
    let mut progress = Progress::new();
    let (seeds, of) = match arguments.seed {
        Some(seed) => (seed..seed.saturating_add(1), 1),
        None => (0..arguments.seeds, arguments.seeds),
    };
    let mut told = |seed: u64, outcome: &Outcome| {
        if seed.is_multiple_of(16) {
            let (runs, failed) = (outcome.runs, outcome.failed());
            progress.tick(&format!("{runs} of {of} runs, {failed} broke a law"));
        }
        !interrupt.is_set()
    };
    let setup = Setup::default();
    let outcome = haptic_faults::all(seeds, &setup, &mut told).map_err(|e| e.to_string())?;
    drop(progress);
    if outcome.runs < of {
        return Err(format!("interrupted after {} of {of} runs", outcome.runs));
    }
    give(&outcome, arguments.json)?;
    if let Some(seed) = arguments.seed
        && !arguments.json
    {
        tell_of(seed)?;
    }
    if let Some(dir) = &arguments.output {
        let classes = Class::ALL.len() as u64;
        let shown = arguments
            .seed
            .map_or(0..classes.min(of), |seed| seed..seed.saturating_add(1));
        for seed in shown {
            let trial = kept(seed)?;
            let name = picture::write(&trial, dir)
                .map_err(|e| format!("{} can not be written: {e}", dir.display()))?;
            note(&dir.join(name).display().to_string());
        }
    }
    Ok(if outcome.ok {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// The runs of a seed with every tick recorded.
fn kept(seed: u64) -> Result<Trial, String> {
    let setup = Setup {
        keep: true,
        ..Setup::default()
    };
    Trial::of(seed, &setup).map_err(|e| e.to_string())
}

/// Prints all details of one seed.
fn tell_of(seed: u64) -> Result<(), String> {
    let trial = kept(seed)?;
    let (plan, tissue) = (&trial.plan, &trial.plan.tissue);
    for fault in &plan.faults {
        let at_ms = fault.from_us as f64 * 1e-3;
        say(&format!("{at_ms:9.1} ms  {fault}"))?;
    }
    say(&format!(
        "tissue of {:.0} N/m, {:.2} N·s/m, friction {:.2} and {:.2}; device of {:.1} N, {:?}",
        tissue.stiffness,
        tissue.damping,
        tissue.mu_static,
        tissue.mu_dynamic,
        plan.caps.continuous_force_n,
        plan.driver
    ))?;
    say(&format!(
        "afterwards at most {:.2} N, without the fault {:.2} N; {:?}",
        trial.run.force_after_n, trial.without.force_after_n, trial.run.counters
    ))
}

fn run_press_cube(arguments: &PressCubeArguments) -> Result<ExitCode, String> {
    if !(0.25..=0.49).contains(&arguments.poisson) {
        return Err(format!(
            "--poisson {} must be between 0.25 (springs alone) and 0.49",
            arguments.poisson
        ));
    }
    let bench = PressCube {
        nodes: usize::from(arguments.nodes),
        poisson: arguments.poisson,
        moving: arguments.moving,
    };
    let report = on_threads(usize::from(arguments.threads), || {
        let mut progress = Progress::new();
        bench.run(&mut |what| progress.stage(what))
    })?;
    give(&report, arguments.json)
}

fn run_press_scene(arguments: &PressSceneArguments) -> Result<ExitCode, String> {
    for (name, value) in [
        ("--depth-mm", arguments.depth_mm),
        ("--speed-mm-s", arguments.speed_mm_s),
        ("--budget-ms", arguments.budget_ms),
    ] {
        if !(value > 0.0 && value <= 1e4) {
            return Err(format!("{name} {value} must be above 0 and at most 10000"));
        }
    }
    let converged = arguments.converged;
    if !(1e-8..=1e-2).contains(&converged) {
        return Err(format!("--converged {converged} must be from 1e-8 to 0.01"));
    }
    let dir = tempfile::tempdir().map_err(|e| format!("no temporary folder: {e}"))?;
    let mut progress = Progress::new();
    progress.stage("reading the model");
    let mut models = Vec::new();
    for (k, name) in std::iter::once(&arguments.model)
        .chain(&arguments.against)
        .enumerate()
    {
        let place = dir.path().join(k.to_string());
        std::fs::create_dir(&place).map_err(|e| format!("no temporary folder: {e}"))?;
        let subject = TestModel::prepare(name, &place).map_err(|e| e.to_string())?;
        models.push(subject.model);
    }
    let bench = PressScene {
        depth_m: arguments.depth_mm * 1e-3,
        speed_m_s: arguments.speed_mm_s * 1e-3,
        budget_ms: arguments.budget_ms,
        converged: arguments.converged,
        wound: arguments.wound,
        repeats: usize::from(arguments.repeats),
        ..PressScene::default()
    };
    let mut reports = on_threads(usize::from(arguments.threads), move || {
        bench.run(models, &mut |what| progress.tick(what))
    })??
    .into_iter();
    match (reports.next(), reports.next()) {
        (Some(report), Some(against)) => give(&Comparison::of(report, against), arguments.json),
        (Some(report), None) => give(&report, arguments.json),
        _ => Err("no model to press".to_owned()),
    }
}

/// Prints a report as text or as one JSON object.
fn give(
    report: &(impl serde::Serialize + std::fmt::Display),
    json: bool,
) -> Result<ExitCode, String> {
    if json {
        say(&serde_json::to_string(report).expect("a report is plain data"))?;
    } else {
        say(&report.to_string())?;
    }
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::{Cli, EXAMPLES};
    use crate::network::Profile;

    #[test]
    fn the_command_line_is_consistent_and_names_every_profile() {
        Cli::command().debug_assert();
        for name in Profile::names() {
            assert!(EXAMPLES.contains(name), "{name} is not in the help");
            assert!(
                crate::demo::command::HELP.contains(name),
                "{name} is not in the help of demo"
            );
        }
    }
}
