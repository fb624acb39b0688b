//! Laws of the passivity controller alone.

use nalgebra::{UnitQuaternion, Vector3};
use palpate_device::{Pose, Wrench};
use palpate_protocol::Span;
use proptest::prelude::*;

use super::{ControllerOutput, LIGHTEST_KG, LIGHTEST_KG_M2, Passivity, ToolState};
use crate::{Slew, WrenchSlew};

const STEP: f64 = 0.6;
const STEP_NM: f64 = 0.03;

fn seen(x: &Vector3<f64>, there_n: f64) -> ToolState {
    ToolState {
        pose: Pose::at(*x),
        v: Vector3::zeros(),
        w: Vector3::zeros(),
        dt: Span::from_millis(1),
        there: Wrench::from_force(Vector3::new(0.0, 0.0, there_n)),
        stiffness_n_per_m: 400.0,
    }
}

fn given(x: Vector3<f64>, force: Vector3<f64>, touches: bool) -> ControllerOutput {
    ControllerOutput {
        pose: Pose::at(x),
        wrench: Wrench::from_force(force),
        withheld: Wrench::ZERO,
        touches,
    }
}

fn passivity() -> Passivity {
    Passivity::new(STEP, STEP_NM, Span::from_millis(1))
}

/// A slew limit that reaches any target in one tick.
fn quick() -> WrenchSlew {
    WrenchSlew {
        force: Slew::new(1e9),
        torque: Slew::new(1e9),
    }
}

/// The controller's limit of a force alone.
fn limit(p: &Passivity, force: Vector3<f64>, v: &Vector3<f64>) -> (Vector3<f64>, bool) {
    let (may, limited) = p.limit(&quick(), &Wrench::from_force(force), v, &Vector3::zeros());
    assert_eq!(may.torque, Vector3::zeros());
    (may.force, limited)
}

#[test]
fn a_force_may_stop_the_hand_but_not_throw_it_back() {
    let p = passivity();
    let force = Vector3::new(0.0, 0.0, 7.0);
    // Stopping 80 g at 0.5 m/s takes 40 mN·s: the impulse of 7 N while it is removed.
    assert_eq!(
        limit(&p, force, &Vector3::new(0.1, 0.0, -0.5)),
        (force, false)
    );
    let (slow, limited) = limit(&p, force, &Vector3::new(0.0, 0.0, -0.1));
    assert!(limited && slow.z > 1.0 && slow.z < 7.0, "{slow:?}");
    assert_eq!(
        limit(&p, force, &Vector3::zeros()),
        (Vector3::zeros(), true)
    );
    let none = Vector3::zeros();
    assert_eq!(limit(&p, none, &Vector3::x()), (none, false));
}

#[test]
fn work_of_other_participants_may_push_a_resting_hand() {
    let mut p = passivity();
    let force = Vector3::new(0.0, 0.0, 2.0);
    p.set_external_work(5.0);
    assert!(
        limit(&p, force, &Vector3::zeros()).1,
        "they began before this hand came"
    );
    p.set_external_work(5.01);
    assert_eq!(limit(&p, force, &Vector3::zeros()), (force, false));
    p.set_external_work(5.0);
    assert!(
        limit(&p, force, &Vector3::zeros()).1,
        "they have taken it back"
    );
}

#[test]
fn a_spring_returns_its_stored_energy() {
    // A spring of 500 N/m, 10 mm and back at 100 mm/s: 25 mJ. Held from tick to tick it would return a tenth of a
    // millimetre's work more than it took; only the last two tenths are limited.
    let mut p = passivity();
    let way = (0..=100).chain((0..100).rev());
    let mut before: i32 = 0;
    for tenth in way {
        let z = -1e-4 * f64::from(tenth);
        let x = Vector3::new(0.0, 0.0, z);
        let v = Vector3::new(0.0, 0.0, 0.1 * f64::from((before - tenth).signum()));
        let force = Vector3::new(0.0, 0.0, -500.0 * z);
        p.observe(&seen(&x, force.z), false);
        let (may, limited) = limit(&p, force, &v);
        assert!(!limited || tenth <= 20, "{may:?} of {force:?} at {tenth}");
        p.record(given(x, may, true));
        before = tenth;
    }
    assert!(
        p.stored_j() >= 0.0 && p.stored_j() < 1e-3,
        "{} J",
        p.stored_j()
    );
}

#[test]
fn stored_energy_decays_after_the_contact() {
    let mut p = passivity();
    let at = |z: f64| Vector3::new(0.0, 0.0, z);
    p.record(given(at(0.0), at(5.0), true));
    p.observe(&seen(&at(-0.01), 5.0), false);
    assert!((p.stored_j() - 0.05).abs() < 1e-12);
    p.record(given(at(-0.01), Vector3::zeros(), false));
    assert!(
        p.stored_j() > 0.049,
        "one tick without contact keeps the energy"
    );
    for _ in 0..1000 {
        p.record(given(at(-0.01), Vector3::zeros(), false));
    }
    assert!(p.stored_j() < 1e-5);
    // Friction fills the tank only up to the depth of a press.
    p.record(given(at(0.0), at(1.0), true));
    for i in 1..1000 {
        p.observe(&seen(&at(-0.01 * f64::from(i)), 1.0), false);
        p.record(given(at(-0.01 * f64::from(i)), at(1.0), true));
    }
    assert!(p.stored_j() < 0.06, "{} J", p.stored_j());
}

#[test]
fn work_against_withheld_forces_is_credited() {
    let mut p = passivity();
    let at = |z: f64| Vector3::new(0.0, 0.0, z);
    p.record(ControllerOutput {
        withheld: Wrench::from_force(at(2.0)),
        ..given(at(0.0), Vector3::zeros(), true)
    });
    p.observe(&seen(&at(-0.01), 2.0), false);
    assert_eq!(limit(&p, at(2.0), &Vector3::zeros()), (at(2.0), false));
    // A hand that moves out again meanwhile has put nothing in.
    p.record(ControllerOutput {
        withheld: Wrench::from_force(at(2.0)),
        ..given(at(-0.01), Vector3::zeros(), true)
    });
    p.observe(&seen(&at(0.0), 2.0), false);
    assert_eq!(
        limit(&p, at(2.0), &Vector3::zeros()),
        (Vector3::zeros(), true)
    );
}

#[test]
fn a_gap_in_contact_or_a_glitch_keeps_stored_energy() {
    let at = |z: f64| Vector3::new(0.0, 0.0, z);
    let mut p = passivity();
    p.record(given(at(0.0), at(4.0), true));
    p.observe(&seen(&at(-0.01), 4.0), false);
    p.record(given(at(-0.01), Vector3::zeros(), false));
    p.observe(&seen(&at(-0.01), 0.0), false);
    assert!(
        p.stored_j() > 0.03,
        "{} J after a tick without contact",
        p.stored_j()
    );
    p.record(given(at(-0.01), at(4.0), true));
    p.observe(&seen(&at(0.2), 0.0), false);
    assert!(p.stored_j() > 0.03, "{} J after a glitch", p.stored_j());
}

#[test]
fn a_hand_moved_by_other_participants_owes_nothing() {
    // Ten times 5 mm up at 4 N, paid for by the other participant; then off the tissue, and pressed by this hand
    // alone.
    let at = |z: f64| Vector3::new(0.0, 0.0, z);
    let mut p = passivity();
    p.set_external_work(0.0);
    for i in 0..10 {
        p.set_external_work(0.025 * f64::from(i + 1));
        p.record(given(at(5e-3 * f64::from(i)), at(4.0), true));
        p.observe(&seen(&at(5e-3 * f64::from(i + 1)), 4.0), false);
    }
    assert!(p.stored_j() >= 0.0, "{} J", p.stored_j());
    // Without a payer, the debt decays within a second off the tissue.
    p.record(given(at(0.0), at(4.0), true));
    p.observe(&seen(&at(0.015), 4.0), false);
    for _ in 0..1000 {
        p.record(given(at(0.0), Vector3::zeros(), false));
        p.observe(&seen(&at(0.0), 0.0), false);
    }
    assert!(p.stored_j() > -1e-5, "{} J", p.stored_j());
}

#[test]
fn after_a_gap_the_tissue_is_assumed_to_store_a_springs_energy() {
    let mut p = passivity();
    let force = Vector3::new(0.0, 0.0, 3.0);
    p.interrupt();
    p.observe(&seen(&Vector3::zeros(), 3.0), false);
    assert_eq!(limit(&p, force, &Vector3::zeros()), (force, false));
}

/// A wrench along and about z.
fn screw(force: f64, torque: f64) -> Wrench {
    Wrench {
        force: Vector3::new(0.0, 0.0, force),
        torque: Vector3::new(0.0, 0.0, torque),
    }
}

/// A pose at `z` m, turned about z by `angle` rad.
fn screwed(z: f64, angle: f64) -> Pose {
    Pose {
        position: Vector3::new(0.0, 0.0, z),
        orientation: UnitQuaternion::new(Vector3::new(0.0, 0.0, angle)),
    }
}

fn given_wrench(pose: Pose, wrench: Wrench) -> ControllerOutput {
    ControllerOutput {
        pose,
        wrench,
        ..given(Vector3::zeros(), Vector3::zeros(), true)
    }
}

fn seen_wrench(pose: Pose, there: Wrench) -> ToolState {
    ToolState {
        pose,
        there,
        ..seen(&Vector3::zeros(), 0.0)
    }
}

#[test]
fn force_and_torque_are_reduced_by_one_minimal_factor() {
    let still = Vector3::zeros();
    for stored in [1e-4, 1e-3, 1e-2] {
        for (force, torque) in [(7.0, 0.3), (7.0, 0.01), (0.0, 0.3), (0.5, 0.6)] {
            let mut p = passivity();
            p.tank_j = stored + super::RESERVE_J;
            let wrench = screw(force, torque);
            let (may, limited) = p.limit(&quick(), &wrench, &still, &still);
            let share = may.torque.z / torque;
            assert!((may.force.z - force * share).abs() < 1e-12);
            assert_eq!(limited, share < 1.0);
            let impulse = |n: f64, step: f64| 1e-3 * (n + n * n / (2.0 * step));
            let needs = impulse(may.force.z, STEP).powi(2) / (2.0 * LIGHTEST_KG)
                + impulse(may.torque.z, STEP_NM).powi(2) / (2.0 * LIGHTEST_KG_M2);
            assert!(needs <= stored, "{needs} J of {stored}");
            assert!(!limited || needs > 0.99 * stored, "{needs} J of {stored}");
        }
    }
}

#[test]
fn a_torsion_spring_returns_its_stored_energy() {
    // A torsion spring of 0.5 N·m/rad, 0.4 rad and back at 2 rad/s: 40 mJ.
    let mut p = passivity();
    let mut before: i32 = 0;
    for step in (0..=200).chain((0..200).rev()) {
        let angle = -2e-3 * f64::from(step);
        let wrench = screw(0.0, -0.5 * angle);
        let w = Vector3::new(0.0, 0.0, 2.0 * f64::from((before - step).signum()));
        p.observe(&seen_wrench(screwed(0.0, angle), wrench), false);
        let (may, limited) = p.limit(&quick(), &wrench, &Vector3::zeros(), &w);
        assert!(!limited || step <= 40, "{may:?} of {wrench:?} at {step}");
        p.record(given_wrench(screwed(0.0, angle), may));
        before = step;
    }
    assert!((0.0..2e-3).contains(&p.stored_j()), "{} J", p.stored_j());
}

#[test]
fn an_implausible_rotation_is_not_charged() {
    let mut p = passivity();
    p.record(given_wrench(screwed(0.0, 0.0), screw(0.0, 0.3)));
    p.observe(&seen_wrench(screwed(0.0, -0.05), screw(0.0, 0.3)), false);
    let stored = p.stored_j();
    assert!((stored - 0.015).abs() < 1e-12, "{stored} J");
    p.record(given_wrench(screwed(0.0, -0.05), screw(0.0, 0.3)));
    p.observe(&seen_wrench(screwed(0.0, 1.5), screw(0.0, 0.3)), false);
    assert_eq!(p.stored_j(), stored);
}

proptest! {
    #[test]
    fn gain_on_any_path_with_rotation_is_at_most_one_ramp_of_force_and_torque(
        ways in proptest::collection::vec(
            (-0.4..0.4f64, -8.0..8.0f64, 1usize..40, 0.0..20.0f64, -0.5..0.5f64), 1..60,
        ),
    ) {
        let mut slew = WrenchSlew { force: Slew::new(STEP), torque: Slew::new(STEP_NM) };
        let mut p = passivity();
        let (mut z, mut angle, mut work, mut most) = (0.0, 0.0, 0.0, [0.0f64; 2]);
        p.record(given_wrench(screwed(z, angle), Wrench::ZERO));
        for (speed, rate, ticks, force, torque) in ways {
            let target = screw(force, torque);
            for _ in 0..ticks {
                p.observe(&seen_wrench(screwed(z, angle), target), false);
                let v = Vector3::new(0.0, 0.0, speed);
                let w = Vector3::new(0.0, 0.0, rate);
                let (may, _) = p.limit(&slew, &target, &v, &w);
                let (wrench, _) = slew.towards(&may);
                p.record(given_wrench(screwed(z, angle), wrench));
                z += speed * 1e-3;
                angle += rate * 1e-3;
                work -= (wrench.force.z * speed + wrench.torque.z * rate) * 1e-3;
                most = [most[0].max(wrench.force.norm()), most[1].max(wrench.torque.norm())];
            }
        }
        let ramp = |most: f64, step: f64, speed: f64| (most + most * most / (2.0 * step)) * 1e-3 * speed;
        let ramps = ramp(most[0], STEP, 0.4) + ramp(most[1], STEP_NM, 8.0);
        prop_assert!(work >= -ramps, "{work} J after {ramps} J");
    }
}

proptest! {
    #[test]
    fn gain_on_any_path_is_at_most_one_ramp(
        ways in proptest::collection::vec((-0.4..0.4f64, 1usize..40, 0.0..20.0f64), 1..60),
    ) {
        // The tool follows any path whatever the force, and the target is arbitrary: the worst case of a hand. A
        // reversal still meets the force, because the slew limit removes it gradually, but only once.
        let (mut p, mut slew) = (passivity(), Slew::new(STEP));
        let (mut z, mut work, mut most) = (0.0, 0.0, 0.0f64);
        let along = |z: f64| Vector3::new(0.0, 0.0, z);
        p.record(given(along(z), Vector3::zeros(), false));
        for (speed, ticks, target) in ways {
            for _ in 0..ticks {
                p.observe(&seen(&along(z), target), false);
                let (may, limited) = limit(&p, slew.peek(along(target)), &along(speed));
                let (force, _) = slew.towards(if limited { may } else { along(target) });
                p.record(given(along(z), force, true));
                z += speed * 1e-3;
                work -= force.z * speed * 1e-3;
                most = most.max(force.z);
            }
        }
        let ramp = (most + most * most / (2.0 * STEP)) * 1e-3 * 0.4;
        prop_assert!(work >= -ramp, "{work} J after {ramp} J");
    }
}
