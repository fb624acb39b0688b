//! The recent track of a tool, and whether a stroke follows it.
//!
//! Clients compose strokes themselves, on a stream that motion may overtake or lag behind, and some samples are lost. A
//! point p of a stroke at time t therefore lies where the tool can have been: for the nearest known stays before and
//! after t,
//!
//! ```text
//! |p - place| <= TOLERANCE + SPEED_MAX * (time between t and the stay)
//! length of the stroke <= TOLERANCE + SPEED_MAX * (time of the stroke)
//! ```
//!
//! The track is decimated to stays: intervals of dense samples within [`STAY_M`] of a place.

use std::collections::VecDeque;

use palpate_protocol::request::TimedBladePoint;
use palpate_protocol::session::PEER_SILENCE;
use palpate_protocol::timeline::GAP_LIMIT;
use palpate_protocol::{ServerTime, Span, ToolSample};

/// Distance of a stroke from the tool, m. It covers decimation (1 mm), quantisation, and a step of the client's clock
/// estimate of 40 ms at a stroke's usual 0.1 m/s.
pub(crate) const TOLERANCE_M: f64 = 5e-3;

/// Speed of a cutting tool, m/s: ten times that of a scalpel in a hand.
pub(crate) const SPEED_MAX_M_S: f64 = 1.0;

/// Time from a point of a stroke to the nearest known stay. A longer silence ends the connection, so every stroke over
/// one connection passes.
pub(crate) const GAP_MAX: Span = PEER_SILENCE;

/// Speed of any tool, m/s: that of a fast arm. Faster samples are dropped, because no hand makes them.
const SAMPLE_SPEED_MAX_M_S: f64 = 5.0;

/// Radius of a stay, m.
const STAY_M: f64 = 1e-3;

/// Stays that are kept: 4 m of path. The longest stroke of one request has 0.4 m. Beyond it the oldest is dropped.
const STAYS_MAX: usize = 4096;

/// Dense samples near a place.
#[derive(Debug, Clone, Copy)]
struct Stay {
    from: ServerTime,
    until: ServerTime,
    place_m: [f64; 3],
}

impl Stay {
    /// Time from this stay to `t`; zero within it.
    fn apart(&self, t: ServerTime) -> Span {
        (self.from - t).max(t - self.until).max(Span::ZERO)
    }
}

/// The recent track of a tool.
#[derive(Debug, Clone, Default)]
pub(crate) struct Track {
    stays: VecDeque<Stay>,
}

impl Track {
    /// Adds a sample; late ones are sorted in. Returns `false` for a sample that the tool can not have reached: drop it.
    pub(crate) fn note(&mut self, sample: &ToolSample) -> bool {
        let (t, place_m) = (sample.time, sample.pose.position_m);
        let at = self.stays.partition_point(|s| s.from <= t);
        let before = at.checked_sub(1).map(|i| self.stays[i]);
        let after = self.stays.get(at).copied();
        let is_reached = |s: &Stay| {
            let way = SAMPLE_SPEED_MAX_M_S * s.apart(t).as_secs_f64();
            distance(place_m, s.place_m) <= TOLERANCE_M + way
        };
        if ![before, after].iter().flatten().all(is_reached) {
            return false;
        }
        let Some(last) = before else {
            // Nothing is older than the oldest stay, once stays were dropped.
            if self.stays.len() < STAYS_MAX {
                self.stays.push_front(Stay::at(t, place_m));
            }
            return true;
        };
        if t <= last.until {
            return true;
        }
        let is_dense = t - last.until <= GAP_LIMIT;
        if is_dense && distance(place_m, last.place_m) <= STAY_M {
            self.stays[at - 1].until = t;
            return true;
        }
        if self.stays.len() == STAYS_MAX {
            self.stays.pop_front();
            self.stays.insert(at - 1, Stay::at(t, place_m));
        } else {
            self.stays.insert(at, Stay::at(t, place_m));
        }
        true
    }

    /// Whether the tool can have made a stroke; otherwise the reason.
    pub(crate) fn check(&self, stroke: &[TimedBladePoint]) -> Result<(), String> {
        for (i, point) in stroke.iter().enumerate() {
            self.check_point(point)
                .map_err(|why| format!("point {} {why}", i + 1))?;
        }
        let (Some(first), Some(last)) = (stroke.first(), stroke.last()) else {
            return Ok(());
        };
        let length_m = length(stroke);
        let time_s = (last.time - first.time).as_secs_f64();
        if length_m > TOLERANCE_M + SPEED_MAX_M_S * time_s {
            return Err(format!(
                "{:.0} mm in {:.0} ms are faster than {SPEED_MAX_M_S} m/s",
                length_m * 1e3,
                time_s * 1e3
            ));
        }
        Ok(())
    }

    fn check_point(&self, point: &TimedBladePoint) -> Result<(), String> {
        let at = self.stays.partition_point(|s| s.from <= point.time);
        let before = at.checked_sub(1).map(|i| self.stays[i]);
        let after = self.stays.get(at).copied();
        let known = [before, after].into_iter().flatten();
        let near: Vec<Stay> = known.filter(|s| s.apart(point.time) <= GAP_MAX).collect();
        if near.is_empty() {
            return Err(format!(
                "is more than {} s away from any known motion of the tool",
                GAP_MAX.as_secs_f64()
            ));
        }
        for stay in near {
            let off_m = distance(point.blade.tip_m, stay.place_m);
            let apart = stay.apart(point.time);
            if off_m > TOLERANCE_M + SPEED_MAX_M_S * apart.as_secs_f64() {
                return Err(format!(
                    "is {:.0} mm away from the tool {:.0} ms earlier or later",
                    off_m * 1e3,
                    apart.as_millis_f64()
                ));
            }
        }
        Ok(())
    }
}

impl Stay {
    fn at(t: ServerTime, place_m: [f64; 3]) -> Self {
        Self {
            from: t,
            until: t,
            place_m,
        }
    }
}

/// Length of the path of the tip, m.
pub(crate) fn length(stroke: &[TimedBladePoint]) -> f64 {
    let step = |w: &[TimedBladePoint]| distance(w[0].blade.tip_m, w[1].blade.tip_m);
    stroke.windows(2).map(step).sum()
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    let square = |i: usize| (a[i] - b[i]) * (a[i] - b[i]);
    (0..3).map(square).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Pose;
    use palpate_protocol::operation::BladePoint;
    use proptest::prelude::*;

    use super::*;

    fn ms(t: i64) -> ServerTime {
        ServerTime::from_micros(t * 1000)
    }

    /// A hand on a figure of eight, 80 mm wide, at up to about 0.25 m/s.
    fn hand(t: i64) -> [f64; 3] {
        let s = t as f64 * 1e-3;
        [0.04 * (3.0 * s).sin(), 0.02 * (6.0 * s).sin(), 0.01]
    }

    fn sample(t: i64, position_m: [f64; 3]) -> ToolSample {
        ToolSample {
            time: ms(t),
            pose: Pose {
                position_m,
                ..Pose::IDENTITY
            },
            ..ToolSample::default()
        }
    }

    fn point(t: i64, tip_m: [f64; 3]) -> TimedBladePoint {
        TimedBladePoint {
            time: ms(t),
            blade: BladePoint {
                tip_m,
                axis: [0.0, 0.0, 1.0],
                depth_m: 0.01,
            },
        }
    }

    /// The stroke of the hand over this time, as a client thins it.
    fn stroke(times: std::ops::Range<i64>) -> Vec<TimedBladePoint> {
        let mut points: Vec<TimedBladePoint> = Vec::new();
        for t in times {
            let next = point(t, hand(t));
            let far = |l: &TimedBladePoint| distance(l.blade.tip_m, next.blade.tip_m) >= 0.75e-3;
            if points.last().is_none_or(far) {
                points.push(next);
            }
        }
        points
    }

    #[test]
    fn stroke_across_an_outage_passes_and_one_without_motion_does_not() {
        let mut track = Track::default();
        let drawn = stroke(500..3000);
        assert!(track.check(&drawn).is_err(), "no sample is known");
        for t in (0..1000).chain(2900..3200) {
            assert!(track.note(&sample(t, hand(t))));
        }
        assert_eq!(track.check(&drawn), Ok(()), "1.9 s are missing");
        // The request overtakes the last samples.
        assert_eq!(track.check(&stroke(2950..3400)), Ok(()));
        let later: Vec<_> = (8000..8010).map(|t| point(t, hand(t))).collect();
        let why = track.check(&later).unwrap_err();
        assert!(why.contains("2 s away"), "{why}");
    }

    #[test]
    fn stroke_beside_the_tool_or_faster_than_it_is_rejected() {
        let mut track = Track::default();
        for t in 0..1000 {
            track.note(&sample(t, hand(t)));
        }
        let mut beside = stroke(200..800);
        assert_eq!(track.check(&beside), Ok(()));
        beside[3].blade.tip_m[2] += 8e-3;
        let why = track.check(&beside).unwrap_err();
        assert!(why.starts_with("point 4 is 8 mm away"), "{why}");
        // A zigzag within the tolerance is longer than the time allows.
        let zigzag: Vec<_> = (0..400)
            .map(|i| {
                let [x, y, z] = hand(500);
                point(500, [x, y + 4e-3 * f64::from(i % 2), z])
            })
            .collect();
        assert!(track.check(&zigzag).unwrap_err().contains("faster"));
    }

    #[test]
    fn sample_that_no_hand_reaches_is_dropped_until_it_can_be_reached() {
        let mut track = Track::default();
        assert!(track.note(&sample(0, [0.0; 3])));
        assert!(!track.note(&sample(4, [0.5, 0.0, 0.0])));
        assert!(track.note(&sample(8, [0.04, 0.0, 0.0])));
        assert!(track.note(&sample(200, [0.5, 0.0, 0.0])));
    }

    proptest! {
        /// Loss of single packets and one outage, and any order of arrival.
        #[test]
        fn honest_stroke_passes_over_a_lossy_path(
            lost in prop::collection::vec(0_u8..100, 1000),
            outage in 0_i64..3000,
            swapped in prop::collection::vec(0_usize..1000, 0..100),
            begin in 100_i64..2000,
            length in 100_i64..2000,
        ) {
            let mut packets: Vec<i64> = (0..1000).map(|i| 4 * i).collect();
            for i in swapped {
                packets.swap(i, (i + 3).min(999));
            }
            let mut track = Track::default();
            for t in packets {
                let is_lost = lost[(t / 4) as usize] < 5;
                if is_lost || (outage..outage + 1000).contains(&t) {
                    continue;
                }
                for t in t..t + 4 {
                    prop_assert!(track.note(&sample(t, hand(t))));
                }
            }
            prop_assert_eq!(track.check(&stroke(begin..begin + length)), Ok(()));
        }

        #[test]
        fn stays_are_bounded_and_in_order(steps in prop::collection::vec((0_i64..200, -0.05..0.05_f64), 1..200)) {
            let mut track = Track::default();
            let (mut t, mut x) = (0, 0.0);
            for _ in 0..50 {
                for (dt, dx) in &steps {
                    (t, x) = (t + dt - 20, x + dx);
                    track.note(&sample(t, [x, 0.0, 0.0]));
                }
            }
            prop_assert!(track.stays.len() <= STAYS_MAX);
            let stays: Vec<Stay> = track.stays.iter().copied().collect();
            prop_assert!(stays.windows(2).all(|w| w[0].from <= w[0].until && w[0].until <= w[1].from));
        }
    }
}
