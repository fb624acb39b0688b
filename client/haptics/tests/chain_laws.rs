//! Laws of the whole chain, on a virtual clock.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use nalgebra::{Matrix3, Vector3};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::script::{Hand, Tool, Waypoint};
use palpate_device::{DeviceTime, Faults, HapticDevice, Pose, Sample, Script, Wrench};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Events, Tick, Touch};
use palpate_protocol::ClientTime;
use proptest::prelude::*;

/// Start of virtual time, as on a machine that has been up for a while.
const BOOT_US: i64 = 40_000_000;

fn ms(ms: i64) -> ClientTime {
    ClientTime::from_micros(BOOT_US + ms * 1000)
}

fn hand(waypoints: Vec<Waypoint>) -> SimHand {
    let tool = Tool::probe(0.004);
    let script = Script::new(tool, Hand::default(), waypoints, false).unwrap();
    SimHand::new(script, ScriptStart::at(DeviceTime::from_micros(BOOT_US)))
}

fn chain() -> Chain {
    let device = hand(vec![Waypoint::new(0.0, Vector3::zeros())]);
    Chain::new(ChainConfig::default(), device.caps())
}

fn sample(x: Vector3<f64>) -> Sample {
    Sample::resting(DeviceTime::ZERO, Pose::at(x))
}

/// A touch at the pivot with `force` N upwards against `k` N/m, with friction.
fn touch(force: f64, k: f64) -> Touch {
    let f0 = Vector3::new(0.0, 0.0, force);
    Touch {
        damping: 0.5,
        mu_static: 0.5,
        mu_dynamic: 0.35,
        ..Touch::at_pivot(f0, Matrix3::from_diagonal_element(k), Vector3::z())
    }
}

/// A contact pressed with `force` N against 300 N/m, solved at `at`. Another participant puts 1 W into the tissue,
/// because the controller would reduce a force without work.
fn pressed(at: ClientTime, force: f64) -> ContactModel {
    ContactModel {
        topology_version: 1,
        solved_at: at,
        radius: 0.01,
        external_work_j: at.as_micros() as f64 * 1e-6,
        ..ContactModel::single(touch(force, 300.0))
    }
}

/// A chain that has held `force` for two seconds, and the time of its next tick, ms.
fn holding(force: f64) -> (Chain, i64) {
    let mut chain = chain();
    let mut last = None;
    for t in 0..2000 {
        let model = pressed(ms(t - t % 4), force);
        last = Some(chain.tick(ms(t), &sample(Vector3::zeros()), &model));
    }
    let n = last.unwrap().wrench.force.norm();
    assert!(
        (n - force.min(chain.force_limit_n())).abs() < 1e-9,
        "{n} N held"
    );
    (chain, 2000)
}

/// Ticks until the force is zero, ms; panics when it takes longer than `limit`.
fn fades(mut tick: impl FnMut(i64) -> Tick, limit: i64) -> i64 {
    let mut before = f64::INFINITY;
    for t in 0..=limit {
        let n = tick(t).wrench.force.norm();
        assert!(n <= before + 1e-9, "{n} N after {before} N while fading");
        before = n;
        if n == 0.0 {
            return t;
        }
    }
    panic!("{before} N left after {limit} ms");
}

#[test]
fn force_is_zero_150_ms_after_the_last_solve() {
    for force in [0.5, 4.0, 10.0, 50.0] {
        let (mut chain, t0) = holding(force);
        let last = pressed(ms(t0), force);
        let at_rest = sample(Vector3::zeros());
        let zero_at = fades(|t| chain.tick(ms(t0 + t), &at_rest, &last), 150);
        assert!(
            zero_at > 75,
            "a delay of 75 ms is not a loss ({zero_at} ms)"
        );
        assert!(chain.counters().stale > 0);
    }
}

#[test]
fn a_non_finite_model_is_rejected() {
    let (mut chain, t0) = holding(8.0);
    let at_rest = sample(Vector3::zeros());
    let bad = |t| {
        let mut model = pressed(ms(t), 8.0);
        model.touches[0].f0 = Vector3::repeat(f64::NAN);
        model
    };
    // The last valid one was solved up to 4 ms before.
    fades(|t| chain.tick(ms(t0 + t), &at_rest, &bad(t0 + t)), 150);
    assert!(chain.counters().bad_models > 0);
}

#[test]
fn a_device_without_motors_gets_no_force_but_the_felt_wrench() {
    let mut caps = hand(vec![Waypoint::new(0.0, Vector3::zeros())])
        .caps()
        .clone();
    caps.dof_out = 0;
    caps.max_force_n = 0.0;
    caps.continuous_force_n = 0.0;
    caps.max_stiffness_n_per_m = 0.0;
    let mut chain = Chain::new(ChainConfig::default(), &caps);
    let deeper = Vector3::new(0.0, 0.0, -2e-3);
    // Pressed at a contact point 30 mm to the right of the pivot.
    let pressed = |at, force| {
        let mut model = pressed(at, force);
        model.touches[0].lever = Vector3::new(0.03, 0.0, 0.0);
        model
    };
    let mut tick = |t: i64, x| chain.tick(ms(t), &sample(x), &pressed(ms(t - t % 4), 4.0));
    for t in 0..2000 {
        let now = tick(t, Vector3::zeros());
        assert_eq!(now.wrench, Wrench::ZERO);
        assert!(now.felt.is_finite() && !now.events.contains(Events::SATURATED));
    }
    let Wrench { force, torque } = tick(2000, Vector3::zeros()).felt;
    assert!((force.z - 4.0).abs() < 1e-9);
    assert!((torque - Vector3::new(0.0, -0.12, 0.0)).norm() < 1e-9);
    // The felt wrench follows the tool between two models as a force does: 300 N/m.
    let blended = (2001..2050).map(|t| tick(t, deeper));
    assert!((blended.last().unwrap().felt.force.z - 4.6).abs() < 1e-6);
    // An old model fades as for a hand.
    let old = pressed(ms(2048), 4.0);
    let mut felt_at = |t| chain.tick(ms(t), &sample(deeper), &old).felt.force.norm();
    let felt: Vec<f64> = (2050..2300).map(&mut felt_at).collect();
    assert!(felt[0] > 4.0 && felt[160..].iter().all(|n| *n == 0.0));
}

/// The tick at a height of the tool, held for 20 ms in a contact of 2 N.
fn held_at(z: f64) -> (Tick, Chain, i64) {
    let (mut chain, t0) = holding(2.0);
    let at = sample(Vector3::new(0.0, 0.0, z));
    let ticks = (t0..t0 + 20).map(|t| chain.tick(ms(t), &at, &pressed(ms(t - t % 4), 2.0)));
    (ticks.last().unwrap(), chain, t0 + 20)
}

proptest! {
    #[test]
    fn proxy_is_at_the_device_exactly_when_the_felt_force_is_zero(z in -9e-3f64..9e-3) {
        let (tick, ..) = held_at(z);
        prop_assert_eq!(tick.felt.force.norm() == 0.0, tick.proxy_offset.norm() == 0.0, "{:?}", tick);
    }

    #[test]
    fn tool_at_the_proxy_6_7_mm_higher_feels_no_force(z in -1e-3f64..6e-3) {
        let (tick, mut chain, t) = held_at(z);
        let at = Vector3::new(0.0, 0.0, z) + tick.proxy_offset;
        prop_assert!((z + tick.proxy_offset.z - 2.0 / 300.0).abs() < 1e-9, "{:?}", tick);
        let there = chain.tick(ms(t), &sample(at), &pressed(ms(t - t % 4), 2.0));
        prop_assert!(there.felt.force.z.abs() < 1e-9 && there.proxy_offset.norm() < 1e-9, "{:?}", there);
    }
}

#[test]
fn a_lost_link_fades_the_force_in_100_ms() {
    for force in [0.5, 4.0, 10.0, 50.0] {
        let (mut chain, t0) = holding(force);
        chain.link_lost(ms(t0));
        let at_rest = sample(Vector3::zeros());
        fades(
            |t| chain.tick(ms(t0 + t), &at_rest, &pressed(ms(t0 + t), force)),
            100,
        );
    }
}

#[test]
fn a_restored_link_brings_force_back_over_the_soft_start() {
    let (mut chain, t0) = holding(8.0);
    chain.link_lost(ms(t0));
    let at_rest = sample(Vector3::zeros());
    let mut n = [0.0; 3];
    for t in t0..t0 + 1300 {
        if t == t0 + 200 {
            chain.link_restored(ms(t));
        }
        let tick = chain.tick(ms(t), &at_rest, &pressed(ms(t), 8.0));
        match t - t0 {
            199 => n[0] = tick.wrench.force.norm(),
            700 => n[1] = tick.wrench.force.norm(),
            1299 => n[2] = tick.wrench.force.norm(),
            _ => {}
        }
    }
    assert_eq!(n[0], 0.0);
    assert!((n[1] - 4.0).abs() < 0.1, "half way: {} N", n[1]);
    assert!((n[2] - 8.0).abs() < 1e-9);
}

#[test]
fn a_tool_outside_the_radius_loses_the_force() {
    let (mut chain, t0) = holding(3.0);
    let far = sample(Vector3::new(0.0, 0.0, -0.03));
    for t in t0..t0 + 80 {
        chain.tick(ms(t), &far, &pressed(ms(t0), 3.0));
    }
    let tick = chain.tick(ms(t0 + 80), &far, &pressed(ms(t0), 3.0));
    assert!(tick.events.contains(Events::LEFT_RADIUS));
    assert!(
        tick.wrench.force.norm() < 1e-9,
        "{} N",
        tick.wrench.force.norm()
    );
}

#[test]
fn a_faulty_sample_fades_the_force_and_is_counted() {
    let nan = sample(Vector3::new(f64::NAN, 0.0, 0.0));
    let stopped = Sample {
        faults: Faults::EMERGENCY_STOP,
        ..sample(Vector3::zeros())
    };
    for bad in [nan, stopped] {
        let (mut chain, t0) = holding(10.0);
        let model = pressed(ms(t0), 10.0);
        let zero_at = fades(|t| chain.tick(ms(t0 + t), &bad, &model), 20);
        assert!(zero_at >= 15, "10 N do not vanish in {zero_at} ms");
        let c = chain.counters();
        assert!(c.bad_samples + c.faulted > 10);
    }
    let (mut chain, t0) = holding(10.0);
    fades(|t| chain.tick_without_sample(ms(t0 + t)), 20);
}

#[test]
fn a_press_against_withheld_forces_is_felt_afterwards() {
    // Pressed 10 mm deep in 300 ms, within the soft start; then a lost link while the hand goes 4 mm deeper.
    let mut chain = chain();
    let alone = |t: i64, x: &Vector3<f64>| {
        let mut model = ContactModel {
            x0: *x,
            external_work_j: 0.0,
            ..pressed(ms(t - t % 4), -300.0 * x.z)
        };
        model.touches[0].touches = x.z < 0.0;
        model
    };
    let mut model = ContactModel::FREE;
    let mut last = 0.0;
    for t in 0..6000 {
        let depth = 1e-3 * (t.min(300) as f64 / 30.0 + (t - 2500).clamp(0, 100) as f64 / 25.0);
        let x = Vector3::new(0.0, 0.0, -depth);
        if t % 4 == 0 {
            model = alone(t, &x);
        }
        match t {
            2400 => chain.link_lost(ms(t)),
            3000 => chain.link_restored(ms(t)),
            _ => {}
        }
        last = chain.tick(ms(t), &sample(x), &model).wrench.force.z;
        if t == 2300 {
            assert!((last - 3.0).abs() < 1e-6, "{last} N after the soft start");
        }
    }
    assert!(
        (last - 4.2).abs() < 1e-6,
        "{last} N after the link came back"
    );
    // Except in the first ticks, before any energy is earned.
    let passivated = chain.counters().passivated;
    assert!(passivated < 10, "{passivated} ticks");
}

#[test]
fn the_soft_start_takes_one_second() {
    let mut chain = chain();
    for t in 0..=1000 {
        let tick = chain.tick(ms(t), &sample(Vector3::zeros()), &pressed(ms(t), 6.0));
        // The first contact also fades in over its blend, so it is never more than the ramp.
        assert!(tick.wrench.force.norm() <= 6.0 * t as f64 / 1000.0 + 1e-9);
        assert_eq!(tick.events.contains(Events::SOFT_START), t < 1000);
    }
}

#[test]
fn a_pause_of_the_thread_skips_no_ramp() {
    let mut chain = chain();
    for t in 0..100 {
        chain.tick(ms(t), &sample(Vector3::zeros()), &pressed(ms(t), 6.0));
    }
    // After a pause of a second, the soft start has advanced by 10 ms.
    let mut last = Vector3::zeros();
    for t in 1100..1120 {
        let tick = chain.tick(ms(t), &sample(Vector3::zeros()), &pressed(ms(t), 6.0));
        last = tick.wrench.force;
    }
    assert!(last.norm() < 6.0 * 0.14, "{} N", last.norm());
}

#[test]
fn a_clock_set_back_keeps_no_old_force_alive() {
    let at_rest = sample(Vector3::zeros());
    for back_ms in [1, 5, 9, 40, 5000] {
        // Without new models.
        let (mut chain, t0) = holding(8.0);
        let last = pressed(ms(t0), 8.0);
        chain.tick(ms(t0), &at_rest, &last);
        let zero_at = fades(|t| chain.tick(ms(t0 + t - back_ms), &at_rest, &last), 150);
        assert!(
            zero_at > 75,
            "{zero_at} ms after a step of {back_ms} ms back"
        );
        // The same with the last model in flight meanwhile.
        let (mut chain, t0) = holding(8.0);
        let mut left = 8.0;
        for t in 1..=150 {
            let tick = chain.tick(ms(t0 + t - back_ms), &at_rest, &last);
            left = tick.wrench.force.norm();
        }
        assert_eq!(left, 0.0, "after a step of {back_ms} ms back");
        // A link that was lost before the clock was set back; the solver is running.
        let (mut chain, t0) = holding(8.0);
        chain.link_lost(ms(t0));
        chain.tick(ms(t0), &at_rest, &pressed(ms(t0), 8.0));
        let model = |t| ContactModel {
            // A pressing hand does not notice the clock.
            external_work_j: pressed(ms(t0 + t), 8.0).external_work_j,
            ..pressed(ms(t0 + t - back_ms), 8.0)
        };
        fades(
            |t| chain.tick(ms(t0 + t - back_ms), &at_rest, &model(t)),
            100,
        );
    }
}

#[test]
fn after_a_step_of_the_clock_new_models_are_felt_as_before() {
    for jump_ms in [-5000, -3, 3, 5000] {
        let (mut chain, t0) = holding(4.0);
        let mut last = Vector3::zeros();
        for t in 0..200 {
            let now = ms(t0 + t + jump_ms);
            let tick = chain.tick(now, &sample(Vector3::zeros()), &pressed(now, 4.0));
            last = tick.wrench.force;
        }
        assert!((last.z - 4.0).abs() < 1e-9, "{last:?} after {jump_ms} ms");
    }
}

#[test]
fn the_next_step_begins_at_the_rendered_wrench() {
    let at_rest = sample(Vector3::zeros());
    for there in [0.0, 2.5] {
        let (mut chain, t0) = holding(8.0);
        let rendered = Wrench::from_force(Vector3::new(0.0, 0.0, there));
        chain.continue_from(&rendered);
        let tick = chain.tick(ms(t0), &at_rest, &pressed(ms(t0), 8.0));
        let z = tick.wrench.force.z;
        assert!(
            (z - there - chain.slew_step_n()).abs() < 1e-9,
            "{z} N from {there} N"
        );
        // After a cut, the force returns over the soft start as well.
        let (mut chain, t0) = holding(8.0);
        chain.restart_from(&rendered);
        let mut last = 0.0;
        for t in t0..t0 + 500 {
            last = chain
                .tick(ms(t), &at_rest, &pressed(ms(t), 8.0))
                .wrench
                .force
                .z;
        }
        assert!((last - 4.0).abs() < 0.1, "half way: {last} N");
    }
    let (mut chain, _) = holding(8.0);
    chain.continue_from(&Wrench::from_force(Vector3::repeat(f64::NAN)));
    let tick = chain.tick_without_sample(ms(2000));
    assert_eq!(
        tick.wrench,
        Wrench::ZERO,
        "a non-finite wrench counts as zero"
    );
}

#[test]
fn numbers_out_of_bounds_leave_no_state() {
    let (mut chain, t0) = holding(3.0);
    let big = f64::MAX;
    let mut wild = [t0, t0 + 1, t0 + 2].map(|t| pressed(ms(t), 3.0));
    wild[0].touches[0].f0 = Vector3::repeat(big);
    wild[0].touches[0].normal = Vector3::repeat(1.0 / 3.0_f64.sqrt());
    wild[1].touches[0].stiffness = Matrix3::repeat(big);
    wild[2].touches[0].damping = big;
    wild[2].radius = big;
    for (t, model) in (t0..).zip(&wild) {
        chain.tick(ms(t), &sample(Vector3::repeat(big)), model);
        chain.tick(ms(t), &sample(Vector3::repeat(-big)), model);
        let mut fast = sample(Vector3::zeros());
        fast.velocity = Vector3::repeat(big);
        chain.tick(ms(t), &fast, model);
        chain.tick(ms(t), &sample(Vector3::zeros()), model);
    }
    let mut last = Vector3::zeros();
    for t in t0 + 3..t0 + 1100 {
        last = chain
            .tick(ms(t), &sample(Vector3::zeros()), &pressed(ms(t), 3.0))
            .wrench
            .force;
    }
    assert!((last - Vector3::z() * 3.0).norm() < 1e-9, "{last:?}");
}

#[test]
fn the_force_never_exceeds_the_device_limit() {
    let (chain, _) = holding(500.0);
    assert!(chain.counters().saturated > 900);
    assert!(chain.counters().max_force_n <= 10.0 + 1e-12);
}

#[test]
fn a_force_limit_of_the_session_is_reached_within_the_slew_rate() {
    let (mut chain, began) = holding(5.0);
    let (step, mut before) = (chain.slew_step_n(), 5.0);
    for t in began..began + 1000 {
        let model = ContactModel {
            force_limit_n: 2.0,
            ..pressed(ms(t - t % 4), 5.0)
        };
        let tick = chain.tick(ms(t), &sample(Vector3::zeros()), &model);
        let now = tick.wrench.force.norm();
        assert!((now - before).abs() <= step + 1e-9, "{before} to {now} N");
        before = now;
    }
    assert!((before - 2.0).abs() < 1e-9, "{before} N");
    let bad = ContactModel {
        force_limit_n: f64::NAN,
        ..pressed(ms(began), 5.0)
    };
    assert!(!bad.is_usable());
}

/// Tissue whose stiffness grows with depth, as real tissue's does: N = 200 d + 20000 d².
fn stiffening(depth: f64) -> (f64, f64) {
    let d = depth.max(0.0);
    (200.0 * d + 2e4 * d * d, 200.0 + 4e4 * d)
}

/// A press of 12 mm in half a second, with models every `interval` ms that arrive `delay` ms after their sample.
/// Returns the largest change of force per tick, and the largest error against the tissue's force, both N.
fn press(interval: i64, delay: i64) -> (f64, f64) {
    let mut hand = hand(vec![
        Waypoint::new(1.5, Vector3::new(0.0, 0.0, 0.002)),
        Waypoint::new(2.0, Vector3::new(0.0, 0.0, -0.012)),
        Waypoint::new(2.5, Vector3::new(0.0, 0.0, -0.012)),
        Waypoint::new(3.0, Vector3::new(0.0, 0.0, 0.002)),
    ]);
    hand.enable_forces(true).unwrap();
    let mut chain = Chain::new(ChainConfig::default(), hand.caps());
    let (mut model, mut solving) = (ContactModel::FREE, ContactModel::FREE);
    let (mut step, mut error) = (0.0_f64, 0.0_f64);
    let mut before = Vector3::zeros();
    for t in 0..3500 {
        let device_now = DeviceTime::from_micros(BOOT_US + t * 1000);
        let sample = hand.read(device_now).unwrap();
        let x = sample.pose.position;
        let (force, k) = stiffening(-x.z);
        if t % interval == 0 {
            solving = ContactModel {
                x0: x,
                ..pressed(ms(t), force)
            };
            solving.touches[0] = Touch {
                touches: x.z < 0.0,
                ..touch(force, k)
            };
        }
        if t % interval == delay {
            model = solving;
        }
        let given = chain.tick(ms(t), &sample, &model).wrench;
        let _ = hand.write(device_now, given);
        if t > 1100 {
            step = step.max((given.force - before).norm());
            error = error.max((given.force.z - force).abs());
        }
        before = given.force;
    }
    assert_eq!(chain.counters().saturated + chain.counters().stale, 0);
    // The hand puts in some 30 mJ on the way down. A passive chain never returns more.
    let min_j = chain.counters().min_energy_j;
    assert!(min_j > -1e-4, "the hand got {min_j} J out of nothing");
    (step, error)
}

#[test]
fn models_at_250_hz_give_a_smooth_press() {
    // The tissue itself changes by at most about 680 N/m at 12 mm, times 0.05 m/s, times 1 ms.
    let (step, error) = press(4, 2);
    println!("250 Hz: largest step {step:.4} N, largest error {error:.4} N");
    assert!(step < 0.06, "a step of {step} N");
    assert!(error < 0.1, "an error of {error} N");
    let (step, error) = press(10, 8);
    println!("100 Hz: largest step {step:.4} N, largest error {error:.4} N");
    assert!(step < 0.12, "a step of {step} N");
    assert!(error < 0.4, "an error of {error} N");
}

/// One tick of a run with random faults.
#[derive(Debug, Clone)]
struct Moment {
    dt_us: i64,
    x: (f64, f64, f64),
    v: f64,
    age_ms: i64,
    force: f64,
    what: u8,
}

fn moments() -> impl Strategy<Value = Vec<Moment>> {
    let dt = prop_oneof![
        20 => Just(1000_i64),
        2 => 0_i64..20_000,
        1 => Just(-50_000_i64),
        1 => Just(2_000_000_i64),
    ];
    let moment = (
        dt,
        (-0.05_f64..0.05, -0.05_f64..0.05, -0.05_f64..0.05),
        -2.0_f64..2.0,
        prop_oneof![8 => 0_i64..8, 1 => 0_i64..500, 1 => -9000_i64..0],
        prop_oneof![8 => 0.0_f64..20.0, 1 => -1e9_f64..1e9],
        any::<u8>(),
    );
    let moment = moment.prop_map(|(dt_us, x, v, age_ms, force, what)| Moment {
        dt_us,
        x,
        v,
        age_ms,
        force,
        what,
    });
    proptest::collection::vec(moment, 1..400)
}

proptest! {
    #[test]
    fn no_sequence_of_faults_makes_a_step(run in moments()) {
        let mut chain = chain();
        let mut now_us = BOOT_US;
        let mut before = Vector3::zeros();
        let step = chain.slew_step_n();
        for m in run {
            now_us += m.dt_us;
            let now = ClientTime::from_micros(now_us);
            let mut s = sample(Vector3::new(m.x.0, m.x.1, m.x.2));
            s.velocity = Vector3::new(0.0, m.v, -m.v);
            let solved_at = ClientTime::from_micros(now_us - m.age_ms * 1000);
            let mut model = pressed(solved_at, m.force);
            match m.what {
                0..8 => s.pose.position.y = f64::NAN,
                8..14 => s.velocity.x = f64::INFINITY,
                14..20 => model.touches[0].f0.x = f64::NAN,
                20..26 => model.touches[0].stiffness = Matrix3::repeat(f64::MAX),
                26..32 => model = ContactModel::free_at(solved_at, 1),
                32..38 => s.faults = Faults::COMMUNICATION,
                38..44 => chain.link_lost(now),
                44..60 => chain.link_restored(now),
                60..64 => s.pose.position *= 1e300,
                64..70 => model.touches[0].normal = Vector3::x(),
                _ => {}
            }
            let tick = if (70..76).contains(&m.what) {
                chain.tick_without_sample(now)
            } else {
                chain.tick(now, &s, &model)
            };
            let force = tick.wrench.force;
            prop_assert!(tick.wrench.is_finite());
            prop_assert!(force.norm() <= chain.force_limit_n() + 1e-9);
            prop_assert!((force - before).norm() <= step + 1e-9, "{before:?} to {force:?}");
            before = force;
        }
    }
}
