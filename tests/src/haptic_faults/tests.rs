//! The laws hold, and who looks can see.

use palpate_haptics::{ChainConfig, WatchdogConfig};
use palpate_protocol::Span;

use super::course::{Run, Setup, comes_back, run};
use super::fault::{Class, What};
use super::oracle::Law;
use super::plan::Plan;
use super::rig::Jerk;
use super::{Trial, all, desktop};

/// Seeds of the plain test: every class several times.
const SEEDS: u64 = 44;

fn laws(run: &Run) -> Vec<Law> {
    run.broken.iter().map(|b| b.law).collect()
}

/// The laws that runs of a class break under a setup, over some seeds.
fn broken_under(setup: &Setup, class: Class) -> Vec<Law> {
    let classes = Class::ALL.len() as u64;
    let first = (0..classes).find(|s| Class::of_seed(*s) == class).unwrap();
    (0..4)
        .flat_map(|i| laws(&Trial::of(first + i * classes, setup).unwrap().run))
        .collect()
}

#[test]
fn no_fault_jerks_the_hand() {
    let outcome = all(0..SEEDS, &Setup::default(), &mut |_, _| true).unwrap();
    assert!(outcome.ok, "{outcome}");
    assert_eq!(outcome.classes.len(), Class::ALL.len());
    let losses: u64 = outcome.classes.values().map(|c| c.losses).sum();
    assert!(losses > 10, "the faults are felt: {losses}\n{outcome}");
}

#[test]
fn a_seed_replays_its_run() {
    let [a, b] = [0, 1].map(|_| {
        let setup = Setup {
            keep: true,
            ..Setup::default()
        };
        Trial::of(10, &setup).unwrap().run
    });
    assert_eq!(a.points, b.points);
}

#[test]
fn an_oracle_of_half_the_limit_sees_the_slew_limit_at_work() {
    let setup = Setup {
        step_share: Some(0.5),
        ..Setup::default()
    };
    assert!(broken_under(&setup, Class::Unplugged).contains(&Law::WrittenStep));
}

#[test]
fn a_device_that_jerks_is_seen() {
    let setup = Setup {
        jerk: Some(Jerk {
            write: 700,
            by_n: 1.0,
        }),
        ..Setup::default()
    };
    assert!(broken_under(&setup, Class::LinkLost).contains(&Law::RenderedStep));
}

#[test]
fn a_watchdog_that_sleeps_is_seen() {
    let watchdog = WatchdogConfig {
        stale_from: Span::from_millis(400),
        stale_zero: Span::from_millis(600),
        link_zero: Span::from_millis(600),
        ..WatchdogConfig::default()
    };
    let setup = Setup {
        chain: ChainConfig {
            watchdog,
            ..ChainConfig::default()
        },
        ..Setup::default()
    };
    for class in [Class::SolverStall, Class::LinkLost] {
        assert!(
            broken_under(&setup, class).contains(&Law::ZeroInTime),
            "{class}"
        );
    }
}

#[test]
fn a_fault_without_end_is_seen() {
    let mut plan = Plan::of(1, &desktop().unwrap()).unwrap();
    assert_eq!(plan.faults[0].what, What::LinkLost);
    let without = run(&plan.without_faults(), &Setup::default());
    let mut cured = run(&plan, &Setup::default());
    comes_back(&plan, &mut cured, &without);
    assert_eq!(laws(&cured), []);
    // Of the same length, looked at at the same time, but the link never comes back.
    plan.faults[0].until_us = i64::MAX;
    let mut lost = run(&plan, &Setup::default());
    comes_back(&plan, &mut lost, &without);
    assert_eq!(laws(&lost), [Law::ComesBack]);
}
