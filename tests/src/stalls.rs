//! Stalls of a session: times in which the network has delivered no motion for too long.
//!
//! They follow from the fates of packets alone, neither from a result nor from the playout delay D, which may be wrong.
//! For each ordered pair of trainees, the newest packet of one at the server was sent a µs ago, and the newest packet of
//! the server at the other b µs ago:
//!
//! ```text
//! age        b + a (at the time of sending b);  m = its median over the session
//! stall      age > m + 50 ms, and at some time > m + 200 ms     beyond extrapolation, and no jitter
//!            until 200 ms after the end of this
//! ```

use palpate_client::Recording;
use palpate_protocol::timeline::{GAP_LIMIT, RETURN};

use crate::network::Direction;
use crate::simulated_session::Sent;

/// Times at which stalls are tested, µs.
const GRID_US: i64 = 1000;

/// Age beyond its median from which a lack of motion is a stall. Less is jitter, which the compensation has to bridge.
const STALL_US: i64 = 200_000;

/// Disjoint intervals in µs of true time, in order.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Stalls {
    spans_us: Vec<(i64, i64)>,
}

/// The newest packet of one flow at any time: arrivals in order, with the latest time of sending so far.
struct Newest(Vec<(i64, i64)>);

impl Newest {
    fn of(sent: &[Sent], seat: usize, direction: Direction) -> Self {
        let of_flow = sent
            .iter()
            .filter(|p| (p.seat, p.direction) == (seat, direction));
        let arrived = of_flow.filter_map(|p| Some((p.arrives_us? as i64, p.at_us as i64)));
        let mut all: Vec<(i64, i64)> = arrived.collect();
        all.sort_unstable();
        let mut newest = i64::MIN;
        for (_, at_us) in &mut all {
            newest = newest.max(*at_us);
            *at_us = newest;
        }
        Self(all)
    }

    /// Time of sending of the newest packet that has arrived; `None` before the first.
    fn sent_by(&self, t: i64) -> Option<i64> {
        let arrived = self.0.partition_point(|(arrival, _)| *arrival <= t);
        Some(self.0[arrived.checked_sub(1)?].1)
    }
}

/// The stalls of one pair, from its ages over time.
fn beyond_median(ages: &[(i64, i64)]) -> Vec<(i64, i64)> {
    let mut sorted: Vec<i64> = ages.iter().map(|a| a.1).collect();
    sorted.sort_unstable();
    let Some(median) = sorted.get(sorted.len() / 2) else {
        return Vec::new();
    };
    let is_late = |age: i64| age > median + GAP_LIMIT.as_micros();
    let runs = ages.chunk_by(|a, b| is_late(a.1) == is_late(b.1));
    let stalls = runs.filter(|run| run.iter().any(|a| a.1 > median + STALL_US));
    stalls
        .filter_map(|run| Some((run.first()?.0, run.last()?.0 + GRID_US + RETURN.as_micros())))
        .collect()
}

impl Stalls {
    /// The stalls between trainees, whose recordings are in the order of their seats.
    pub fn between(sent: &[Sent], recordings: &[Recording]) -> Self {
        let mut stalled = Vec::new();
        for (to, recording) in recordings.iter().enumerate() {
            let ends = recording.views.first().zip(recording.views.last());
            let Some((first, last)) = ends.map(|(a, b)| (a.shown_us, b.shown_us)) else {
                continue;
            };
            let down = Newest::of(sent, to, Direction::Down);
            for from in (0..recordings.len()).filter(|from| *from != to) {
                let up = Newest::of(sent, from, Direction::Up);
                let ages = (first..last).step_by(GRID_US as usize).filter_map(|t| {
                    let sent_us = down
                        .sent_by(t)
                        .and_then(|at_server| up.sent_by(at_server))?;
                    Some((t, t - sent_us))
                });
                stalled.extend(beyond_median(&ages.collect::<Vec<_>>()));
            }
        }
        stalled.sort_unstable();
        let mut spans_us: Vec<(i64, i64)> = Vec::new();
        for (from, until) in stalled {
            match spans_us.last_mut() {
                Some(last) if from <= last.1 => last.1 = last.1.max(until),
                _ => spans_us.push((from, until)),
            }
        }
        Self { spans_us }
    }

    /// Whether a time is within a stall.
    pub fn contain(&self, t_us: i64) -> bool {
        let begun = self.spans_us.partition_point(|(from, _)| *from <= t_us);
        begun > 0 && t_us < self.spans_us[begun - 1].1
    }

    /// Whether an interval has a time within a stall.
    pub fn meet(&self, from_us: i64, until_us: i64) -> bool {
        self.spans_us
            .iter()
            .any(|(from, until)| *from < until_us && from_us < *until)
    }

    /// The intervals, µs of true time.
    pub fn spans_us(&self) -> &[(i64, i64)] {
        &self.spans_us
    }

    /// Their time within an interval, µs.
    pub fn within_us(&self, from_us: i64, until_us: i64) -> i64 {
        let part = |(from, until): &(i64, i64)| (until.min(&until_us) - from.max(&from_us)).max(0);
        self.spans_us.iter().map(part).sum()
    }
}

#[cfg(test)]
mod tests {
    use palpate_client::recording::ViewRecord;

    use super::*;
    use crate::simulated_session::Part;

    /// Two trainees with packets every 4 ms, 30 ms per link; `fate` may change an arrival at the server
    /// or at the second trainee.
    fn stalls(fate: impl Fn(i64, Direction) -> Option<i64>) -> Vec<(i64, i64)> {
        let packet = |seat, direction, at_us: i64, arrives: Option<i64>| Sent {
            at_us: at_us as u64,
            seat,
            direction,
            part: Part::Motion,
            acknowledgement: 0,
            bytes: 20,
            arrives_us: arrives.map(|t| t as u64),
        };
        let mut sent = Vec::new();
        for at_us in (0..3_000_000).step_by(4000) {
            let plain = Some(at_us + 30_000);
            sent.push(packet(0, Direction::Up, at_us, fate(at_us, Direction::Up)));
            sent.push(packet(
                1,
                Direction::Down,
                at_us,
                fate(at_us, Direction::Down),
            ));
            sent.push(packet(1, Direction::Up, at_us, plain));
            sent.push(packet(0, Direction::Down, at_us, plain));
        }
        let view = |k: i64| ViewRecord {
            shown_us: k * 16_000,
            ..ViewRecord::default()
        };
        let recording = Recording {
            views: (0..180).map(view).collect(),
            ..Recording::default()
        };
        let stalls = Stalls::between(&sent, &[recording.clone(), recording]);
        stalls.spans_us().to_vec()
    }

    #[test]
    fn outage_and_held_packets_are_stalls_until_200_ms_after_their_end() {
        assert_eq!(stalls(|t, _| Some(t + 30_000)), []);
        let outage = |t: i64, direction| {
            let is_lost = direction == Direction::Up && (1_000_000..1_600_000).contains(&t);
            (!is_lost).then_some(t + 30_000)
        };
        // Packets are 60 to 68 ms old (64 in the median). The last one before was sent at 996 ms, the next one is at the other
        // trainee at 1660 ms.
        let [(from, until)] = stalls(outage)[..] else {
            panic!("{:?}", stalls(outage));
        };
        assert!((from - (996_000 + 114_000)).abs() <= 2000, "{from}");
        assert!((until - 1_860_000).abs() <= 6000, "{until}");
        let held = |t: i64, direction| {
            let is_held = direction == Direction::Down && (1_000_000..1_700_000).contains(&t);
            Some(if is_held { 1_730_000 } else { t + 30_000 })
        };
        let [(from, until)] = stalls(held)[..] else {
            panic!("{:?}", stalls(held));
        };
        assert!((from - (964_000 + 114_000)).abs() <= 4000, "{from}");
        assert!((until - 1_930_000).abs() <= 2000, "{until}");
    }

    #[test]
    fn gap_that_the_compensation_bridges_is_no_stall() {
        for (held_ms, is_stall) in [(75, false), (180, false), (240, true)] {
            let until = 1_000_000 + 1000 * held_ms;
            let late = |t: i64, _| {
                let held = (1_000_000..until - 40_000).contains(&t);
                Some(if held { until } else { t + 30_000 })
            };
            assert_eq!(!stalls(late).is_empty(), is_stall, "{held_ms}");
        }
    }

    #[test]
    fn time_within_an_interval_is_clipped() {
        let stalls = Stalls {
            spans_us: vec![(10, 20), (40, 60)],
        };
        assert_eq!(stalls.within_us(15, 50), 15);
        assert!(stalls.contain(10) && !stalls.contain(20) && stalls.contain(59));
        assert!(stalls.meet(0, 11) && !stalls.meet(20, 40) && stalls.meet(30, 70));
    }
}
