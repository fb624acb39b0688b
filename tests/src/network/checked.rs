//! Range checks for the numbers of a profile file.
//!
//! An error names the valid range; the file reader adds the position.

use serde::de::{Deserialize, Deserializer, Error};

use super::link::{Outage, Step};
use super::path::DELAY_MAX_MS;

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

/// A share of packets, 0 to 1.
pub(super) fn share<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    between(d, (0.0, 1.0), "a share of packets")
}

/// [`share`] of an optional key.
pub(super) fn maybe_share<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    share(d).map(Some)
}

/// A delay in milliseconds.
pub(super) fn delay_ms<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    between(d, (0.0, DELAY_MAX_MS), "a delay in milliseconds")
}

/// [`delay_ms`] of an optional key.
pub(super) fn maybe_delay_ms<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    delay_ms(d).map(Some)
}

/// A positive length in milliseconds, used as a divisor.
pub(super) fn spread_ms<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    between(d, (0.001, DELAY_MAX_MS), "a spread in milliseconds")
}

/// Exponent of a heavy tail. Below 1 the mean does not exist; from 100 on the tail vanishes.
pub(super) fn exponent<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    between(d, (1.0, 100.0), "an exponent")
}

/// A mean run length in packets.
pub(super) fn packets<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    between(d, (1.0, 1e9), "a mean number of packets in a row")
}

/// Bits per second. A packet of 1200 B takes 10 s on the slowest.
pub(super) fn bits_per_s<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    between(d, (1e3, 1e12), "a rate in bits per second")
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

/// A time or length in seconds, up to a week.
pub(super) fn seconds<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    between(d, (0.0, 604_800.0), "a moment in seconds")
}

/// A period in seconds, from a millisecond to a week.
pub(super) fn maybe_period_s<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    between(d, (1e-3, 604_800.0), "a period in seconds").map(Some)
}

/// Steps in increasing order.
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

/// Outages in increasing order, without overlap.
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
