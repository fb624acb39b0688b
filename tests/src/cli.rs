//! The command line of `palpate-lab`.

use palpate_transport::LevelFilter;
use std::ffi::{OsStr, OsString};
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand, ValueEnum};

use crate::attack;
use crate::bench::ablate::Ablate;
use crate::bench::blade_sample::BladeSample;
use crate::bench::bytes::Bytes;
use crate::bench::coding::Coding;
use crate::bench::cuts::CutLoad;
use crate::bench::haptic_tick::HapticTick;
use crate::bench::late_join::LateJoin;
use crate::bench::press_cube::PressCube;
use crate::bench::press_scene::PressScene;
use crate::bench::view_cost::ViewCost;
use crate::bench::{Benchmark, OnStage};
use crate::demo;
use crate::experiments::{command, run_all};
use crate::hand;
use crate::haptic_faults::fault::Class;
use crate::haptic_faults::outcome::Outcome;
use crate::haptic_faults::run::Setup;
use crate::haptic_faults::{self, SeedResult, run_plot};
use crate::network;
use crate::program::die_with_parent;
use crate::progress::{Interrupt, Progress};
use crate::relay;
use crate::stress;

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
  palpate-lab bench blade-sample thigh.palp --depth-mm 10
  palpate-lab bench coding --round-trip-ms 200
  palpate-lab bench bytes --model thigh.palp
  palpate-lab bench view-cost --seconds 30

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
    Demo(demo::DemoOptions),
    /// Attack a server beside an honest session, and report the damage
    #[command(after_help = attack::command::HELP)]
    Attack(attack::command::Arguments),
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
    All(run_all::AllArguments),
    /// Inject faults into the haptic chain, and check that no fault jerks the hand
    #[command(after_help = FAULTS)]
    HapticFaults(HapticFaultsArguments),
    /// Switch off one mechanism of the solver at a time: force error and time of a press, slide and withdrawal
    #[command(after_help = ABLATE)]
    Ablate(Measurement<Ablate>),
    /// Measure the equilibrium against its own converged solution
    #[command(subcommand, after_help = BENCHES)]
    Bench(Bench),
}

#[derive(Debug, Subcommand)]
enum Bench {
    /// A cube of side 0.1 m pressed by a disc: the time from rest to 1 % and to convergence
    PressCube(Measurement<PressCube>),
    /// A sphere of 8 mm pressed into a model at the speed of a hand: force error and time per tick
    PressScene(Measurement<PressScene>),
    /// Bits per pose and per node on the wire: this codec, deflate, raw
    Coding(Measurement<Coding>),
    /// Bandwidth of a session during press and cut: kbit/s per direction and part, including QUIC
    Bytes(Box<Measurement<Bytes>>),
    /// Load of a trainee's threads while other trainees cut beside the press
    Cuts(Measurement<CutLoad>),
    /// Time of a blade sample of 1 mm: topology, levels, and their adoption by a pressing hand
    BladeSample(Measurement<BladeSample>),
    /// Time of a join to a session with many cuts: from the snapshot, and from the whole log
    LateJoin(Measurement<LateJoin>),
    /// Time one tick of the force loop: read, compute, write
    HapticTick(Measurement<HapticTick>),
    /// Cost of a trainee's own page: force error, lateness and CPU time with and without it
    ViewCost(Box<Measurement<ViewCost>>),
}

/// A benchmark and the form of its report.
#[derive(Debug, Args)]
struct Measurement<B: Args> {
    #[command(flatten)]
    benchmark: B,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// A measurement of any kind; `report` returns the report as JSON and as text.
trait Measure {
    fn wants_json(&self) -> bool;
    fn report(&self, on_stage: &mut OnStage<'_>) -> Result<[String; 2], String>;
}

impl<B: Benchmark> Measure for Measurement<B> {
    fn wants_json(&self) -> bool {
        self.json
    }

    fn report(&self, on_stage: &mut OnStage<'_>) -> Result<[String; 2], String> {
        self.benchmark.measure(on_stage).map(|r| both_forms(&r))
    }
}

impl Bench {
    fn measurement(&self) -> &dyn Measure {
        match self {
            Self::PressCube(measurement) => measurement,
            Self::PressScene(measurement) => measurement,
            Self::Coding(measurement) => measurement,
            Self::Bytes(measurement) => measurement.as_ref(),
            Self::Cuts(measurement) => measurement,
            Self::BladeSample(measurement) => measurement,
            Self::LateJoin(measurement) => measurement,
            Self::HapticTick(measurement) => measurement,
            Self::ViewCost(measurement) => measurement.as_ref(),
        }
    }
}

fn measure(measurement: &dyn Measure) -> Result<bool, String> {
    let mut progress = Progress::new();
    let report = measurement.report(&mut |what| progress.tick(what))?;
    drop(progress);
    print_line(&report[usize::from(!measurement.wants_json())])?;
    Ok(true)
}

/// The report of a command line that measures, as JSON and as text.
pub(crate) fn measured(line: &str, on_stage: &mut OnStage<'_>) -> Result<[String; 2], String> {
    let cli = Cli::try_parse_from(line.split(' ')).map_err(|e| e.to_string())?;
    match cli.command {
        Command::Bench(bench) => bench.measurement().report(on_stage),
        Command::HapticFaults(arguments) => {
            let go_on = &mut |what: &str| {
                on_stage(what);
                true
            };
            arguments.outcome(go_on).map(|outcome| both_forms(&outcome))
        }
        Command::Attack(arguments) => {
            let report = arguments.report(&mut Progress::new(), &Interrupt::default())?;
            Ok(both_forms(&report))
        }
        _ => Err(format!("\"{line}\" does not measure")),
    }
}

fn both_forms(report: &(impl serde::Serialize + std::fmt::Display)) -> [String; 2] {
    let json = serde_json::to_string(report).expect("a report is plain data");
    [json, report.to_string()]
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
        Command::Attack(arguments) => attack::command::run(arguments),
        Command::Relay(arguments) => relay::command::run(&arguments),
        Command::Profiles(arguments) => network::command::run(&arguments),
        Command::Hand(arguments) => hand::command::run(&arguments),
        Command::Run(arguments) => command::run(&arguments),
        Command::List => command::list(),
        Command::All(arguments) => run_all::all(&arguments),
        Command::HapticFaults(arguments) => run_haptic_faults(&arguments),
        Command::Ablate(measurement) => measure(&measurement),
        Command::Bench(bench) => measure(bench.measurement()),
    };
    let is_good = done.unwrap_or_else(|sentence| {
        note(&format!("palpate-lab: {sentence}"));
        false
    });
    ExitCode::from(u8::from(!is_good))
}

/// Command line of another role: its program name, and the arguments after the role.
fn role_line(name: &str, args: &[OsString]) -> Vec<OsString> {
    let rest = args.iter().skip(2).cloned();
    std::iter::once(OsString::from(name)).chain(rest).collect()
}

/// Writes a line to standard output. A closed pipe is not an error: the remaining work is still done.
pub(crate) fn print_line(line: &str) -> Result<(), String> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{line}").and_then(|()| out.flush()) {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(format!("cannot print the result: {e}"))
        }
        _ => Ok(()),
    }
}

pub(crate) fn note(line: &str) {
    // A closed standard error is ignored.
    let _ = writeln!(std::io::stderr(), "{line}");
}

impl HapticFaultsArguments {
    fn seeds(&self) -> std::ops::Range<u64> {
        let one = |seed: u64| seed..seed.saturating_add(1);
        self.seed.map_or(0..self.seeds, one)
    }

    /// Runs all seeds; `go_on` receives the progress and returns whether to continue.
    fn outcome(&self, go_on: &mut dyn FnMut(&str) -> bool) -> Result<Outcome, String> {
        let seeds = self.seeds();
        let of = seeds.end - seeds.start;
        let mut each = |seed: u64, outcome: &Outcome| {
            let (runs, failed) = (outcome.runs, outcome.failed());
            !seed.is_multiple_of(16) || go_on(&format!("{runs} of {of} runs, {failed} broke a law"))
        };
        let setup = Setup::default();
        let outcome = haptic_faults::all(seeds, &setup, &mut each).map_err(|e| e.to_string())?;
        if outcome.runs < of {
            return Err(format!("interrupted after {} of {of} runs", outcome.runs));
        }
        Ok(outcome)
    }
}

fn run_haptic_faults(arguments: &HapticFaultsArguments) -> Result<bool, String> {
    let interrupt = Interrupt::listen()?;
    let mut progress = Progress::new();
    let outcome = arguments.outcome(&mut |what| {
        progress.tick(what);
        !interrupt.is_set()
    })?;
    drop(progress);
    print_line(&both_forms(&outcome)[usize::from(!arguments.json)])?;
    if let Some(seed) = arguments.seed
        && !arguments.json
    {
        print_details(seed)?;
    }
    if let Some(dir) = &arguments.output {
        let classes = Class::value_variants().len();
        for seed in arguments.seeds().take(classes) {
            let result = kept(seed)?;
            let name = run_plot::write(&result, dir)
                .map_err(|e| format!("{} can not be written: {e}", dir.display()))?;
            note(&dir.join(name).display().to_string());
        }
    }
    Ok(outcome.ok)
}

/// The runs of a seed with every tick recorded.
fn kept(seed: u64) -> Result<SeedResult, String> {
    let setup = Setup {
        keep: true,
        ..Setup::default()
    };
    SeedResult::of(seed, &setup).map_err(|e| e.to_string())
}

fn print_details(seed: u64) -> Result<(), String> {
    let result = kept(seed)?;
    let (plan, tissue) = (&result.plan, &result.plan.tissue);
    for fault in &plan.faults {
        let at_ms = fault.from_us as f64 * 1e-3;
        print_line(&format!("{at_ms:9.1} ms  {fault}"))?;
    }
    print_line(&format!(
        "tissue of {:.0} N/m, {:.2} N·s/m, friction {:.2} and {:.2}; device of {:.1} N, {:?}",
        tissue.stiffness,
        tissue.damping,
        tissue.mu_static,
        tissue.mu_dynamic,
        plan.caps.continuous_force_n,
        plan.driver
    ))?;
    print_line(&format!(
        "afterwards at most {:.2} N, without the fault {:.2} N; {:?}",
        result.faulty.force_after_n, result.fault_free.force_after_n, result.faulty.counters
    ))
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
