//! Insertions of a needle, as the participants of a session show them.

use std::collections::BTreeMap;

use palpate_client::recording::{Recording, ViewRecord};
use serde::{Deserialize, Serialize};

/// Insertions of the holder's needle in the views of one participant.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Insertions {
    pub participant: String,
    /// Times that the needle enters the tissue.
    pub count: usize,
    /// Longest time of the session in which the participant and the holder show different states, ms; `None` if they
    /// show no moment in common.
    pub apart_ms: Option<f64>,
}

impl Insertions {
    pub fn of(recording: &Recording, holder: &Recording) -> Self {
        let state = |view: &ViewRecord| {
            let tool = view
                .tools
                .iter()
                .find(|t| t.participant == holder.participant);
            Some((view.s_us, tool?.inserted))
        };
        let shown: Vec<(i64, bool)> = recording.views.iter().filter_map(state).collect();
        let first = shown.first().is_some_and(|first| first.1);
        let enters = shown.windows(2).filter(|w| !w[0].1 && w[1].1);
        let of_holder: BTreeMap<i64, bool> = holder.views.iter().filter_map(state).collect();
        let mut apart_us = None;
        let mut since_us = None;
        for (s_us, is_in) in &shown {
            let Some(expected) = of_holder.get(s_us) else {
                continue;
            };
            let from_us = since_us.unwrap_or(*s_us);
            apart_us = apart_us.max(Some(s_us - from_us));
            since_us = (is_in != expected).then_some(from_us);
        }
        Self {
            participant: recording.name.clone(),
            count: usize::from(first) + enters.count(),
            apart_ms: apart_us.map(|us| us as f64 * 1e-3),
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_client::recording::ToolRecord;

    use super::*;

    /// Views every 20 ms for 2 s of participant 7's needle, which is inserted in these intervals, ms.
    fn recording(inserted_ms: &[(i64, i64)]) -> Recording {
        let view = |i: i64| ViewRecord {
            s_us: 20_000 * i,
            tools: vec![ToolRecord {
                participant: 7,
                position_m: [0.0; 3],
                stale: false,
                inserted: inserted_ms.iter().any(|s| (s.0..s.1).contains(&(20 * i))),
            }],
            ..ViewRecord::default()
        };
        Recording {
            participant: 7,
            views: (0..100).map(view).collect(),
            ..Recording::default()
        }
    }

    fn compared(other_ms: &[(i64, i64)]) -> (usize, Option<f64>) {
        let holder = recording(&[(400, 1000), (1400, 1800)]);
        let found = Insertions::of(&recording(other_ms), &holder);
        (found.count, found.apart_ms)
    }

    #[test]
    fn late_or_missing_insertion_is_time_apart() {
        assert_eq!(compared(&[(400, 1000), (1400, 1800)]), (2, Some(0.0)));
        assert_eq!(compared(&[(460, 1000), (1400, 1840)]), (2, Some(60.0)));
        assert_eq!(compared(&[(400, 1000)]), (1, Some(400.0)));
        assert_eq!(compared(&[]), (0, Some(600.0)));
    }

    #[test]
    fn newcomer_is_compared_from_its_first_view_on() {
        let holder = recording(&[(400, 1000)]);
        let mut newcomer = holder.clone();
        newcomer.views.drain(..30);
        let found = Insertions::of(&newcomer, &holder);
        assert_eq!((found.count, found.apart_ms), (1, Some(0.0)));
        newcomer.views.clear();
        assert_eq!(Insertions::of(&newcomer, &holder).apart_ms, None);
    }
}
