//! No tick allocates: ten thousand ticks are counted, with the simulated devices.

#![allow(clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use palpate_device::backend::five_dof;
use palpate_device::backend::pointer::{Pointer, PointerConfig, PointerEvent};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::backend::steered::{
    Controls, DeviceLost, Kind, RateControl, Rumble, Source, SourceEvent, Space, Steered,
};
use palpate_device::script::{Hand, Tool, Waypoint};
use palpate_device::{Buttons, DeviceCaps, DeviceTime, HapticDevice, Pose, Script, Workspace};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Counters, Touch};
use palpate_protocol::ClientTime;

thread_local! {
    /// Calls of the allocator on this thread. The test runner's other threads have their own.
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

fn note() {
    // A thread that is being torn down has no counter any more, and none is needed.
    let _ = CALLS.try_with(|c| c.set(c.get() + 1));
}

struct Counting;

// SAFETY: every call is handed to the system's allocator with the caller's own arguments, so its
// contract holds unchanged; `note` allocates nothing (a const thread-local without a destructor).
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note();
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        note();
        // SAFETY: `ptr` came from `System` with this layout, as `alloc` above gives no other.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        note();
        // SAFETY: as in `dealloc`, and the size is the caller's.
        unsafe { System.realloc(ptr, layout, new_size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Contact model of a line of `contacts` stations along the tool's y on 400 N/m below z = 0.
fn tissue(us: i64, pose: &Pose, contacts: usize) -> ContactModel {
    let mut model = ContactModel {
        topology_version: 1,
        solved_at: ClientTime::from_micros(us),
        x0: pose.position,
        turn0: pose.orientation,
        radius: 0.005,
        couple: Vector3::new(0.0, 0.01, 0.0),
        ..ContactModel::FREE
    };
    let share = 1.0 / contacts as f64;
    for (i, touch) in model.touches[..contacts].iter_mut().enumerate() {
        let along = 0.04 * ((i as f64 + 0.5) * share - 0.5);
        let lever = pose.orientation * (Vector3::y() * along);
        let depth = -(pose.position + lever).z;
        let f0 = Vector3::new(0.0, 0.0, 400.0 * share * depth.max(0.0));
        *touch = Touch {
            touches: depth > 0.0,
            lever,
            damping: 0.5 * share,
            mu_static: 0.4,
            mu_dynamic: 0.3,
            // Stiffer than the cap: all slopes have to be lowered.
            ..Touch::at_pivot(
                f0,
                Matrix3::from_diagonal_element(4000.0 * share),
                Vector3::z(),
            )
        };
    }
    model
}

fn script() -> Script {
    let tool = Tool::probe(0.004);
    let waypoints = vec![
        Waypoint::new(0.0, Vector3::new(0.0, 0.0, 0.01)),
        Waypoint::new(1.0, Vector3::new(0.0, 0.0, -0.02)),
        Waypoint::new(2.0, Vector3::new(0.05, 0.0, -0.02))
            .pressed()
            .turned(UnitQuaternion::new(Vector3::new(0.15, 0.0, 0.0))),
        Waypoint::new(3.0, Vector3::new(0.0, 0.0, 0.01)),
    ];
    let tremor = Hand {
        tremor_m: 0.000_2,
        ..Hand::default()
    };
    Script::new(tool, tremor, waypoints, true).unwrap()
}

/// Ten thousand ticks with faults; returns the allocator calls and the chain's counters.
fn ticks(device: &mut dyn HapticDevice, contacts: usize) -> (u64, Counters) {
    device.enable_forces(true).unwrap();
    let mut chain = Chain::new(ChainConfig::default(), device.caps());
    let mut model = ContactModel::FREE;
    let mut warm = 0;
    for tick in 0..11_000_i64 {
        if tick == 1000 {
            warm = CALLS.with(Cell::get);
        }
        let us = tick * 1000;
        // Faults too: a missed reading, a bad model, a lost and restored link.
        let now = ClientTime::from_micros(us);
        let result = if tick % 2500 == 2400 {
            chain.tick_without_sample(now)
        } else {
            let sample = device.read(DeviceTime::from_micros(us)).unwrap();
            if tick % 4 == 0 {
                model = tissue(us, &sample.pose, contacts);
            }
            if tick % 3000 == 0 {
                model.couple.x = f64::NAN;
            }
            chain.tick(now, &sample, &model)
        };
        let now_device = DeviceTime::from_micros(us);
        if device.caps().dof_out == 0 {
            device.cue(now_device, &result.felt);
        } else {
            let _ = device.write(now_device, result.wrench);
        }
        match tick % 4000 {
            3000 => chain.link_lost(now),
            3300 => chain.link_restored(now),
            _ => {}
        }
    }
    (CALLS.with(Cell::get) - warm, *chain.counters())
}

#[test]
fn ten_thousand_ticks_allocate_nothing() {
    let start = || ScriptStart::at(DeviceTime::ZERO);
    for contacts in [1, 4, 16] {
        let caps = DeviceCaps {
            dof_out: 6,
            max_torque_nm: 0.5,
            ..SimHand::new(script(), start()).caps().clone()
        };
        let mut hand = SimHand::new(script(), start());
        let mut turned = SimHand::with_caps(script(), start(), caps);
        let mut five_dof = five_dof::simulated(&script(), start()).unwrap();
        let devices: [(&mut dyn HapticDevice, bool); 3] = [
            (&mut hand, false),
            (&mut turned, true),
            (&mut five_dof, true),
        ];
        for (device, renders_torque) in devices {
            let name = device.caps().name.clone();
            let (calls, c) = ticks(device, contacts);
            assert!(
                c.slip > 500 && c.stick > 500 && c.released > 0 && c.bad_models > 0,
                "{name}, {contacts}: {c:?}"
            );
            assert_eq!(c.max_torque_nm > 0.0, renders_torque, "{name}: {c:?}");
            assert_eq!(
                calls, 0,
                "calls of the allocator in 10,000 ticks of the {name} with {contacts} contacts"
            );
        }
    }
}

/// A hand that pushes down without end.
struct Pushes;

impl Source for Pushes {
    fn listen(&mut self, patience: std::time::Duration) -> Result<SourceEvent, DeviceLost> {
        std::thread::park_timeout(patience / 16);
        Ok(SourceEvent::Controls(Controls {
            push: Vector3::new(0.0, 0.0, -1.0),
            ..Controls::NEUTRAL
        }))
    }

    fn reopen(&mut self) -> bool {
        true
    }
}

#[test]
fn ten_thousand_ticks_of_devices_without_motors_allocate_nothing() {
    let half = Vector3::repeat(0.1);
    let space = Space {
        workspace: Workspace {
            min: -half,
            max: half,
        },
        start: Pose::default(),
    };
    let config = PointerConfig::new(space.workspace, space.start);
    let (mut pointer, mut handle) = Pointer::new(&config).unwrap();
    for i in 0..200 {
        let event = PointerEvent {
            time: DeviceTime::from_micros(i),
            goal: Some(Pose {
                position: Vector3::new(1e-4, 0.0, -5e-4) * i as f64,
                orientation: UnitQuaternion::from_scaled_axis(Vector3::z() * (1e-2 * i as f64)),
            }),
            buttons: Buttons::PRIMARY,
        };
        handle.send(event).unwrap();
    }
    let kind = Kind {
        name: "steered".to_owned(),
        dof_in: 6,
        silence_max_us: None,
        rate: RateControl::default(),
        rumble: Some(Rumble::default()),
    };
    let mut steered = Steered::open(Box::new(Pushes), kind, &space).unwrap();
    let devices: [&mut dyn HapticDevice; 2] = [&mut pointer, &mut steered];
    for device in devices {
        let name = device.caps().name.clone();
        let (calls, c) = ticks(device, 16);
        assert_eq!(c.max_force_n, 0.0, "{name}: {c:?}");
        assert_eq!(
            calls, 0,
            "calls of the allocator in 10,000 ticks of the {name}"
        );
    }
}
