use nalgebra::Vector3;
use proptest::prelude::*;

use super::{Moment, Motion, Replay};
use crate::backend::sim::ScriptStart;
use crate::{Buttons, DeviceTime, HapticDevice, Pose, Wrench, Written, conformance};

fn motion(at: &[(f64, [f64; 3])]) -> Motion {
    let moment = |&(t_s, at): &(f64, [f64; 3])| Moment {
        t_s,
        pose: Pose::at(at.into()),
        buttons: Buttons::NONE,
    };
    Motion::new(at.iter().map(moment).collect()).unwrap()
}

#[test]
fn it_passes_the_conformance_suite() {
    let way = motion(&[(0.0, [0.0; 3]), (1.0, [0.1, 0.0, 0.0])]);
    let mut device = Replay::new(way, ScriptStart::at(DeviceTime::ZERO));
    let mut us = 0;
    let mut clock = || {
        us += 1000;
        DeviceTime::from_micros(us)
    };
    let report = conformance::run(&mut device, &mut clock, conformance::Options::default());
    assert!(report.passed(), "{report}");
}

#[test]
fn forces_do_not_change_the_motion() {
    // Recorded every 4 ms, as sessions are.
    let path = |t: f64| Vector3::new(0.02 * (3.0 * t).sin(), 0.0, 0.01 * (5.0 * t).cos());
    let points: Vec<_> = (0..500)
        .map(|i| {
            let t = 4e-3 * f64::from(i);
            (t, path(t).into())
        })
        .collect();
    let start = ScriptStart::at(DeviceTime::from_micros(7_000_000));
    let mut device = Replay::new(motion(&points), start);
    device.enable_forces(true).unwrap();
    for i in 0..1990 {
        let now = DeviceTime::from_micros(7_000_000 + 1000 * i);
        let sample = device.read(now).unwrap();
        let t = 1e-3 * i as f64;
        // A motion is at rest at its ends; the path is not.
        if (8..1980).contains(&i) {
            assert!((sample.pose.position - path(t)).norm() < 1e-6, "at {t} s");
            let slope = (path(t + 1e-5) - path(t - 1e-5)) / 2e-5;
            assert!((sample.velocity - slope).norm() < 2e-3, "at {t} s");
        }
        let push = Wrench::from_force(Vector3::new(5.0, 0.0, 0.0));
        assert_eq!(device.write(now, push), Written::Applied);
    }
    assert_eq!(device.rendered().force.x, 5.0);
}

#[test]
fn a_recording_of_a_session_is_a_motion() {
    let text = r#"{"name": "Ada", "script_started_us": 4999000, "haptic": [
        {"t_us": 1000000, "position_m": [9.0, 0.0, 0.1], "force_n": [0, 0, 0]},
        {"t_us": 5000000, "position_m": [0.0, 0.0, 0.1], "force_n": [0, 0, 0]},
        {"t_us": 5004000, "position_m": [0.0, 0.0, 0.09], "orientation": [1, 0, 0, 0], "buttons": 1,
         "force_n": [0, 0, 1]}
    ], "views": []}"#;
    let motion = Motion::from_recording(text).unwrap();
    assert!((motion.length_s() - 4e-3).abs() < 1e-12);
    let [first, second] = motion.moments() else {
        panic!("{motion:?}")
    };
    assert_eq!(first.pose.orientation.angle(), 0.0);
    assert_eq!(first.buttons, Buttons::NONE);
    assert_eq!(second.pose.position.z, 0.09);
    assert_eq!(second.pose.orientation.i, 1.0);
    assert_eq!(second.buttons, Buttons::PRIMARY);
    let error = Motion::from_recording("{\"views\": []}").unwrap_err();
    assert!(error.to_string().contains("\"haptic\""), "{error}");
    let error = Motion::from_recording("{\"haptic\": []}").unwrap_err();
    assert_eq!(
        error.to_string(),
        "a motion needs two moments or more; here is 0"
    );
}

#[test]
fn a_table_is_a_motion() {
    let text = "\u{feff}t_s, x_m, y_m, z_m, qw, qx, qy, qz, buttons\n\
                10, 0, 0, 0, 1, 0, 0, 0, 1\r\n\n10.5, 0.1, 0, 0, 0, 0, 0, 2, 1\n";
    let motion = Motion::from_table(text).unwrap();
    // The laboratory's tables of hands use another name for the time.
    let theirs = text.replace("t_s", "time_s");
    assert_eq!(Motion::from_table(&theirs).unwrap(), motion);
    let mut near = 0;
    let (middle, velocity, turning) = motion.at(0.25, &mut near);
    assert!((middle.pose.position.x - 0.05).abs() < 1e-12 && velocity.x > 0.2);
    assert!((turning.norm() - 2.0 * std::f64::consts::PI).abs() < 1e-9);
    assert_eq!(motion.at(0.5, &mut near).0.buttons, Buttons::PRIMARY);
    assert_eq!(motion.at(f64::NAN, &mut near).0.t_s, 0.0);
    // A button that is held from the first moment on is not held before it.
    assert_eq!(motion.at(0.0, &mut near).0.buttons, Buttons::PRIMARY);
    let before = motion.at(f64::NEG_INFINITY, &mut near).0;
    assert_eq!(before.buttons, Buttons::NONE);
}

#[test]
fn errors_of_a_table_contain_the_line() {
    for (text, said) in [
        ("", "line 1 should name the columns"),
        ("x,y\n1,2", "line 1 should name the columns"),
        (
            "t_s,x_m,y_m,z_m\n0,0,0,0\n1,0,zero,0",
            "line 3: y_m is \"zero\", which is not a finite number",
        ),
        ("t_s,x_m,y_m,z_m\n0,0,0", "line 2: 3 numbers in 4 columns"),
        (
            "t_s,x_m,y_m,z_m\n0,0,0,0\n0,0,0,0",
            "line 3: the moment is not later",
        ),
        (
            "t_s,x_m,y_m,z_m\n0,0,0,0\n1,0,nan,0",
            "line 3: y_m is \"nan\", which is not a finite number",
        ),
        (
            "t_s,x_m,y_m,z_m\n0,0,0,0\n1,0,120,0",
            "are these millimetres?",
        ),
        (
            "t_s,x_m,y_m,z_m,buttons\n0,0,0,0,-1",
            "line 2: buttons are a number of bits",
        ),
    ] {
        let error = Motion::from_table(text).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}

proptest! {
    #[test]
    fn any_text_is_a_motion_or_an_error(text in "[-0-9a-z_,.\n ]{0,200}") {
        let _ = Motion::from_table(&text);
        let _ = Motion::from_table(&format!("t_s,x_m,y_m,z_m\n{text}"));
        let _ = Motion::from_recording(&text);
    }

    /// The result does not depend on the order of queries.
    #[test]
    fn the_start_of_the_search_does_not_matter(
        steps in proptest::collection::vec((3e-3..0.1f64, -0.1..0.1f64), 2..40),
        asked in proptest::collection::vec(-0.5..5.0f64, 1..40),
    ) {
        let mut t = 0.0;
        let points: Vec<_> = steps.iter().map(|&(dt, x)| { t += dt; (t, [x, 0.0, 0.0]) }).collect();
        let motion = motion(&points);
        let mut near = 0;
        for t in asked {
            let fresh = motion.at(t, &mut 0);
            prop_assert_eq!(motion.at(t, &mut near), fresh);
            prop_assert!(fresh.0.pose.position.x.abs() <= 0.3);
        }
    }
}
