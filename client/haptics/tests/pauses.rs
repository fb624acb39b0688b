//! A hand that sinks into the tissue while its tool is absent feels the tissue again afterwards, and gains no more than its
//! energy.

#![allow(clippy::unwrap_used)]

use nalgebra::{Matrix3, Vector3};
use palpate_device::{DeviceCaps, DeviceTime, Pose, Sample, Workspace};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Counters, Touch};
use palpate_protocol::ClientTime;
use proptest::prelude::*;

/// Sub-steps of the hand in a tick of 1 ms.
const SUB_STEPS: usize = 50;
/// The hand and its handle, kg and N·s/m, and the arm behind it, N/m.
const MASS: f64 = 0.2;
const DAMPING: f64 = 4.0;
const ARM: f64 = 300.0;
/// Where the arm holds the hand, m below the surface.
const DEPTH: f64 = 0.01;

fn caps() -> DeviceCaps {
    let half = Vector3::repeat(0.5);
    DeviceCaps {
        name: "hand on a spring".to_owned(),
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

/// Force and tissue force at the end of the hold, N, largest depth from the end of the pause to that of the soft start, m, and the counters after a withdrawal.
struct Felt {
    force: f64,
    tissue: f64,
    sunk_m: f64,
    counters: Counters,
}

/// A hand presses from `presses` ms on. From `pauses` ms on the tool is absent for `lasts` ms, or, if it touches nothing, no model
/// comes (`is_busy`). The hand withdraws in the end.
fn run(stiffness: f64, presses: usize, pauses: usize, lasts: usize, is_busy: bool) -> Felt {
    let mut chain = Chain::new(ChainConfig::default(), &caps());
    let (mut x, mut v) = (0.005_f64, 0.0_f64);
    let mut model = ContactModel::absent_at(ClientTime::ZERO, 1);
    let ends = presses.max(pauses + lasts) + 2500;
    let (mut force, mut tissue, mut sunk_m) = (0.0, 0.0, 0.0);
    for tick in 0..ends + 1000 {
        let now = ClientTime::from_micros(1_000_000 + 1000 * tick as i64);
        let is_paused = (pauses..pauses + lasts).contains(&tick);
        if tick % 4 == 0 && !(is_busy && is_paused && !model.in_contact()) {
            let depth = (-x).max(0.0);
            let f0 = Vector3::new(0.0, 0.0, stiffness * depth);
            let law = Matrix3::from_diagonal_element(stiffness);
            model = ContactModel {
                topology_version: 1,
                solved_at: now,
                x0: Vector3::new(0.0, 0.0, x),
                radius: 0.01,
                ..ContactModel::single(Touch {
                    touches: depth > 0.0,
                    ..Touch::at_pivot(f0, law, Vector3::z())
                })
            };
            if is_paused && !is_busy {
                model = ContactModel::absent_at(now, 1);
            }
        }
        let mut sample = Sample::resting(DeviceTime::ZERO, Pose::at(Vector3::new(0.0, 0.0, x)));
        sample.velocity.z = v;
        if (pauses + lasts..pauses + lasts + 1200).contains(&tick) {
            sunk_m = f64::max(sunk_m, -x);
        }
        let rendered = chain.tick(now, &sample, &model).wrench.force.z;
        if tick == ends {
            (force, tissue) = (rendered, stiffness * (-x).max(0.0));
        }
        let target = if (presses..=ends).contains(&tick) {
            -DEPTH
        } else {
            0.005
        };
        for _ in 0..SUB_STEPS {
            let pull = ARM * (target - x) - DAMPING * v;
            v += 1e-3 / SUB_STEPS as f64 * (pull + rendered) / MASS;
            x += 1e-3 / SUB_STEPS as f64 * v;
        }
    }
    Felt {
        force,
        tissue,
        sunk_m,
        counters: *chain.counters(),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn force_returns_after_a_pause(
        stiffness in 100.0..900.0,
        presses in 1100..3000usize,
        (pauses, lasts) in prop_oneof![
            (0..3500usize, 200..3000usize),
            // The pause ends during the press.
            (0..900usize, 0..120usize).prop_map(|(t, after)| (t, 1100 + after - t)),
        ],
        is_busy: bool,
    ) {
        let presses = if pauses + lasts < 1221 { 1100 } else { presses };
        let felt = run(stiffness, presses, pauses, lasts, is_busy);
        prop_assert!(felt.tissue > 0.3, "{} N", felt.tissue);
        let off = (felt.force / felt.tissue - 1.0).abs();
        prop_assert!(off < 0.03, "{} of {} N", felt.force, felt.tissue);
        // A hand also gets what it has put in against the part that the soft start withholds.
        let spring_j = 0.5 * stiffness * felt.sunk_m.powi(2);
        let gained = -felt.counters.min_energy_j;
        prop_assert!(gained <= 1.02 * spring_j + 1e-5, "{gained} J of {spring_j} J");
        prop_assert!(felt.counters.max_delta_force_n < 0.601);
    }
}
