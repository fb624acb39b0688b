//! Range checks for the numbers of a profile file.
//!
//! An error names the valid range; the file reader adds the position.

use serde::de::{Deserialize, Deserializer, Error};

use super::link::{Outage, Step};
use super::path::DELAY_MAX_MS;

const WEEK_S: f64 = 604_800.0;

/// A number within inclusive bounds; NaN is rejected.
fn between<'de, D: Deserializer<'de>>(
    deserializer: D,
    (low, high): (f64, f64),
    what: &str,
) -> Result<f64, D::Error> {
    let x = f64::deserialize(deserializer)?;
    if (low..=high).contains(&x) {
        Ok(x)
    } else {
        let bounds = format!("{x} is not {what}: write a number from {low} to {high}");
        Err(D::Error::custom(bounds))
    }
}

macro_rules! ranges {
    ($($name:ident, $low:expr, $high:expr, $what:literal;)*) => {
        $(pub(super) fn $name<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
            between(d, ($low, $high), $what)
        })*
    };
}

ranges! {
    share, 0.0, 1.0, "a share of packets";
    delay_ms, 0.0, DELAY_MAX_MS, "a delay in milliseconds";
    // A divisor.
    spread_ms, 0.001, DELAY_MAX_MS, "a spread in milliseconds";
    // Of a heavy tail: below 1 the mean does not exist; from 100 on the tail vanishes.
    exponent, 1.0, 100.0, "an exponent";
    packets, 1.0, 1e9, "a mean number of packets in a row";
    // A packet of 1200 B takes 10 s on the slowest.
    bits_per_s, 1e3, 1e12, "a rate in bits per second";
    seconds, 0.0, WEEK_S, "a moment in seconds";
}

/// A period in seconds, used as a divisor.
pub(super) fn maybe_period_s<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    between(d, (1e-3, WEEK_S), "a period in seconds").map(Some)
}

pub(super) fn maybe_offset_s<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    seconds(d).map(Some)
}

/// Queue size in bytes; a queue below one full packet would drop every packet.
pub(super) fn queue_bytes<'de, D: Deserializer<'de>>(d: D) -> Result<u64, D::Error> {
    let bytes = u64::deserialize(d)?;
    if (1500..=1 << 32).contains(&bytes) {
        Ok(bytes)
    } else {
        Err(D::Error::custom(format!(
            "a queue of {bytes} bytes: write 1500, which is one full packet, to 4294967296"
        )))
    }
}

pub(super) fn steps<'de, D: Deserializer<'de>>(d: D) -> Result<Vec<Step>, D::Error> {
    let steps = Vec::<Step>::deserialize(d)?;
    for pair in steps.windows(2) {
        if pair[1].at_s <= pair[0].at_s {
            return Err(D::Error::custom(format!(
                "steps are not sorted: {} s follows {} s; write them in the order of time",
                pair[1].at_s, pair[0].at_s
            )));
        }
    }
    Ok(steps)
}

pub(super) fn outages<'de, D: Deserializer<'de>>(d: D) -> Result<Vec<Outage>, D::Error> {
    let outages = Vec::<Outage>::deserialize(d)?;
    let mut free_from_s = 0.0;
    for outage in &outages {
        if outage.to_s <= outage.from_s {
            return Err(D::Error::custom(format!(
                "an outage from {} s to {} s ends before it begins",
                outage.from_s, outage.to_s
            )));
        }
        if outage.from_s < free_from_s {
            return Err(D::Error::custom(format!(
                "the outage from {} s begins before the one above it ended: write them in the order of time",
                outage.from_s
            )));
        }
        free_from_s = outage.to_s;
    }
    Ok(outages)
}
