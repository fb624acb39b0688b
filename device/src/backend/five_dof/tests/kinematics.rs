//! Kinematics and statics against finite differences, virtual work and the equations in another form.

use nalgebra::{Unit, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::super::{
    Angles, Arm, Linkage, Middle, SINGULAR, Side, TILT_RAD, end_forces, manipulability, torques,
};
use crate::Wrench;

const POSES: usize = 10_000;

fn vector(rng: &mut Pcg64Mcg, most: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| rng.random_range(-most..most))
}

/// A linkage with lengths of its own for either arm.
fn linkage(rng: &mut Pcg64Mcg) -> Linkage {
    let mut lengths = || {
        [
            rng.random_range(0.05..0.12),
            rng.random_range(0.1..0.25),
            rng.random_range(0.1..0.25),
        ]
    };
    let (left, right) = (lengths(), lengths());
    of(left, right, rng.random_range(0.02..0.06))
}

/// A linkage of arms of L0, L1, L2 (m), left and right, and a probe (m).
fn of(left: [f64; 3], right: [f64; 3], probe_m: f64) -> Linkage {
    let arm = |side, [offset_m, upper_m, lower_m]: [f64; 3]| Arm {
        side,
        offset_m,
        upper_m,
        lower_m,
    };
    Linkage {
        arms: [arm(Side::Left, left), arm(Side::Right, right)],
        probe_m,
    }
}

/// A posture that the arm works in, not close to a singular one.
fn angles(rng: &mut Pcg64Mcg, arm: &Arm) -> Angles {
    loop {
        let q = vector(rng, 1.5);
        let works = arm.reach(&q) > 0.0 && (q.y + q.z).cos() > 0.0;
        if works && arm.manipulability(&q) > SINGULAR {
            return q;
        }
    }
}

fn posture(rng: &mut Pcg64Mcg, linkage: &Linkage) -> [Angles; 2] {
    [0, 1].map(|a| angles(rng, &linkage.arms[a]))
}

#[test]
fn the_jacobian_equals_finite_differences() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for _ in 0..POSES {
        let linkage = linkage(&mut rng);
        for arm in &linkage.arms {
            let q = vector(&mut rng, 3.0);
            let exact = arm.jacobian(&q);
            for k in 0..3 {
                let mut by = Vector3::zeros();
                // Fourth-order differences allow a step long enough for small rounding errors.
                by[k] = 1e-3;
                let slope = ((arm.end(&(q + by)) - arm.end(&(q - by))) * 8.0
                    - (arm.end(&(q + by * 2.0)) - arm.end(&(q - by * 2.0))))
                    / (12.0 * by[k]);
                let wrong = (slope - exact.column(k)).amax();
                assert!(wrong < 1e-8, "{wrong} at {q:?}");
            }
            assert!((exact.determinant() - arm.determinant(&q)).abs() < 1e-15);
        }
    }
}

#[test]
fn motor_work_equals_probe_work() {
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    for _ in 0..POSES {
        let linkage = linkage(&mut rng);
        let q = posture(&mut rng, &linkage);
        let wrench = Wrench {
            force: vector(&mut rng, 10.0),
            torque: vector(&mut rng, 0.2),
        };
        let found = torques(&linkage, &q, &wrench, f64::INFINITY);
        let probe = linkage.probe(&q);
        if found.share < 1.0 || probe.length_m < 0.5 * linkage.probe_m {
            continue;
        }
        // Rates under which the probe keeps its length, as a rigid one does.
        let rates = [vector(&mut rng, 1.0), vector(&mut rng, 1.0)];
        let (velocity, turning) = linkage.velocity(&q, &rates);
        let stretch = {
            let of = |a: usize| linkage.arms[a].jacobian(&q[a]) * rates[a];
            (of(0) - of(1)).dot(&probe.axis)
        };
        let by_motors: f64 = (0..2).map(|a| found.nm[a].dot(&rates[a])).sum();
        let forces = end_forces(&probe, &wrench);
        let along = (forces[0] - forces[1]).dot(&probe.axis) * 0.5 * stretch;
        let by_probe = wrench.force.dot(&velocity) + wrench.torque.dot(&turning);
        let wrong = (by_motors - by_probe - along).abs();
        assert!(wrong < 1e-12, "{wrong} of {by_probe} W");
        assert!(
            along.abs() < 1e-12,
            "the probe is neither pulled nor pressed"
        );
    }
}

#[test]
fn end_forces_equal_the_wrench_except_about_the_axis() {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    for _ in 0..1000 {
        let linkage = Linkage::default();
        let probe = linkage.probe(&posture(&mut rng, &linkage));
        let wrench = Wrench {
            force: vector(&mut rng, 10.0),
            torque: vector(&mut rng, 0.2),
        };
        let [left, right] = end_forces(&probe, &wrench);
        let axis = probe.axis.into_inner();
        let arm = axis * (0.5 * probe.length_m);
        let torque = arm.cross(&left) - arm.cross(&right);
        let rendered = wrench.torque - axis * wrench.torque.dot(&axis);
        assert!((left + right - wrench.force).norm() < 1e-12);
        assert!((torque - rendered).norm() < 1e-12);
        let about_itself = Wrench {
            force: Vector3::zeros(),
            torque: axis * 0.3,
        };
        assert!(end_forces(&probe, &about_itself)[0].norm() < 1e-12);
    }
}

#[test]
fn inverse_kinematics_inverts_forward_kinematics() {
    let mut rng = Pcg64Mcg::seed_from_u64(4);
    for _ in 0..POSES {
        let linkage = linkage(&mut rng);
        for arm in &linkage.arms {
            let q = angles(&mut rng, arm);
            let back = arm.angles(&arm.end(&q)).unwrap();
            let wrong = (back - q).amax();
            assert!(wrong < 1e-9, "{wrong} rad at {q:?}");
        }
    }
}

#[test]
fn the_probe_reaches_the_requested_pose() {
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let linkage = Linkage::default();
    let middle = Middle::of(&linkage).unwrap();
    for _ in 0..POSES {
        let at = middle.pivot + vector(&mut rng, middle.half_m);
        let turn = Vector3::new(
            rng.random_range(-0.3..0.3),
            1.0,
            rng.random_range(-0.3..0.3),
        );
        let axis = Unit::new_normalize(turn);
        let q = linkage.angles(&at, &axis).unwrap();
        let probe = linkage.probe(&q);
        assert!((probe.pivot - at).norm() < 1e-13);
        assert!((probe.axis.into_inner() - axis.into_inner()).norm() < 1e-11);
        assert!((probe.length_m - linkage.probe_m).abs() < 1e-13);
        let turned = probe.orientation() * Vector3::y();
        assert!((turned - axis.into_inner()).norm() < 1e-11);
    }
}

#[test]
fn each_arm_has_its_own_lengths() {
    // Figure 4.1 as it is printed: the left upper link is longer.
    let printed = of([0.08, 0.18, 0.18], [0.08, 0.15, 0.18], 0.03);
    let q = Vector3::new(0.1, 0.2, 0.3);
    let [left, right] = printed.ends(&[q, q]);
    let written_out = |s: f64, l1: f64| {
        let r = l1 * 0.2_f64.sin() + 0.18 * 0.3_f64.cos();
        Vector3::new(
            r * 0.1_f64.cos(),
            r * 0.1_f64.sin() + s * 0.08,
            -l1 * 0.2_f64.cos() - 0.18 * 0.3_f64.sin(),
        )
    };
    assert!((left - written_out(1.0, 0.18)).norm() < 1e-15);
    assert!((right - written_out(-1.0, 0.15)).norm() < 1e-15);
    assert_eq!(printed.arms.map(|a| a.side), Side::BOTH);
}

#[test]
fn a_position_out_of_reach_is_reported() {
    let linkage = Linkage::default();
    let far = Vector3::new(0.5, 0.0, -0.15);
    let error = linkage.angles(&far, &Vector3::y_axis()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the left arm can not reach (500.0, 15.0, -150.0) mm"
    );
    let on_axis = Vector3::new(0.0, 0.08 - 0.015, -0.15);
    assert!(linkage.angles(&on_axis, &Vector3::y_axis()).is_err());
    let nowhere = Vector3::repeat(f64::NAN);
    assert!(linkage.angles(&nowhere, &Vector3::y_axis()).is_err());
}

#[test]
fn torques_fade_near_singular_postures_and_stay_within_the_limit() {
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    let linkage = Linkage::default();
    let mut singular = 0;
    for _ in 0..POSES {
        // All postures, folded ones and links in line among them.
        let q = [vector(&mut rng, 3.1), vector(&mut rng, 3.1)];
        let wrench = Wrench {
            force: vector(&mut rng, 30.0),
            torque: vector(&mut rng, 1.0),
        };
        let found = torques(&linkage, &q, &wrench, 1.5);
        let most = found.nm[0].amax().max(found.nm[1].amax());
        assert!(most <= 1.5 * (1.0 + 1e-12), "{most} N·m");
        let is_singular = linkage.manipulability(&q) < SINGULAR;
        assert!(!is_singular || found.share < 1.0);
        singular += usize::from(is_singular);
    }
    assert!(singular > 100, "{singular}");
    // Links in line: no force at all, and said so.
    let q = Vector3::new(-0.3, std::f64::consts::FRAC_PI_2, 0.0);
    let push = Wrench::from_force(Vector3::x());
    let found = torques(&linkage, &[q, q], &push, 1.5);
    assert!(found.share < 1e-12, "{found:?}");
}

#[test]
fn the_workspace_is_reachable_at_every_tilt() {
    let linkage = Linkage::default();
    let middle = Middle::of(&linkage).unwrap();
    assert!(middle.half_m > 0.03, "{} m", middle.half_m);
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    for _ in 0..2000 {
        let at = middle.pivot + vector(&mut rng, middle.half_m);
        let about = rng.random_range(0.0..std::f64::consts::TAU);
        let tilt = rng.random_range(0.0..TILT_RAD);
        let axis = Unit::new_normalize(Vector3::new(
            tilt.sin() * about.cos(),
            tilt.cos(),
            tilt.sin() * about.sin(),
        ));
        assert!(manipulability(&linkage, &at, &axis) > SINGULAR);
    }
}
