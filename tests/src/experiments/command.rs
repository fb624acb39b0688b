//! `palpate-lab run`, `list` and `all`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use serde_json::json;

use super::{ALL, Bench, Experiment, Outcome, gallery, named};
use crate::bench::on_threads;
use crate::cli::say;
use crate::progress::Progress;
use crate::subject::Subject;

/// Where everything goes when nothing is said.
const DIR: &str = "palpate-experiments";

/// What `run --help` ends with.
pub const RUN_HELP: &str = "\
Examples:
  palpate-lab list
  palpate-lab run friction                       figures here, charts and tables in ./palpate-experiments
  palpate-lab run press --model thigh.palp --json
  palpate-lab all -o report                      every experiment, and report/index.html with all charts

What a hand feels comes from the haptic path as clients run it: models solved 250 times a second with 1 ms of work
each, on one thread, and the 1 kHz chain between them. It is compared with a solver that converges every eleventh
millisecond. rms is the root mean square of the difference over that of the converged answer.";

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Which experiment; `palpate-lab list` names them
    #[arg(value_parser = experiment)]
    experiment: Experiment,
    /// Other tissue than the experiment's own: a model file (.palp), a scene (.toml), or a sample
    #[arg(long)]
    model: Option<String>,
    /// Print one line of JSON, and write charts and tables only where -o says
    #[arg(long)]
    json: bool,
    /// Where charts (SVG) and tables (CSV) go [default: palpate-experiments; with --json nowhere]
    #[arg(short, long = "out", value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Arguments of `all`.
#[derive(Debug, Args)]
pub struct AllArguments {
    /// Where the page (index.html), charts and tables go
    #[arg(short, long = "out", value_name = "DIR", default_value = DIR)]
    out: PathBuf,
    /// Print one line of JSON per experiment
    #[arg(long)]
    json: bool,
}

fn experiment(name: &str) -> Result<Experiment, String> {
    named(name).ok_or_else(|| {
        let names = ALL.map(|e| e.name).join(", ");
        format!("there is no experiment \"{name}\"; there are {names}")
    })
}

/// Lists the experiments.
pub fn list() -> Result<ExitCode, String> {
    for e in ALL {
        say(&format!("{:<12} {}", e.name, e.about))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Runs one.
pub fn run(arguments: &RunArguments) -> Result<ExitCode, String> {
    if arguments.model.is_some() && !arguments.experiment.takes_models {
        let name = arguments.experiment.name;
        return Err(format!(
            "\"{name}\" has tissue of its own; leave --model out"
        ));
    }
    let kept = tempfile::tempdir().map_err(|e| format!("no folder for models: {e}"))?;
    let mut progress = Progress::new();
    let model = match &arguments.model {
        Some(name) => {
            progress.stage(&format!("preparing the model \"{name}\""));
            let subject = Subject::prepare(name, kept.path()).map_err(|e| e.to_string())?;
            Some(subject.model)
        }
        None => None,
    };
    let outcome = made(arguments.experiment, model, kept.path(), &mut progress)?;
    let out = match (&arguments.out, arguments.json) {
        (Some(dir), _) => Some(dir.clone()),
        (None, true) => None,
        (None, false) => Some(PathBuf::from(DIR)),
    };
    if let Some(dir) = &out {
        outcome.write(dir)?;
    }
    drop(progress);
    if arguments.json {
        say(&outcome.figures.to_string())?;
    } else {
        let figures = serde_json::to_string_pretty(&outcome.figures).expect("plain data");
        say(&format!("{}\n\n{figures}", outcome.caption))?;
    }
    if let Some(dir) = out {
        eprintln!("charts and tables are in {}", dir.display());
    }
    Ok(ExitCode::SUCCESS)
}

/// Runs all of them and makes a page of it.
pub fn all(arguments: &AllArguments) -> Result<ExitCode, String> {
    let kept = tempfile::tempdir().map_err(|e| format!("no folder for models: {e}"))?;
    let mut progress = Progress::new();
    let mut done = Vec::new();
    for experiment in ALL {
        let outcome = made(experiment, None, kept.path(), &mut progress)?;
        outcome.write(&arguments.out)?;
        if arguments.json {
            say(&outcome.figures.to_string())?;
        }
        done.push((experiment, outcome));
        // After each, so that what is done can be looked at.
        let page = arguments.out.join("index.html");
        std::fs::write(&page, gallery::page(&done))
            .map_err(|e| format!("{}: {e}; check that the disk has room", page.display()))?;
    }
    drop(progress);
    if !arguments.json {
        say(&json!({ "experiments": done.len() }).to_string())?;
    }
    eprintln!("the page is {}", arguments.out.join("index.html").display());
    Ok(ExitCode::SUCCESS)
}

/// One experiment on one thread, as the haptic path is measured.
fn made(
    experiment: Experiment,
    model: Option<std::sync::Arc<palpate_tissue::Model>>,
    dir: &Path,
    progress: &mut Progress,
) -> Result<Outcome, String> {
    progress.stage(&format!("{}: {}", experiment.name, experiment.about));
    let mut told = |what: &str, share: f64| {
        progress.tick(&format!("{what}: {:3.0} %", share * 100.0));
    };
    on_threads(1, || {
        experiment.run(&mut Bench {
            model,
            dir,
            progress: &mut told,
        })
    })?
}
