//! Converts the path of the own blade, while its button is held, into cut requests.

use palpate_protocol::operation::STROKE_MAX_POINTS;
use palpate_protocol::request::{CutRequest, TimedBladePoint};
use palpate_protocol::{Pose, ServerTime};

use super::convert::wire_blade;

/// Spacing of stroke points, m: a fifth of the finest lattice (4 mm), so that the swept surface is as smooth as the
/// lattice resolves. A smaller spacing only lengthens the request.
const POINT_SPACING_M: f64 = 0.75e-3;

/// Minimum distance of the release point from the point before, m; closer points define no direction.
const LAST_STEP_MIN_M: f64 = 0.1e-3;

/// Width of the wound, m: that of a scalpel.
const WIDTH_M: f64 = 0.5e-3;

/// Collects the strokes of one blade.
#[derive(Debug, Clone)]
pub struct StrokeCollector {
    length_m: f64,
    points: Vec<TimedBladePoint>,
    /// The latest blade pose, whether or not it became a point.
    last: Option<TimedBladePoint>,
}

impl StrokeCollector {
    /// For a blade with an edge of `length_m`.
    pub fn new(length_m: f64) -> Self {
        Self {
            length_m,
            points: Vec::new(),
            last: None,
        }
    }

    /// Adds a blade pose and the state of its button. Returns a stroke on release, or a piece of a stroke at the
    /// maximum length of a request.
    pub fn push(&mut self, time: ServerTime, pose: &Pose, pressed: bool) -> Option<CutRequest> {
        if !pressed {
            return self.finish();
        }
        // A better clock estimate may step back a little; stroke times must ascend.
        let time = self.last.map_or(time, |l| time.max(l.time));
        let point = TimedBladePoint {
            time,
            blade: wire_blade(pose, self.length_m),
        };
        self.last = Some(point);
        let far = self
            .points
            .last()
            .is_none_or(|l| distance(l, &point) >= POINT_SPACING_M);
        if !far {
            return None;
        }
        self.points.push(point);
        if self.points.len() < STROKE_MAX_POINTS {
            return None;
        }
        let piece = std::mem::replace(&mut self.points, vec![point]);
        Some(CutRequest {
            points: piece,
            width_m: WIDTH_M,
        })
    }

    fn finish(&mut self) -> Option<CutRequest> {
        let end = self.last.take()?;
        let mut points = std::mem::take(&mut self.points);
        if points
            .last()
            .is_some_and(|l| distance(l, &end) >= LAST_STEP_MIN_M)
        {
            points.push(end);
        }
        // A single point sweeps no surface.
        (points.len() >= 2).then_some(CutRequest {
            points,
            width_m: WIDTH_M,
        })
    }
}

fn distance(a: &TimedBladePoint, b: &TimedBladePoint) -> f64 {
    let (a, b) = (a.blade.tip_m, b.blade.tip_m);
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x_mm: f64) -> Pose {
        Pose {
            position_m: [x_mm * 1e-3, 0.0, 0.0],
            ..Pose::IDENTITY
        }
    }

    fn ms(t: i64) -> ServerTime {
        ServerTime::from_micros(t * 1000)
    }

    #[test]
    fn stroke_is_thinned_and_ends_at_release_point() {
        let mut strokes = StrokeCollector::new(0.02);
        for t in 0..=1000 {
            assert_eq!(strokes.push(ms(t), &at(0.0205 * t as f64), true), None);
        }
        let stroke = strokes.push(ms(1001), &at(30.0), false).unwrap();
        assert!(stroke.is_valid());
        assert!(
            (25..30).contains(&stroke.points.len()),
            "{}",
            stroke.points.len()
        );
        for pair in stroke.points.windows(2) {
            assert!(distance(&pair[0], &pair[1]) >= LAST_STEP_MIN_M);
        }
        let last = stroke.points.last().unwrap();
        assert!((last.blade.tip_m[0] - 0.0205).abs() < LAST_STEP_MIN_M);
        assert_eq!(strokes.push(ms(1002), &at(30.0), false), None);
    }

    #[test]
    fn resting_blade_cuts_nothing() {
        let mut strokes = StrokeCollector::new(0.02);
        for t in 0..100 {
            strokes.push(ms(t), &at(0.0), true);
        }
        assert_eq!(strokes.push(ms(100), &at(0.0), false), None);
    }

    #[test]
    fn pieces_of_long_stroke_share_a_point() {
        let mut strokes = StrokeCollector::new(0.02);
        let mut pieces: Vec<CutRequest> = (0..2000)
            .filter_map(|t| strokes.push(ms(t), &at(t as f64), true))
            .collect();
        pieces.extend(strokes.push(ms(2000), &at(2000.0), false));
        assert_eq!(pieces.len(), 4);
        assert!(pieces.iter().all(CutRequest::is_valid));
        for pair in pieces.windows(2) {
            assert_eq!(pair[0].points.last(), pair[1].points.first());
        }
    }

    #[test]
    fn stroke_times_ascend_when_clock_is_set_back() {
        let mut strokes = StrokeCollector::new(0.02);
        for (i, t) in [10, 12, 11, 13].into_iter().enumerate() {
            strokes.push(ms(t), &at(i as f64), true);
        }
        assert!(strokes.push(ms(14), &at(5.0), false).unwrap().is_valid());
    }
}
