//! One participant's share of the work of cutting: length of the strokes, time of their preparation, and log.

use palpate_protocol::request::{CutRequest, RequestRefusal, TimedBladePoint};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ServerTime, Span, TokenBucket};

use crate::track;

/// Length of strokes over time, m/s: three times the speed of a careful cut, without a pause.
const LENGTH_PER_S_M: f64 = 0.15;

/// Length of strokes at once, m: the longest stroke of one request (511 steps of 0.75 mm) and a third more.
const LENGTH_BURST_M: f64 = 0.5;

/// Length of strokes of a participant who has just joined, m: joining again gains little.
const LENGTH_FIRST_M: f64 = 0.1;

/// Preparation time over time: a quarter of one core.
const TIME_PER_S: f64 = 0.25;

/// Preparation time at once, s: some ten cuts of 0.2 s.
const TIME_BURST_S: f64 = 2.0;

/// Preparation time of a participant who has just joined, s.
const TIME_FIRST_S: f64 = 0.5;

/// Largest swept area of one stroke, m²: the longest stroke at a depth of 50 mm.
const SWEPT_MAX_M2: f64 = 0.02;

/// Least mean step between the points of a stroke, m: less than half of a client's 0.75 mm. Denser strokes would only
/// fill the log.
const STEP_MEAN_MIN_M: f64 = 0.3e-3;

/// Points of a stroke that need no length.
const POINTS_FREE: usize = 8;

/// Widest wound of a thin blade, m; of a thicker one its thickness.
const WIDTH_MAX_M: f64 = 1e-3;

/// Tolerance of depths, m.
const DEPTH_TOLERANCE_M: f64 = 1e-3;

/// One participant's budget.
#[derive(Debug)]
pub(crate) struct CutBudget {
    length_m: TokenBucket,
    time_s: TokenBucket,
    /// Log space of the cuts of participants who left before this one joined, bytes.
    inherited: u64,
    /// Log space of this participant's cuts, bytes.
    own: u64,
}

impl CutBudget {
    /// The budget of a newcomer. Participants who have left used `inherited` bytes of the log.
    pub(crate) fn new(inherited: u64, now: ServerTime) -> Self {
        let at = now - ServerTime::ZERO;
        Self {
            length_m: TokenBucket::new(LENGTH_PER_S_M, LENGTH_BURST_M, at).holding(LENGTH_FIRST_M),
            time_s: TokenBucket::new(TIME_PER_S, TIME_BURST_S, at).holding(TIME_FIRST_S),
            inherited,
            own: 0,
        }
    }

    /// Log space that counts for this participant, bytes.
    pub(crate) fn log_used(&self) -> u64 {
        self.inherited + self.own
    }

    /// Log space of this participant's cuts alone, bytes.
    pub(crate) fn own_log(&self) -> u64 {
        self.own
    }

    /// Notes the log space of a cut, bytes.
    pub(crate) fn note_log(&mut self, bytes: u64) {
        self.own += bytes;
    }

    /// No cut uses log space any more: a snapshot covers them.
    pub(crate) fn clear_log(&mut self) {
        (self.inherited, self.own) = (0, 0);
    }

    /// Takes the length of a stroke, unless it or an unpaid preparation exceeds the budget.
    pub(crate) fn take(&mut self, cut: &CutRequest, now: ServerTime) -> Result<(), RequestRefusal> {
        let at = now - ServerTime::ZERO;
        let has_time = self.time_s.has(0.0, at);
        if has_time && self.length_m.take(track::length(&cut.points), at) {
            Ok(())
        } else {
            Err(RequestRefusal::TooMany)
        }
    }

    /// Charges the CPU time of a preparation.
    pub(crate) fn charge(&mut self, time: Span, now: ServerTime) {
        self.time_s
            .charge(time.as_secs_f64(), now - ServerTime::ZERO);
    }
}

/// Whether a stroke fits the blade and one request.
pub(crate) fn check_shape(cut: &CutRequest, tool: &ToolDescription) -> Result<(), RequestRefusal> {
    let bad = |why: String| Err(RequestRefusal::CanNotCut(why));
    let mm = |m: f64| m * 1e3;
    let deepest_m = cut
        .points
        .iter()
        .map(|p| p.blade.depth_m)
        .fold(0.0, f64::max);
    if deepest_m > tool.length_m + DEPTH_TOLERANCE_M {
        return bad(format!(
            "it is {:.1} mm deep, but the blade is {:.1} mm long",
            mm(deepest_m),
            mm(tool.length_m)
        ));
    }
    let width_max_m = WIDTH_MAX_M.max(2.0 * tool.radius_m);
    if cut.width_m > width_max_m {
        return bad(format!(
            "the wound is {:.1} mm wide, but this blade makes at most {:.1} mm",
            mm(cut.width_m),
            mm(width_max_m)
        ));
    }
    let swept_m2 = swept(&cut.points);
    if swept_m2 > SWEPT_MAX_M2 {
        return bad(format!(
            "it sweeps {:.0} cm², more than {:.0} cm²; make several of it",
            swept_m2 * 1e4,
            SWEPT_MAX_M2 * 1e4
        ));
    }
    let length_m = track::length(&cut.points);
    if cut.points.len() as f64 > POINTS_FREE as f64 + length_m / STEP_MEAN_MIN_M {
        return bad(format!(
            "it has {} points on {:.1} mm; leave at least {} mm between them",
            cut.points.len(),
            mm(length_m),
            mm(STEP_MEAN_MIN_M)
        ));
    }
    Ok(())
}

/// Upper bound of the area that the blade sweeps, m²: per step the depth times the longer way of tip and top.
fn swept(points: &[TimedBladePoint]) -> f64 {
    let step = |w: &[TimedBladePoint]| {
        let [a, b] = [&w[0].blade, &w[1].blade];
        let way = |along: f64| {
            let square = |i: usize| {
                let top = |p: &palpate_protocol::operation::BladePoint| {
                    p.tip_m[i] + along * p.depth_m * p.axis[i]
                };
                (top(b) - top(a)).powi(2)
            };
            (0..3).map(square).sum::<f64>().sqrt()
        };
        a.depth_m.max(b.depth_m) * way(0.0).max(way(1.0))
    };
    points.windows(2).map(step).sum()
}

#[cfg(test)]
mod tests {
    use palpate_protocol::operation::{BladePoint, STROKE_MAX_POINTS};
    use proptest::prelude::*;

    use super::*;

    fn stroke(points: usize, step_m: f64, depth_m: f64) -> CutRequest {
        let point = |i: usize| TimedBladePoint {
            time: ServerTime::from_micros(10_000 * i as i64),
            blade: BladePoint {
                tip_m: [step_m * i as f64, 0.0, 0.0],
                axis: [0.0, 0.0, 1.0],
                depth_m,
            },
        };
        CutRequest::whole((0..points).map(point).collect(), 0.5e-3)
    }

    #[test]
    fn longest_stroke_of_a_client_fits_and_impossible_ones_do_not() {
        let blade = ToolDescription::scalpel(0.2e-3, 0.05);
        let check = |cut: &CutRequest| check_shape(cut, &blade);
        assert_eq!(check(&stroke(STROKE_MAX_POINTS, 0.75e-3, 0.05)), Ok(()));
        assert_eq!(check(&stroke(2, 0.1e-3, 0.05)), Ok(()));
        let wide = CutRequest {
            width_m: 3e-3,
            ..stroke(10, 1e-3, 0.05)
        };
        for (cut, why) in [
            (stroke(10, 1e-3, 0.06), "blade is 50.0 mm"),
            (wide, "at most 1.0 mm"),
            (stroke(500, 2e-3, 0.05), "more than 200 cm²"),
            (stroke(500, 0.1e-3, 0.05), "500 points"),
        ] {
            let refusal = check(&cut).unwrap_err().to_string();
            assert!(refusal.contains(why), "{refusal}");
        }
    }

    proptest! {
        #[test]
        fn accepted_length_stays_within_the_budget_for_any_schedule(
            asked in prop::collection::vec((0_i64..3_000_000, 2_usize..512), 1..100),
        ) {
            let mut now = ServerTime::ZERO;
            let mut budget = CutBudget::new(0, now);
            let mut accepted_m = 0.0;
            for (wait, points) in asked {
                now = now + Span::from_micros(wait);
                let cut = stroke(points, 0.75e-3, 0.01);
                if budget.take(&cut, now).is_ok() {
                    accepted_m += track::length(&cut.points);
                }
                let limit_m = LENGTH_BURST_M + LENGTH_PER_S_M * (now - ServerTime::ZERO).as_secs_f64();
                prop_assert!(accepted_m <= limit_m + 1e-9);
            }
        }

        #[test]
        fn prepared_time_exceeds_the_budget_by_at_most_one_preparation(
            asked in prop::collection::vec((0_i64..3_000_000, 0_i64..5_000_000), 1..100),
        ) {
            let mut now = ServerTime::ZERO;
            let mut budget = CutBudget::new(0, now);
            let (mut used_s, mut longest_s) = (0.0, 0.0_f64);
            for (wait, took) in asked {
                now = now + Span::from_micros(wait);
                if budget.take(&stroke(2, 0.75e-3, 0.01), now).is_ok() {
                    let took = Span::from_micros(took);
                    budget.charge(took, now);
                    used_s += took.as_secs_f64();
                    longest_s = longest_s.max(took.as_secs_f64());
                }
                let limit_s = TIME_BURST_S + TIME_PER_S * (now - ServerTime::ZERO).as_secs_f64();
                prop_assert!(used_s <= limit_s + longest_s + 1e-9);
            }
        }
    }
}
