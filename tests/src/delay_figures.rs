//! Playout delay D of a session, and the limit for its network.

use palpate_client::Recording;
use palpate_protocol::compensation::CAP_DEFAULT;
use serde::{Deserialize, Serialize};

use crate::bench::quantile;
use crate::network::Profile;

/// Start of the D statistics after the start of the scripts, s: clocks and estimators settle first.
pub const SETTLED_S: f64 = 1.0;

/// Maximum D on a network without delay, ms.
pub const LEAST_MS: f64 = 20.0;

/// Maximum D as a multiple of round trip and jitter.
pub const FACTOR: f64 = 1.3;

/// Standard deviations of the round trip that count as jitter.
pub const DEVIATIONS: f64 = 4.0;

/// D during the scripts, over the views of all participants.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DelayFigures {
    pub median_ms: f64,
    pub max_ms: f64,
}

impl DelayFigures {
    /// D of the views shown from [`SETTLED_S`] after the scripts' start to their end; `None` without a script or views.
    pub fn of(recordings: &[&Recording], seconds: f64) -> Option<Self> {
        let began = recordings
            .iter()
            .filter_map(|r| r.script_started_us)
            .min()?;
        let us = |s: f64| began + (s * 1e6) as i64;
        let judged = us(SETTLED_S)..=us(seconds);
        let views = recordings.iter().flat_map(|r| &r.views);
        let delays = views.filter(|v| judged.contains(&v.shown_us));
        let delays: Vec<f64> = delays.map(|v| v.delay_us as f64 * 1e-3).collect();
        (!delays.is_empty()).then(|| Self {
            median_ms: quantile(&delays, 0.5),
            max_ms: delays.iter().copied().fold(0.0, f64::max),
        })
    }
}

/// Maximum D on a profile, ms; `None` if mean and standard deviation do not describe the network.
pub fn limit_ms(profile: &Profile) -> Option<f64> {
    let r = profile.round_trip();
    let limit = LEAST_MS.max(FACTOR * (r.mean_ms + DEVIATIONS * r.deviation_ms));
    (profile.is_steady() && limit.is_finite()).then_some(limit)
}

/// Whether the maximum adaptive delay covers the profile, so that no participant may be demoted.
pub fn is_covered(profile: &Profile) -> bool {
    let r = profile.round_trip();
    r.mean_ms + r.at_worst_ms + DEVIATIONS * r.deviation_ms < CAP_DEFAULT.as_millis_f64()
}

#[cfg(test)]
mod tests {
    use palpate_client::Recording;
    use palpate_client::recording::ViewRecord;

    use super::{DelayFigures, is_covered, limit_ms};
    use crate::network::Profile;

    fn named(name: &str) -> Profile {
        Profile::named(name).unwrap()
    }

    #[test]
    fn limits_follow_round_trip_and_jitter() {
        assert_eq!(limit_ms(&named("lan")), Some(20.0));
        let transatlantic = limit_ms(&named("transatlantic")).unwrap();
        assert!((transatlantic - 1.3 * (120.0 + 4.0 * 8.165)).abs() < 0.01);
        for name in ["bursts", "steps", "outages", "lte"] {
            assert_eq!(limit_ms(&named(name)), None, "{name}");
        }
    }

    #[test]
    fn maximum_delay_covers_all_but_the_longest_and_broken_networks() {
        for name in Profile::names() {
            let expected = !["satellite", "outages"].contains(&name);
            assert_eq!(is_covered(&named(name)), expected, "{name}");
        }
    }

    #[test]
    fn delay_statistics_start_one_second_after_the_scripts() {
        let view = |shown_s: f64, delay_us| ViewRecord {
            shown_us: 7_000_000 + (shown_s * 1e6) as i64,
            delay_us,
            ..ViewRecord::default()
        };
        let recording = Recording {
            script_started_us: Some(7_000_000),
            views: vec![
                view(0.5, 300_000),
                view(1.5, 10_000),
                view(2.0, 12_000),
                view(3.5, 18_000),
                view(4.5, 400_000),
            ],
            ..Recording::default()
        };
        let d = DelayFigures::of(&[&recording], 4.0).unwrap();
        assert_eq!((d.median_ms, d.max_ms), (12.0, 18.0));
        assert_eq!(DelayFigures::of(&[], 4.0), None);
        assert_eq!(DelayFigures::of(&[&recording], 0.5), None);
    }
}
