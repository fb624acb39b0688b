//! A simulated hand against delayed contacts: it gains energy with the controller off, and none with it on.
//!
//! The hand is a mass with a damper, pulled against the surface by a soft spring, and free to bounce. The contact
//! model is exact for the tool's pose a delay ago. Between two models the chain follows the capped stiffness, so a
//! stiffer contact responds late and throws the hand back.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use nalgebra::{Matrix3, Vector3};
use palpate_device::{DeviceCaps, DeviceTime, Pose, Sample, Workspace};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Counters, Touch};
use palpate_protocol::ClientTime;

/// The sub-step of the hand, s.
const SUB_STEP: f64 = 1e-5;
/// Ticks of a run, and the first one of contact: the soft start is over by then.
const TICKS: usize = 6000;
const BEGINS: usize = 1100;

#[derive(Debug, Clone, Copy)]
struct Case {
    /// kg.
    mass: f64,
    /// N·s/m, towards the table.
    damping: f64,
    /// N/m of the tissue.
    stiffness: f64,
    /// Ticks from a sample to the model that was solved for it.
    delay: usize,
}

fn caps() -> DeviceCaps {
    let half = Vector3::repeat(0.5);
    DeviceCaps {
        name: "mass with a damper".to_owned(),
        dof_in: 3,
        dof_out: 3,
        workspace: Workspace {
            min: -half,
            max: half,
        },
        max_force_n: 40.0,
        continuous_force_n: 20.0,
        max_torque_nm: 0.0,
        max_stiffness_n_per_m: 1e5,
        rate_hz: 1000.0,
    }
}

/// Runs a case; returns the chain's counters, and the largest force in the last second.
fn run(case: Case, controlled: bool) -> (Counters, f64) {
    let config = ChainConfig {
        passivity: controlled,
        ..ChainConfig::default()
    };
    let mut chain = Chain::new(config, &caps());
    let (mut x, mut v) = (0.01_f64, 0.0_f64);
    let mut path = Vec::with_capacity(TICKS);
    let mut last = 0.0_f64;
    for tick in 0..TICKS {
        path.push(x);
        let now = ClientTime::from_micros(1_000_000 + 1000 * tick as i64);
        // Models of every fourth tick, with the delay.
        let solved = tick.saturating_sub(case.delay) / 4 * 4;
        let x0 = path[solved];
        let depth = (-x0).max(0.0);
        let f0 = Vector3::new(0.0, 0.0, case.stiffness * depth);
        let stiffness = Matrix3::from_diagonal_element(case.stiffness);
        let model = ContactModel {
            topology_version: 1,
            solved_at: ClientTime::from_micros(1_000_000 + 1000 * solved as i64),
            x0: Vector3::new(0.0, 0.0, x0),
            radius: 0.01,
            ..ContactModel::single(Touch {
                touches: depth > 0.0,
                ..Touch::at_pivot(f0, stiffness, Vector3::z())
            })
        };
        let mut sample = Sample::resting(DeviceTime::ZERO, Pose::at(Vector3::new(0.0, 0.0, x)));
        sample.velocity.z = v;
        let force = chain.tick(now, &sample, &model).wrench.force.z;
        if tick + 1000 > TICKS {
            last = last.max(force);
        }
        // The arm behind the hand: 3 N and 100 N/m towards 10 mm below the surface, once the contact begins.
        for _ in 0..(1e-3 / SUB_STEP) as usize {
            let pull = if tick < BEGINS {
                -50.0 * (x - 0.01)
            } else {
                -2.0 - 100.0 * (x + 0.01)
            };
            v += SUB_STEP * (pull + force - case.damping * v) / case.mass;
            x += SUB_STEP * v;
        }
    }
    (*chain.counters(), last)
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for mass in [0.1, 0.3, 1.0] {
        for damping in [0.0, 0.5, 5.0] {
            for stiffness in [200.0, 2000.0, 20_000.0] {
                for delay in [0, 1, 5, 10, 30, 75, 150, 300] {
                    cases.push(Case {
                        mass,
                        damping,
                        stiffness,
                        delay,
                    });
                }
            }
        }
    }
    cases
}

#[test]
fn a_hand_gains_energy_only_without_the_controller() {
    let (mut worst, mut without, mut lively) = (f64::INFINITY, f64::INFINITY, 0);
    for case in cases() {
        let (on, last) = run(case, true);
        let (off, last_off) = run(case, false);
        if std::env::var_os("SHOW").is_some() {
            println!(
                "{case:?}: on {:.2e} J, {} ticks, {last:.1} N; off {:.2e} J, {last_off:.1} N",
                on.min_energy_j, on.passivated, off.min_energy_j
            );
        }
        worst = worst.min(on.min_energy_j);
        without = without.min(off.min_energy_j);
        lively += usize::from(off.min_energy_j < -1e-3);
    }
    println!("least energy: {worst:.2e} J with it, {without:.2e} J without ({lively} cases)");
    assert!(worst >= 0.0, "the hand gained {worst} J");
    assert!(without < -0.1 && lively > 10, "without it none is lively");
}
