//! What one direction of a network is like.

use serde::{Deserialize, Serialize};

use super::checked;
use super::trace::Trace;

/// One direction of a network. Everything that is not said is as on a wire that does nothing.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Link {
    /// Delay of every packet, milliseconds.
    pub delay_ms: f64,
    /// Delays that take the place of [`delay_ms`](Self::delay_ms) from given times on.
    pub steps: Option<Steps>,
    /// What is added to the delay, packet by packet.
    pub jitter: Jitter,
    /// Whether a packet with less delay overtakes the one before. Without, it waits for it.
    pub reorder: bool,
    /// Share of packets that are lost, each for itself, 0 to 1.
    pub loss: f64,
    /// Bad moments.
    pub bursts: Option<Bursts>,
    /// Share of packets that arrive twice, 0 to 1.
    pub duplicate: f64,
    /// Share of packets that arrive with flipped bits, 0 to 1.
    pub corrupt: f64,
    /// The bottleneck.
    pub rate: Option<Rate>,
    /// Times without a link.
    pub outages: Option<Outages>,
    /// Recorded delays and losses, added to the others.
    pub trace: Option<Trace>,
}

/// What is added to the delay. A packet never arrives before it was sent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Jitter {
    /// Nothing.
    #[default]
    None,
    /// Anything within plus or minus so much.
    Uniform {
        /// The reach to both sides, milliseconds.
        #[serde(deserialize_with = "checked::delay_ms")]
        reach_ms: f64,
    },
    /// Normally distributed about nothing.
    Normal {
        /// Standard deviation, milliseconds.
        #[serde(deserialize_with = "checked::delay_ms")]
        deviation_ms: f64,
    },
    /// Gamma distributed: what queues in a row add. Never negative.
    Gamma {
        /// Mean, milliseconds.
        #[serde(deserialize_with = "checked::spread_ms")]
        mean_ms: f64,
        /// Standard deviation, milliseconds.
        #[serde(deserialize_with = "checked::spread_ms")]
        deviation_ms: f64,
    },
    /// Pareto's distribution shifted to begin at zero (Lomax 1954): P(more than x) =
    /// (1 + x / scale)^-exponent. Mostly little and sometimes very much.
    Pareto {
        /// The scale, milliseconds; the mean is this over (exponent - 1).
        #[serde(deserialize_with = "checked::spread_ms")]
        scale_ms: f64,
        /// How fast the tail falls.
        #[serde(deserialize_with = "checked::exponent")]
        exponent: f64,
    },
}

/// A link of two states with memory (Gilbert 1960, Elliott 1963): after every packet the state
/// may change, so that both states last geometrically distributed numbers of packets.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bursts {
    /// Mean number of packets in a row in the good state.
    #[serde(deserialize_with = "checked::packets")]
    pub good_packets: f64,
    /// Mean number of packets in a row in the bad state.
    #[serde(deserialize_with = "checked::packets")]
    pub bad_packets: f64,
    /// Share of packets that are lost in the bad state, 0 to 1; in the good one it is the link's.
    #[serde(deserialize_with = "checked::share")]
    pub loss: f64,
    /// Delay added in the bad state, milliseconds.
    #[serde(default, deserialize_with = "checked::delay_ms")]
    pub delay_ms: f64,
}

/// A bottleneck with a queue in front of it that drops what comes when it is full.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rate {
    /// Bits per second, headers included.
    #[serde(deserialize_with = "checked::bits_per_s")]
    pub bits_per_s: f64,
    /// Room of the queue, bytes, the packet on the wire included.
    #[serde(deserialize_with = "checked::queue_bytes")]
    pub queue_bytes: u64,
}

/// Delays that change at given times, as when a route changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Steps {
    /// After so many seconds it begins again; without it the last delay stays.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "checked::maybe_period_s"
    )]
    pub repeat_s: Option<f64>,
    /// The steps, the earlier first.
    #[serde(deserialize_with = "checked::steps")]
    pub delays: Vec<Step>,
}

/// A delay from a time on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// When, seconds after the network began.
    #[serde(deserialize_with = "checked::seconds")]
    pub at_s: f64,
    /// The delay from then on, milliseconds.
    #[serde(deserialize_with = "checked::delay_ms")]
    pub delay_ms: f64,
}

/// Times in which every packet is lost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outages {
    /// After so many seconds it begins again.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "checked::maybe_period_s"
    )]
    pub repeat_s: Option<f64>,
    /// The outages, the earlier first.
    #[serde(deserialize_with = "checked::outages")]
    pub times: Vec<Outage>,
}

/// One time without a link.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outage {
    /// Its beginning, seconds after the network began; a packet sent then is lost.
    #[serde(deserialize_with = "checked::seconds")]
    pub from_s: f64,
    /// Its end; a packet sent then is not.
    #[serde(deserialize_with = "checked::seconds")]
    pub to_s: f64,
}

/// A time within the period, when there is one.
fn within(at_s: f64, repeat_s: Option<f64>) -> f64 {
    repeat_s.map_or(at_s, |period| at_s.rem_euclid(period))
}

impl Steps {
    /// The delay at a time in seconds, in milliseconds; before the first step `otherwise`.
    pub fn delay_ms(&self, at_s: f64, otherwise: f64) -> f64 {
        let at_s = within(at_s, self.repeat_s);
        let passed = self.delays.partition_point(|s| s.at_s <= at_s);
        passed
            .checked_sub(1)
            .map_or(otherwise, |last| self.delays[last].delay_ms)
    }
}

impl Outages {
    /// Whether there is no link at a time in seconds.
    pub fn covers(&self, at_s: f64) -> bool {
        let at_s = within(at_s, self.repeat_s);
        let begun = self.times.partition_point(|o| o.from_s <= at_s);
        begun > 0 && at_s < self.times[begun - 1].to_s
    }
}
