//! Contact cases through the whole chain on a virtual clock: free, pushed, pulled, stuck, sliding, turning.

#![allow(clippy::unwrap_used)]

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use palpate_device::{Buttons, DeviceCaps, DeviceTime, Faults, Pose, Sample, Workspace, Wrench};
use palpate_haptics::{CONTACTS_MAX, Chain, ChainConfig, ContactModel, Events, Tick, Touch};
use palpate_protocol::ClientTime;
use proptest::prelude::*;

fn ms(ms: i64) -> ClientTime {
    ClientTime::from_micros(40_000_000 + ms * 1000)
}

fn caps(dof_out: u8, max_torque_nm: f64) -> DeviceCaps {
    let half = Vector3::repeat(0.5);
    DeviceCaps {
        name: "test".to_owned(),
        dof_in: 6,
        dof_out,
        workspace: Workspace {
            min: -half,
            max: half,
        },
        max_force_n: 20.0,
        continuous_force_n: 10.0,
        max_torque_nm,
        max_stiffness_n_per_m: 3000.0,
        rate_hz: 1000.0,
    }
}

fn sample(x: Vector3<f64>, turn: Vector3<f64>) -> Sample {
    let pose = Pose {
        position: x,
        orientation: UnitQuaternion::new(turn),
    };
    Sample::resting(DeviceTime::ZERO, pose)
}

/// A foundation of `k` N/m below z = 0, under a line of `n` stations over 40 mm along the tool's x, whose middle is
/// `beside` (m) the pivot.
fn tissue(at: ClientTime, pose: &Pose, n: usize, beside: f64, k: f64) -> ContactModel {
    let mut model = ContactModel {
        topology_version: 1,
        solved_at: at,
        x0: pose.position,
        turn0: pose.orientation,
        radius: 0.02,
        ..ContactModel::FREE
    };
    let share = 1.0 / n as f64;
    for (i, touch) in model.touches[..n].iter_mut().enumerate() {
        let along = beside + 0.04 * ((i as f64 + 0.5) * share - 0.5);
        let lever = pose.orientation * (Vector3::x() * along);
        let depth = -(pose.position + lever).z;
        let f0 = Vector3::z() * (k * share * depth.max(0.0));
        *touch = Touch {
            touches: depth > 0.0,
            lever,
            mu_static: 0.5,
            mu_dynamic: 0.35,
            ..Touch::at_pivot(f0, Matrix3::from_diagonal_element(k * share), Vector3::z())
        };
    }
    model
}

/// A tool that is led, with a model of every fourth millisecond.
struct Led {
    chain: Chain,
    model: ContactModel,
    tissue: fn(ClientTime, &Pose) -> ContactModel,
    t: i64,
    at: [Vector3<f64>; 2],
}

impl Led {
    fn new(caps: &DeviceCaps, tissue: fn(ClientTime, &Pose) -> ContactModel) -> Self {
        let mut led = Self {
            chain: Chain::new(ChainConfig::default(), caps),
            model: ContactModel::FREE,
            tissue,
            t: 0,
            at: [Vector3::new(0.0, 0.0, 0.005), Vector3::zeros()],
        };
        // The soft start.
        led.to(1100, led.at[0], led.at[1]);
        led
    }

    /// Moves to `x` (m), turned by `turn` (rotation vector, rad), in `ticks`; returns the last of them.
    fn to(&mut self, ticks: i64, x: Vector3<f64>, turn: Vector3<f64>) -> Tick {
        let from = self.at;
        let mut last = None;
        for i in 1..=ticks {
            let share = i as f64 / ticks as f64;
            self.at = [
                from[0] + (x - from[0]) * share,
                from[1] + (turn - from[1]) * share,
            ];
            let mut s = sample(self.at[0], self.at[1]);
            let per_s = 1e3 / ticks as f64;
            s.velocity = (x - from[0]) * per_s;
            s.angular_velocity = (turn - from[1]) * per_s;
            if self.t % 4 == 0 {
                self.model = (self.tissue)(ms(self.t), &s.pose);
            }
            last = Some(self.chain.tick(ms(self.t), &s, &self.model));
            self.t += 1;
        }
        last.unwrap()
    }
}

fn at(x: f64, z: f64) -> Vector3<f64> {
    Vector3::new(x, 0.0, z)
}

const LEVEL: Vector3<f64> = Vector3::new(0.0, 0.0, 0.0);

#[test]
fn a_free_tool_feels_nothing() {
    let mut led = Led::new(&caps(6, 1.0), |t, pose| tissue(t, pose, 8, 0.0, 400.0));
    let tick = led.to(100, at(0.02, 0.001), LEVEL);
    assert_eq!(tick.wrench, Wrench::ZERO);
    assert_eq!(tick.events, Events::NONE);
}

#[test]
fn a_push_gives_its_force_and_the_torque_of_its_lever() {
    type Line = fn(ClientTime, &Pose) -> ContactModel;
    let lines: [(Line, f64); 4] = [
        (|t, p| tissue(t, p, 1, 0.0, 400.0), 0.0),
        (|t, p| tissue(t, p, 16, 0.0, 400.0), 0.0),
        (|t, p| tissue(t, p, 4, 0.03, 400.0), 0.03),
        (|t, p| tissue(t, p, 16, 0.03, 400.0), 0.03),
    ];
    for (line, beside) in lines {
        let mut led = Led::new(&caps(6, 1.0), line);
        led.to(200, at(0.0, -0.008), LEVEL);
        let felt = led.to(100, at(0.0, -0.008), LEVEL).wrench;
        assert!((felt.force - Vector3::z() * 3.2).norm() < 1e-6, "{felt:?}");
        let expected = Vector3::new(0.0, -3.2 * beside, 0.0);
        let off = (felt.torque - expected).norm();
        assert!(off < 1e-2 * 3.2 * beside + 1e-9, "{felt:?} at {beside} m");
    }
}

#[test]
fn torque_is_clamped_to_the_device_and_zero_without_torque() {
    let pressed = |caps: &DeviceCaps| {
        let mut led = Led::new(caps, |t, p| tissue(t, p, 8, 0.1, 400.0));
        led.to(200, at(0.0, -0.008), LEVEL);
        let tick = led.to(100, at(0.0, -0.008), LEVEL);
        (tick, *led.chain.counters())
    };
    let (weak, counters) = pressed(&caps(6, 0.1));
    assert!((weak.wrench.torque.norm() - 0.1).abs() < 1e-9 && weak.wrench.torque.y < 0.0);
    assert!(
        (weak.wrench.force.z - 3.2).abs() < 1e-6,
        "the force is its own"
    );
    assert!(weak.events.contains(Events::TORQUE_SATURATED) && counters.torque_saturated > 50);
    assert!(counters.max_torque_nm <= 0.1 + 1e-12);
    for without in [caps(3, 0.0), caps(3, 1.0), caps(6, 0.0)] {
        let (tick, counters) = pressed(&without);
        assert_eq!(tick.wrench.torque, Vector3::zeros());
        assert!((tick.wrench.force.z - 3.2).abs() < 1e-6);
        assert_eq!(
            (counters.torque_saturated, counters.max_torque_nm),
            (0, 0.0)
        );
    }
}

#[test]
fn a_press_by_tilting_is_felt_on_a_device_without_torque() {
    // The pivot stays 5 mm above; the line beside it is lowered by 12 mm.
    for caps in [caps(3, 0.0), caps(6, 1.0)] {
        let mut led = Led::new(&caps, |t, p| tissue(t, p, 4, 0.06, 400.0));
        led.to(300, at(0.0, 0.005), Vector3::new(0.0, 0.2, 0.0));
        let felt = led
            .to(100, at(0.0, 0.005), Vector3::new(0.0, 0.2, 0.0))
            .wrench;
        let expected = 400.0 * (0.06 * 0.2_f64.sin() - 0.005);
        assert!(
            (felt.force.z / expected - 1.0).abs() < 0.01,
            "{felt:?} of {expected} N"
        );
    }
}

#[test]
fn adhesive_tissue_never_pulls() {
    // An adhesive model: zero force at the surface, and a pull above.
    let mut led = Led::new(&caps(6, 1.0), |t, p| {
        let mut model = tissue(t, p, 4, 0.0, 400.0);
        for touch in &mut model.touches[..4] {
            touch.touches = p.position.z < 0.004;
            touch.f0 = Vector3::z() * (-100.0 * p.position.z);
        }
        model
    });
    assert!(led.to(200, at(0.0, -0.004), LEVEL).wrench.force.z > 1.0);
    let mut released = 0;
    for i in 1..=70 {
        let tick = led.to(1, at(0.0, -0.004 + 1e-4 * f64::from(i)), LEVEL);
        assert!(tick.wrench.force.z >= -1e-12, "{:?}", tick.wrench);
        released += u32::from(tick.events.contains(Events::RELEASED));
    }
    assert_eq!(released, 1);
    assert_eq!(led.to(1, led.at[0], LEVEL).wrench, Wrench::ZERO);
}

#[test]
fn a_tool_sticks_until_it_slides_with_the_dynamic_coefficient() {
    let mut led = Led::new(&caps(6, 1.0), |t, p| tissue(t, p, 16, 0.0, 400.0));
    led.to(200, at(0.0, -0.005), LEVEL);
    // Ties of two thirds of 400 N/m hold up to μs N = 1 N, or 3.75 mm.
    let stuck = led.to(100, at(0.002, -0.005), LEVEL);
    assert!(stuck.events.contains(Events::STICK) && !stuck.events.contains(Events::SLIP));
    assert!(
        (stuck.wrench.force.x + 1.6 / 3.0).abs() < 1e-6,
        "{:?}",
        stuck.wrench
    );
    let slides = led.to(400, at(0.03, -0.005), LEVEL);
    assert!(slides.events.contains(Events::SLIP) && !slides.events.contains(Events::STICK));
    assert!(
        (slides.wrench.force.x + 0.35 * 2.0).abs() < 1e-6,
        "{:?}",
        slides.wrench
    );
}

#[test]
fn a_line_turned_about_one_end_sticks_there_and_slides_at_the_other() {
    let mut led = Led::new(&caps(6, 1.0), |t, p| tissue(t, p, 16, 0.02, 400.0));
    led.to(200, at(0.0, -0.005), LEVEL);
    let both = led.to(100, at(0.0, -0.005), Vector3::new(0.0, 0.0, 0.12));
    assert!(both.events.contains(Events::STICK) && both.events.contains(Events::SLIP));
    assert!(both.wrench.torque.z < -0.01, "{:?}", both.wrench);
}

#[test]
fn faults_fade_force_and_torque_alike() {
    let pressed = || {
        let mut led = Led::new(&caps(6, 1.0), |t, p| tissue(t, p, 8, 0.05, 400.0));
        led.to(200, at(0.0, -0.01), LEVEL);
        let tick = led.to(100, at(0.0, -0.01), LEVEL);
        assert!(tick.wrench.torque.norm() > 0.19);
        led
    };
    let mut unplugged = pressed();
    let mut stopped = pressed();
    let mut lost = pressed();
    lost.chain.link_lost(ms(lost.t));
    let mut last = [lost.chain.torque_limit_nm(); 3];
    let mut given = [Wrench::ZERO; 3];
    for _ in 0..100 {
        let t = ms(lost.t);
        let broken = Sample {
            faults: Faults::COMMUNICATION,
            ..sample(at(0.0, -0.01), LEVEL)
        };
        given = [
            unplugged.chain.tick_without_sample(t).wrench,
            stopped.chain.tick(t, &broken, &stopped.model).wrench,
            lost.to(1, at(0.0, -0.01), LEVEL).wrench,
        ];
        for (now, before) in given.iter().zip(&mut last) {
            let n = now.torque.norm();
            assert!(n <= *before + 1e-12, "{n} after {before} N·m");
            *before = n;
        }
    }
    assert_eq!(given, [Wrench::ZERO; 3]);
}

#[test]
fn the_contact_of_a_blade_ends_when_it_begins_to_cut() {
    let mut led = Led::new(&caps(6, 1.0), |at, pose| ContactModel {
        was_cutting: Some(false),
        ..tissue(at, pose, 1, 0.0, 400.0)
    });
    let held = led.to(200, at(0.0, -0.005), Vector3::zeros());
    assert!((held.wrench.force.z - 2.0).abs() < 0.05);
    // No new model arrives: the force falls, and returns after a bounce of the button, at the slew limit.
    let mut s = sample(at(0.0, -0.005), Vector3::zeros());
    let mut last = held;
    for (buttons, expected) in [
        (Buttons::PRIMARY, 0.0),
        (Buttons::NONE, held.wrench.force.z),
    ] {
        s.buttons = buttons;
        for _ in 0..8 {
            let tick = led.chain.tick(ms(led.t), &s, &led.model);
            let step = (tick.wrench.force - last.wrench.force).norm();
            assert!(step <= led.chain.slew_step_n() + 1e-9, "{step}");
            last = tick;
            led.t += 1;
        }
        assert!((last.wrench.force.z - expected).abs() < 1e-6, "{last:?}");
    }
}

#[test]
fn an_invalid_quaternion_is_a_bad_sample() {
    let mut led = Led::new(&caps(6, 1.0), |t, p| tissue(t, p, 8, 0.05, 400.0));
    let mut stretched = sample(at(0.0, -0.01), LEVEL);
    stretched.pose.orientation.as_mut_unchecked().coords *= 1.1;
    let mut spinning = sample(at(0.0, -0.01), LEVEL);
    spinning.angular_velocity.z = 1e9;
    for bad in [stretched, spinning] {
        let tick = led.chain.tick(ms(led.t), &bad, &led.model);
        assert!(tick.events.contains(Events::BAD_SAMPLE));
        assert_eq!(tick.wrench, Wrench::ZERO);
    }
}

#[test]
fn a_line_of_one_station_equals_a_point_through_the_chain() {
    for caps in [caps(3, 0.0), caps(6, 1.0)] {
        let mut point = Led::new(&caps, |t, p| tissue(t, p, 1, 0.0, 700.0));
        let mut station = Led::new(&caps, |t, p| {
            let mut model = tissue(t, p, 1, 0.0, 700.0);
            model.touches.swap(0, 9);
            model
        });
        for i in 0..600 {
            let s = 0.01 * f64::from(i);
            let x = at(0.01 * (0.7 * s).sin(), 0.004 * s.sin() - 0.003);
            assert_eq!(point.to(1, x, LEVEL), station.to(1, x, LEVEL), "tick {i}");
        }
    }
}

proptest! {
    #[test]
    fn no_model_makes_a_step_of_force_or_torque(
        run in proptest::collection::vec(
            (-0.02f64..0.01, -0.3f64..0.3, 0usize..=CONTACTS_MAX, -0.1f64..0.1, any::<u8>()), 1..300,
        ),
    ) {
        let mut chain = Chain::new(ChainConfig::default(), &caps(6, 0.8));
        let mut before = Wrench::ZERO;
        let mut model = ContactModel::FREE;
        for (i, (z, tilt, n, beside, what)) in run.into_iter().enumerate() {
            let now = ms(i as i64);
            let s = sample(at(0.0, z), Vector3::new(0.0, tilt, 0.0));
            if what % 4 == 0 {
                model = tissue(now, &s.pose, n, beside, 2000.0);
            }
            match what {
                0..8 => model.couple = Vector3::repeat(f64::NAN),
                8..24 => model.couple = Vector3::repeat(50.0),
                24..30 => model.touches[15].normal = Vector3::zeros(),
                30..36 => model.turn0 = UnitQuaternion::new(Vector3::x()),
                _ => {}
            }
            let tick = match what {
                240.. => chain.tick_without_sample(now),
                _ => chain.tick(now, &s, &model),
            };
            let w = tick.wrench;
            prop_assert!(w.is_finite());
            prop_assert!(w.force.norm() <= chain.force_limit_n() + 1e-9);
            prop_assert!(w.torque.norm() <= chain.torque_limit_nm() + 1e-9);
            prop_assert!((w.force - before.force).norm() <= chain.slew_step_n() + 1e-9);
            prop_assert!((w.torque - before.torque).norm() <= chain.slew_step_nm() + 1e-9);
            before = w;
        }
    }
}
