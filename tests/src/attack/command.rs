//! `palpate-lab attack`.

use std::path::PathBuf;

use clap::Args;

use super::kinds::{ALL, Attack};
use super::{AttackOptions, AttackReport};
use crate::cli::print_line;
use crate::network::Profile;
use crate::progress::{Interrupt, Progress};

/// Text at the end of `attack --help`.
pub(crate) const HELP: &str = "\
Attackers with valid links, on a thread of this program, attack a server process that serves two honest trainees. They
begin with the scripts of the trainees and end with them. Every 3 s a newcomer tries to join. The same session without
attack runs first.

Each figure that is missing or beyond its limit is a line \"FAILED: attack: criterion, value, limit\":
  force error of both hands, and median and maximum of the playout delay D: 10 % above the session without attack, or
    1 percentage point (more in runs below 30 s) and 2 ms, whichever is more
  longest dropout 60 ms; no demotion of an honest trainee; no lost cut; no dead process
  newcomers join within 3 s, model included
  growth of the server's memory: 64 MB more than without attack
  newcomers, D and memory as before within 2 s after the attack

Examples:
  palpate-lab attack                       every attack, one after the other; about 14 minutes
  palpate-lab attack delay seats           two attacks at once
  palpate-lab attack handshakes --seconds 10 --json
  palpate-lab attack --list

The exit code is 0 when every criterion is met, 2 when the command line is wrong, 1 otherwise.";

/// Arguments of `attack`.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Attacks that run at once; none: every attack, one after the other
    #[arg(value_name = "NAME", value_parser = Attack::named)]
    attacks: Vec<Attack>,
    /// List the attacks
    #[arg(long)]
    list: bool,
    /// Length of an attack and of the scripts, 4 to 600 s
    #[arg(long, default_value_t = 30.0, value_name = "S")]
    seconds: f64,
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(long, default_value = "thigh")]
    model: String,
    /// The network between the server and the honest trainees
    #[arg(long, default_value = "lan", value_parser = Profile::parse)]
    profile: Profile,
    /// Seed of the packet fates
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Runs the attacks.
    pub(crate) fn report(
        self,
        progress: &mut Progress,
        interrupt: &Interrupt,
    ) -> Result<AttackReport, String> {
        let options = AttackOptions {
            executable: executable()?,
            model: self.model,
            seconds: self.seconds,
            profile: self.profile,
            seed: self.seed,
            runs: if self.attacks.is_empty() {
                ALL.iter().map(|attack| vec![*attack]).collect()
            } else {
                vec![self.attacks]
            },
        };
        super::run(&options, progress, interrupt).map_err(|e| e.to_string())
    }
}

/// Runs `attack`.
pub(crate) fn run(arguments: Arguments) -> Result<bool, String> {
    if arguments.list {
        for attack in ALL {
            print_line(&format!("{:<15} {}", attack.name, attack.about))?;
        }
        return Ok(true);
    }
    let interrupt = Interrupt::listen()?;
    let json = arguments.json;
    let mut progress = Progress::new();
    let report = arguments.report(&mut progress, &interrupt);
    drop(progress);
    let report = report?;
    if json {
        print_line(&serde_json::to_string(&report).expect("a report is plain data"))?;
    } else {
        print_line(&format!("\n{report}"))?;
    }
    Ok(report.ok)
}

/// The laboratory program, which plays all roles.
fn executable() -> Result<PathBuf, String> {
    std::env::current_exe().map_err(|e| format!("cannot find the path of this program: {e}"))
}
