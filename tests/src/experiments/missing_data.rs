//! A stretch of a hand's motion with a gap, and what each method makes of it (Lin 2007, fig 6.9).

use std::fmt::Write as _;

use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{ServerTime, Span};
use serde_json::{Value, json};

use super::samples::{Sampled, distance};
use super::{Bench, Outcome, line};
use crate::chart::{BLUE, Chart, GREEN, GREY, Mark, ORANGE, Panel};

/// Samples per second of the stream.
const RATE_HZ: u32 = 1000;

/// The length of the gap, ms.
const GAP_MS: i64 = 50;

/// What is drawn before and after the gap, ms.
const AROUND_MS: i64 = 60;

/// From one moment drawn to the next, µs.
const STEP_US: i64 = 250;

/// Where gaps are looked for, ms: the one that is drawn is where the straight line is worst, so that there is something
/// to see.
const SEARCH_MS: i64 = 10;

/// A line of each method.
fn colour(method: Method) -> (&'static str, bool) {
    match method {
        Method::Hold => (GREY, true),
        Method::Linear => (GREEN, false),
        Method::VerletRaw => (ORANGE, true),
        Method::Verlet => (BLUE, false),
        Method::Hermite => (ORANGE, false),
    }
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let hand = bench.hand();
    let sampled = Sampled::new(&*hand, RATE_HZ)?;
    let began = worst_gap(&sampled)?;
    let ended = began + GAP_MS * 1000;
    let (from, until) = (began - AROUND_MS * 1000, ended + AROUND_MS * 1000);
    let axis = liveliest(&sampled, began, ended);
    let ms = |t_us: i64| (t_us - began) as f64 * 1e-3;
    let place = |p: [f64; 3]| 1e3 * (p[axis] - sampled.truth(began)[axis]);
    let moments = || (from..=until).step_by(STEP_US as usize);
    let truth: Vec<(f64, f64)> = (moments().map(|t| (ms(t), place(sampled.truth(t))))).collect();
    let mut panels = Vec::new();
    let mut figures = Vec::new();
    let mut table = String::from("kind,method,time_ms,place_mm,error_mm\n");
    for kind in ["extrapolation", "interpolation"] {
        let mut places = vec![line("the hand", "#000000", truth.clone())];
        let mut errors = Vec::new();
        for method in Method::ALL {
            let mut timeline = Timeline::new(method, Span::from_millis(GAP_MS));
            sampled.fill(&mut timeline, from - 60_000, began);
            if kind == "interpolation" {
                sampled.fill(&mut timeline, ended, until + 60_000);
            }
            let mut course = (Vec::new(), Vec::new());
            let last = if kind == "interpolation" {
                until
            } else {
                ended
            };
            for t in (from..=last).step_by(STEP_US as usize) {
                let shown = timeline.at(ServerTime::from_micros(t));
                let at = shown
                    .ok_or("the motion begins too late for its gap")?
                    .pose
                    .position_m;
                let error = 1e3 * distance(at, sampled.truth(t));
                // Writing to a string can not fail.
                let _ = writeln!(
                    table,
                    "{kind},{},{},{},{error}",
                    method.name(),
                    ms(t),
                    place(at)
                );
                course.0.push((ms(t), place(at)));
                course.1.push((ms(t), error));
            }
            let inside = |e: &&(f64, f64)| e.0 > 0.0 && e.0 <= GAP_MS as f64;
            let worst = course
                .1
                .iter()
                .filter(inside)
                .map(|e| e.1)
                .fold(0.0, f64::max);
            figures.push(json!({ "kind": kind, "method": method.name(), "max_mm": worst }));
            let (colour, dashed) = colour(method);
            let of = |points| super::Line {
                dashed,
                ..line(method.name(), colour, points)
            };
            // The raw second difference leaves every picture in which the others can be told apart.
            if method != Method::VerletRaw || worst < 3.0 {
                places.push(of(course.0));
            }
            if method != Method::Hold && (method != Method::VerletRaw || worst < 1.0) {
                errors.push(of(course.1));
            }
        }
        let panel = |what: &str, y: &str, lines| Panel {
            title: format!("{kind}: {what}"),
            y_label: y.to_owned(),
            lines,
        };
        panels.push(panel(
            "along the axis that moves most",
            "place (mm)",
            places,
        ));
        panels.push(panel(
            "distance to the hand, without hold",
            "error (mm)",
            errors,
        ));
    }
    Ok(outcome(panels, &figures, table))
}

fn outcome(panels: Vec<Panel>, figures: &[Value], table: String) -> Outcome {
    let mark = |x: i64, label: &str| Mark {
        x: x as f64,
        label: label.to_owned(),
    };
    let chart = Chart {
        title: format!("{GAP_MS} ms without samples in a stream of {RATE_HZ} Hz"),
        x_label: "time since the last sample (ms)".to_owned(),
        panels,
        marks: vec![mark(0, "last sample"), mark(GAP_MS, "next sample")],
    };
    Outcome {
        caption: "One gap in a hand's motion, at the place in ten seconds where a straight line is farthest off, and what is shown of it by \
                  each method: beyond the last sample, and between samples once the next ones are there. A method whose line would \
                  hide all others is left out of the picture and stands in the figures."
            .to_owned(),
        figures: json!({ "experiment": "missing-data", "rate_hz": RATE_HZ, "gap_ms": GAP_MS, "methods": figures }),
        charts: vec![("missing-data".to_owned(), chart)],
        tables: vec![("missing-data".to_owned(), table)],
    }
}

/// Where a straight line is farthest off at the end of a gap, µs.
fn worst_gap(sampled: &Sampled<'_>) -> Result<i64, String> {
    let (first, last) = sampled.room(GAP_MS * 1000 + AROUND_MS * 1000)?;
    let mut worst = (first, -1.0);
    for t in (first..=last.min(first + 10_000_000)).step_by(SEARCH_MS as usize * 1000) {
        let mut timeline = Timeline::new(Method::Linear, Span::from_millis(GAP_MS));
        sampled.fill(&mut timeline, t - 60_000, t);
        let end = t + GAP_MS * 1000;
        if let Some(shown) = timeline.at(ServerTime::from_micros(end)) {
            let error = distance(shown.pose.position_m, sampled.truth(end));
            if error > worst.1 {
                worst = (t, error);
            }
        }
    }
    Ok(worst.0)
}

/// The axis along which it moves farthest in the gap.
fn liveliest(sampled: &Sampled<'_>, began: i64, ended: i64) -> usize {
    let range = |axis: usize| {
        let along = || {
            (began..=ended)
                .step_by(1000)
                .map(|t| sampled.truth(t)[axis])
        };
        along().fold(f64::MIN, f64::max) - along().fold(f64::MAX, f64::min)
    };
    (0..3)
        .max_by(|a, b| range(*a).total_cmp(&range(*b)))
        .unwrap_or(0)
}
