//! `palpate-lab all`: all experiments and benchmarks, and a page with the results.
//!
//! The page and the exit code report failures and missed limits; the remaining experiments still run.

use std::fmt::Write as _;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use palpate_protocol::PROTOCOL_VERSION;
use palpate_tissue::file::write_file;
use serde_json::{Value, json};

use super::command::{DIR, experiment, find, make_folder};
use super::gallery::{self, Origin, Part};
use super::inputs::{Input, Inputs, SEED};
use super::recipe::Recipe;
use super::registry::{ALL, BENCHMARKS, Experiment, Work};
use super::safe_delays::SafeDelays;
use super::schedule::Schedule;
use crate::cli::{note, print_line};
use crate::progress::Progress;

/// Arguments of `all`.
#[derive(Debug, Args)]
pub struct AllArguments {
    /// Directory of the page (index.html), charts and tables
    #[arg(short, long = "out", value_name = "DIR", default_value = DIR)]
    out: PathBuf,
    /// Only these experiments, separated by commas
    #[arg(long, value_name = "NAMES", value_delimiter = ',', value_parser = item)]
    only: Vec<Experiment>,
    /// Seed for experiments with random numbers [default: 1]
    #[arg(long)]
    seed: Option<u64>,
    /// Networks for experiments with a network, separated by commas: names or files (.toml)
    #[arg(long, value_name = "PROFILES", value_delimiter = ',')]
    profile: Vec<String>,
    /// Recorded hand motion, a table (.csv) or a recording (.json), for experiments with a hand motion
    #[arg(long, value_name = "FILE")]
    motion: Option<String>,
    /// Print one line of JSON per experiment: name, ok, duration, and figures or error
    #[arg(long)]
    json: bool,
}

fn item(name: &str) -> Result<Experiment, String> {
    find(name, BENCHMARKS).map_or_else(|| experiment(name), Ok)
}

impl AllArguments {
    fn items(&self) -> Vec<Experiment> {
        if !self.only.is_empty() {
            return self.only.clone();
        }
        [ALL, BENCHMARKS].concat()
    }

    fn recipe(&self, experiment: Experiment) -> Recipe {
        let takes = |input| experiment.takes.contains(&input);
        Recipe {
            seed: self.seed.filter(|_| takes(Input::Seed)),
            profile: if takes(Input::Profile) {
                self.profile.clone()
            } else {
                Vec::new()
            },
            motion: self.motion.clone().filter(|_| takes(Input::Motion)),
            ..Recipe::default()
        }
    }

    fn command(&self, item: Experiment) -> String {
        if let Work::Command(line, _) = item.work {
            return line.to_owned();
        }
        let recipe = self.recipe(item);
        let mut command = format!("palpate-lab run {}", item.name);
        if item.takes.contains(&Input::Seed) {
            // Writing to a string cannot fail.
            let _ = write!(command, " --seed {}", recipe.seed.unwrap_or(SEED));
        }
        let networks = (!recipe.profile.is_empty()).then(|| recipe.profile.join(","));
        for (option, value) in [("profile", networks), ("motion", recipe.motion)] {
            if let Some(value) = value {
                let _ = write!(command, " --{option} {value}");
            }
        }
        command
    }
}

pub fn all(arguments: &AllArguments) -> Result<bool, String> {
    let kept = tempfile::tempdir()
        .map_err(|e| format!("cannot create a temporary directory for models: {e}"))?;
    make_folder(&arguments.out)?;
    let items = arguments.items();
    let page = arguments.out.join("index.html");
    let origin = Origin {
        versions: format!(
            "palpate-lab {}, protocol version {PROTOCOL_VERSION}",
            env!("CARGO_PKG_VERSION")
        ),
        machine: machine(),
        planned: items.len(),
    };
    let mut progress = Progress::new();
    let mut schedule = Schedule::new(items.iter().map(|item| item.took_s).collect());
    let mut parts: Vec<Part> = Vec::new();
    let safe_delays = SafeDelays::default();
    for item in items {
        progress.stage(&format!(
            "{}: {}  {}",
            item.name,
            item.about,
            schedule.line(0.0)
        ));
        let began = Instant::now();
        let mut report_progress = |what: &str, share: f64| {
            let line = schedule.line(began.elapsed().as_secs_f64());
            progress.tick(&format!("{line}; {what}: {:3.0} %", share * 100.0));
        };
        let run = AssertUnwindSafe(|| {
            let mut inputs = Inputs::load(&arguments.recipe(item), kept.path())?;
            for network in &mut inputs {
                network.safe_delays = safe_delays.clone();
            }
            item.run(inputs, kept.path(), &mut report_progress)
        });
        // The temporary state of an item is dropped after a panic.
        let result = catch_unwind(run).unwrap_or_else(|fault| Err(panicked(fault.as_ref())));
        let took_s = began.elapsed().as_secs_f64();
        schedule.done(took_s);
        let part = Part {
            item,
            command: arguments.command(item),
            took_s,
            result,
        };
        // Printed first, so a full disk cannot lose the figures.
        if arguments.json {
            print_line(&line(&part).to_string())?;
        }
        match &part.result {
            Ok(outcome) => outcome.write(&arguments.out, part.item.name)?,
            Err(why) => progress.stage(&format!("{} failed: {why}", part.item.name)),
        }
        parts.push(part);
        // Written after each item, so partial results are readable.
        make_folder(&arguments.out)?;
        write_file(&page, gallery::page(&parts, &origin)).map_err(|e| e.to_string())?;
    }
    drop(progress);
    let short = |p: &&Part| p.result.as_ref().is_ok_and(|o| !o.missed().is_empty());
    let missed = parts.iter().filter(short).count();
    let failed = parts.iter().filter(|p| p.result.is_err()).count();
    if !arguments.json {
        let done = parts.len() - failed;
        print_line(&format!("{done} of {} completed", parts.len()))?;
    }
    note(&format!("wrote the page {}", page.display()));
    let sentences = [(failed, "failed"), (missed, "missed their limits")];
    let said: Vec<String> = (sentences.iter().filter(|(n, _)| *n > 0))
        .map(|(n, what)| format!("{n} {what}"))
        .collect();
    if said.is_empty() {
        return Ok(true);
    }
    note(&format!(
        "palpate-lab: {}; the page shows the reasons",
        said.join(", ")
    ));
    Ok(false)
}

fn line(part: &Part) -> Value {
    let (key, value, ok) = match &part.result {
        Ok(outcome) => (
            "figures",
            outcome.figures.clone(),
            outcome.missed().is_empty(),
        ),
        Err(why) => ("error", Value::from(why.clone()), false),
    };
    json!({ "experiment": part.item.name, "ok": ok, "took_s": part.took_s, key: value })
}

fn machine() -> String {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    format!(
        "{} on {}, {threads} hardware threads",
        std::env::consts::OS,
        std::env::consts::ARCH
    )
}

fn panicked(fault: &(dyn std::any::Any + Send)) -> String {
    let words = (fault.downcast_ref::<String>().map(String::as_str))
        .or_else(|| fault.downcast_ref::<&str>().copied());
    format!(
        "internal error: {}; please report it with the command above",
        words.unwrap_or("no message")
    )
}
