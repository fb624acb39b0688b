//! What a network is like.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// A network, the same in both directions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Profile {
    /// What it is called.
    pub name: String,
    /// Delay of every packet, one way, milliseconds.
    pub delay_ms: f64,
    /// What is added to the delay, packet by packet.
    #[serde(default)]
    pub jitter: Jitter,
    /// Whether a packet with less delay overtakes the one before. Without, it waits for it.
    #[serde(default)]
    pub reorder: bool,
    /// Share of packets that are lost, each for itself, 0 to 1.
    #[serde(default)]
    pub loss: f64,
    /// Share of packets that arrive twice, 0 to 1.
    #[serde(default)]
    pub duplicate: f64,
    /// Bad moments.
    #[serde(default)]
    pub bursts: Option<Bursts>,
}

/// What is added to the delay. A packet never arrives before it was sent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Jitter {
    /// Nothing.
    #[default]
    None,
    /// Anything within plus or minus so many milliseconds.
    Uniform(f64),
    /// Normally distributed with this standard deviation in milliseconds, cut off at three of them.
    Normal(f64),
}

/// Moments in which a radio link is bad. Packets are counted off in blocks; some blocks contain one
/// burst, at a random place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bursts {
    /// Packets in a block.
    pub block: u64,
    /// Share of blocks with a burst, 0 to 1.
    pub probability: f64,
    /// Packets in a burst.
    pub length: u64,
    /// Share of a burst's packets that are lost, 0 to 1.
    pub loss: f64,
    /// Delay added within a burst, milliseconds.
    pub delay_ms: f64,
}

/// The named profiles.
const NAMES: [&str; 9] = [
    "none",
    "lan",
    "metro",
    "transatlantic",
    "intercontinental",
    "satellite",
    "wifi-bursts",
    "lte",
    "lossy",
];

impl Profile {
    /// The names that [`named`](Self::named) knows.
    pub fn names() -> &'static [&'static str] {
        &NAMES
    }

    /// A network that changes nothing.
    pub fn none() -> Self {
        Self::new("none", 0.0, Jitter::None, 0.0)
    }

    fn new(name: &str, delay_ms: f64, jitter: Jitter, loss: f64) -> Self {
        Self {
            name: name.to_owned(),
            delay_ms,
            jitter,
            reorder: false,
            loss,
            duplicate: 0.0,
            bursts: None,
        }
    }

    /// A profile by its name.
    pub fn named(name: &str) -> Result<Self, UnknownProfile> {
        let plain = |delay_ms, jitter, loss| Self::new(name, delay_ms, jitter, loss);
        Ok(match name {
            "none" => Self::none(),
            "lan" => plain(0.3, Jitter::Uniform(0.1), 0.0),
            "metro" => plain(5.0, Jitter::Normal(0.5), 0.001),
            "transatlantic" => Self {
                reorder: true,
                ..plain(60.0, Jitter::Uniform(10.0), 0.02)
            },
            "intercontinental" => Self {
                reorder: true,
                ..plain(120.0, Jitter::Uniform(15.0), 0.02)
            },
            "satellite" => plain(300.0, Jitter::Normal(5.0), 0.01),
            "wifi-bursts" => Self {
                bursts: Some(Bursts {
                    block: 250,
                    probability: 0.5,
                    length: 20,
                    loss: 0.4,
                    delay_ms: 60.0,
                }),
                ..plain(8.0, Jitter::Normal(2.0), 0.005)
            },
            "lte" => Self {
                bursts: Some(Bursts {
                    block: 500,
                    probability: 0.3,
                    length: 25,
                    loss: 0.1,
                    delay_ms: 100.0,
                }),
                ..plain(35.0, Jitter::Normal(6.0), 0.005)
            },
            "lossy" => Self {
                reorder: true,
                duplicate: 0.01,
                ..plain(40.0, Jitter::Uniform(10.0), 0.2)
            },
            _ => {
                return Err(UnknownProfile {
                    name: name.to_owned(),
                });
            }
        })
    }
}

impl FromStr for Profile {
    type Err = UnknownProfile;

    fn from_str(name: &str) -> Result<Self, UnknownProfile> {
        Self::named(name)
    }
}

/// A name that no profile has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnknownProfile {
    /// The name.
    pub name: String,
}

impl std::error::Error for UnknownProfile {}

impl fmt::Display for UnknownProfile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "there is no network profile \"{}\"", self.name)?;
        let nearest = NAMES.iter().min_by_key(|n| edits(&self.name, n));
        if let Some(nearest) = nearest.filter(|n| edits(&self.name, n) <= n.len() / 2) {
            write!(f, "; did you mean \"{nearest}\"?")?;
        }
        write!(f, " Known profiles: {}", NAMES.join(", "))
    }
}

/// How many letters must be changed, added or taken away to make one word of the other.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().take(64).enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let change = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = change.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_is_a_profile() {
        for name in Profile::names() {
            assert_eq!(Profile::named(name).unwrap().name, *name);
        }
    }

    #[test]
    fn an_unknown_name_is_answered_with_the_nearest_and_all() {
        let sentence = Profile::named("transatlantik").unwrap_err().to_string();
        assert!(
            sentence.contains("did you mean \"transatlantic\"?"),
            "{sentence}"
        );
        assert!(sentence.contains("satellite"));
        assert!(
            !Profile::named("qqqq")
                .unwrap_err()
                .to_string()
                .contains("did you mean")
        );
    }

    #[test]
    fn a_profile_is_read_from_toml() {
        let text = "name = \"mine\"\ndelay_ms = 12.5\njitter = { normal = 2.0 }\nloss = 0.05\n";
        let profile: Profile = toml::from_str(text).unwrap();
        assert_eq!(
            (profile.delay_ms, profile.jitter),
            (12.5, Jitter::Normal(2.0))
        );
        assert!(toml::from_str::<Profile>("name = \"x\"\ndelay_ms = 1.0\ndeley = 2").is_err());
    }
}
