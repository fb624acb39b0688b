//! Motion on its way from everybody to everybody.
//!
//! ```text
//! passed on at once          32 participants x 250 datagrams/s x 31 others = 250,000 a second
//! collected for a period T   32 participants x 1/T                         =   3,333 a second at 9.6 ms
//! T(n) = 4 ms up to 4 moving tools, then linear up to 16 ms at 64
//! ```
//!
//! The first sample after a pause leaves at once: waiting costs latency only where it saves datagrams.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_protocol::datagram::TRACK_MAX_SAMPLES;
use palpate_protocol::{ParticipantId, ServerTime, Span, ToolSample, ToolTrack};

/// Between two rounds while few tools move: the length of a client's own batch.
const PERIOD_MIN: Span = Span::from_millis(4);

/// Between two rounds with all seats moving: still four rounds within the longest gap that is
/// extrapolated.
const PERIOD_MAX: Span = Span::from_millis(16);

/// Up to so many tools the period is the shortest.
const FEW_TOOLS: i64 = 4;

/// With so many tools it is the longest: one per seat.
const MANY_TOOLS: i64 = 64;

/// Samples of one tool that may wait for a round: four of the longest at 1 kHz. Beyond, the oldest goes.
const WAITING_MAX: usize = 64;

/// What waits for the next round.
#[derive(Debug, Default)]
pub(crate) struct FanOut {
    waiting: BTreeMap<ParticipantId, Vec<ToolSample>>,
    /// The earliest moment of the next round.
    next: ServerTime,
}

impl FanOut {
    /// Takes samples of one tool, oldest first.
    pub(crate) fn push(&mut self, who: ParticipantId, samples: &[ToolSample]) {
        let waiting = self.waiting.entry(who).or_default();
        for sample in samples {
            // Late news go where they belong; what is known already is not sent twice.
            let at = waiting.partition_point(|s| s.time < sample.time);
            if waiting.get(at).is_none_or(|s| s.time != sample.time) {
                waiting.insert(at, *sample);
            }
        }
        let surplus = waiting.len().saturating_sub(WAITING_MAX);
        waiting.drain(..surplus);
    }

    /// Somebody's tool is no more.
    pub(crate) fn remove(&mut self, who: ParticipantId) {
        self.waiting.remove(&who);
    }

    /// When the next round is due; `None` while nothing waits.
    pub(crate) fn due(&self) -> Option<ServerTime> {
        (!self.waiting.is_empty()).then_some(self.next)
    }

    /// Everything that waits, when its round has come.
    pub(crate) fn poll(&mut self, now: ServerTime) -> Option<Arc<[ToolTrack]>> {
        if self.due().is_none_or(|due| now < due) {
            return None;
        }
        self.next = now + period(self.waiting.len());
        let tracks = std::mem::take(&mut self.waiting).into_iter();
        let track = |(participant, samples): (ParticipantId, Vec<ToolSample>)| ToolTrack {
            participant,
            samples: thinned(&samples),
        };
        Some(tracks.map(track).collect())
    }
}

/// Between two rounds with so many tools moving.
fn period(tools: usize) -> Span {
    let tools = i64::try_from(tools)
        .unwrap_or(MANY_TOOLS)
        .clamp(FEW_TOOLS, MANY_TOOLS);
    let range = PERIOD_MAX.as_micros() - PERIOD_MIN.as_micros();
    let more = range * (tools - FEW_TOOLS) / (MANY_TOOLS - FEW_TOOLS);
    PERIOD_MIN + Span::from_micros(more)
}

/// At most as many samples as a datagram takes of one tool: the newest always, because what is shown
/// beyond it is guessed, and of the others an even choice, between which sites interpolate.
fn thinned(samples: &[ToolSample]) -> Vec<ToolSample> {
    let step = samples.len().div_ceil(TRACK_MAX_SAMPLES).max(1);
    let mut some: Vec<ToolSample> = samples.iter().rev().step_by(step).copied().collect();
    some.reverse();
    some
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn us(t: i64) -> ServerTime {
        ServerTime::from_micros(t)
    }

    fn sample(t: i64) -> ToolSample {
        ToolSample {
            time: us(t),
            ..ToolSample::default()
        }
    }

    #[test]
    fn the_period_grows_from_four_to_sixteen_milliseconds() {
        let ms = |n| period(n).as_millis_f64();
        assert_eq!([0, 1, 4].map(ms), [4.0; 3]);
        assert_eq!(ms(34), 10.0);
        assert_eq!([64, 1000].map(ms), [16.0; 2]);
    }

    #[test]
    fn the_first_sample_after_a_pause_leaves_at_once_and_the_next_waits_for_its_round() {
        let mut fan = FanOut::default();
        assert_eq!(fan.due(), None);
        fan.push(ParticipantId(1), &[sample(900_000)]);
        assert!(fan.poll(us(1_000_000)).is_some());
        fan.push(ParticipantId(1), &[sample(1_000_500)]);
        assert!(fan.poll(us(1_001_000)).is_none());
        assert_eq!(fan.due(), Some(us(1_004_000)));
        assert!(fan.poll(us(1_004_000)).is_some());
        assert_eq!(fan.due(), None);
    }

    proptest! {
        #[test]
        fn a_round_has_every_tool_its_newest_sample_in_order_and_within_bounds(
            pushes in prop::collection::vec((1_u16..70, prop::collection::vec(0_i64..100_000, 1..40)), 1..80),
        ) {
            let mut fan = FanOut::default();
            let mut newest = BTreeMap::new();
            for (who, times) in &pushes {
                let samples: Vec<ToolSample> = times.iter().map(|t| sample(*t)).collect();
                fan.push(ParticipantId(*who), &samples);
                let max = newest.entry(*who).or_insert(0);
                *max = times.iter().copied().chain([*max]).max().unwrap_or(0);
            }
            let round = fan.poll(us(1_000_000)).unwrap();
            prop_assert_eq!(round.len(), newest.len());
            for track in round.iter() {
                prop_assert!((1..=TRACK_MAX_SAMPLES).contains(&track.samples.len()));
                prop_assert!(track.samples.windows(2).all(|w| w[0].time < w[1].time));
                let last = track.samples[track.samples.len() - 1].time;
                prop_assert_eq!(last, us(newest[&track.participant.0]));
            }
            prop_assert_eq!(fan.due(), None);
        }
    }
}
