//! An experiment with its options, as a file.
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

use serde::Deserialize;

use crate::nearest::with_nearest;

/// The largest file that is read, bytes: it names an experiment and its options.
const BYTES_MAX: u64 = 64 << 10;

/// What is to be run, and with what.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The experiment's name.
    pub experiment: String,
    /// Of everything that is left to chance.
    pub seed: Option<u64>,
    /// How many seeds to try.
    pub seeds: Option<u64>,
    /// How many sessions in real time.
    pub real: Option<u64>,
    /// The network.
    pub profile: Option<String>,
    /// A recorded motion (CSV).
    pub motion: Option<String>,
    /// Other tissue than the experiment's own.
    pub model: Option<String>,
}

impl Recipe {
    /// Reads one. Files that it names are looked for in its folder.
    pub fn load(path: &Path) -> Result<Self, String> {
        let shown = path.display();
        let read = |e: std::io::Error| format!("{shown} can not be read: {e}; check its name");
        let metadata = std::fs::metadata(path).map_err(read)?;
        if metadata.is_dir() {
            return Err(format!("{shown} is a folder; name a file in it"));
        }
        let bytes = metadata.len();
        if bytes > BYTES_MAX {
            return Err(format!(
                "{shown} has {bytes} bytes; a file that names an experiment has at most {BYTES_MAX}"
            ));
        }
        let text = std::fs::read_to_string(path).map_err(read)?;
        let mut recipe = Self::parse(&text).map_err(|e| format!("{shown}: {e}"))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let beside = |name: &mut String| {
            // What is no file there is a name, as of a sample.
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

    /// From the text of one.
    pub fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|e| with_nearest(&e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_names_an_experiment_and_its_options() {
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
    fn what_is_not_known_or_can_not_be_is_refused_with_its_line() {
        for (text, expected) in [
            (
                "experiment = \"press\"\nsede = 7\n",
                "did you mean \"seed\"?",
            ),
            ("seed = 7\n", "experiment"),
            ("experiment = \"press\"\nseed = -1\n", "line 2"),
            ("experiment = press\n", "line 1"),
        ] {
            let said = Recipe::parse(text).unwrap_err();
            assert!(said.contains(expected), "{said:?} should say {expected:?}");
        }
    }

    #[test]
    fn files_are_looked_for_beside_the_one_that_names_them() {
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
