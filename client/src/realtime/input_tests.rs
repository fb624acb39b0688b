//! A device without motors in the loop: the tool moves and cuts without any written force.

#![allow(clippy::unwrap_used)]

use nalgebra::{Matrix3, Vector3};
use palpate_device::backend::pointer::{Pointer, PointerConfig, PointerEvent};
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

/// A goal on the x axis with the main button held; without `x` the pointer leaves.
fn event(x: Option<f64>) -> PointerEvent {
    PointerEvent {
        time: device_time(monotonic_now()),
        goal: x.map(|x| Pose::at(Vector3::new(x, 0.0, 0.0))),
        buttons: Buttons::PRIMARY,
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
    let mut parts: Vec<CutRequest> = Vec::new();
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
            parts.extend(collector.push(time, &sample.pose, sample.buttons & 1 != 0));
        }
        if parts.last().is_some_and(|part| part.is_last) && felt_n > 2.9 {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    assert!(parts.iter().all(CutRequest::is_valid));
    let points: usize = parts.iter().map(|part| part.points.len()).sum();
    assert!(points > 5, "the button was held on the way and let go");
    assert!((2.9..3.1).contains(&felt_n), "{felt_n} N");
    let summary = hand.stop();
    assert_eq!(summary.panicked, None);
    let stats = summary.stats;
    assert_eq!((stats.device.rejected, stats.device.faults), (0, 0));
    assert_eq!(stats.counters.max_force_n, 0.0);
}
