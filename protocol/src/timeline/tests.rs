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

/// Errors of extrapolation at `ahead_us` (rms, mm and degrees) against the true hand, after each sample of a
/// stream of 20 s whose poses and times are changed by `device`.
fn streamed(
    method: Method,
    period_us: i64,
    ahead_us: i64,
    device: impl Fn(&mut ToolSample, &mut Pcg64) -> bool,
) -> (f64, f64) {
    let mut rng = Pcg64::seed_from_u64(7);
    let mut timeline = Timeline::new(method, Span::from_millis(200));
    let (mut sum, mut turned, mut n) = (0.0, 0.0, 0.0);
    for k in 0..20_000_000 / period_us {
        let mut measured = turning(k * period_us);
        if device(&mut measured, &mut rng) {
            timeline.insert(measured);
        }
        if k * period_us > 3_000_000 {
            let t = k * period_us + ahead_us;
            let (got, truth) = (timeline.uncorrected_pose(us(t)).unwrap(), turning(t).pose);
            sum += distance(got.position_m, truth.position_m).powi(2);
            turned += unit(got.orientation)
                .angle_to(&unit(truth.orientation))
                .powi(2);
            n += 1.0;
        }
    }
    (1e3 * (sum / n).sqrt(), (turned / n).sqrt().to_degrees())
}

/// The hand about a wrist 0.1 m away.
fn turning(t_us: i64) -> ToolSample {
    let at = sample(t_us);
    let turn = nalgebra::Vector3::from(hand(t_us as f64 * 1e-6)) / 0.1;
    let orientation = from_unit(UnitQuaternion::from_scaled_axis(turn));
    ToolSample {
        pose: Pose {
            orientation,
            ..at.pose
        },
        ..at
    }
}

/// Noise of a tracker: uniform, with this deviation in m on each axis and 0.1 m of lever.
fn noisy(sample: &mut ToolSample, deviation_m: f64, rng: &mut Pcg64) {
    let mut noise =
        || std::array::from_fn(|_| 12_f64.sqrt() * deviation_m * (rng.random::<f64>() - 0.5));
    let (along, about): (Vec3, Vec3) = (noise(), noise());
    sample.pose.position_m = map2(sample.pose.position_m, along, |x, n| x + n);
    let turn = UnitQuaternion::from_scaled_axis(nalgebra::Vector3::from(about) / 0.1);
    sample.pose.orientation = from_unit(turn * unit(sample.pose.orientation));
}

#[test]
fn chosen_is_as_good_as_the_best_method_on_quiet_noisy_and_repeated_samples() {
    type Device = fn(&mut ToolSample, &mut Pcg64) -> bool;
    let quiet: Device = |_, _| true;
    let tracker: Device = |sample, rng| {
        noisy(sample, 3e-4, rng);
        true
    };
    // A slow device in a loop of 1 kHz.
    let repeated: Device = |sample, _| {
        let time = sample.time;
        let device_us = time.as_micros() / 10_000 * 10_000;
        *sample = ToolSample {
            time,
            ..turning(device_us)
        };
        true
    };
    let lossy: Device = |sample, rng| {
        noisy(sample, 1e-4, rng);
        !rng.random_bool(0.2)
    };
    // Innovations do not show the age of repeated samples, so that a predictor with less lag is not noticed.
    for (name, device, period_us, tolerance) in [
        ("quiet", quiet, 1000, 1.05),
        ("quiet", quiet, 33_333, 1.05),
        ("tracker", tracker, 10_000, 1.05),
        ("lossy", lossy, 4000, 1.05),
        ("repeated", repeated, 1000, 1.15),
    ] {
        for ahead_us in [10_000, 20_000, 40_000] {
            let of = |method| streamed(method, period_us, ahead_us, device);
            let chosen = of(Method::Chosen);
            let others = [Method::Hold, Method::Linear, Method::Verlet, Method::Kalman].map(of);
            let best =
                |part: fn(&(f64, f64)) -> f64| others.iter().map(part).fold(f64::MAX, f64::min);
            let best = (best(|e| e.0), best(|e| e.1));
            println!("{name} {period_us} {ahead_us}: {chosen:.3?} {others:.3?}");
            assert!(
                chosen.0 < tolerance * best.0 && chosen.1 < tolerance * best.1,
                "{name} {ahead_us}"
            );
            if name == "tracker" {
                let (linear, verlet) = (others[1], others[2]);
                assert!(chosen.0 < 0.7 * linear.0.min(verlet.0), "{ahead_us}");
                assert!(chosen.1 < 0.7 * linear.1.min(verlet.1), "{ahead_us}");
            }
        }
    }
}

/// Error in mm of every fifth sample of a stream of 100 Hz with noise, left out and interpolated.
fn interpolated(method: Method, deviation_m: f64) -> f64 {
    let mut rng = Pcg64::seed_from_u64(7);
    let mut timeline = Timeline::new(method, GAP_LIMIT);
    let (mut missing, mut sum, mut n) = (ToolSample::default(), 0.0, 0.0);
    for k in 0..2000 {
        let mut measured = sample(k * 10_000);
        noisy(&mut measured, deviation_m, &mut rng);
        match k % 5 {
            2 => missing = measured,
            _ => timeline.insert(measured),
        }
        if k % 5 == 4 && k > 200 {
            let got = timeline.uncorrected_pose(missing.time).unwrap();
            sum += distance(got.position_m, missing.pose.position_m).powi(2);
            n += 1.0;
        }
    }
    1e3 * f64::sqrt(sum / n)
}

#[test]
fn noise_straightens_the_chosen_interpolation() {
    for deviation_m in [0.0, 1e-5, 1e-4, 3e-4, 1e-3] {
        let [linear, verlet, chosen] =
            [Method::Linear, Method::Verlet, Method::Chosen].map(|m| interpolated(m, deviation_m));
        println!("{deviation_m}: {linear:.4} {verlet:.4} {chosen:.4}");
        assert!(chosen < 1.02 * linear.min(verlet), "{deviation_m}");
    }
}

#[test]
fn jumps_and_pauses_leave_extrapolation_finite_and_bounded() {
    for method in [Method::Chosen, Method::Kalman] {
        let mut rng = Pcg64::seed_from_u64(3);
        let mut timeline = Timeline::new(method, GAP_LIMIT);
        let mut t = 0;
        for k in 0..20_000 {
            t += if rng.random_bool(0.01) {
                rng.random_range(1..2_000_000)
            } else {
                rng.random_range(1000..5000)
            };
            let mut jumping = sample(t);
            if k % 5 == 0 {
                noisy(&mut jumping, 1e-3, &mut rng);
            }
            timeline.insert(jumping);
            let at =
                |timeline: &Timeline, ahead: i64| timeline.uncorrected_pose(us(t + ahead)).unwrap();
            let step = distance(at(&timeline, 1).position_m, jumping.pose.position_m);
            assert!(step < 1e-4, "{method:?}: {step} m at once");
            for ahead in [2500, 20_000, 50_000] {
                let pose = at(&timeline, ahead);
                let far = distance(pose.position_m, jumping.pose.position_m);
                assert!(far < 0.5, "{method:?}: {far} m in {ahead} µs");
                let norm = pose.orientation.iter().map(|q| q * q).sum::<f64>();
                assert!((norm - 1.0).abs() < 1e-9);
            }
        }
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

/// Samples of a straight line at this speed in m/s, every millisecond up to `last_ms`.
fn straight(timeline: &mut Timeline, from_ms: i64, last_ms: i64, speed: f64) {
    for ms in from_ms..=last_ms {
        let mut at = sample(ms * 1000);
        at.pose.position_m = [speed * ms as f64 * 1e-3, 0.0, 0.0];
        timeline.insert(at);
    }
}

#[test]
fn silent_tool_slows_down_within_its_error_budget_and_holds() {
    for speed in [0.01, 0.1, 0.5, 2.0] {
        let mut timeline = Timeline::default();
        straight(&mut timeline, 0, 200, speed);
        let at_limit = speed * 0.25;
        let mut last = timeline.at(us(250_000)).unwrap();
        assert_eq!(last.source, Source::Extrapolated);
        for ms in 251..1500 {
            let shown = timeline.at(us(ms * 1000)).unwrap();
            assert_eq!(shown.source, Source::Held);
            let [x, v] = [shown.pose.position_m[0], shown.velocity_m_s[0]];
            assert!(
                (0.0..=last.velocity_m_s[0] + 1e-12).contains(&v),
                "{ms}: {v} m/s"
            );
            let step = x - last.pose.position_m[0];
            assert!(step >= -1e-12 && step <= 1e-3 * last.velocity_m_s[0] + 1e-9);
            assert!(x - at_limit <= SLOWING_MAX_M + 1e-9, "{speed} m/s: {x} m");
            last = shown;
        }
        let way = last.pose.position_m[0] - at_limit;
        let expected = (speed * SLOWING.as_secs_f64()).min(SLOWING_MAX_M);
        assert!(
            (way - expected).abs() < 1e-3 * expected,
            "{speed} m/s: {way} m"
        );
    }
}

#[test]
fn contact_of_silent_tool_is_kept_for_half_a_second_then_fades_smoothly() {
    let mut timeline = Timeline::default();
    straight(&mut timeline, 0, 20, 0.1);
    let mut at = |ms: i64| timeline.at(us(ms * 1000)).unwrap().strength;
    assert_eq!([at(20), at(100), at(520)], [1.0; 3]);
    let course: Vec<f64> = (520..1100).map(at).collect();
    // A smooth step of 0.5 s: 1.5 times its mean slope.
    let falls = course.windows(2).map(|w| w[0] - w[1]);
    assert!(falls.clone().all(|fall| (0.0..=3.01e-3).contains(&fall)));
    assert!((course[250] - 0.5).abs() < 1e-3 && course[500] == 0.0);
}

#[test]
fn sites_with_the_same_samples_hold_the_same_tool() {
    let [mut near, mut far] = [Timeline::default(), Timeline::default()];
    for ms in 0..1200 {
        if ms <= 300 {
            near.insert(sample(ms * 1000));
        }
        // A burst of samples that were late.
        if ms == 380 {
            (100..=300).for_each(|ms| far.insert(sample(ms * 1000)));
        } else if ms <= 100 {
            far.insert(sample(ms * 1000));
        }
        let [a, b] = [&mut near, &mut far].map(|timeline| timeline.at(us(ms * 1000)).unwrap());
        if ms >= 480 {
            let apart = distance(a.pose.position_m, b.pose.position_m);
            assert!(apart < 1e-9 && a.strength == b.strength, "{ms}: {apart} m");
        }
    }
}

#[test]
fn tool_and_contact_return_within_100_ms_after_a_hold_of_any_length() {
    // The hand moves on during the hold, by up to 200 mm.
    for silent_ms in [100, 300, 700, 990, 2000] {
        let mut timeline = Timeline::default();
        straight(&mut timeline, 0, 100, 0.1);
        let ends = 100 + silent_ms;
        let mut last = timeline.at(us(100_000)).unwrap();
        for ms in (104..ends).step_by(4) {
            last = timeline.at(us(ms * 1000)).unwrap();
        }
        let held = last;
        let held_ms = (ends - 1) / 4 * 4;
        for ms in (ends..ends + 300).step_by(4) {
            straight(&mut timeline, ms - 3, ms, 0.1);
            let shown = timeline.at(us(ms * 1000)).unwrap();
            let step = distance(shown.pose.position_m, last.pose.position_m);
            let jump = distance(held.pose.position_m, [1e-4 * ends as f64, 0.0, 0.0]);
            let appears = held.strength == 0.0 && ms == ends;
            assert!(
                appears || step < 4e-4 + 4.0 / 30.0 * jump,
                "{silent_ms}: {step} m"
            );
            let grows = shown.strength - last.strength;
            assert!((0.0..0.12).contains(&grows), "{silent_ms}: {grows} at once");
            let agrees = ms >= ends + 100;
            let off = (shown.pose.position_m[0] - 1e-4 * ms as f64).abs();
            assert!(!agrees || off < 1e-9 && shown.strength == 1.0);
            assert_eq!(shown.returns, ms < held_ms + 200);
            last = shown;
        }
    }
}

/// The methods for sessions: methods of sample-to-sample differences jump by construction.
const STEADY: [Method; 5] = [
    Method::Linear,
    Method::Verlet,
    Method::Hermite,
    Method::Kalman,
    Method::Chosen,
];

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
