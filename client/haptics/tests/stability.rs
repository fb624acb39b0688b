//! A held spring with delay: its maximum stiffness from discrete eigenvalues, and a test that the chain stays below
//! it.
//!
//! The device is a mass m with damping b; the spring reads a position that is d ticks old and
//! holds its force for a period T:
//!
//! ```text
//! x' = x + (m/b)(1 − a) v + (T/b − (m/b²)(1 − a)) F,   v' = a v + ((1 − a)/b) F
//! a = exp(−b T / m),   F_k = −K x_(k−d)
//! ```
//!
//! The loop is stable while every eigenvalue of the step on (x, v, x_(−1), .., x_(−d)) is inside
//! the unit circle.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use nalgebra::{DMatrix, Matrix3, Vector3};
use palpate_device::{DeviceCaps, DeviceTime, Pose, Sample, Workspace};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Touch};
use palpate_protocol::ClientTime;

const MASS: f64 = 0.1;
const PERIOD: f64 = 1e-3;

/// Exact step of the device under a held force: (x, v) to (x, v).
fn device_step(b: f64) -> ([[f64; 2]; 2], [f64; 2]) {
    let a = (-b * PERIOD / MASS).exp();
    let slide = MASS / b * (1.0 - a);
    let push = [PERIOD / b - MASS / (b * b) * (1.0 - a), (1.0 - a) / b];
    ([[1.0, slide], [0.0, a]], push)
}

fn spectral_radius(b: f64, k: f64, delay: usize) -> f64 {
    let ([[xx, xv], [_, vv]], [fx, fv]) = device_step(b);
    // The state is (x, v, x one tick ago, .., x `delay` ticks ago).
    let mut m = DMatrix::zeros(delay + 2, delay + 2);
    (m[(0, 0)], m[(0, 1)], m[(1, 1)]) = (xx, xv, vv);
    let read = if delay == 0 { 0 } else { delay + 1 };
    m[(0, read)] -= k * fx;
    m[(1, read)] -= k * fv;
    for i in 0..delay {
        m[(i + 2, if i == 0 { 0 } else { i + 1 })] = 1.0;
    }
    m.complex_eigenvalues()
        .iter()
        .map(|e| e.norm())
        .fold(0.0, f64::max)
}

/// The stiffness at which the loop becomes unstable, N/m.
fn k_max(b: f64, delay: usize) -> f64 {
    let (mut low, mut high) = (0.1, 1e5);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if spectral_radius(b, middle, delay) > 1.0 + 1e-12 {
            high = middle;
        } else {
            low = middle;
        }
    }
    low
}

#[test]
fn the_stiffest_stable_spring_falls_with_delay_as_measured() {
    let table = [
        (0.5, [(0, 1001.0), (1, 334.0), (10, 48.0), (30, 17.0)]),
        (2.0, [(0, 4013.0), (1, 1341.0), (10, 197.0), (30, 71.0)]),
    ];
    for (b, row) in table {
        for (delay, expected) in row {
            let k = k_max(b, delay);
            println!("b = {b} N s/m, delay {delay} ms: K_max = {k:.1} N/m ({expected})");
            assert!(
                (k / expected - 1.0).abs() < 0.03,
                "b {b}, delay {delay}: {k}"
            );
        }
    }
}

/// The device of damping `b` on the chain's spring of `k` N/m about a held force of 5 N, started 10 µm off. Returns
/// the amplitude in the last tenth of 20 s over that of the first, and the largest force step.
fn growth(b: f64, k: f64, assumed_b: f64) -> f64 {
    let half = Vector3::repeat(0.1);
    let caps = DeviceCaps {
        name: "mass with a damper".to_owned(),
        dof_in: 3,
        dof_out: 3,
        workspace: Workspace {
            min: -half,
            max: half,
        },
        max_force_n: 20.0,
        continuous_force_n: 10.0,
        max_torque_nm: 0.0,
        max_stiffness_n_per_m: 1e5,
        rate_hz: 1000.0,
    };
    let config = ChainConfig {
        damping_ns_per_m: assumed_b,
        // Without the controller, the spring's own stability is measured.
        passivity: false,
        ..ChainConfig::default()
    };
    let mut chain = Chain::new(config, &caps);
    let ([[_, xv], [_, vv]], [fx, fv]) = device_step(b);
    let (mut x, mut v) = (0.0, 0.0);
    let (mut first, mut last) = (0.0_f64, 0.0_f64);
    for t in 0..22_000_i64 {
        let now = ClientTime::from_micros(1_000_000 + t * 1000);
        let model = ContactModel {
            topology_version: 1,
            solved_at: now,
            radius: 0.01,
            ..ContactModel::single(Touch::at_pivot(
                Vector3::new(0.0, 0.0, 5.0),
                Matrix3::from_diagonal_element(k),
                Vector3::z(),
            ))
        };
        let mut sample = Sample::resting(DeviceTime::ZERO, Pose::at(Vector3::new(0.0, 0.0, x)));
        sample.velocity.z = v;
        let f = chain.tick(now, &sample, &model).wrench.force.z - 5.0;
        if t < 2000 {
            // During the soft start the device is held.
            (x, v) = (1e-5, 0.0);
            continue;
        }
        (x, v) = (x + xv * v + fx * f, vv * v + fv * f);
        if t < 4000 {
            first = first.max(x.abs());
        } else if t >= 20_000 {
            last = last.max(x.abs());
        }
    }
    last / first
}

#[test]
fn the_chain_adds_no_delay_to_a_spring() {
    // With a cap far above, the chain's spring is the spring of the table at zero delay.
    assert!(growth(0.5, 950.0, 50.0) < 1.0);
    assert!(growth(0.5, 1050.0, 50.0) > 1.0);
}

#[test]
fn the_stiffness_cap_keeps_a_stiff_contact_stable() {
    for b in [0.5, 2.0] {
        assert!(growth(b, 20.0 * 2.0 * b / PERIOD, b) <= 1.0, "b = {b}");
    }
}
