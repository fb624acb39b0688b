//! The laws hold, and the oracle detects violations.

use clap::ValueEnum;
use palpate_haptics::{ChainConfig, WatchdogConfig};
use palpate_protocol::Span;

use super::fault::{Class, FaultKind};
use super::faulty_device::Jerk;
use super::oracle::Law;
use super::plan::Plan;
use super::run::{Run, Setup, check_return, simulate};
use super::{SeedResult, all, desktop};

/// Seeds of the default test: every class several times.
const SEEDS: u64 = 44;

fn laws(run: &Run) -> Vec<Law> {
    run.broken.iter().map(|b| b.law).collect()
}

/// Laws that a class breaks under a setup, over some seeds.
fn broken_under(setup: &Setup, class: Class) -> Vec<Law> {
    let classes = Class::value_variants().len() as u64;
    let first = (0..classes).find(|s| Class::of_seed(*s) == class).unwrap();
    (0..4)
        .flat_map(|i| laws(&SeedResult::of(first + i * classes, setup).unwrap().faulty))
        .collect()
}

#[test]
fn all_laws_hold_under_every_fault_class() {
    let outcome = all(0..SEEDS, &Setup::default(), &mut |_, _| true).unwrap();
    assert!(outcome.ok, "{outcome}");
    assert_eq!(outcome.classes.len(), Class::value_variants().len());
    let losses: u64 = outcome.classes.values().map(|c| c.losses).sum();
    assert!(losses > 10, "the faults are felt: {losses}\n{outcome}");
}

#[test]
fn equal_seeds_give_equal_runs() {
    let [a, b] = [0, 1].map(|_| {
        let setup = Setup {
            keep: true,
            ..Setup::default()
        };
        SeedResult::of(10, &setup).unwrap().faulty
    });
    assert_eq!(a.points, b.points);
}

#[test]
fn oracle_with_half_limit_detects_slew_limited_steps() {
    let setup = Setup {
        step_share: Some(0.5),
        ..Setup::default()
    };
    assert!(broken_under(&setup, Class::Unplugged).contains(&Law::WrittenStep));
}

#[test]
fn oracle_detects_jerking_device() {
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
fn oracle_detects_late_watchdog() {
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
fn oracle_detects_force_that_does_not_return() {
    let mut plan = Plan::of(1, &desktop().unwrap()).unwrap();
    assert_eq!(plan.faults[0].what, FaultKind::LinkLost);
    let without = simulate(&plan.without_faults(), &Setup::default());
    let mut cured = simulate(&plan, &Setup::default());
    check_return(&plan, &mut cured, &without);
    assert_eq!(laws(&cured), []);
    // Equal length and check time, but the link stays lost.
    plan.faults[0].until_us = i64::MAX;
    let mut lost = simulate(&plan, &Setup::default());
    check_return(&plan, &mut lost, &without);
    assert_eq!(laws(&lost), [Law::ComesBack]);
}
