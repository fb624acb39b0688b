//! Relay of motion from every participant to all other participants.
//!
//! ```text
//! relayed at once            32 participants x 250 datagrams/s x 31 receivers = 250,000 per second
//! collected for a period T   32 participants x 1/T                            =   3,333 per second at 9.6 ms
//! T(n) = 4 ms up to 4 moving tools, then linear up to 16 ms at 64
//! ```
//!
//! The first sample after a pause leaves at once: waiting costs latency only where it saves datagrams.

use std::collections::BTreeMap;

use palpate_protocol::datagram::TRACK_MAX_SAMPLES;
use palpate_protocol::lateness::Lateness;
use palpate_protocol::session::{MotionRound, PeerMotion};
use palpate_protocol::{ParticipantId, ServerTime, Span, ToolSample, ToolTrack};

/// Period while few tools move: the length of a client's batch.
const PERIOD_MIN: Span = Span::from_millis(4);

/// Period with all seats moving: four rounds fit into the longest gap that is extrapolated.
const PERIOD_MAX: Span = Span::from_millis(16);

/// Number of tools up to which the period is the shortest.
const FEW_TOOLS: i64 = 4;

/// Number of tools at which the period is the longest: one per seat.
const MANY_TOOLS: i64 = 64;

/// Samples of one tool that may wait: four of the longest rounds at 1 kHz. Beyond it the oldest is dropped.
const WAITING_MAX: usize = 64;

/// Motion of one tool that waits for the next round.
#[derive(Debug, Default)]
struct Waiting {
    samples: Vec<ToolSample>,
    /// Arrival times of the newest sample and of the oldest update, without delays by machines.
    came: Option<[ServerTime; 2]>,
}

impl Waiting {
    /// Notes motion whose newest sample has this age, without delays by machines.
    fn note(&mut self, motion: &PeerMotion, age: Span) {
        let Some(newest) = motion.samples.last().map(|s| s.time + age) else {
            return;
        };
        let oldest = newest - (motion.late.oldest - motion.late.newest);
        self.came = Some(match self.came {
            None => [newest, oldest],
            Some([latest, before]) => [latest.max(newest), oldest.min(before)],
        });
    }
}

/// Motion of all tools that waits for the next round.
#[derive(Debug, Default)]
pub(crate) struct FanOut {
    waiting: BTreeMap<ParticipantId, Waiting>,
    /// The earliest time of the next round.
    next: ServerTime,
}

impl FanOut {
    /// Queues motion of one tool whose newest sample has this age, without delays by machines.
    pub(crate) fn push(&mut self, who: ParticipantId, motion: &PeerMotion, age: Span) {
        let tool = self.waiting.entry(who).or_default();
        tool.note(motion, age);
        let waiting = &mut tool.samples;
        for sample in &motion.samples {
            // Late samples are sorted in; duplicates are dropped.
            let at = waiting.partition_point(|s| s.time < sample.time);
            if waiting.get(at).is_none_or(|s| s.time != sample.time) {
                waiting.insert(at, *sample);
            }
        }
        let surplus = waiting.len().saturating_sub(WAITING_MAX);
        waiting.drain(..surplus);
    }

    /// Drops the waiting motion of a tool.
    pub(crate) fn remove(&mut self, who: ParticipantId) {
        self.waiting.remove(&who);
    }

    /// Time of the next round; `None` while no motion waits.
    pub(crate) fn due(&self) -> Option<ServerTime> {
        (!self.waiting.is_empty()).then_some(self.next)
    }

    /// The waiting motion, if its round is due.
    pub(crate) fn poll(&mut self, now: ServerTime) -> Option<MotionRound> {
        if self.due().is_none_or(|due| now < due) {
            return None;
        }
        let period = period(self.waiting.len());
        self.next = now + period;
        let tracks = std::mem::take(&mut self.waiting).into_iter();
        let track = |(participant, tool): (ParticipantId, Waiting)| ToolTrack {
            participant,
            samples: thinned(&tool.samples),
            late: tool.came.map_or(Lateness::NONE, |[newest, oldest]| {
                Lateness::after(now, newest + period, oldest + period)
            }),
        };
        Some(MotionRound {
            released: now,
            tracks: tracks.map(track).collect(),
        })
    }
}

/// Time between two rounds with this number of moving tools.
fn period(tools: usize) -> Span {
    let tools = i64::try_from(tools)
        .unwrap_or(MANY_TOOLS)
        .clamp(FEW_TOOLS, MANY_TOOLS);
    let range = PERIOD_MAX.as_micros() - PERIOD_MIN.as_micros();
    let more = range * (tools - FEW_TOOLS) / (MANY_TOOLS - FEW_TOOLS);
    PERIOD_MIN + Span::from_micros(more)
}

/// At most as many samples as a datagram takes of one tool. The newest is always kept, because poses beyond it are
/// extrapolated. The rest is decimated evenly, because clients interpolate between samples.
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

    /// Motion with samples of these times, without delays by machines.
    fn motion(times: &[i64], arrived: i64) -> PeerMotion {
        PeerMotion::on_time(times.iter().map(|t| sample(*t)).collect(), us(arrived))
    }

    #[test]
    fn track_lateness_is_sender_plus_socket_plus_room_beyond_the_round() {
        let (who, ms) = (ParticipantId(1), Span::from_millis);
        let mut fan = FanOut::default();
        let late = |fan: &mut FanOut, now| fan.poll(us(now)).unwrap().tracks[0].late;
        fan.push(who, &motion(&[996_000], 1_000_000), ms(4));
        assert_eq!(late(&mut fan, 1_000_000), Lateness::NONE);
        fan.push(who, &motion(&[1_000_000], 1_004_000), ms(4));
        assert_eq!(late(&mut fan, 1_008_000), Lateness::NONE, "its round");
        // The room stalls while further motion arrives.
        fan.push(who, &motion(&[1_005_000], 1_010_000), ms(5));
        fan.push(who, &motion(&[1_206_000], 1_210_000), ms(4));
        let expected = Lateness {
            newest: ms(6),
            oldest: ms(206),
        };
        assert_eq!(late(&mut fan, 1_220_000), expected);
        // The sender was late by 30 ms, its socket was read 5 ms late, and 4 ms are the network's.
        let claimed = PeerMotion {
            late: Lateness {
                newest: ms(30),
                oldest: ms(70),
            },
            stall: ms(5),
            ..motion(&[1_230_000], 1_269_000)
        };
        fan.push(who, &claimed, ms(4));
        let expected = Lateness {
            newest: ms(32),
            oldest: ms(72),
        };
        assert_eq!(late(&mut fan, 1_270_000), expected);
    }

    #[test]
    fn the_period_grows_from_four_to_sixteen_milliseconds() {
        let ms = |n| period(n).as_millis_f64();
        assert_eq!([0, 1, 4].map(ms), [4.0; 3]);
        assert_eq!(ms(34), 10.0);
        assert_eq!([64, 1000].map(ms), [16.0; 2]);
    }

    #[test]
    fn first_sample_after_a_pause_leaves_at_once_and_the_next_waits() {
        let mut fan = FanOut::default();
        assert_eq!(fan.due(), None);
        fan.push(ParticipantId(1), &motion(&[900_000], 1_000_000), Span::ZERO);
        assert!(fan.poll(us(1_000_000)).is_some());
        fan.push(
            ParticipantId(1),
            &motion(&[1_000_500], 1_000_800),
            Span::ZERO,
        );
        assert!(fan.poll(us(1_001_000)).is_none());
        assert_eq!(fan.due(), Some(us(1_004_000)));
        assert!(fan.poll(us(1_004_000)).is_some());
        assert_eq!(fan.due(), None);
    }

    proptest! {
        #[test]
        fn a_round_holds_the_newest_sample_of_every_tool_in_order_and_within_bounds(
            pushes in prop::collection::vec((1_u16..70, prop::collection::vec(0_i64..100_000, 1..40)), 1..80),
        ) {
            let mut fan = FanOut::default();
            let mut newest = BTreeMap::new();
            for (who, times) in &pushes {
                fan.push(ParticipantId(*who), &motion(times, 200_000), Span::ZERO);
                let max = newest.entry(*who).or_insert(0);
                *max = times.iter().copied().chain([*max]).max().unwrap_or(0);
            }
            let round = fan.poll(us(1_000_000)).unwrap();
            prop_assert_eq!(round.tracks.len(), newest.len());
            for track in &round.tracks {
                prop_assert!((1..=TRACK_MAX_SAMPLES).contains(&track.samples.len()));
                prop_assert!(track.samples.windows(2).all(|w| w[0].time < w[1].time));
                let last = track.samples[track.samples.len() - 1].time;
                prop_assert_eq!(last, us(newest[&track.participant.0]));
            }
            prop_assert_eq!(fan.due(), None);
        }
    }
}
