//! A device without motors in the loop: the tool moves and cuts without any written force.

#![allow(clippy::unwrap_used)]

use nalgebra::{Matrix3, Vector3};
use palpate_device::backend::pointer::{Modifiers, Pointer, PointerConfig, PointerEvent, View};
use palpate_device::{Buttons, Pose, Workspace, Wrench};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Touch};
use palpate_protocol::ServerTime;
use palpate_protocol::request::CutRequest;

use super::local_sample;
use super::{RealtimeConfig, device_time, monotonic_now, spawn};
use palpate_site::StrokeCollector;

/// A current contact of 3 N.
fn contact() -> ContactModel {
    ContactModel {
        topology_version: 1,
        solved_at: monotonic_now(),
        radius: 0.5,
        ..ContactModel::single(Touch::at_pivot(
            Vector3::new(0.0, 0.0, 3.0),
            Matrix3::from_diagonal_element(300.0),
            Vector3::z(),
        ))
    }
}

/// An event from above; the main button is held if `x` is given.
fn event(x: Option<f64>) -> PointerEvent {
    PointerEvent {
        time: device_time(monotonic_now()),
        view: View {
            centre: Vector3::zeros(),
            right: Vector3::x(),
            up: Vector3::y(),
            eye_m: None,
        },
        at: x.map(|x| [x, 0.0]),
        wheel_m: 0.0,
        buttons: Buttons::PRIMARY,
        modifiers: Modifiers::NONE,
    }
}

#[test]
fn pointer_moves_and_cuts_without_rendering_force() {
    let half = Vector3::repeat(0.2);
    let workspace = Workspace {
        min: -half,
        max: half,
    };
    let config = PointerConfig::new(workspace, Pose::default());
    let (pointer, mut handle) = Pointer::new(&config).unwrap();
    let chain = Chain::new(
        ChainConfig::default(),
        palpate_device::HapticDevice::caps(&pointer),
    );
    let config = RealtimeConfig {
        real_time: false,
        ..RealtimeConfig::default()
    };
    let (hand, mut ports) = spawn(Box::new(pointer), chain, config).unwrap();
    let mut collector = StrokeCollector::new(0.02);
    let mut stroke: Option<CutRequest> = None;
    let (mut felt_n, mut farthest): (f64, f64) = (0.0, 0.0);
    // Bound on the wait for the thread, far above the needs of any machine.
    for _ in 0..10_000 {
        ports.models.write(contact());
        // The button is released once the tool has come far enough.
        handle
            .send(event((farthest < 0.05).then_some(0.06)))
            .unwrap();
        while let Ok(frame) = ports.frames.pop() {
            assert_eq!(frame.wrench, Wrench::ZERO);
            felt_n = felt_n.max(frame.felt.force.z);
            farthest = farthest.max(frame.sample.pose.position.x);
            let sample = local_sample(&frame);
            let time = ServerTime::from_micros(sample.time.as_micros());
            let cut = collector.push(time, &sample.pose, sample.buttons & 1 != 0);
            stroke = stroke.or(cut);
        }
        if stroke.is_some() && felt_n > 2.9 {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    let stroke = stroke.expect("the button was held on the way and let go");
    assert!(stroke.is_valid() && stroke.points.len() > 5);
    assert!((2.9..3.1).contains(&felt_n), "{felt_n} N");
    let summary = hand.stop();
    assert_eq!(summary.panicked, None);
    let stats = summary.stats;
    assert_eq!((stats.device.rejected, stats.device.faults), (0, 0));
    assert_eq!(stats.counters.max_force_n, 0.0);
}
