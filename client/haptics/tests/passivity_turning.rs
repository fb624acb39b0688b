//! A simulated rigid hand on a device with torque, against delayed line contacts: it gains energy with the
//! controller off, and none with it on.
//!
//! The hand is a mass and an inertia about the pivot with dampers. Soft springs, some of which sweep, pull it onto
//! the surface and out of level; it is free to bounce and to rock. The contact model is exact for the tool's pose a
//! delay ago.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use palpate_device::{DeviceCaps, DeviceTime, Pose, Sample, Workspace};
use palpate_haptics::{CONTACTS_MAX, Chain, ChainConfig, ContactModel, Counters, Touch};
use palpate_protocol::ClientTime;

/// Sub-steps of the hand per tick.
const SUB_STEPS: usize = 10;
/// Ticks of a run, and the first one of contact: the soft start is over by then.
const TICKS: usize = 4000;
const BEGINS: usize = 1100;
/// Length of the line, and offset of its middle from the pivot, m.
const LENGTH: f64 = 0.06;
const BESIDE: f64 = 0.01;
/// Effective distance from the pivot at which a hand damps rotation, m.
const GRIP: f64 = 0.05;

#[derive(Debug, Clone, Copy)]
struct Case {
    /// kg and kg·m² of a handle, or of a handle with fingers.
    body: (f64, f64),
    /// N·s/m, towards the table.
    damping: f64,
    /// N/m of the tissue along the whole line.
    stiffness: f64,
    /// Ticks from a sample to the model that was solved for it.
    delay: usize,
    stations: usize,
    mu: f64,
}

fn caps() -> DeviceCaps {
    let half = Vector3::repeat(0.5);
    DeviceCaps {
        name: "handle in a hand".to_owned(),
        dof_in: 6,
        dof_out: 6,
        workspace: Workspace {
            min: -half,
            max: half,
        },
        max_force_n: 40.0,
        continuous_force_n: 20.0,
        max_torque_nm: 1.0,
        max_stiffness_n_per_m: 1e5,
        rate_hz: 1000.0,
    }
}

/// The contact model of a tool at `pose`: a foundation below z = 0.
fn solved(case: &Case, pose: &Pose, at: ClientTime) -> ContactModel {
    let mut model = ContactModel {
        topology_version: 1,
        solved_at: at,
        x0: pose.position,
        turn0: pose.orientation,
        radius: 0.02,
        ..ContactModel::FREE
    };
    let share = 1.0 / case.stations as f64;
    let k = case.stiffness * share;
    for (i, touch) in model.touches[..case.stations].iter_mut().enumerate() {
        let along = BESIDE + LENGTH * ((i as f64 + 0.5) * share - 0.5);
        let lever = pose.orientation * (Vector3::x() * along);
        let depth = -(pose.position + lever).z;
        let f0 = Vector3::z() * (k * depth.max(0.0));
        *touch = Touch {
            touches: depth > 0.0,
            lever,
            mu_static: case.mu,
            mu_dynamic: 0.7 * case.mu,
            ..Touch::at_pivot(f0, Matrix3::from_diagonal_element(k), Vector3::z())
        };
    }
    model
}

/// Runs a case; returns the chain's counters, and the mean force in the last half second, N.
fn run(case: Case, controlled: bool) -> (Counters, f64) {
    let config = ChainConfig {
        passivity: controlled,
        ..ChainConfig::default()
    };
    let mut chain = Chain::new(config, &caps());
    let mut pose = Pose::at(Vector3::new(0.0, 0.0, 0.015));
    let (mut v, mut w) = (Vector3::<f64>::zeros(), Vector3::<f64>::zeros());
    let mut path = Vec::with_capacity(TICKS);
    let mut model = ContactModel::FREE;
    let at = |tick: usize| ClientTime::from_micros(1_000_000 + 1000 * tick as i64);
    let (mass, inertia) = case.body;
    let mut held = 0.0;
    for tick in 0..TICKS {
        path.push(pose);
        let begun = tick.saturating_sub(case.delay) / 4 * 4;
        if at(begun) != model.solved_at {
            model = solved(&case, &path[begun], at(begun));
        }
        let mut sample = Sample::resting(DeviceTime::ZERO, pose);
        (sample.velocity, sample.angular_velocity) = (v, w);
        let given = chain.tick(at(tick), &sample, &model).wrench;
        if tick + 500 >= TICKS {
            held += given.force.z / 500.0;
        }
        // The arm behind the hand: 2 N and 100 N/m towards 10 mm below the surface and out of level, once it begins.
        let (target, tilt, weight) = if tick < BEGINS {
            (0.015, Vector3::zeros(), 0.0)
        } else {
            (-0.01, Vector3::new(0.0, 0.1, 0.1), -2.0)
        };
        // With friction, it also sweeps and rocks.
        let s = if case.mu > 0.0 {
            1e-3 * tick as f64
        } else {
            0.0
        };
        let target = Vector3::new(0.01 * (2.0 * s).sin(), 0.0, target);
        let tilt = tilt * (1.0 + (9.0 * s).sin());
        let h = 1e-3 / SUB_STEPS as f64;
        for _ in 0..SUB_STEPS {
            let pull = (target - pose.position) * 100.0 + Vector3::z() * weight;
            v += (pull + given.force - v * case.damping) * (h / mass);
            pose.position += v * h;
            let lean = UnitQuaternion::new(tilt) * pose.orientation.inverse();
            let turn = lean.scaled_axis() * (100.0 * GRIP * GRIP);
            w += (turn + given.torque - w * (case.damping * GRIP * GRIP)) * (h / inertia);
            pose.orientation = UnitQuaternion::new(w * h) * pose.orientation;
        }
    }
    (*chain.counters(), held)
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for body in [(0.1, 5.3e-5), (0.4, 5e-4)] {
        for damping in [0.0, 0.5] {
            for (stiffness, mu) in [(300.0, 0.0), (2000.0, 0.4), (20_000.0, 0.0)] {
                for delay in [0, 1, 5, 10, 30, 75, 150, 300] {
                    let stations = if delay == 10 {
                        CONTACTS_MAX
                    } else {
                        1 + delay % 4
                    };
                    cases.push(Case {
                        body,
                        damping,
                        stiffness,
                        delay,
                        stations,
                        mu,
                    });
                }
            }
        }
    }
    cases
}

#[test]
fn a_turning_hand_gains_energy_only_without_the_controller() {
    let (mut worst, mut without, mut lively) = (f64::INFINITY, f64::INFINITY, 0);
    let mut torque = 0.0_f64;
    for case in cases() {
        let ((on, held), (off, _)) = (run(case, true), run(case, false));
        if std::env::var_os("SHOW").is_some() {
            println!(
                "{case:?}: on {:.2e} J, {} ticks, {:.2} N, {:.3} N m, {held:.2} N held; off {:.2e} J",
                on.min_energy_j, on.passivated, on.max_force_n, on.max_torque_nm, off.min_energy_j
            );
        }
        worst = worst.min(on.min_energy_j);
        without = without.min(off.min_energy_j);
        lively += usize::from(off.min_energy_j < -1e-3);
        torque = torque.max(on.max_torque_nm);
        // Soft tissue is rendered unchanged: 3 N less 100 N/m against 300 N/m, and the tilt.
        if case.stiffness == 300.0 && case.damping > 0.0 && case.delay <= 5 {
            assert!((2.0..2.6).contains(&held), "{held} N of {case:?}");
        }
    }
    println!(
        "least energy: {worst:.2e} J with it, {without:.2e} J without ({lively} cases); up to {torque:.2} N m"
    );
    assert!(worst >= 0.0, "the hand gained {worst} J");
    assert!(without < -0.1 && lively > 10, "without it none is lively");
    assert!(torque > 0.05, "the hand was hardly turned: {torque} N m");
}
