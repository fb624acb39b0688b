//! Converts the path of the own blade, while its button is held, into requests for parts of a stroke.

use palpate_protocol::operation::STROKE_MAX_POINTS;
use palpate_protocol::request::{CutRequest, TimedBladePoint};
use palpate_protocol::{Pose, ServerTime, Span};

use super::convert::wire_blade;

/// Maximum spacing of stroke points, m. Its chords are 0.06 mm off an arc of 5 mm, 3 % of a lattice of 2 mm. A smaller spacing only
/// lengthens the request.
const POINT_SPACING_M: f64 = 1.5e-3;

/// Minimum motion of the blade for a part of a stroke, m.
const PART_MIN_M: f64 = 0.75e-3;

/// Minimum distance of the release point from the point before, m; closer points define no direction.
const LAST_STEP_MIN_M: f64 = 0.1e-3;

/// Minimum time between two parts of a stroke: two thirds of the requests that a server accepts. A part leaves as soon as
/// the blade has then moved, and ends where the blade is.
const PART_PERIOD: Span = Span::from_millis(30);

/// Width of the wound, m: that of a scalpel.
const WIDTH_M: f64 = 0.5e-3;

/// Collects the strokes of one blade.
#[derive(Debug, Clone)]
pub struct StrokeCollector {
    length_m: f64,
    open: Option<OpenStroke>,
}

#[derive(Debug, Clone)]
struct OpenStroke {
    began: ServerTime,
    /// From the last point of the latest part on.
    points: Vec<TimedBladePoint>,
    /// The latest blade pose, whether or not it became a point.
    last: TimedBladePoint,
    part_at: ServerTime,
    has_parts: bool,
}

impl StrokeCollector {
    /// For a blade with an edge of `length_m`.
    pub fn new(length_m: f64) -> Self {
        Self {
            length_m,
            open: None,
        }
    }

    /// Drops the stroke of a blade that has jumped.
    pub fn drop_open(&mut self) {
        self.open = None;
    }

    /// Adds a blade pose and the state of its button. Returns a part of the stroke when one is due, and the last part on
    /// release.
    pub fn push(&mut self, time: ServerTime, pose: &Pose, pressed: bool) -> Option<CutRequest> {
        if !pressed {
            return self.open.take().and_then(OpenStroke::finish);
        }
        let mut point = TimedBladePoint {
            time,
            blade: wire_blade(pose, self.length_m),
        };
        let open = self.open.get_or_insert_with(|| OpenStroke {
            began: time,
            points: vec![point],
            last: point,
            part_at: time,
            has_parts: false,
        });
        // A better clock estimate may step back a little; stroke times must ascend.
        point.time = time.max(open.last.time);
        open.last = point;
        let has_moved = open.points.len() >= 2 || open.is_far(PART_MIN_M);
        let is_due = has_moved && point.time - open.part_at >= PART_PERIOD;
        if open.is_far(POINT_SPACING_M) || is_due && open.is_far(LAST_STEP_MIN_M) {
            open.points.push(point);
        }
        (is_due || open.points.len() == STROKE_MAX_POINTS).then(|| open.part(false))
    }
}

impl OpenStroke {
    /// Whether the blade is this far from the last point, m.
    fn is_far(&self, by_m: f64) -> bool {
        let from = self.points.last();
        from.is_none_or(|p| distance(p, &self.last) >= by_m)
    }

    /// The path since the latest part.
    fn part(&mut self, is_last: bool) -> CutRequest {
        self.has_parts = true;
        self.part_at = self.last.time;
        let end = self.points.last().copied();
        let points = std::mem::replace(&mut self.points, end.into_iter().collect());
        CutRequest {
            began: self.began,
            points,
            width_m: WIDTH_M,
            is_last,
        }
    }

    /// The last part; `None` for a stroke that has not moved, because a single point sweeps no surface.
    fn finish(mut self) -> Option<CutRequest> {
        if self.is_far(LAST_STEP_MIN_M) {
            self.points.push(self.last);
        }
        (self.has_parts || self.points.len() >= 2).then(|| self.part(true))
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

    /// All parts of a stroke, as they are sent.
    fn parts(poses: impl Iterator<Item = (i64, f64)>) -> Vec<CutRequest> {
        let mut strokes = StrokeCollector::new(0.02);
        let mut parts = Vec::new();
        let mut end = (0, 0.0);
        for (t, x_mm) in poses {
            parts.extend(strokes.push(ms(t), &at(x_mm), true));
            end = (t + 1, x_mm);
        }
        parts.extend(strokes.push(ms(end.0), &at(end.1), false));
        assert_eq!(strokes.push(ms(end.0 + 1), &at(end.1), false), None);
        parts
    }

    #[test]
    fn parts_are_thinned_in_time_share_a_point_and_end_at_the_release_point() {
        let parts = parts((0..=1000).map(|t| (t, 0.0205 * t as f64)));
        assert!((25..=34).contains(&parts.len()), "{}", parts.len());
        for part in &parts {
            assert!(part.is_valid() && part.began == ms(0));
        }
        for pair in parts.windows(2) {
            assert_eq!(pair[0].points.last(), pair[1].points.first());
            assert!(!pair[0].is_last && pair[0].points.len() >= 2);
        }
        let last = parts.last().unwrap();
        assert!(last.is_last);
        let steps = parts.iter().flat_map(|part| part.points.windows(2));
        let steps: Vec<f64> = steps.map(|pair| distance(&pair[0], &pair[1])).collect();
        assert!((25..30).contains(&steps.len()), "{}", steps.len());
        assert!(steps.iter().all(|step| *step >= LAST_STEP_MIN_M));
        let end = last.points.last().unwrap();
        assert!((end.blade.tip_m[0] - 0.0205).abs() < LAST_STEP_MIN_M);
    }

    #[test]
    fn parts_end_where_the_blade_is() {
        for mm_s in [1.0, 10.0, 25.0, 40.0, 77.0, 300.0] {
            let mut strokes = StrokeCollector::new(0.02);
            let pushed = (0..500).filter_map(|t| {
                let part = strokes.push(ms(t), &at(mm_s * 1e-3 * t as f64), true)?;
                Some((ms(t), part))
            });
            for (now, part) in pushed {
                let behind_m = mm_s * 1e-3 * (now - part.points.last().unwrap().time).as_secs_f64();
                assert!(behind_m < LAST_STEP_MIN_M, "{mm_s} mm/s: {behind_m} m");
            }
        }
    }

    #[test]
    fn resting_blade_cuts_nothing() {
        assert_eq!(parts((0..100).map(|t| (t, 0.0))), []);
    }

    #[test]
    fn stroke_that_rests_at_its_end_is_ended() {
        let parts = parts((0..300).map(|t| (t, 0.1 * (t as f64).min(100.0))));
        let last = parts.last().unwrap();
        assert!(last.is_last && last.is_valid());
    }

    #[test]
    fn fast_stroke_needs_no_more_requests() {
        let parts = parts((0..2000).map(|t| (t, t as f64)));
        assert!((60..=70).contains(&parts.len()), "{}", parts.len());
        assert!(parts.iter().all(CutRequest::is_valid));
    }

    #[test]
    fn stroke_times_ascend_when_clock_is_set_back() {
        let parts = parts(
            [10, 12, 11, 13]
                .into_iter()
                .enumerate()
                .map(|(i, t)| (t, i as f64)),
        );
        assert!(!parts.is_empty() && parts.iter().all(CutRequest::is_valid));
    }
}
