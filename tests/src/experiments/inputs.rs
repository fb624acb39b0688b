//! Inputs of an experiment: its options, loaded from files and names.

use std::path::Path;
use std::sync::Arc;

use palpate_device::backend::replay::Motion;
use palpate_tissue::Model;

use super::recipe::Recipe;
use super::{Outcome, registry::Experiment};
use crate::bench::on_threads;
use crate::hand::{Hand, HandParameters, Random};
use crate::network::Profile;
use crate::test_model::{self, TestModel};

/// Default seed.
pub(super) const SEED: u64 = 1;

/// An option that experiments may accept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// Another tissue model.
    Model,
    /// Seed of the random numbers.
    Seed,
    /// Number of seeds.
    Seeds,
    /// Number of sessions in real time, with processes and sockets.
    Real,
    /// A network.
    Profile,
    /// Recorded hand motion.
    Motion,
}

/// Callback for progress: the activity and the completed share.
pub(super) type Progress<'a> = dyn FnMut(&str, f64) + Send + 'a;

/// Loaded options.
#[derive(Debug, Clone, Default)]
pub struct Inputs {
    /// Tissue model instead of the default.
    pub model: Option<Arc<Model>>,
    /// Seed of all random numbers, if given.
    pub seed: Option<u64>,
    /// Number of seeds.
    pub seeds: Option<u64>,
    /// Number of sessions in real time.
    pub real: Option<u64>,
    /// Network instead of the default.
    pub profile: Option<Profile>,
    /// Recorded motion instead of the default hand.
    pub motion: Option<Arc<Motion>>,
}

impl Inputs {
    /// Loads the files of a recipe; built models go into `dir`.
    pub(super) fn load(recipe: &Recipe, dir: &Path) -> Result<Self, String> {
        let profile = recipe.profile.as_deref().map(Profile::parse);
        let profile = profile.transpose().map_err(|e| e.to_string())?;
        let motion = recipe.motion.as_ref().map(|file| {
            let motion = Motion::load(Path::new(file)).map_err(|e| format!("{file}: {e}"));
            motion.map(Arc::new)
        });
        let motion = motion.transpose()?;
        // Last: a build takes long.
        let model = recipe.model.as_ref().map(|name| {
            let built = TestModel::prepare(name, dir).map_err(|e| e.to_string());
            built.map(|built| built.model)
        });
        Ok(Self {
            profile,
            motion,
            model: model.transpose()?,
            seed: recipe.seed,
            seeds: recipe.seeds,
            real: recipe.real,
        })
    }
}

/// An experiment's inputs, working directory and progress.
pub struct Bench<'a> {
    /// The options.
    pub inputs: Inputs,
    /// Directory for built models.
    pub dir: &'a Path,
    /// Progress callback.
    pub progress: &'a mut Progress<'a>,
}

impl Bench<'_> {
    /// The seed of all random numbers.
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

    /// The given network, or a named one.
    pub(super) fn profile_or(&self, name: &str) -> Result<Profile, String> {
        match &self.inputs.profile {
            Some(profile) => Ok(profile.clone()),
            None => Profile::named(name).map_err(|e| e.to_string()),
        }
    }

    /// The given model, or a built-in sample.
    pub(super) fn model_or(&mut self, sample: &str) -> Result<Arc<Model>, String> {
        if let Some(model) = &self.inputs.model {
            return Ok(Arc::clone(model));
        }
        (self.progress)(&format!("building the sample \"{sample}\""), 0.0);
        let built = TestModel::prepare(sample, self.dir).map_err(|e| e.to_string())?;
        Ok(built.model)
    }

    /// The given model, or a soft block of this many cells.
    pub(super) fn model_or_block(&self, cells: [usize; 3]) -> Arc<Model> {
        let block = || Arc::new(test_model::soft_block(cells, 5e-3));
        self.inputs.model.clone().unwrap_or_else(block)
    }
}

impl Experiment {
    /// Runs the experiment on one thread, as the haptic path requires.
    pub(super) fn run(
        &self,
        inputs: Inputs,
        dir: &Path,
        progress: &mut Progress<'_>,
    ) -> Result<Outcome, String> {
        let run = self.run;
        on_threads(1, || {
            run(&mut Bench {
                inputs,
                dir,
                progress: &mut |what, share| progress(what, share),
            })
        })?
    }
}
