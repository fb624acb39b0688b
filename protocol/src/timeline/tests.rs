//! Laws of the timeline, and the table of errors against a known motion.
#![allow(clippy::print_stdout)]

use std::f64::consts::TAU;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;

/// A hand that moves at 87 mm/s rms with a tremor of 0.1 mm at 9 Hz.
fn hand(t_s: f64) -> [f64; 3] {
    let wave = |amplitude: f64, hz: f64, phase: f64| amplitude * (TAU * hz * t_s + phase).sin();
    let slow = |phase: f64| wave(0.0155, 0.5, phase) + wave(0.0055, 1.3, 2.0 * phase);
    let tremor = |phase: f64| wave(1e-4, 9.0, phase);
    [
        slow(0.3) + tremor(0.1),
        slow(1.9) + tremor(2.0),
        slow(4.0) + tremor(4.1),
    ]
}

fn us(n: i64) -> ServerTime {
    ServerTime::from_micros(n)
}

fn sample(t_us: i64) -> ToolSample {
    let position_m = hand(t_us as f64 * 1e-6).map(|x| (x * 1e5).round() * 1e-5);
    ToolSample {
        time: us(t_us),
        pose: Pose {
            position_m,
            ..Pose::IDENTITY
        },
        ..ToolSample::default()
    }
}

/// Root mean square and largest error in mm over the gaps of a stream: `known_us` of samples every
/// `period_us`, then a gap of `gap_us`, again and again.
fn errors(method: Method, period_us: i64, gap_us: i64, both_sides: bool) -> (f64, f64) {
    let (mut sum, mut count, mut max) = (0.0, 0, 0.0_f64);
    let gap_samples = gap_us / period_us;
    let mut start = 0;
    for i in 0..400 {
        let begin = i * 47_000;
        let mut timeline = Timeline::new(method, Span::from_millis(200));
        start = start.max(begin);
        let known = 60_000 / period_us;
        for k in 0..=known {
            timeline.insert(sample(begin + k * period_us));
        }
        let last = begin + known * period_us;
        if both_sides {
            for k in 0..=known {
                timeline.insert(sample(last + (gap_samples + k) * period_us));
            }
        }
        for t in ((last + 1000)..(last + gap_samples * period_us)).step_by(1000) {
            let got = timeline.raw(us(t)).unwrap().pose.position_m;
            let error = distance(got, hand(t as f64 * 1e-6)) * 1e3;
            sum += error * error;
            count += 1;
            max = max.max(error);
        }
    }
    ((sum / f64::from(count)).sqrt(), max)
}

#[test]
fn synthetic_hand_has_the_speed_in_the_table() {
    let n = 20_000;
    let mean = (0..n)
        .map(|i| {
            let t = f64::from(i) * 1e-3;
            (distance(hand(t + 1e-4), hand(t)) / 1e-4).powi(2)
        })
        .sum::<f64>()
        / f64::from(n);
    assert!((mean.sqrt() - 0.087).abs() < 0.01, "{} m/s", mean.sqrt());
}

#[test]
fn each_method_is_as_good_as_the_prototype() {
    let row = |period, gap| {
        let e = |method, both| errors(method, period, gap, both);
        (
            e(Method::Hold, false),
            e(Method::Linear, false),
            e(Method::Verlet, false),
            e(Method::Verlet, true),
            e(Method::Hermite, true),
        )
    };
    let (hold, linear, verlet, between, hermite) = row(1000, 10_000);
    println!(
        "1 kHz, 10 ms gaps, mm rms/max: hold {hold:.3?} linear {linear:.3?} verlet {verlet:.3?} between {between:.3?} hermite {hermite:.3?}"
    );
    assert!(hold.0 < 0.7 && linear.0 < 0.08 && verlet.0 < 0.02 && between.0 < 0.008);
    assert!(between.0 < verlet.0 && verlet.0 < linear.0 && linear.0 < hold.0);

    let (hold, linear, verlet, between, hermite) = row(10_000, 50_000);
    println!(
        "100 Hz, 50 ms gaps, mm rms/max: hold {hold:.3?} linear {linear:.3?} verlet {verlet:.3?} between {between:.3?} hermite {hermite:.3?}"
    );
    assert!(hold.0 < 3.5 && linear.0 < 0.5 && verlet.0 < 0.3 && between.0 < 0.05);
    assert!(
        between.0 < verlet.0 && verlet.0 < linear.0 && linear.0 < hold.0 && hermite.0 < between.0
    );
}

#[test]
fn sample_at_the_queried_time_is_shown_unchanged() {
    let mut timeline = Timeline::default();
    for i in 0..20 {
        timeline.insert(sample(i * 1000));
    }
    let shown = timeline.at(us(7000)).unwrap();
    assert_eq!(
        (shown.pose, shown.source),
        (sample(7000).pose, Source::Exact)
    );
    assert_eq!(timeline.at(us(7400)).unwrap().source, Source::Interpolated);
    assert!(timeline.at(us(-1)).is_none());
}

#[test]
fn tool_is_held_fades_and_is_stale_beyond_the_gap_limit() {
    let mut timeline = Timeline::default();
    for i in 0..=20 {
        timeline.insert(sample(i * 1000));
    }
    let at = |timeline: &mut Timeline, ms: i64| timeline.at(us(ms * 1000)).unwrap();
    assert_eq!(at(&mut timeline, 60).source, Source::Extrapolated);
    let held = at(&mut timeline, 80);
    assert!(held.stale && held.source == Source::Held && held.velocity_m_s == [0.0; 3]);
    let later = at(&mut timeline, 200);
    assert_eq!(later.pose, held.pose);
    assert!(later.opacity < held.opacity);
    assert_eq!(at(&mut timeline, 1000).opacity, 0.0);
}

/// The methods for sessions: methods of sample-to-sample differences jump by construction.
const STEADY: [Method; 3] = [Method::Linear, Method::Verlet, Method::Hermite];

#[test]
fn steady_methods_extrapolate_continuously() {
    for method in STEADY {
        for (period, missing) in [(1000, 0), (4000, 0), (10_000, 0), (1000, 40)] {
            let mut timeline = Timeline::new(method, GAP_LIMIT);
            for i in (0..=60).filter(|i| !(60 - missing..60).contains(i)) {
                timeline.insert(sample(i * period));
            }
            let newest = 60 * period;
            let there = sample(newest).pose.position_m;
            let beyond = timeline.raw(us(newest + 1)).unwrap().pose.position_m;
            let step = distance(there, beyond);
            assert!(
                step < 2.2e-5,
                "{method:?} at {period} µs without {missing}: {step} m"
            );
        }
    }
}

#[test]
fn few_samples_extrapolate_without_large_accelerations() {
    for method in STEADY {
        for known in 1..20 {
            let mut timeline = Timeline::new(method, GAP_LIMIT);
            for i in 0..known {
                timeline.insert(sample(i * 1000));
            }
            let last = (known - 1) * 1000;
            let shown = timeline.raw(us(last + 10_000)).unwrap().pose.position_m;
            let error = distance(shown, hand((last + 10_000) as f64 * 1e-6));
            let still = distance(
                hand(last as f64 * 1e-6),
                hand((last + 10_000) as f64 * 1e-6),
            );
            assert!(error < still + 1e-4, "{method:?} of {known}: {error} m");
        }
    }
}

#[test]
fn late_and_lost_packets_never_cause_a_step_of_a_millimetre() {
    for (seed, method) in (0..4).flat_map(|s| STEADY.map(|m| (s, m))) {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut timeline = Timeline::new(method, GAP_LIMIT);
        let mut arrivals: Vec<(i64, i64)> = Vec::new();
        for batch in 0..1000_i64 {
            let newest = batch * 4000;
            if rng.random_bool(0.15) {
                continue;
            }
            let arrival = newest + 20_000 + rng.random_range(0..45_000);
            arrivals.extend((0..8).map(|k| (arrival, newest - k * 1000)));
        }
        arrivals.sort_unstable();
        let mut next = 0;
        let (mut last, mut worst) = (None::<[f64; 3]>, 0.0_f64);
        for now in (100_000..4_000_000).step_by(1000) {
            while next < arrivals.len() && arrivals[next].0 <= now {
                timeline.insert(sample(arrivals[next].1));
                next += 1;
            }
            let tau = now - 40_000;
            let Some(shown) = timeline.at(us(tau)) else {
                continue;
            };
            let here = shown.pose.position_m;
            if let Some(last) = last {
                let moved = distance(hand((tau - 1000) as f64 * 1e-6), hand(tau as f64 * 1e-6));
                worst = worst.max(distance(here, last) - moved);
            }
            last = Some(here);
        }
        assert!(
            worst < 1e-3,
            "seed {seed}, {method:?}: a step of {} mm",
            worst * 1e3
        );
    }
}

#[test]
fn correction_ends_after_its_blend_time() {
    let mut timeline = Timeline::default();
    for i in 0..=20 {
        timeline.insert(sample(i * 1000));
    }
    timeline.at(us(60_000));
    for i in 21..=400 {
        timeline.insert(sample(i * 1000));
    }
    let error_at = |timeline: &mut Timeline, ms: i64| {
        let shown = timeline.at(us(ms * 1000)).unwrap().pose.position_m;
        distance(shown, sample(ms * 1000).pose.position_m)
    };
    let first = error_at(&mut timeline, 61);
    for ms in 62..160 {
        error_at(&mut timeline, ms);
    }
    assert!(first > 1e-5, "there was something to correct: {first}");
    assert!(error_at(&mut timeline, 161) < 1e-12);
}

#[test]
fn rotation_is_interpolated_evenly_and_extrapolated() {
    let turned = |t_us: i64| {
        let q =
            UnitQuaternion::from_scaled_axis(nalgebra::Vector3::z() * (t_us as f64 * 1e-6 * 3.0));
        let pose = Pose {
            position_m: [0.0; 3],
            orientation: from_unit(q),
        };
        ToolSample {
            time: us(t_us),
            pose,
            ..ToolSample::default()
        }
    };
    let mut timeline = Timeline::default();
    for i in 0..=10 {
        timeline.insert(turned(i * 10_000));
    }
    for t_us in [34_567, 100_000, 130_000] {
        let shown = timeline.at(us(t_us)).unwrap();
        let angle = unit(shown.pose.orientation).angle_to(&unit(turned(t_us).pose.orientation));
        assert!(angle < 1e-6, "{angle} rad at {t_us}");
    }
}

#[test]
fn samples_are_bounded_and_duplicates_ignored() {
    let mut timeline = Timeline::default();
    for i in 0..10_000 {
        timeline.insert(sample(i * 1000));
        timeline.insert(sample(i * 1000));
    }
    assert_eq!(timeline.newest(), Some(us(9_999_000)));
    assert!(timeline.at(us(0)).is_none(), "the oldest are forgotten");
}
