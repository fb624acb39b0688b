use super::*;
use crate::lateness::Lateness;
use crate::operation::{CompensationMode, CompensationSettings};
use crate::request::DelayReport;
use crate::{ParticipantId, ServerTime};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

fn at(us: i64) -> ServerTime {
    ServerTime::from_micros(us)
}

fn adaptive(initial_us: u32, cap_us: u32) -> CompensationSettings {
    CompensationSettings {
        mode: CompensationMode::Adaptive { cap_us },
        initial_delay_us: initial_us,
    }
}

#[test]
fn clock_set_by_hours_is_not_a_delay_and_is_counted() {
    for hours_us in [7_200_000_000_i64, -7_200_000_000] {
        let mut estimator = DelayEstimator::default();
        for i in 0..2000_i64 {
            let is_wrong = (1000..1075).contains(&i);
            let wrong_us = if is_wrong { hours_us } else { 0 };
            let (sent, arrival) = (i * 4000, i * 4000 + 60_000 + wrong_us);
            estimator.handle_arrival(MotionArrival::on_time(at(sent), at(arrival)));
        }
        assert_eq!(estimator.ignored(), 75);
        let wanted = estimator.wanted().unwrap();
        // The gap of 300 ms is 4 % of the time.
        assert!(wanted < Span::from_millis(100), "{wanted:?}");
    }
}

#[test]
fn growth_of_the_uplink_delay_is_predicted_for_all_participants() {
    let mut group = GroupDelay::new(&adaptive(50_000, 400_000));
    let report = |wanted_us| DelayReport {
        wanted_us,
        ..DelayReport::default()
    };
    let lead = Span::from_millis(50);
    group.handle_report(ParticipantId(1), report(50_000));
    group.handle_report(ParticipantId::SERVER, report(20_000));
    assert_eq!(group.poll_change(at(0), lead), None);
    group.handle_report(ParticipantId::SERVER, report(45_000));
    let change = group.poll_change(at(300_000), lead).unwrap();
    assert_eq!(change.delay_us, 75_000, "25 ms more before anybody said so");
    group.handle_report(ParticipantId(1), report(100_000));
    let change = group.poll_change(at(400_000), lead).unwrap();
    assert_eq!(change.delay_us, 100_000, "what they say counts, not twice");
    group.handle_report(ParticipantId(1), report(50_000));
    assert_eq!(
        group.poll_change(at(1_000_000), lead).unwrap().delay_us,
        50_000
    );
}

#[test]
fn schedule_is_a_function_of_the_log_and_never_runs_backwards() {
    let mut schedule = DelaySchedule::new(&adaptive(50_000, 200_000));
    schedule.handle_change(150_000, at(1_000_000));
    schedule.handle_change(60_000, at(2_000_000));
    assert_eq!(schedule.delay_at(at(900_000)), Span::from_millis(50));
    assert_eq!(schedule.delay_at(at(1_200_000)), Span::from_millis(100));
    assert_eq!(schedule.delay_at(at(2_000_000)), Span::from_millis(150));
    assert_eq!(schedule.delay_at(at(3_000_000)), Span::from_millis(100));
    assert_eq!(schedule.delay_at(at(9_000_000)), Span::from_millis(60));
    let mut last = schedule.shown_at(at(0));
    for ms in 1..10_000 {
        let shown = schedule.shown_at(at(ms * 1000));
        let rate = (shown - last).as_micros() as f64 / 1000.0;
        assert!(
            (1.0 - SLEW_UP - 0.002..=1.0 + SLEW_DOWN + 0.002).contains(&rate),
            "{rate}"
        );
        last = shown;
    }
}

proptest! {
    #[test]
    fn late_changes_are_corrected_without_jumps(
        changes in prop::collection::vec((0_u32..300, 0_i64..400, 0_i64..400), 1..12),
    ) {
        let settings = adaptive(50_000, 400_000);
        let (mut here, mut there) = (DelaySchedule::new(&settings), DelaySchedule::new(&settings));
        let mut now = 1_000_000;
        let mut last = here.shown_at(at(now));
        let mut go = |here: &DelaySchedule, now: &mut i64, ms: i64| {
            for _ in 0..ms {
                *now += 1000;
                let shown = here.shown_at(at(*now));
                let rate = (shown - last).as_micros() as f64 / 1000.0;
                let (least, most) = (1.0 - SLEW_UP - CATCH_UP, 1.0 + SLEW_DOWN + CATCH_UP);
                assert!((least - 0.002..=most + 0.002).contains(&rate), "{rate}");
                last = shown;
            }
        };
        for (ms, after, late) in changes {
            go(&here, &mut now, after);
            let effective_at = at(now);
            there.handle_change(ms * 1000, effective_at);
            go(&here, &mut now, late);
            here.handle_late_change(ms * 1000, effective_at, at(now));
        }
        go(&here, &mut now, 2000);
        prop_assert!((here.delay_at(at(now)) - there.delay_at(at(now))).as_micros().abs() <= 1);
    }
}

#[test]
fn group_delay_follows_the_slowest_that_a_delay_can_bridge() {
    let mut group = GroupDelay::new(&adaptive(50_000, 200_000));
    let report = |wanted_us| DelayReport {
        wanted_us,
        ..DelayReport::default()
    };
    let (near, far) = (ParticipantId(1), ParticipantId(2));
    let lead = Span::from_millis(100);
    group.handle_report(near, report(70_000));
    group.handle_report(far, report(180_000));
    let change = group.poll_change(at(0), lead).unwrap();
    assert_eq!(
        (change.delay_us, change.effective_at),
        (180_000, at(100_000))
    );
    group.handle_report(far, report(320_000));
    assert_eq!(group.poll_change(at(90_000), lead), None, "D is held");
    assert_eq!(
        group.poll_change(at(100_000), lead),
        None,
        "not twice within the period"
    );
    group.remove(far);
    assert_eq!(
        group.poll_change(at(300_000), lead).unwrap().delay_us,
        70_000
    );
    assert_eq!(
        group.poll_change(at(900_000), lead),
        None,
        "nothing changed"
    );

    let mut raised = GroupDelay::new(&adaptive(50_000, 600_000));
    raised.handle_report(far, report(320_000));
    assert_eq!(raised.poll_change(at(0), lead).unwrap().delay_us, 320_000);
}

#[test]
fn a_fixed_delay_stays() {
    let settings = CompensationSettings {
        mode: CompensationMode::Fixed,
        initial_delay_us: 80_000,
    };
    let mut group = GroupDelay::new(&settings);
    group.handle_report(
        ParticipantId(1),
        DelayReport {
            wanted_us: 150_000,
            ..DelayReport::default()
        },
    );
    assert_eq!(group.poll_change(at(0), Span::ZERO), None);
    assert_eq!(
        DelaySchedule::new(&settings).delay_at(at(77)),
        Span::from_millis(80)
    );
}

#[test]
fn no_report_postpones_a_change_by_more_than_half_the_cap() {
    let cap_us = 400_000;
    let mut group = GroupDelay::new(&CompensationSettings {
        mode: CompensationMode::Adaptive { cap_us },
        initial_delay_us: 50_000,
    });
    let report = DelayReport {
        wanted_us: u32::MAX,
        ..DelayReport::default()
    };
    group.handle_report(ParticipantId(3), report);
    assert!(group.lead() <= Span::from_micros(i64::from(cap_us) / 2) + Span::from_millis(20));
}

/// D* over a minute of packets with jitter of up to 20 ms, except that no packet arrives during the stalls: those of
/// the stall arrive at its end.
fn wanted_over_stalls(stalls_ms: &[(i64, i64)]) -> Vec<(i64, Span)> {
    let mut rng = Pcg64::seed_from_u64(1);
    let mut estimator = DelayEstimator::default();
    let mut arrivals: Vec<(i64, i64)> = (0..60_000_i64)
        .step_by(4)
        .map(|sent_ms| {
            let mut arrives_us = sent_ms * 1000 + rng.random_range(50_000..70_000);
            for &(from_ms, lasts_ms) in stalls_ms {
                let until_us = (from_ms + lasts_ms) * 1000;
                if (from_ms * 1000..until_us).contains(&arrives_us) {
                    arrives_us = until_us;
                }
            }
            (arrives_us, sent_ms * 1000)
        })
        .collect();
    arrivals.sort_unstable();
    let wanted = arrivals.into_iter().filter_map(|(arrival, sent)| {
        estimator.handle_arrival(MotionArrival::on_time(at(sent), at(arrival)));
        Some((arrival / 1000, estimator.wanted()?))
    });
    wanted.collect()
}

/// The largest D* in a range of milliseconds.
fn most_wanted_ms(wanted: &[(i64, Span)], range: std::ops::Range<i64>) -> f64 {
    let within = wanted.iter().filter(|(ms, _)| range.contains(ms));
    within.map(|(_, w)| w.as_millis_f64()).fold(0.0, f64::max)
}

#[test]
fn single_stall_does_not_raise_the_delay() {
    for (stall_ms, factor) in [(30, 1.1), (300, 1.1), (1000, 1.1), (3000, 1.3)] {
        let wanted = wanted_over_stalls(&[(30_000, stall_ms)]);
        let before = most_wanted_ms(&wanted, 20_000..30_000);
        let after = most_wanted_ms(&wanted, 30_000..60_000);
        assert!(
            after <= factor * before,
            "{stall_ms}: {before} to {after} ms"
        );
    }
}

#[test]
fn rare_small_bursts_do_not_keep_a_large_one_in_memory() {
    let small = (0..6).map(|k| (k * 10_000 + 5000, 90));
    let stalls: Vec<_> = small.chain([(22_000, 300)]).collect();
    let wanted = wanted_over_stalls(&stalls);
    let before = most_wanted_ms(&wanted, 15_000..22_000);
    let after = most_wanted_ms(&wanted, 22_000..60_000);
    assert!(after <= 1.1 * before, "{before} to {after} ms");
}

#[test]
fn recurring_bursts_are_covered() {
    let stalls: Vec<_> = (0..40).map(|k| (k * 1500, 250)).collect();
    let wanted = wanted_over_stalls(&stalls);
    let later = wanted.iter().filter(|(ms, _)| *ms > 10_000);
    let least = later
        .map(|(_, w)| w.as_millis_f64())
        .fold(f64::MAX, f64::min);
    let most = most_wanted_ms(&wanted, 10_000..60_000);
    assert!(least >= 190.0 && most <= 310.0, "{least} to {most} ms");
}

#[test]
fn bursts_before_a_step_do_not_raise_the_delay_beyond_the_cap() {
    let mut estimator = DelayEstimator::new(Span::from_millis(400));
    let mut most = Span::ZERO;
    for i in 0..10_000_i64 {
        // The packets of a quarter of the time arrive at once.
        let (sent, burst) = (i * 4, i * 4 % 1500);
        let age_ms = if i < 5000 { 50.max(395 - burst) } else { 150 };
        let arrival = MotionArrival::on_time(at(sent * 1000), at((sent + age_ms) * 1000));
        estimator.handle_arrival(arrival);
        most = most.max(estimator.wanted().unwrap_or_default());
    }
    assert!(
        most > Span::from_millis(250) && most <= Span::from_millis(400),
        "{most:?}"
    );
}

#[test]
fn lasting_level_beyond_the_cap_is_reported_for_demotion() {
    let mut estimator = DelayEstimator::new(Span::from_millis(200));
    let mut wanted = Vec::new();
    for i in 0..2000_i64 {
        let age_us = if i < 1000 { 60_000 } else { 260_000 };
        estimator.handle_arrival(MotionArrival::on_time(at(i * 4000), at(i * 4000 + age_us)));
        wanted.push(estimator.wanted());
    }
    let before = wanted[999];
    assert!(before < Some(Span::from_millis(70)), "{before:?}");
    assert_eq!(wanted[1100], before, "held while it may be a stall");
    assert!(wanted[1999] > Some(Span::from_millis(250)));
}

proptest! {
    #[test]
    fn reported_lateness_keeps_the_age_within_measured_bounds(
        claims in prop::collection::vec((0_i64..3000, 0_i64..3000, 0_i64..400), 1..50),
        base_ms in 5_i64..200,
        seed in any::<u64>(),
    ) {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut estimator = DelayEstimator::default();
        let (mut least, mut most) = (i64::MAX, 0);
        for i in 0..2000_i64 {
            let age_us = base_ms * 1000 + rng.random_range(0..10_000);
            let (newest, more, stall) = claims[i as usize % claims.len()];
            let late = Lateness {
                newest: Span::from_millis(newest),
                oldest: Span::from_millis(newest + more),
            };
            let motion = MotionArrival {
                late: late.limited(),
                stall: Span::from_millis(stall),
                ..MotionArrival::on_time(at(i * 4000), at(i * 4000 + age_us))
            };
            let left = estimator.handle_arrival(motion).as_micros();
            // Where every arrival is delayed, the measurement begins after a second.
            if i >= 260 {
                prop_assert!((base_ms * 1000..=age_us).contains(&left), "{left} of {age_us} us");
            }
            (least, most) = (least.min(age_us), most.max(age_us));
        }
        let wanted = estimator.wanted().unwrap().as_micros();
        let bridge = BRIDGE.as_micros();
        prop_assert!((least - bridge..=most + 9000).contains(&wanted), "{wanted} us of {least} to {most}");
    }
}

#[test]
fn sender_lateness_does_not_count_as_network_delay() {
    let mut estimator = DelayEstimator::default();
    let mut t = 0;
    for i in 0..4000_i64 {
        // One batch of 50 leaves 200 ms late, and nothing between it and the batch before.
        let (interval_us, newest_ms, oldest_ms) = match i % 50 {
            48 => (204_000, 40, 200),
            // The queue of the stall drains.
            49 => (4000, 0, 40),
            _ => (4000, 0, 0),
        };
        t += interval_us;
        let late = Lateness {
            newest: Span::from_millis(newest_ms),
            oldest: Span::from_millis(oldest_ms),
        };
        let age_us = 60_000 + i % 7 * 500;
        let motion = MotionArrival {
            late,
            ..MotionArrival::on_time(at(t - late.newest.as_micros()), at(t + age_us))
        };
        estimator.handle_arrival(motion);
    }
    let wanted = estimator.wanted().unwrap();
    assert!(wanted <= Span::from_millis(68), "{wanted:?}");
}

#[test]
fn few_late_packets_after_pauses_are_no_step() {
    let mut estimator = DelayEstimator::default();
    let mut t = 0;
    let mut step_and_delay_after = |late: i64| {
        for i in 0..300 {
            // The last packets come 15 ms apart, each 12 ms older than usual.
            let is_late = i >= 300 - late;
            t += if is_late { 15_000 } else { 4000 };
            let age_us = if is_late { 14_000 } else { 2000 };
            let motion = MotionArrival::on_time(at(t - age_us), at(t));
            estimator.handle_arrival(motion);
        }
        (estimator.take_urgent(), estimator.wanted().unwrap())
    };
    for late in 1..4 {
        assert_eq!(step_and_delay_after(late), (false, Span::ZERO), "{late}");
    }
    let (is_step, wanted) = step_and_delay_after(4);
    assert!(is_step && wanted > Span::ZERO, "{wanted:?}");
}

#[test]
fn prediction_stays_within_the_measured_path_and_covers_the_uplink() {
    let lead = Span::from_millis(100);
    let report = |wanted_us| DelayReport {
        wanted_us,
        ..DelayReport::default()
    };
    // The uplink rises by 38 ms while the last report of the whole way is 45 ms.
    let after_rise = |path_us: u32| {
        let mut group = GroupDelay::new(&adaptive(10_000, 400_000));
        group.bound_predictions(path_us);
        group.handle_report(ParticipantId(1), report(45_000));
        group.handle_report(ParticipantId::SERVER, report(7_000));
        group.poll_change(at(0), lead);
        group.handle_report(ParticipantId::SERVER, report(45_000));
        let change = group.poll_change(at(100_000), lead);
        change.map_or(45_000, |change| change.delay_us)
    };
    assert_eq!(after_rise(u32::MAX), 83_000);
    assert_eq!(after_rise(65_000), 65_000);
    assert_eq!(after_rise(20_000), 45_000, "never below the uplink");
}
