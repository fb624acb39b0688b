//! Inputs of an experiment: its options, loaded from files and names.

use std::path::Path;
use std::sync::Arc;

use palpate_device::backend::replay::Motion;
use palpate_tissue::Model;
use serde_json::Value;

use super::Outcome;
use super::recipe::Recipe;
use super::registry::{Experiment, Work};
use super::safe_delays::SafeDelays;
use crate::bench::on_threads;
use crate::cli::measured;
use crate::hand::{Hand, HandParameters, Random};
use crate::network::Profile;
use crate::test_model::{self, TestModel};

pub(super) const SEED: u64 = 1;

/// A week.
const TRACE_OFFSET_MAX_S: f64 = 604_800.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    Model,
    Seed,
    Seeds,
    /// Number of sessions in real time, with processes and sockets.
    Real,
    Profile,
    Motion,
    /// Finer spacings, which take minutes.
    Fine,
}

impl Input {
    /// Name of the option, and why an experiment may not accept it.
    pub(super) fn described(self) -> (&'static str, &'static str) {
        match self {
            Self::Model => ("model", "has a fixed tissue"),
            Self::Seed => ("seed", "uses no random numbers"),
            Self::Seeds => ("seeds", "has a single run"),
            Self::Real => ("real", "has no real-time sessions"),
            Self::Profile => ("profile", "has no network or a fixed set of networks"),
            Self::Motion => ("motion", "has fixed tool paths"),
            Self::Fine => ("fine", "has fixed spacings"),
        }
    }
}

/// Callback for progress: the activity and the completed share.
pub(super) type Progress<'a> = dyn FnMut(&str, f64) + Send + 'a;

#[derive(Clone, Default)]
pub struct Inputs {
    pub model: Option<Arc<Model>>,
    pub seed: Option<u64>,
    pub seeds: Option<u64>,
    pub real: Option<u64>,
    pub profile: Option<Profile>,
    pub motion: Option<Arc<Motion>>,
    pub fine: bool,
    pub(super) safe_delays: SafeDelays,
}

impl Inputs {
    /// Loads the files of a recipe, for one run per network; built models go into `dir`.
    pub(super) fn load(recipe: &Recipe, dir: &Path) -> Result<Vec<Self>, String> {
        let profiles = recipe.profile.iter().map(|name| Profile::parse(name));
        let mut profiles: Vec<Profile> = profiles.collect::<Result<_, _>>()?;
        for (k, profile) in profiles.iter().enumerate() {
            if profiles[..k].iter().any(|p| p.name == profile.name) {
                return Err(format!(
                    "two networks are named \"{}\"; rename one in its file",
                    profile.name
                ));
            }
        }
        if let Some(offset_s) = recipe.trace_offset {
            if profiles.is_empty() || !profiles.iter().all(Profile::has_trace) {
                return Err("--trace-offset needs a --profile with a trace".into());
            }
            if !(0.0..=TRACE_OFFSET_MAX_S).contains(&offset_s) {
                return Err(format!(
                    "--trace-offset {offset_s} is out of range; use a number from 0 to {TRACE_OFFSET_MAX_S}"
                ));
            }
            for profile in &mut profiles {
                profile.begin_traces_at(offset_s);
            }
        }
        let motion = recipe.motion.as_ref().map(|file| {
            let motion = Motion::load(Path::new(file)).map_err(|e| format!("{file}: {e}"));
            motion.map(Arc::new)
        });
        let motion = motion.transpose()?;
        // Last: a build takes long.
        let model = recipe
            .model
            .as_ref()
            .map(|name| TestModel::prepare(name, dir).map(|built| built.model));
        let default = Self {
            profile: None,
            motion,
            model: model.transpose()?,
            seed: recipe.seed,
            seeds: recipe.seeds,
            real: recipe.real,
            fine: recipe.fine,
            safe_delays: SafeDelays::default(),
        };
        if profiles.is_empty() {
            return Ok(vec![default]);
        }
        let over = |profile| Self {
            profile: Some(profile),
            ..default.clone()
        };
        Ok(profiles.into_iter().map(over).collect())
    }
}

pub struct Bench<'a> {
    pub inputs: Inputs,
    /// Directory for built models.
    pub dir: &'a Path,
    pub progress: &'a mut Progress<'a>,
}

impl Bench<'_> {
    pub(super) fn seed(&self) -> u64 {
        self.inputs.seed.unwrap_or(SEED)
    }

    /// The given motion, or a random hand of 87 mm/s with 0.1 mm tremor.
    pub(super) fn hand(&self) -> Arc<dyn Hand> {
        match &self.inputs.motion {
            Some(recorded) => Arc::<Motion>::clone(recorded),
            None => Arc::new(Random::new(HandParameters::default(), self.seed())),
        }
    }

    pub(super) fn profile_or(&self, name: &str) -> Result<Profile, String> {
        match &self.inputs.profile {
            Some(profile) => Ok(profile.clone()),
            None => Profile::named(name),
        }
    }

    pub(super) fn model_or(&mut self, sample: &str) -> Result<Arc<Model>, String> {
        if let Some(model) = &self.inputs.model {
            return Ok(Arc::clone(model));
        }
        (self.progress)(&format!("building the sample \"{sample}\""), 0.0);
        Ok(TestModel::prepare(sample, self.dir)?.model)
    }

    /// The given model, or a soft block of this many cells.
    pub(super) fn model_or_block(&self, cells: [usize; 3]) -> Arc<Model> {
        let block = || Arc::new(test_model::soft_block(cells, 5e-3));
        self.inputs.model.clone().unwrap_or_else(block)
    }
}

impl Experiment {
    /// Runs an experiment once per network, or a benchmark.
    pub(super) fn run(
        &self,
        networks: Vec<Inputs>,
        dir: &Path,
        progress: &mut Progress<'_>,
    ) -> Result<Outcome, String> {
        let all = networks.len() as f64;
        let mut outcomes = Vec::new();
        for (k, inputs) in networks.into_iter().enumerate() {
            let name = inputs.profile.as_ref().map(|p| p.name.clone());
            let name = name.unwrap_or_default();
            let mut within = |what: &str, share: f64| progress(what, (k as f64 + share) / all);
            let outcome = match self.run_over(inputs, dir, &mut within) {
                // The results of the other networks are kept.
                Err(why) if all > 1.0 => Outcome::failed_over(&name, &why),
                result => result?,
            };
            outcomes.push((name, outcome));
        }
        Ok(Outcome::of_networks(outcomes))
    }

    /// On one thread, as the haptic path requires.
    fn run_over(
        &self,
        inputs: Inputs,
        dir: &Path,
        progress: &mut Progress<'_>,
    ) -> Result<Outcome, String> {
        let run = match self.work {
            Work::Experiment(run) => run,
            Work::Command(line, caption) => {
                return on_threads(1, || measure(line, caption, progress))?;
            }
        };
        on_threads(1, || {
            run(&mut Bench {
                inputs,
                dir,
                progress: &mut |what, share| progress(what, share),
            })
        })?
    }
}

fn measure(line: &str, caption: &str, progress: &mut Progress<'_>) -> Result<Outcome, String> {
    let [json, text] = measured(line, &mut |what| progress(what, 0.0))?;
    let figures: Value = serde_json::from_str(&json).map_err(|e| e.to_string())?;
    if figures["failures"]
        .as_array()
        .is_some_and(|f| !f.is_empty())
    {
        return Err(text);
    }
    Ok(Outcome {
        caption: caption.to_owned(),
        figures,
        text: Some(text),
        ..Outcome::default()
    })
}
