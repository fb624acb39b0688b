//! Network profiles, by name or from a file.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use super::link::Link;
use super::path::Direction;
use super::trace::Trace;
use crate::input_file;
use crate::name_suggestion::{did_you_mean, with_suggestion};

const FILE_BYTES_MAX: u64 = 1_000_000;

/// A network; `up` is the link to the server.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    pub name: String,
    pub up: Link,
    pub down: Link,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Document {
    name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    both: Option<Link>,
    #[serde(skip_serializing_if = "Option::is_none")]
    up: Option<Link>,
    #[serde(skip_serializing_if = "Option::is_none")]
    down: Option<Link>,
}

#[derive(Deserialize)]
struct Named {
    profile: Vec<Document>,
}

static NAMED: LazyLock<Vec<Profile>> = LazyLock::new(|| {
    let named = toml::from_str::<Named>(include_str!("profiles.toml")).expect("valid profiles");
    let profile = |document: Document| {
        let link = document.both.expect("named networks are symmetric");
        Profile::both(&document.name, link)
    };
    named.profile.into_iter().map(profile).collect()
});

impl Profile {
    pub fn names() -> impl Iterator<Item = &'static str> {
        NAMED.iter().map(|profile| profile.name.as_str())
    }

    pub fn named(name: &str) -> Result<Self, String> {
        let named = NAMED.iter().find(|profile| profile.name == name);
        named.cloned().ok_or_else(|| {
            let names: Vec<&str> = Self::names().collect();
            let (meant, names) = (did_you_mean(name, &names), names.join(", "));
            format!(
                "unknown network profile \"{name}\"{meant}. Known profiles: {names}; or give a TOML file's \
                 path, which ends in .toml"
            )
        })
    }

    /// The recorded networks: files in the folder `networks` of `PALPATE_DATA`, by name.
    pub fn recorded() -> Vec<PathBuf> {
        let folder = std::env::var_os("PALPATE_DATA").map(|data| Path::new(&data).join("networks"));
        let entries = folder.and_then(|folder| std::fs::read_dir(folder).ok());
        let files = entries.into_iter().flatten().flatten().map(|e| e.path());
        let mut files: Vec<PathBuf> = files
            .filter(|file| file.extension().is_some_and(|e| e == "toml"))
            .collect();
        files.sort();
        files
    }

    pub fn has_trace(&self) -> bool {
        self.trace_period_us().is_some()
    }

    /// Length of the longer trace, microseconds.
    pub fn trace_period_us(&self) -> Option<u64> {
        let traces = [&self.up, &self.down].map(|link| link.trace.as_ref());
        traces.into_iter().flatten().map(Trace::period_us).max()
    }

    /// Begins all sessions at this time of the traces, s, instead of a random one.
    pub fn begin_traces_at(&mut self, offset_s: f64) {
        for link in [&mut self.up, &mut self.down] {
            link.trace_offset_s = Some(offset_s);
        }
    }

    /// A symmetric network.
    pub fn both(name: &str, link: Link) -> Self {
        Self {
            name: name.to_owned(),
            up: link.clone(),
            down: link,
        }
    }

    pub fn link(&self, direction: Direction) -> &Link {
        match direction {
            Direction::Up => &self.up,
            Direction::Down => &self.down,
        }
    }

    /// A profile by name, or from the `.toml` file with this path.
    pub fn parse(name_or_path: &str) -> Result<Self, String> {
        let path = Path::new(name_or_path);
        if path.extension().is_none_or(|e| e != "toml") {
            let is_named = |file: &PathBuf| file.file_stem().is_some_and(|s| s == name_or_path);
            return match Self::recorded().into_iter().find(is_named) {
                Some(file) => Self::parse(&file.to_string_lossy()),
                None => Self::named(name_or_path),
            };
        }
        let remedy = "long recordings go into a trace";
        let text = input_file::read(path, "network profile", FILE_BYTES_MAX, remedy)?;
        Self::from_toml(&text, path)
    }

    /// A profile from TOML text. `path` is used in errors and as the base of trace paths.
    pub fn from_toml(text: &str, path: &Path) -> Result<Self, String> {
        let shown = path.display();
        let invalid =
            |why: toml::de::Error| format!("{shown}: {}", with_suggestion(&why.to_string()));
        // Each table is read by itself first, because only errors of the text name their line.
        let document: Document = toml::from_str(text).map_err(invalid)?;
        let mut tables: toml::Table = toml::from_str(text).map_err(invalid)?;
        let mut table = |name: &str| match tables.remove(name) {
            Some(toml::Value::Table(table)) => table,
            _ => toml::Table::new(),
        };
        let both = table("both");
        let mut link = |name: &str| -> Result<Link, String> {
            let mut keys = both.clone();
            keys.extend(table(name));
            let mut link: Link = keys.try_into().map_err(invalid)?;
            if let Some(trace) = &mut link.trace {
                let folder = path.parent().unwrap_or(Path::new(""));
                trace
                    .load(folder)
                    .map_err(|why| format!("{shown}: {why}"))?;
            }
            Ok(link)
        };
        Ok(Self {
            up: link("up")?,
            down: link("down")?,
            name: document.name,
        })
    }

    pub fn to_toml(&self) -> String {
        let of = |link: &Link, is_written: bool| is_written.then(|| link.clone());
        let is_symmetric = self.up == self.down;
        let document = Document {
            name: self.name.clone(),
            both: of(&self.up, is_symmetric),
            up: of(&self.up, !is_symmetric),
            down: of(&self.down, !is_symmetric),
        };
        toml::to_string(&document).expect("a profile is plain data")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn named_profiles_round_trip_through_their_files() {
        for name in Profile::names() {
            let profile = Profile::parse(name).unwrap();
            assert_eq!(profile.name, name);
            let text = profile.to_toml();
            let again = Profile::from_toml(&text, Path::new("again.toml")).unwrap();
            assert_eq!(again, profile, "{text}");
        }
    }

    #[test]
    fn unknown_name_error_suggests_the_nearest_and_lists_all() {
        let sentence = Profile::parse("transatlantik").unwrap_err();
        assert!(
            sentence.contains("did you mean \"transatlantic\"?"),
            "{sentence}"
        );
        assert!(sentence.contains("satellite"));
        let sentence = Profile::parse("qqqq").unwrap_err();
        assert!(!sentence.contains("did you mean"), "{sentence}");
    }

    #[test]
    fn direction_overrides_both() {
        let text = "name = \"dsl\"\n\
            [both]\ndelay_ms = 12\nloss = 0.01\njitter = { kind = \"gamma\", mean_ms = 4, deviation_ms = 2 }\n\
            [up]\nrate = { bits_per_s = 1e6, queue_bytes = 20000 }\n\
            [down]\nloss = 0.0\noutages = { repeat_s = 60, times = [{ from_s = 1, to_s = 1.5 }] }\n";
        let profile = Profile::from_toml(text, Path::new("dsl.toml")).unwrap();
        assert_eq!((profile.up.delay_ms, profile.down.delay_ms), (12.0, 12.0));
        assert_eq!((profile.up.loss, profile.down.loss), (0.01, 0.0));
        assert!(profile.up.rate.is_some() && profile.down.rate.is_none());
        let again = Profile::from_toml(&profile.to_toml(), Path::new("dsl.toml")).unwrap();
        assert_eq!(again, profile);
    }

    #[test]
    fn invalid_value_error_names_file_line_and_valid_range() {
        let cases = [
            ("delay_ms = -3", "from 0 to 60000"),
            ("delay_ms = nan", "from 0 to 60000"),
            ("delay_ms = inf", "from 0 to 60000"),
            ("loss = 1.5", "from 0 to 1"),
            ("duplicate = -0.1", "from 0 to 1"),
            ("corrupt = nan", "from 0 to 1"),
            ("deley_ms = 3", "did you mean \"delay_ms\"?"),
            ("jitter = { kind = \"gama\" }", "did you mean \"gamma\"?"),
            (
                "jitter = { kind = \"uniform\", reach_ms = -1 }",
                "from 0 to 60000",
            ),
            (
                "jitter = { kind = \"pareto\", scale_ms = 1, exponent = 0.5 }",
                "from 1 to 100",
            ),
            (
                "bursts = { good_packets = 100, bad_packets = 0, loss = 0.5 }",
                "from 1 to",
            ),
            (
                "rate = { bits_per_s = 1e6, queue_bytes = 100 }",
                "write 1500",
            ),
            (
                "rate = { bits_per_s = 0, queue_bytes = 10000 }",
                "from 1000 to",
            ),
            (
                "steps = { delays = [{ at_s = 2, delay_ms = 1 }, { at_s = 1, delay_ms = 1 }] }",
                "in the order of time",
            ),
            (
                "outages = { times = [{ from_s = 2, to_s = 1 }] }",
                "ends before it begins",
            ),
        ];
        for (line, right) in cases {
            let text = format!("name = \"mine\"\n[both]\n{line}\n");
            let sentence = Profile::from_toml(&text, Path::new("mine.toml")).unwrap_err();
            for part in ["mine.toml", "line 3", right] {
                assert!(sentence.contains(part), "{line}: {sentence}");
            }
        }
    }
}
