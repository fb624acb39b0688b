//! Laws of adaptive compensation, over seeds, in virtual time.

use super::{Alignment, COUNTED_MAX_US, COUNTED_US, Figures, Mode, WARM_UP_US};
use crate::network::{Jitter, Link, Outage, Outages, Profile, Step, Steps};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

const ADAPTIVE: Mode = Mode::Adaptive;

/// An alignment with random motions.
fn alignment(profile: Profile, seed: u64) -> Alignment {
    Alignment {
        profile,
        seed,
        motion: None,
    }
}

/// An alignment over a named network.
fn over(name: &str, seed: u64) -> Alignment {
    alignment(Profile::named(name).unwrap(), seed)
}

/// From site to site 50 ms with a little jitter, and occasional bursts of 120 ms that last 0.1 to 0.4 s on all
/// links.
fn over_bursts(seed: u64) -> Alignment {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut delays = Vec::new();
    let mut at_s = 0.0;
    while at_s < (WARM_UP_US + COUNTED_US) as f64 * 1e-6 {
        for (lasts_s, delay_ms) in [(1.0..4.0, 25.0), (0.1..0.4, 60.0)] {
            delays.push(Step { at_s, delay_ms });
            at_s += rng.random_range(lasts_s);
        }
    }
    let link = Link {
        steps: Some(Steps {
            repeat_s: None,
            delays,
        }),
        jitter: Jitter::Gamma {
            mean_ms: 0.5,
            deviation_ms: 0.5,
        },
        reorder: true,
        ..Link::default()
    };
    alignment(Profile::both("bursts on all links", link), seed)
}

#[test]
fn measurement_covers_all_of_a_recorded_network() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.csv");
    let over_trace = |seconds: u32| {
        let rows = (0..seconds).map(|s| format!("{s}000,30,0\n"));
        let text = format!("time_ms,delay_ms,lost\n{}", rows.collect::<String>());
        std::fs::write(&file, text).unwrap();
        let text = "name = \"recorded\"\n[down]\ntrace = \"trace.csv\"\n";
        let profile = Profile::from_toml(text, &folder.path().join("recorded.toml"));
        alignment(profile.unwrap(), 1)
    };
    assert_eq!(over_trace(20).counted_us(), COUNTED_US);
    let moments = over_trace(75).moments(ADAPTIVE);
    assert_eq!(moments.len(), 75_000);
    assert_eq!(over_trace(7200).counted_us(), COUNTED_MAX_US);
}

/// Checks that fixed delays below the adaptive mean divided by `factor` are unsafe.
fn lag_is_within(factor: f64, figures: &Figures, alignment: &Alignment) {
    let shorter_ms = (figures.compensation_ms.mean / factor).ceil() as u32 - 1;
    let fixed = alignment.figures(Mode::Fixed(shorter_ms));
    assert!(
        !fixed.is_safe(),
        "a fixed delay of {shorter_ms} ms is safe: {fixed:?}"
    );
}

fn times_nearer(figures: &Figures, alignment: &Alignment) -> f64 {
    alignment.figures(Mode::None).disagreement_mm.rms / figures.disagreement_mm.rms
}

#[test]
fn steady_jitter_costs_at_most_a_tenth_more_lag_than_the_smallest_safe_delay() {
    for seed in 1..=2 {
        let alignment = over("gamma", seed);
        let figures = alignment.figures(ADAPTIVE);
        assert!(figures.is_safe(), "{seed}: {figures:?}");
        assert!(times_nearer(&figures, &alignment) >= 25.0);
        lag_is_within(1.10, &figures, &alignment);
    }
}

#[test]
fn delay_steps_cost_less_lag_than_any_safe_fixed_delay() {
    for seed in 1..=2 {
        let alignment = over("steps", seed);
        let figures = alignment.figures(ADAPTIVE);
        assert!(figures.is_safe(), "{seed}: {figures:?}");
        assert!(times_nearer(&figures, &alignment) >= 50.0);
        lag_is_within(0.85, &figures, &alignment);
    }
}

#[test]
fn recurring_bursts_cost_at_most_a_tenth_more_lag_than_the_smallest_safe_delay() {
    for seed in 1..=3 {
        let alignment = over_bursts(seed);
        let figures = alignment.figures(ADAPTIVE);
        assert!(figures.is_safe(), "{seed}: {figures:?}");
        lag_is_within(1.10, &figures, &alignment);
    }
}

/// D over a session with jitter and one outage of this length at 30 s, ms per millisecond.
fn delays_over_outage(lasts_s: f64) -> Vec<(f64, f64)> {
    let link = Link {
        delay_ms: 25.0,
        jitter: Jitter::Gamma {
            mean_ms: 3.0,
            deviation_ms: 3.0,
        },
        outages: Some(Outages {
            repeat_s: None,
            times: vec![Outage {
                from_s: 30.0,
                to_s: 30.0 + lasts_s,
            }],
        }),
        ..Link::default()
    };
    let moments = alignment(Profile::both("one outage", link), 1).moments(ADAPTIVE);
    moments.iter().map(|m| (m.time_s, m.delay_ms)).collect()
}

#[test]
fn single_stall_is_not_paid_for_with_delay() {
    let most = |delays: &[(f64, f64)], from_s: f64, to_s: f64| {
        let within = delays.iter().filter(|(t, _)| (from_s..to_s).contains(t));
        within.map(|d| d.1).fold(0.0, f64::max)
    };
    let short = delays_over_outage(0.3);
    let (before, later) = (most(&short, 25.0, 30.0), most(&short, 35.3, 60.0));
    assert!(later <= 1.1 * before, "{before} to {later} ms");
    let long = delays_over_outage(1.0);
    let (before, later) = (most(&long, 25.0, 30.0), most(&long, 30.0, 60.0));
    assert!(later <= 1.3 * before, "{before} to {later} ms");
}

#[test]
fn search_for_a_safe_delay_ends_at_one_second() {
    let link = Link {
        delay_ms: 450.0,
        ..Link::default()
    };
    let far = alignment(Profile::both("900 ms from site to site", link), 1);
    let safe_ms = far.smallest_safe_fixed_ms(&mut |_| {});
    assert!(
        safe_ms.is_some_and(|ms| (850..=1000).contains(&ms)),
        "{safe_ms:?}"
    );
}

#[test]
fn prediction_beats_no_compensation_but_not_an_adaptive_delay() {
    let alignment = over("transatlantic", 1);
    let [predicted, delayed] = [Mode::Predicted, ADAPTIVE].map(|m| alignment.figures(m));
    assert!(times_nearer(&predicted, &alignment) >= 2.0, "{predicted:?}");
    assert!(predicted.disagreement_mm.rms >= 10.0 * delayed.disagreement_mm.rms);
    assert_eq!(
        predicted.compensation_ms.mean, 0.0,
        "prediction must not add a playout delay"
    );
    let near = over("lan", 1).figures(Mode::Predicted);
    assert!(near.is_safe(), "{near:?}");
}

#[test]
fn short_steady_paths_cost_at_most_a_tenth_more_lag_than_the_smallest_safe_delay() {
    let (mut mean_ms, mut safe_ms) = (0.0, 0);
    for seed in 1..=3 {
        let alignment = over("metro", seed);
        let figures = alignment.figures(ADAPTIVE);
        assert!(figures.is_safe(), "{seed}: {figures:?}");
        mean_ms += figures.compensation_ms.mean;
        safe_ms += alignment.smallest_safe_fixed_ms(&mut |_| {}).unwrap();
    }
    assert!(
        mean_ms <= 1.10 * f64::from(safe_ms),
        "{mean_ms} of {safe_ms}"
    );
}

#[test]
fn network_delay_steps_cause_no_shown_steps() {
    for seed in 1..=2 {
        let figures = over("far-steps", seed).figures(ADAPTIVE);
        assert_eq!(figures.corrections_over_1mm, 0, "{seed}: {figures:?}");
    }
}

#[test]
fn session_recovers_from_a_clock_set_by_hours() {
    for by_us in [7_200_000_000, -7_200_000_000] {
        let alignment = over("gamma", 3);
        let mut simulation = alignment.simulation(ADAPTIVE);
        simulation.run(WARM_UP_US, WARM_UP_US + 10_000_000, &mut |_| {});
        simulation.set_clock(1, by_us);
        let mut moments = Vec::new();
        simulation.run(WARM_UP_US + 30_000_000, WARM_UP_US + 40_000_000, &mut |m| {
            moments.push(m);
        });
        assert_eq!(simulation.clock_steps(), [0, 1]);
        let figures = Figures::of(&moments);
        assert!(figures.is_safe(), "clock set by {by_us} us: {figures:?}");
        assert!(figures.compensation_ms.mean < 70.0, "{figures:?}");
    }
}

#[test]
fn session_survives_outages_and_recorded_losses() {
    let lost = "time_ms,delay_ms,lost\n0,20,0\n9000,,1\n9500,20,0\n20000,20,0\n";
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("lost.csv"), lost).unwrap();
    let text = "name = \"recorded\"\n[both]\ntrace = \"lost.csv\"\ntrace_offset_s = 0\n";
    let recorded = Profile::from_toml(text, &dir.path().join("recorded.toml")).unwrap();
    for profile in [Profile::named("outages").unwrap(), recorded] {
        let figures = alignment(profile, 1).figures(ADAPTIVE);
        // The outages cover 2.5 % and 5 % of the time; the sites agree otherwise.
        assert!(figures.disagreement_mm.p95 <= 1.0, "{figures:?}");
        let delay_ms = figures.compensation_ms;
        assert!((40.0..400.0).contains(&delay_ms.mean), "{figures:?}");
    }
}

#[test]
fn session_terminates_on_a_network_that_loses_every_packet() {
    let dead = Link {
        loss: 1.0,
        ..Link::default()
    };
    let alignment = alignment(Profile::both("dead", dead), 1);
    let mut shown = 0;
    let mut simulation = alignment.simulation(ADAPTIVE);
    simulation.run(0, 5_000_000, &mut |_| shown += 1);
    assert_eq!((simulation.arrived(), shown), (0, 0));
}
