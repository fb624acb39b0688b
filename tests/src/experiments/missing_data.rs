//! One gap in a hand's motion and its reconstruction by each method (Lin 2007, fig 6.9).

use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{ServerTime, Span};
use serde_json::{Value, json};

use super::samples::{HISTORY_US, Sampled, angle_deg, distance, method_line, methods};
use super::{Bench, Outcome, Table};
use crate::chart::{BLACK, Chart, Line, Mark, Panel};

const RATE_HZ: u32 = 1000;
const GAP_MS: i64 = 50;

/// Time of the samples before the gap, from which predictors learn their errors, µs.
const LEARNED_US: i64 = 4_000_000;

/// Drawn time before and after the gap, ms; a longer time would make the gap too narrow.
const AROUND_MS: i64 = 20;
const STEP_US: i64 = 250;

/// Step of the search for a gap, ms. The drawn gap is the one with the largest error of linear
/// extrapolation.
const SEARCH_MS: i64 = 10;

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let hand = bench.hand();
    let sampled = Sampled::new(&*hand, RATE_HZ)?;
    let began = worst_gap(&sampled)?;
    let ended = began + GAP_MS * 1000;
    let (from, until) = (began - AROUND_MS * 1000, ended + AROUND_MS * 1000);
    let axis = axis_of_largest_motion(&sampled, began, ended);
    let ms = |t_us: i64| (t_us - began) as f64 * 1e-3;
    let position_mm = |p: [f64; 3]| 1e3 * (p[axis] - sampled.true_pose(began).position_m[axis]);
    let moments = || (from..=until).step_by(STEP_US as usize);
    let true_motion: Vec<(f64, f64)> =
        (moments().map(|t| (ms(t), position_mm(sampled.true_pose(t).position_m)))).collect();
    let mut panels = Vec::new();
    let mut figures = Vec::new();
    let mut table = Table::new("kind,method,time_ms,place_mm,error_mm,turn_error_deg");
    for (kind, titled) in [
        ("extrapolation", "Extrapolation"),
        ("interpolation", "Interpolation"),
    ] {
        let mut position_lines = vec![Line::new("the hand", BLACK, true_motion.clone())];
        let (mut errors, mut turns) = (Vec::new(), Vec::new());
        for method in methods(kind == "interpolation") {
            let points = reconstruct(&sampled, method, began, kind == "interpolation")?;
            let row = |p: &Point| {
                let figures = [
                    ms(p.t_us),
                    position_mm(p.position_m),
                    p.error_mm,
                    p.turn_error_deg,
                ];
                let words = [kind, method.name()].map(str::to_owned).into_iter();
                words.chain(figures.map(|x| x.to_string())).collect()
            };
            table.rows.extend(points.iter().map(row));
            let inside: Vec<&Point> = (points.iter())
                .filter(|p| p.t_us > began && p.t_us <= ended)
                .collect();
            let rms = |of: fn(&Point) -> f64| {
                let squares: f64 = inside.iter().map(|p| of(p).powi(2)).sum();
                (squares / inside.len().max(1) as f64).sqrt()
            };
            let worst = inside.iter().map(|p| p.error_mm).fold(0.0, f64::max);
            figures.push(json!({
                "kind": kind, "method": method.name(), "rms_mm": rms(|p| p.error_mm), "max_mm": worst,
                "rms_deg": rms(|p| p.turn_error_deg),
            }));
            let of = |y: &dyn Fn(&Point) -> f64| {
                method_line(method, points.iter().map(|p| (ms(p.t_us), y(p))))
            };
            // The raw second difference is omitted if its error would hide the other methods.
            if method != Method::VerletRaw || worst < 3.0 {
                position_lines.push(of(&|p| position_mm(p.position_m)));
            }
            if method != Method::Hold && (method != Method::VerletRaw || worst < 1.0) {
                errors.push(of(&|p| p.error_mm));
            }
            // Orientation errors of the other methods are those of linear.
            if matches!(method, Method::Linear | Method::Kalman | Method::Chosen) {
                turns.push(of(&|p| p.turn_error_deg));
            }
        }
        for (what, y_label, lines) in [
            (
                "position along the axis of largest motion",
                "place (mm)",
                position_lines,
            ),
            ("position error, without hold", "error (mm)", errors),
            ("orientation error", "error (°)", turns),
        ] {
            panels.push(Panel::new(format!("{titled}: {what}"), y_label, lines));
        }
    }
    Ok(outcome(panels, &figures, table))
}

struct Point {
    t_us: i64,
    position_m: [f64; 3],
    error_mm: f64,
    turn_error_deg: f64,
}

/// Reconstruction of a method around a gap. Without samples after the gap it stops at the gap's end.
fn reconstruct(
    sampled: &Sampled<'_>,
    method: Method,
    began: i64,
    is_closed: bool,
) -> Result<Vec<Point>, String> {
    let ended = began + GAP_MS * 1000;
    let (from, until) = (began - AROUND_MS * 1000, ended + AROUND_MS * 1000);
    let mut timeline = Timeline::new(method, Span::from_millis(GAP_MS));
    sampled.fill(&mut timeline, (from - LEARNED_US).max(0), began)?;
    if is_closed {
        sampled.fill(&mut timeline, ended, until + HISTORY_US)?;
    }
    let last = if is_closed { until } else { ended };
    let points = (from..=last).step_by(STEP_US as usize).map(|t_us| {
        let shown = timeline.at(ServerTime::from_micros(t_us));
        let shown = shown.ok_or("the motion begins too late for its gap")?.pose;
        let true_motion = sampled.true_pose(t_us);
        Ok(Point {
            t_us,
            position_m: shown.position_m,
            error_mm: 1e3 * distance(shown.position_m, true_motion.position_m),
            turn_error_deg: angle_deg(shown.orientation, true_motion.orientation),
        })
    });
    points.collect()
}

fn outcome(panels: Vec<Panel>, figures: &[Value], table: Table) -> Outcome {
    let mark = |x: i64, label: &str| Mark {
        x: x as f64,
        label: label.to_owned(),
    };
    let title = format!("{GAP_MS} ms without samples in a stream of {RATE_HZ} Hz");
    let chart = Chart::new(title, "time since the last sample (ms)", panels)
        .with_marks(vec![mark(0, "last sample"), mark(GAP_MS, "next sample")]);
    Outcome {
        caption: "One gap in a hand's motion and its reconstruction by each method, in position and \
                  orientation: extrapolation beyond the last sample, and interpolation once the next samples \
                  have arrived. The gap is the one in ten seconds with the largest error of linear \
                  extrapolation. A method whose error would hide the others (hold in the error panels, the \
                  raw second difference if it is large) is omitted from the panel but not from the figures."
            .to_owned(),
        figures: json!({ "experiment": "missing-data", "rate_hz": RATE_HZ, "gap_ms": GAP_MS, "methods": figures }),
        charts: vec![("missing-data".to_owned(), chart)],
        tables: vec![("missing-data".to_owned(), table)],
        ..Outcome::default()
    }
}

/// Start of the gap with the largest error of linear extrapolation, µs.
fn worst_gap(sampled: &Sampled<'_>) -> Result<i64, String> {
    let (first, last) = sampled.gap_range(GAP_MS * 1000 + AROUND_MS * 1000)?;
    let mut worst = (first, -1.0);
    for t in (first..=last.min(first + 10_000_000)).step_by(SEARCH_MS as usize * 1000) {
        let mut timeline = Timeline::new(Method::Linear, Span::from_millis(GAP_MS));
        sampled.fill(&mut timeline, t - HISTORY_US, t)?;
        let end = t + GAP_MS * 1000;
        if let Some(shown) = timeline.at(ServerTime::from_micros(end)) {
            let error = distance(shown.pose.position_m, sampled.true_pose(end).position_m);
            if error > worst.1 {
                worst = (t, error);
            }
        }
    }
    Ok(worst.0)
}

fn axis_of_largest_motion(sampled: &Sampled<'_>, began: i64, ended: i64) -> usize {
    let range = |axis: usize| {
        let along = || {
            (began..=ended)
                .step_by(1000)
                .map(|t| sampled.true_pose(t).position_m[axis])
        };
        along().fold(f64::MIN, f64::max) - along().fold(f64::MAX, f64::min)
    };
    (0..3)
        .max_by(|a, b| range(*a).total_cmp(&range(*b)))
        .unwrap_or(0)
}
