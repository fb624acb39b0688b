//! `palpate-lab run` and `list`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::inputs::Inputs;
use super::recipe::Recipe;
use super::registry::{ALL, Experiment};
use crate::cli::{note, print_line};
use crate::name_suggestion::did_you_mean;
use crate::progress::Progress;

pub(super) const DIR: &str = "palpate-experiments";

pub const RUN_HELP: &str = "\
Examples:
  palpate-lab list
  palpate-lab run friction                       figures here, charts and tables in ./palpate-experiments
  palpate-lab run press --model thigh.palp --json
  palpate-lab run table-7-1 --motion hand.csv    columns time_s,x_m,y_m,z_m[,qw,qx,qy,qz]; see `palpate-lab hand`
  palpate-lab run replicas --seeds 1000 --real 20 --json
  palpate-lab run atc-adaptive --profile lan,lte one run per network
  palpate-lab run validate --fine                finer spacings; minutes
  palpate-lab run mine.toml                      experiment and options from a file;
                                                 command-line options override the file's
  palpate-lab all --out report                   all experiments, and report/index.html with all tables and charts
  palpate-lab all --only atc-fixed,atc-adaptive --profile mine-too.toml --out report

An experiment file (its paths are relative to the file):
  experiment = \"table-7-1\"
  seed = 7                                       also seeds, real, profile, model, fine, if the experiment accepts them
  motion = \"hand.csv\"
  profile = [\"lan\", \"mine-too.toml\"]             or a single one

--json prints one JSON object; --out writes it to NAME.json, and charts (SVG), pictures (PNG) and tables (CSV):
  table-7-1     {experiment, seed, hands [{hand, rate_hz of a recording, speed_rms_mm_s}], rows [{hand, kind:
                interpolation|extrapolation, method, rate_hz, finer than the recording, gap_ms, rms_mm, max_mm, rms_deg,
                force_percent, n}]}
  missing-data  {experiment, rate_hz, gap_ms, methods [{kind, method, rms_mm, max_mm, rms_deg}]}
  atc-*         {mode, profile, seed, disagreement_mm {rms, p95, max}, compensation_ms {mean, p95},
                smallest_safe_fixed_ms, corrections_over_1mm, stale_ticks}; atc-predicted also ahead_ms and, beside it,
                adaptive {disagreement_mm, compensation_ms}
  transmission  {profile, seed, without_ms {mean, deviation}, with_ms {mean, deviation}}
  jitter        {profile, seed, without_um, with_um}
  replicas      {profile, seeds, shape_disagreement_mm {p50, p95, max}, force_error_rms, force_error_p95,
                outside_stalls [the same], stalls {share, dropouts, force_step_max_n}, hashes_equal,
                bytes_per_s {up, down}, ok, missed [one message per missed limit], networks [the same for each network]};
                thin and scale also have ok and missed; the exit code is 1 if ok is false
  cut-time      {experiment, sizes [{nodes, opening, first_ms, cut | other | follow | step | quiet_step {p50_ms, p99_ms,
                max_ms}, cut_ratio}]}
  cut-width     {experiment, cuts [{model, width_mm, depth_mm, pairs, on_law_percent, deviation_max_mm, ...}]}
  cut-gallery   {experiment, pictures [{picture, figure, faces, on_path_percent, off_path (spacings), components, quantity,
                measured, expected}], quality [{model, refinement, cells, inverted, worst, p5, mean, shortest_spring}]}
  validate      {experiment, limit_percent, fine, cases [{case, poisson, quantity, reference, expected, cells, error_percent,
                order, extrapolated_percent, ok, runs [{spacing_mm, cells, nodes, measured, error_percent, ...}]}], ok, missed}
  on tissue     {experiment, spots | cases | materials | paths [{..., deviation {largest, n, rms, worst}}]}: largest force
                (N) or torque (N m), rms and worst deviation from the converged solution as shares of it
Over several networks: {networks [the figures of each, or profile and error], ok, missed}.
Lengths end in _mm or _um, times in _ms, angles in _deg; shares are 0 to 1 unless they end in _percent.

Rendered forces come from the client's haptic path: contact models solved 250 times per second with 1 ms of work each,
on one thread, and the 1 kHz haptic chain. The reference is a solver that converges every 11 ms. rms is the root mean
square of the difference, relative to that of the converged solution.";

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Experiment (see `palpate-lab list`), or a file (.toml) with an experiment and its options
    #[arg(value_parser = which, value_name = "NAME|FILE.toml")]
    experiment: Which,
    #[command(flatten)]
    options: Recipe,
    /// Print one line of JSON; write charts, pictures and tables only with -o
    #[arg(long)]
    json: bool,
    /// Directory for figures (JSON), charts (SVG), pictures (PNG) and tables (CSV) [default: palpate-experiments; with
    /// --json none]
    #[arg(short, long = "out", value_name = "DIR")]
    out: Option<PathBuf>,
}

#[derive(Debug, Clone)]
enum Which {
    Named(Experiment),
    File(PathBuf),
}

fn which(word: &str) -> Result<Which, String> {
    if Path::new(word).extension().is_some_and(|e| e == "toml") {
        return Ok(Which::File(word.into()));
    }
    experiment(word).map(Which::Named)
}

pub(super) fn find(name: &str, among: &[Experiment]) -> Option<Experiment> {
    among.iter().find(|e| e.name == name).copied()
}

pub(super) fn experiment(name: &str) -> Result<Experiment, String> {
    find(name, ALL).ok_or_else(|| {
        let names: Vec<&str> = ALL.iter().map(|e| e.name).collect();
        let (meant, names) = (did_you_mean(name, &names), names.join(", "));
        format!("unknown experiment \"{name}\"{meant}; known experiments: {names}")
    })
}

impl RunArguments {
    fn recipe(&self) -> Result<(Experiment, Recipe), String> {
        let (experiment, file) = match &self.experiment {
            Which::Named(experiment) => (*experiment, Recipe::default()),
            Which::File(path) => {
                let recipe = Recipe::load(path)?;
                let named = experiment(&recipe.experiment);
                let named = named.map_err(|e| format!("{}: {e}", path.display()))?;
                (named, recipe)
            }
        };
        Ok((experiment, self.options.clone().or(file)))
    }
}

fn refuse_unused(experiment: Experiment, recipe: &Recipe) -> Result<(), String> {
    for (input, is_given) in recipe.options() {
        if is_given && !experiment.takes.contains(&input) {
            let (option, why) = input.described();
            return Err(format!(
                "\"{}\" {why}; remove --{option} or the line `{option}` in the file",
                experiment.name
            ));
        }
    }
    Ok(())
}

pub fn list() -> Result<bool, String> {
    for e in ALL {
        print_line(&format!("{:<12} {}", e.name, e.about))?;
    }
    Ok(true)
}

pub fn run(arguments: &RunArguments) -> Result<bool, String> {
    let (experiment, recipe) = arguments.recipe()?;
    refuse_unused(experiment, &recipe)?;
    let out = match (&arguments.out, arguments.json) {
        (Some(dir), _) => Some(dir.clone()),
        (None, true) => None,
        (None, false) => Some(PathBuf::from(DIR)),
    };
    let kept = tempfile::tempdir()
        .map_err(|e| format!("cannot create a temporary directory for models: {e}"))?;
    let mut progress = Progress::new();
    if let Some(name) = &recipe.model {
        progress.stage(&format!("preparing the model \"{name}\""));
    }
    let inputs = Inputs::load(&recipe, kept.path())?;
    // Created after the inputs are validated and before the work.
    out.as_deref().map_or(Ok(()), make_folder)?;
    progress.stage(&format!("{}: {}", experiment.name, experiment.about));
    let mut report_progress = |what: &str, share: f64| {
        progress.tick(&format!("{what}: {:3.0} %", share * 100.0));
    };
    let outcome = experiment.run(inputs, kept.path(), &mut report_progress)?;
    drop(progress);
    // Printed first, so a full disk cannot lose the figures.
    if arguments.json {
        print_line(&outcome.figures.to_string())?;
    } else {
        print_line(&outcome.to_text())?;
    }
    if let Some(dir) = out {
        outcome.write(&dir, experiment.name)?;
        note(&format!(
            "figures, charts and tables are in {}",
            dir.display()
        ));
    }
    let missed = outcome.missed();
    if missed.is_empty() {
        return Ok(true);
    }
    Err(format!("not ok: {}", missed.join("; ")))
}

/// Creates the output directory and checks that it is writable, before hours of work.
pub(super) fn make_folder(dir: &Path) -> Result<(), String> {
    let shown = dir.display();
    if dir.is_file() {
        return Err(format!("--out {shown} is a file; choose a directory"));
    }
    std::fs::create_dir_all(dir)
        .and_then(|()| tempfile::tempfile_in(dir).map(drop))
        .map_err(|e| format!("--out {shown}: {e}; choose a writable directory"))
}
