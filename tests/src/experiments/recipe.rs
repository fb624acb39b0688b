//! A TOML file with an experiment and its options.
//!
//! ```toml
//! experiment = "table-7-1"
//! seed = 7                    # each of these only where the experiment takes it
//! seeds = 100
//! real = 20
//! motion = "hand.csv"         # files are looked for beside this one
//! profile = "transatlantic"   # or a list, for one run per network
//! model = "thigh"
//! fine = true                 # finer spacings
//! ```

use std::path::Path;

use clap::Args;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};

use super::Input;
use crate::input_file;
use crate::name_suggestion::with_suggestion;

const BYTES_MAX: u64 = 64 << 10;

/// Maximum number of seeds, days of work; also the limit of the command line.
pub const SEEDS_MAX: u64 = 1_000_000;

/// Maximum number of sessions in real time, about a day.
pub const REAL_MAX: u64 = 10_000;

fn up_to<'de, const MAX: u64, D: Deserializer<'de>>(value: D) -> Result<Option<u64>, D::Error> {
    let n = u64::deserialize(value)?;
    if (1..=MAX).contains(&n) {
        return Ok(Some(n));
    }
    Err(D::Error::custom(format!(
        "{n} is out of range; use a number from 1 to {MAX}"
    )))
}

fn one_or_more<'de, D: Deserializer<'de>>(value: D) -> Result<Vec<String>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "expected a network or a list of networks")]
    enum Names {
        One(String),
        More(Vec<String>),
    }
    Ok(match Names::deserialize(value)? {
        Names::One(name) => vec![name],
        Names::More(names) => names,
    })
}

/// An experiment and its options, in a file or on the command line.
#[derive(Debug, Clone, PartialEq, Default, Deserialize, Args)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The experiment's name.
    #[arg(skip)]
    pub experiment: String,
    /// Tissue instead of the default: a model file (.palp), a scene (.toml), or a sample
    #[arg(long)]
    pub model: Option<String>,
    /// Seed of the random numbers [default: 1]
    #[arg(long)]
    pub seed: Option<u64>,
    /// Number of simulated sessions, each with its own seed
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=SEEDS_MAX))]
    #[serde(default, deserialize_with = "up_to::<SEEDS_MAX, _>")]
    pub seeds: Option<u64>,
    /// Number of additional sessions in real time, with processes and QUIC
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=REAL_MAX))]
    #[serde(default, deserialize_with = "up_to::<REAL_MAX, _>")]
    pub real: Option<u64>,
    /// Networks instead of the default, separated by commas: names or files (.toml); the experiment runs once per network
    #[arg(long, value_name = "PROFILES", value_delimiter = ',')]
    #[serde(default, deserialize_with = "one_or_more")]
    pub profile: Vec<String>,
    /// Where every session begins in the traces of the network, s [default: a random time for each seed and site]
    #[arg(long, value_name = "SECONDS")]
    pub trace_offset: Option<f64>,
    /// Recorded hand motion, a table (.csv) or a recording (.json), instead of the default
    #[arg(long, value_name = "FILE")]
    pub motion: Option<String>,
    /// Finer spacings, which take minutes
    #[arg(long)]
    #[serde(default)]
    pub fine: bool,
}

impl Recipe {
    /// Loads a recipe. Relative paths in it refer to its directory.
    pub fn load(path: &Path) -> Result<Self, String> {
        let text = input_file::read(path, "experiment file", BYTES_MAX, "name files in it")?;
        let mut recipe = Self::parse(&text).map_err(|e| format!("{}: {e}", path.display()))?;
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

    /// This recipe, with the options of `file` where it has none.
    #[must_use]
    pub fn or(self, file: Self) -> Self {
        Self {
            experiment: file.experiment,
            model: self.model.or(file.model),
            seed: self.seed.or(file.seed),
            seeds: self.seeds.or(file.seeds),
            real: self.real.or(file.real),
            profile: if self.profile.is_empty() {
                file.profile
            } else {
                self.profile
            },
            trace_offset: self.trace_offset.or(file.trace_offset),
            motion: self.motion.or(file.motion),
            fine: self.fine || file.fine,
        }
    }

    pub(super) fn options(&self) -> [(Input, bool); 7] {
        [
            (Input::Model, self.model.is_some()),
            (Input::Seed, self.seed.is_some()),
            (Input::Seeds, self.seeds.is_some()),
            (Input::Real, self.real.is_some()),
            (
                Input::Profile,
                !self.profile.is_empty() || self.trace_offset.is_some(),
            ),
            (Input::Motion, self.motion.is_some()),
            (Input::Fine, self.fine),
        ]
    }

    pub fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|e| with_suggestion(&e.to_string()))
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
            (Some("a.csv"), vec![])
        );
    }

    #[test]
    fn recipe_accepts_one_network_or_several() {
        for (value, expected) in [
            ("\"lan\"", vec!["lan"]),
            ("[\"lan\", \"lte\"]", vec!["lan", "lte"]),
        ] {
            let recipe = Recipe::parse(&format!("experiment = \"thin\"\nprofile = {value}\n"));
            assert_eq!(recipe.unwrap().profile, expected);
        }
        let said = Recipe::parse("experiment = \"thin\"\nprofile = 7\n").unwrap_err();
        assert!(said.contains("a network or a list of networks"), "{said}");
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
