//! A TOML file with an experiment and its options.
//!
//! ```toml
//! experiment = "table-7-1"
//! seed = 7                    # each of these only where the experiment takes it
//! seeds = 100
//! real = 20
//! motion = "hand.csv"         # files are looked for beside this one
//! profile = "transatlantic"
//! model = "thigh"
//! ```

use std::path::Path;

use palpate_device::text_file::{self, TextFileError};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};

use crate::name_suggestion::with_nearest;

/// Maximum file size, bytes.
const BYTES_MAX: u64 = 64 << 10;

/// Maximum number of seeds, days of work; also the limit of the command line.
pub const SEEDS_MAX: u64 = 1_000_000;

/// Maximum number of sessions in real time, about a day.
pub const REAL_MAX: u64 = 10_000;

fn seeds<'de, D: Deserializer<'de>>(value: D) -> Result<Option<u64>, D::Error> {
    between_one_and(SEEDS_MAX, value)
}

fn real<'de, D: Deserializer<'de>>(value: D) -> Result<Option<u64>, D::Error> {
    between_one_and(REAL_MAX, value)
}

fn between_one_and<'de, D: Deserializer<'de>>(max: u64, value: D) -> Result<Option<u64>, D::Error> {
    let n = u64::deserialize(value)?;
    if (1..=max).contains(&n) {
        return Ok(Some(n));
    }
    Err(D::Error::custom(format!(
        "{n} is out of range; use a number from 1 to {max}"
    )))
}

/// An experiment and its options.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The experiment's name.
    pub experiment: String,
    /// Seed of the random numbers.
    pub seed: Option<u64>,
    /// Number of seeds, 1 to [`SEEDS_MAX`].
    #[serde(default, deserialize_with = "seeds")]
    pub seeds: Option<u64>,
    /// Number of sessions in real time, 1 to [`REAL_MAX`].
    #[serde(default, deserialize_with = "real")]
    pub real: Option<u64>,
    /// The network.
    pub profile: Option<String>,
    /// A recorded motion (CSV).
    pub motion: Option<String>,
    /// Tissue model.
    pub model: Option<String>,
}

impl Recipe {
    /// Loads a recipe. Relative paths in it refer to its directory.
    pub fn load(path: &Path) -> Result<Self, String> {
        let shown = path.display();
        let text = text_file::read(path, BYTES_MAX).map_err(|e| match e {
            TextFileError::Read(why) => format!("cannot read {shown}: {why}"),
            TextFileError::TooLarge { bytes } => {
                format!(
                    "{shown} has {bytes} bytes; an experiment file may have at most {BYTES_MAX}"
                )
            }
        })?;
        let mut recipe = Self::parse(&text).map_err(|e| format!("{shown}: {e}"))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let beside = |name: &mut String| {
            // A value that is no file there may be a name, such as a sample.
            let file = folder.join(&*name);
            if file.is_file() {
                *name = file.display().to_string();
            }
        };
        recipe.motion.iter_mut().for_each(beside);
        recipe.model.iter_mut().for_each(beside);
        recipe.profile.iter_mut().for_each(beside);
        Ok(recipe)
    }

    /// Parses a recipe.
    pub fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|e| with_nearest(&e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recipe_contains_experiment_and_options() {
        let recipe = Recipe::parse("experiment = \"table-7-1\"\nseed = 7\nmotion = \"a.csv\"\n");
        let recipe = recipe.unwrap();
        assert_eq!(
            (recipe.experiment.as_str(), recipe.seed),
            ("table-7-1", Some(7))
        );
        assert_eq!(
            (recipe.motion.as_deref(), recipe.profile),
            (Some("a.csv"), None)
        );
    }

    #[test]
    fn invalid_recipes_are_rejected_with_their_line() {
        for (text, expected) in [
            (
                "experiment = \"press\"\nsede = 7\n",
                "did you mean \"seed\"?",
            ),
            ("seed = 7\n", "experiment"),
            ("experiment = \"press\"\nseed = -1\n", "line 2"),
            ("experiment = press\n", "line 1"),
            (
                "experiment = \"replicas\"\nseeds = 0\n",
                "0 is out of range; use a number from 1 to 1000000",
            ),
            (
                "experiment = \"replicas\"\nseeds = 99999999999999\n",
                "line 2",
            ),
            ("experiment = \"replicas\"\n\nreal = 0\n", "line 3"),
        ] {
            let said = Recipe::parse(text).unwrap_err();
            assert!(
                said.contains(expected),
                "{said:?} should contain {expected:?}"
            );
        }
    }

    #[test]
    fn paths_are_relative_to_the_recipe() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("hand.csv"), "").unwrap();
        let path = dir.path().join("mine.toml");
        let text = "experiment = \"x\"\nmotion = \"hand.csv\"\nmodel = \"thigh\"\n";
        std::fs::write(&path, text).unwrap();
        let recipe = Recipe::load(&path).unwrap();
        let hand = dir.path().join("hand.csv").display().to_string();
        assert_eq!(recipe.motion, Some(hand));
        assert_eq!(recipe.model.as_deref(), Some("thigh"));
    }
}
