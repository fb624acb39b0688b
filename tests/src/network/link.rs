//! Properties of one direction of a network.

use serde::{Deserialize, Serialize};

use super::checked;
use super::trace::Trace;

/// One direction of a network. The default link is ideal.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Link {
    #[serde(deserialize_with = "checked::delay_ms")]
    pub delay_ms: f64,
    /// Whether a packet with less delay overtakes an earlier one; otherwise it waits.
    #[serde(skip_serializing_if = "is_default")]
    pub reorder: bool,
    #[serde(skip_serializing_if = "is_default")]
    #[serde(deserialize_with = "checked::share")]
    pub loss: f64,
    #[serde(skip_serializing_if = "is_default")]
    #[serde(deserialize_with = "checked::share")]
    pub duplicate: f64,
    /// Share of packets with flipped bits, 0 to 1.
    #[serde(skip_serializing_if = "is_default")]
    #[serde(deserialize_with = "checked::share")]
    pub corrupt: f64,
    /// Recorded delays and losses, in addition to the others.
    #[serde(skip_serializing_if = "is_default")]
    pub trace: Option<Trace>,
    /// Begin of the session in the trace, s; without it each participant begins at a random time of the trace.
    #[serde(skip_serializing_if = "is_default")]
    #[serde(deserialize_with = "checked::maybe_offset_s")]
    pub trace_offset_s: Option<f64>,
    #[serde(skip_serializing_if = "is_default")]
    pub jitter: Jitter,
    #[serde(skip_serializing_if = "is_default")]
    pub bursts: Option<Bursts>,
    #[serde(skip_serializing_if = "is_default")]
    pub rate: Option<Rate>,
    /// Delays that replace [`delay_ms`](Self::delay_ms) from given times on.
    #[serde(skip_serializing_if = "is_default")]
    pub steps: Option<Steps>,
    #[serde(skip_serializing_if = "is_default")]
    pub outages: Option<Outages>,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Random addition to the delay. A packet never arrives before it was sent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Jitter {
    #[default]
    None,
    /// Uniform within ± `reach_ms`.
    Uniform {
        /// Half width, ms.
        #[serde(deserialize_with = "checked::delay_ms")]
        reach_ms: f64,
    },
    Normal {
        #[serde(deserialize_with = "checked::delay_ms")]
        deviation_ms: f64,
    },
    /// Gamma distribution, never negative: a model of several queues in series.
    Gamma {
        #[serde(deserialize_with = "checked::spread_ms")]
        mean_ms: f64,
        #[serde(deserialize_with = "checked::spread_ms")]
        deviation_ms: f64,
    },
    /// Shifted Pareto distribution (Lomax 1954): P(X > x) = (1 + x / scale)^-exponent. Usually small and
    /// sometimes very large.
    Pareto {
        /// Scale, ms; the mean is scale / (exponent - 1).
        #[serde(deserialize_with = "checked::spread_ms")]
        scale_ms: f64,
        #[serde(deserialize_with = "checked::exponent")]
        exponent: f64,
    },
}

/// A two-state link with memory (Gilbert 1960, Elliott 1963). The state may change after every packet, so run
/// lengths are geometrically distributed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bursts {
    /// Mean run length of the good state, packets.
    #[serde(deserialize_with = "checked::packets")]
    pub good_packets: f64,
    #[serde(deserialize_with = "checked::packets")]
    pub bad_packets: f64,
    /// Packet loss in the bad state, 0 to 1; the good state has that of the link.
    #[serde(deserialize_with = "checked::share")]
    pub loss: f64,
    /// Additional delay in the bad state, ms.
    #[serde(default, deserialize_with = "checked::delay_ms")]
    pub delay_ms: f64,
}

/// A bottleneck with a drop-tail queue.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rate {
    /// Rate in bits per second, headers included.
    #[serde(deserialize_with = "checked::bits_per_s")]
    pub bits_per_s: f64,
    /// Queue capacity in bytes, including the packet in transmission.
    #[serde(deserialize_with = "checked::queue_bytes")]
    pub queue_bytes: u64,
}

/// Delays that change at given times, as after a route change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Steps {
    /// Period in seconds; without it the last delay stays.
    #[serde(default, skip_serializing_if = "is_default")]
    #[serde(deserialize_with = "checked::maybe_period_s")]
    pub repeat_s: Option<f64>,
    #[serde(deserialize_with = "checked::steps")]
    pub delays: Vec<Step>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Begin, seconds after the start of the network.
    #[serde(deserialize_with = "checked::seconds")]
    pub at_s: f64,
    #[serde(deserialize_with = "checked::delay_ms")]
    pub delay_ms: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outages {
    #[serde(default, skip_serializing_if = "is_default")]
    #[serde(deserialize_with = "checked::maybe_period_s")]
    pub repeat_s: Option<f64>,
    #[serde(deserialize_with = "checked::outages")]
    pub times: Vec<Outage>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outage {
    /// Begin, seconds after the start of the network; inclusive.
    #[serde(deserialize_with = "checked::seconds")]
    pub from_s: f64,
    /// End; exclusive.
    #[serde(deserialize_with = "checked::seconds")]
    pub to_s: f64,
}

/// Seconds in whole microseconds, so that events occur exactly at the time in their file.
fn micros(s: f64) -> u64 {
    (s * 1e6).round() as u64
}

/// A time in microseconds, modulo the period if there is one.
fn within(at_us: u64, repeat_s: Option<f64>) -> u64 {
    repeat_s.map_or(at_us, |period| at_us % micros(period).max(1))
}

impl Steps {
    /// Delay in ms at a time in microseconds after the start of the network; before the first step `otherwise`.
    pub fn delay_ms(&self, at_us: u64, otherwise: f64) -> f64 {
        let at_us = within(at_us, self.repeat_s);
        let passed = self.delays.partition_point(|s| micros(s.at_s) <= at_us);
        passed
            .checked_sub(1)
            .map_or(otherwise, |last| self.delays[last].delay_ms)
    }
}

impl Outages {
    /// Whether the link is down at a time in microseconds after the start of the network.
    pub fn covers(&self, at_us: u64) -> bool {
        let at_us = within(at_us, self.repeat_s);
        let begun = self.times.partition_point(|o| micros(o.from_s) <= at_us);
        begun > 0 && at_us < micros(self.times[begun - 1].to_s)
    }
}
