//! Network profiles, by name or from a file.

use std::path::{Path, PathBuf};

use palpate_device::text_file;
use serde::{Deserialize, Serialize};

use super::checked;
use super::link::{Bursts, Jitter, Link, Outage, Outages, Rate, Step, Steps};
use super::path::Direction;
use super::trace::{Trace, TraceError};
use crate::name_suggestion::{did_you_mean, with_suggestion};

/// Maximum size of a profile file, bytes. Longer recordings belong into a trace file.
const FILE_BYTES_MAX: u64 = 1_000_000;

/// A network.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Name.
    pub name: String,
    /// Link to the server.
    pub up: Link,
    /// Link to a client.
    pub down: Link,
}

/// Failure to load a profile.
#[derive(Debug, thiserror::Error)]
pub enum ProfileError {
    /// Unknown name.
    #[error("unknown network profile \"{name}\"{}. Known profiles: {}; or give a TOML file's path, which ends in .toml", did_you_mean(name, &NAMES), NAMES.join(", "))]
    Unknown {
        /// The name.
        name: String,
    },
    /// Unreadable file.
    #[error("the network profile {} can not be read: {why}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        why: std::io::Error,
    },
    /// Invalid content.
    #[error("{}: {why}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Error with line, column and the valid form.
        why: String,
    },
    /// Invalid trace.
    #[error("{}: {why}", path.display())]
    Trace {
        /// The profile file.
        path: PathBuf,
        /// Error of the trace.
        why: TraceError,
    },
}

/// The named profiles.
const NAMES: [&str; 14] = [
    "none",
    "lan",
    "metro",
    "transatlantic",
    "intercontinental",
    "satellite",
    "wifi-bursts",
    "lte",
    "lossy",
    "gamma",
    "steps",
    "bursts",
    "outages",
    "far-steps",
];

/// The profile in a file.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Document {
    name: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    both: Option<LinkDocument>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    up: Option<LinkDocument>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    down: Option<LinkDocument>,
}

/// One direction in a file; omitted keys are inherited.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct LinkDocument {
    #[serde(
        skip_serializing_if = "Option::is_none",
        deserialize_with = "checked::maybe_delay_ms"
    )]
    delay_ms: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reorder: Option<bool>,
    #[serde(
        skip_serializing_if = "Option::is_none",
        deserialize_with = "checked::maybe_share"
    )]
    loss: Option<f64>,
    #[serde(
        skip_serializing_if = "Option::is_none",
        deserialize_with = "checked::maybe_share"
    )]
    duplicate: Option<f64>,
    #[serde(
        skip_serializing_if = "Option::is_none",
        deserialize_with = "checked::maybe_share"
    )]
    corrupt: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    trace: Option<PathBuf>,
    #[serde(skip_serializing_if = "Option::is_none")]
    jitter: Option<Jitter>,
    #[serde(skip_serializing_if = "Option::is_none")]
    bursts: Option<Bursts>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rate: Option<Rate>,
    #[serde(skip_serializing_if = "Option::is_none")]
    steps: Option<Steps>,
    #[serde(skip_serializing_if = "Option::is_none")]
    outages: Option<Outages>,
}

impl LinkDocument {
    /// The file form of a link, without default values.
    fn of(link: &Link) -> Self {
        let unless_zero = |x: f64| (x != 0.0).then_some(x);
        Self {
            delay_ms: Some(link.delay_ms),
            reorder: link.reorder.then_some(true),
            loss: unless_zero(link.loss),
            duplicate: unless_zero(link.duplicate),
            corrupt: unless_zero(link.corrupt),
            trace: link.trace.as_ref().map(|t| t.file.clone()),
            jitter: (link.jitter != Jitter::None).then_some(link.jitter),
            bursts: link.bursts,
            rate: link.rate,
            steps: link.steps.clone(),
            outages: link.outages.clone(),
        }
    }

    /// Fills omitted keys from `other`.
    fn or(self, other: &Self) -> Self {
        let other = other.clone();
        Self {
            delay_ms: self.delay_ms.or(other.delay_ms),
            reorder: self.reorder.or(other.reorder),
            loss: self.loss.or(other.loss),
            duplicate: self.duplicate.or(other.duplicate),
            corrupt: self.corrupt.or(other.corrupt),
            trace: self.trace.or(other.trace),
            jitter: self.jitter.or(other.jitter),
            bursts: self.bursts.or(other.bursts),
            rate: self.rate.or(other.rate),
            steps: self.steps.or(other.steps),
            outages: self.outages.or(other.outages),
        }
    }

    /// Converts to a link; `folder` is the base of the trace path.
    fn into_link(self, folder: &Path) -> Result<Link, TraceError> {
        let trace = self.trace.map(|file| Trace::read(&file, folder));
        Ok(Link {
            delay_ms: self.delay_ms.unwrap_or_default(),
            steps: self.steps,
            jitter: self.jitter.unwrap_or_default(),
            reorder: self.reorder.unwrap_or_default(),
            loss: self.loss.unwrap_or_default(),
            bursts: self.bursts,
            duplicate: self.duplicate.unwrap_or_default(),
            corrupt: self.corrupt.unwrap_or_default(),
            rate: self.rate,
            outages: self.outages,
            trace: trace.transpose()?,
        })
    }
}

impl Profile {
    /// Names that [`named`](Self::named) accepts.
    pub fn names() -> &'static [&'static str] {
        &NAMES
    }

    /// An ideal network.
    pub fn none() -> Self {
        Self::both("none", Link::default())
    }

    /// A symmetric network.
    pub fn both(name: &str, link: Link) -> Self {
        Self {
            name: name.to_owned(),
            up: link.clone(),
            down: link,
        }
    }

    /// The link of a direction.
    pub fn link(&self, direction: Direction) -> &Link {
        match direction {
            Direction::Up => &self.up,
            Direction::Down => &self.down,
        }
    }

    /// A profile by name, or from the `.toml` file with this path.
    pub fn parse(name_or_path: &str) -> Result<Self, ProfileError> {
        let path = Path::new(name_or_path);
        if path.extension().is_some_and(|e| e == "toml") {
            Self::read(path)
        } else {
            Self::named(name_or_path)
        }
    }

    /// A profile from a TOML file. Trace paths are relative to it.
    pub fn read(path: &Path) -> Result<Self, ProfileError> {
        let text = text_file::read(path, FILE_BYTES_MAX).map_err(|why| ProfileError::Read {
            path: path.to_owned(),
            why,
        })?;
        Self::from_toml(&text, path)
    }

    /// A profile from TOML text. `path` is used in errors and as the base of trace paths.
    pub fn from_toml(text: &str, path: &Path) -> Result<Self, ProfileError> {
        let document: Document = toml::from_str(text).map_err(|why| ProfileError::Content {
            path: path.to_owned(),
            why: with_suggestion(why.to_string().trim_end()),
        })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let both = document.both.unwrap_or_default();
        let link = |own: Option<LinkDocument>| {
            let link = own.unwrap_or_default().or(&both).into_link(folder);
            link.map_err(|why| ProfileError::Trace {
                path: path.to_owned(),
                why,
            })
        };
        Ok(Self {
            name: document.name,
            up: link(document.up)?,
            down: link(document.down)?,
        })
    }

    /// The profile as TOML text.
    pub fn to_toml(&self) -> String {
        let of = |link| Some(LinkDocument::of(link));
        let (both, up, down) = if self.up == self.down {
            (of(&self.up), None, None)
        } else {
            (None, of(&self.up), of(&self.down))
        };
        let document = Document {
            name: self.name.clone(),
            both,
            up,
            down,
        };
        toml::to_string(&document).expect("a profile is plain data")
    }

    /// A profile by its name.
    pub fn named(name: &str) -> Result<Self, ProfileError> {
        let uniform = |reach_ms| Jitter::Uniform { reach_ms };
        let normal = |deviation_ms| Jitter::Normal { deviation_ms };
        // Shape 1, so that uplink and downlink add up to shape 2.
        let gamma = |mean_ms| Jitter::Gamma {
            mean_ms,
            deviation_ms: mean_ms,
        };
        let plain = |delay_ms, jitter, loss| Link {
            delay_ms,
            jitter,
            loss,
            ..Link::default()
        };
        let stepping = |delays_ms: [f64; 3], jitter| Link {
            steps: Some(Steps {
                repeat_s: Some(30.0),
                delays: [0.0, 10.0, 20.0]
                    .into_iter()
                    .zip(delays_ms)
                    .map(|(at_s, delay_ms)| Step { at_s, delay_ms })
                    .collect(),
            }),
            ..plain(delays_ms[0], jitter, 0.0)
        };
        let link = match name {
            "none" => Link::default(),
            "lan" => plain(0.3, uniform(0.1), 0.0),
            "metro" => plain(5.0, normal(0.5), 0.001),
            "transatlantic" => Link {
                reorder: true,
                ..plain(60.0, uniform(10.0), 0.02)
            },
            "intercontinental" => Link {
                reorder: true,
                ..plain(120.0, uniform(15.0), 0.02)
            },
            "satellite" => plain(300.0, normal(5.0), 0.01),
            "wifi-bursts" => Link {
                bursts: Some(Bursts {
                    good_packets: 480.0,
                    bad_packets: 20.0,
                    loss: 0.4,
                    delay_ms: 60.0,
                }),
                ..plain(8.0, normal(2.0), 0.005)
            },
            "lte" => Link {
                bursts: Some(Bursts {
                    good_packets: 1640.0,
                    bad_packets: 25.0,
                    loss: 0.1,
                    delay_ms: 100.0,
                }),
                ..plain(35.0, normal(6.0), 0.005)
            },
            "lossy" => Link {
                reorder: true,
                duplicate: 0.01,
                ..plain(40.0, uniform(10.0), 0.2)
            },
            "gamma" => Link {
                reorder: true,
                ..plain(25.0, gamma(5.0), 0.0)
            },
            // 50 ms, and 120 ms for 0.2 s in every 2 s at 250 packets per second.
            "bursts" => Link {
                bursts: Some(Bursts {
                    good_packets: 450.0,
                    bad_packets: 50.0,
                    loss: 0.0,
                    delay_ms: 70.0,
                }),
                ..plain(50.0, uniform(2.0), 0.0)
            },
            // An outage of 0.5 s in every 20 s: a radio handover.
            "outages" => Link {
                outages: Some(Outages {
                    repeat_s: Some(20.0),
                    times: vec![Outage {
                        from_s: 15.0,
                        to_s: 15.5,
                    }],
                }),
                ..plain(25.0, uniform(3.0), 0.002)
            },
            // 30, 80 and 120 ms from one participant to another, half of it on each link to the server.
            "steps" => stepping([15.0, 40.0, 60.0], gamma(0.25)),
            // The full delay on every link: 60, 160 and 240 ms from one participant to another.
            "far-steps" => stepping([30.0, 80.0, 120.0], uniform(2.0)),
            _ => {
                return Err(ProfileError::Unknown {
                    name: name.to_owned(),
                });
            }
        };
        Ok(Self::both(name, link))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn named_profiles_round_trip_through_their_files() {
        for name in Profile::names() {
            let profile = Profile::parse(name).unwrap();
            assert_eq!(profile.name, *name);
            let text = profile.to_toml();
            let again = Profile::from_toml(&text, Path::new("again.toml")).unwrap();
            assert_eq!(again, profile, "{text}");
        }
    }

    #[test]
    fn unknown_name_error_suggests_the_nearest_and_lists_all() {
        let sentence = Profile::parse("transatlantik").unwrap_err().to_string();
        assert!(
            sentence.contains("did you mean \"transatlantic\"?"),
            "{sentence}"
        );
        assert!(sentence.contains("satellite"));
        let sentence = Profile::parse("qqqq").unwrap_err().to_string();
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
            let error = Profile::from_toml(&text, Path::new("mine.toml")).unwrap_err();
            let sentence = error.to_string();
            for part in ["mine.toml", "line 3", right] {
                assert!(sentence.contains(part), "{line}: {sentence}");
            }
        }
    }
}
