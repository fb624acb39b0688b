//! Reads and writes of commercial devices allocate nothing on the calling thread.

#![allow(clippy::unwrap_used)]

mod fake_haply;
mod mock;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use fake_haply::Fake;
use mock::Mock;
use nalgebra::Vector3;
use palpate_device::backend::{dhd, haply, openhaptics};
use palpate_device::{DeviceTime, HapticDevice, Wrench};

thread_local! {
    /// Calls of the allocator on this thread.
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

fn note() {
    // A thread in teardown has no counter, and needs none.
    let _ = CALLS.try_with(|c| c.set(c.get() + 1));
}

// SAFETY: every call is handed to the system's allocator with the caller's own arguments, so its contract holds
// unchanged; `note` allocates nothing (a const thread-local without a destructor).
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
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations in a thousand ticks under force, including a lost device and a rejected wrench. The caller controls
/// the time between ticks.
fn allocations(device: &mut dyn HapticDevice, mut between: impl FnMut(i64)) -> u64 {
    device.enable_forces(true).unwrap();
    let mut calls = 0;
    for ms in 0..1000 {
        between(ms);
        let now = DeviceTime::from_micros(ms * 1000);
        let n = if ms % 100 == 99 { f64::NAN } else { 0.5 };
        let wrench = Wrench::from_force(Vector3::new(0.0, n, 0.0));
        let before = CALLS.get();
        let _ = device.read(now);
        let _ = device.write(now, wrench);
        let _ = (device.rendered(), device.force_state());
        calls += CALLS.get() - before;
    }
    calls
}

#[test]
fn ticks_of_a_device_of_force_dimension_allocate_nothing() {
    let mock = Mock::compiled("drd.rs", "libdrd.so", &[]);
    let mut device = dhd::open(Some(&mock.file()), None).unwrap();
    // Its library is of this program's thread, and so are the notes that the stand-in makes: they are its own allocator's.
    let calls = allocations(&mut device, |ms| {
        if ms == 900 {
            mock.set(1, 2.0);
        }
    });
    assert_eq!(calls, 0);
}

#[test]
fn ticks_of_a_touch_allocate_nothing() {
    let mock = Mock::compiled("hd.rs", "libHD.so", &[]);
    let mut device = openhaptics::open(Some(&mock.file()), None).unwrap();
    mock.set(0, 0.0);
    let calls = allocations(&mut device, |ms| {
        if ms < 900 {
            mock.set(8, 1.0);
        }
    });
    assert_eq!(calls, 0);
    mock.set(0, 1.0);
}

#[test]
fn ticks_of_an_inverse3_allocate_nothing() {
    let fake = Fake::start(true, &["049D"]);
    let mut device = haply::open(&fake.service, None).unwrap();
    let calls = allocations(&mut device, |ms| {
        if ms == 900 {
            fake.with(|t| t.ids.clear());
        }
        fake.answers();
    });
    assert_eq!(calls, 0);
}
