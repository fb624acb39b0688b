//! A mock of libdrd with the same C functions, compiled when a test runs. It has one effector of 0.1 kg on a
//! spring, logs relevant calls, and counts violations that a real device would report.

#![allow(non_snake_case)]

use std::ffi::c_char;
use std::sync::Mutex;

/// Parameters that a test sets, by `mock_set`.
#[derive(Clone, Copy)]
struct Knobs {
    devices: i32,
    /// Position fails with this code; 0: it does not.
    position_error: i32,
    /// Force fails with this code.
    force_error: i32,
    /// Result of a successful call: 0, 1 (time guard) or 2 (saturated).
    returns: i32,
    initialised: bool,
    not_a_number: bool,
    /// Opening fails with this code.
    open_error: i32,
    system_type: i32,
    millimetres: bool,
    swaps_axes: bool,
    half_force: bool,
}

struct State {
    knobs: Knobs,
    open: bool,
    on: bool,
    force: [f64; 3],
    x: [f64; 3],
    v: [f64; 3],
    last_error: i32,
    wrong: u32,
    pushes: u32,
    most_n: f64,
    log: String,
}

static STATE: Mutex<State> = Mutex::new(State {
    knobs: Knobs {
        devices: 1,
        position_error: 0,
        force_error: 0,
        returns: 0,
        initialised: true,
        not_a_number: false,
        open_error: 0,
        system_type: 35,
        millimetres: false,
        swaps_axes: false,
        half_force: false,
    },
    open: false,
    on: false,
    force: [0.0; 3],
    x: [0.0; 3],
    v: [0.0; 3],
    last_error: 0,
    wrong: 0,
    pushes: 0,
    most_n: 0.0,
    log: String::new(),
});

fn with<T>(f: impl FnOnce(&mut State) -> T) -> T {
    f(&mut STATE.lock().unwrap_or_else(|e| e.into_inner()))
}

impl State {
    fn note(&mut self, word: &str) {
        if self.log.len() < 4_000_000 {
            self.log.push_str(word);
            self.log.push('\n');
        }
    }

    /// A call for the open device must use -1.
    fn called(&mut self, id: i32) {
        if !self.open || id != -1 {
            self.wrong += 1;
            self.note("wrong: not open, or another id");
        }
    }

    fn fails(&mut self, code: i32) -> i32 {
        self.last_error = code;
        -1
    }

    /// Advances by a millisecond under the force.
    fn step(&mut self) {
        for i in 0..3 {
            let force = if self.on { self.force[i] } else { 0.0 };
            let a = (force - 400.0 * self.x[i] - 12.0 * self.v[i]) / 0.1;
            self.v[i] += a * 1e-3;
            self.x[i] += self.v[i] * 1e-3;
        }
    }
}

#[no_mangle]
pub extern "C" fn mock_set(knob: u32, value: f64) {
    with(|s| match knob {
        0 => s.knobs.devices = value as i32,
        1 => s.knobs.position_error = value as i32,
        2 => s.knobs.force_error = value as i32,
        3 => s.knobs.returns = value as i32,
        4 => s.knobs.initialised = value != 0.0,
        5 => s.knobs.not_a_number = value != 0.0,
        6 => s.knobs.open_error = value as i32,
        7 => s.knobs.system_type = value as i32,
        8 => s.knobs.millimetres = value != 0.0,
        9 => s.knobs.swaps_axes = value != 0.0,
        10 => s.knobs.half_force = value != 0.0,
        _ => {
            s.wrong += 1;
            s.note("wrong: an unknown knob");
        }
    });
}

#[no_mangle]
pub extern "C" fn mock_get(what: u32) -> f64 {
    with(|s| match what {
        0 => f64::from(s.wrong),
        1 => f64::from(s.pushes),
        2 => s.most_n,
        3..=5 => s.force[what as usize - 3],
        6 => f64::from(u8::from(s.on)),
        7 => f64::from(u8::from(s.open)),
        _ => f64::NAN,
    })
}

/// Copies the notes to `out` and gives their length.
///
/// # Safety
///
/// `out` has room for `room` bytes.
#[no_mangle]
pub unsafe extern "C" fn mock_log(out: *mut u8, room: usize) -> usize {
    with(|s| {
        let n = s.log.len().min(room);
        // SAFETY: the caller's promise; at most `room` bytes are written.
        unsafe { std::ptr::copy_nonoverlapping(s.log.as_ptr(), out, n) };
        s.log.len()
    })
}

#[no_mangle]
pub extern "C" fn dhdGetDeviceCount() -> i32 {
    with(|s| s.knobs.devices)
}

#[no_mangle]
pub extern "C" fn drdOpenID(index: i32) -> i32 {
    with(|s| {
        if s.open {
            s.wrong += 1;
            s.note("wrong: opened twice");
        }
        if s.knobs.open_error != 0 {
            return s.fails(s.knobs.open_error);
        }
        s.open = true;
        s.note(&format!("open {index}"));
        // Some releases count opened devices, and not those that are plugged in.
        index + 16
    })
}

#[no_mangle]
pub extern "C" fn drdClose(id: i32) -> i32 {
    with(|s| {
        s.called(id);
        // Without a plug the mock receives no calls, and renders no force.
        if s.on || s.force != [0.0; 3] && s.knobs.force_error == 0 {
            s.wrong += 1;
            s.note("wrong: closed with forces on");
        }
        s.open = false;
        s.note("close");
        0
    })
}

#[no_mangle]
pub extern "C" fn dhdGetSystemType(id: i32) -> i32 {
    with(|s| {
        s.called(id);
        s.knobs.system_type
    })
}

#[no_mangle]
pub extern "C" fn dhdGetSystemName(id: i32) -> *const c_char {
    with(|s| s.called(id));
    c"omega.7".as_ptr()
}

/// # Safety
///
/// `number` points to two bytes at least.
#[no_mangle]
pub unsafe extern "C" fn dhdGetSerialNumber(number: *mut u16, id: i32) -> i32 {
    with(|s| {
        s.called(id);
        let opened = s.log.matches("open ").count() as u16;
        // SAFETY: the caller's promise.
        unsafe { *number = 4000 + (opened + 1) % 2 };
        0
    })
}

#[no_mangle]
pub extern "C" fn dhdErrorGetLast() -> i32 {
    with(|s| s.last_error)
}

#[no_mangle]
pub extern "C" fn dhdErrorGetLastStr() -> *const c_char {
    c"communication error".as_ptr()
}

/// # Safety
///
/// The pointers are valid.
#[no_mangle]
pub unsafe extern "C" fn dhdGetPosition(x: *mut f64, y: *mut f64, z: *mut f64, id: i32) -> i32 {
    with(|s| {
        s.called(id);
        if s.knobs.position_error != 0 {
            return s.fails(s.knobs.position_error);
        }
        let mut at = s.x;
        if s.knobs.not_a_number {
            at = [f64::NAN; 3];
        }
        if s.knobs.millimetres {
            at = at.map(|m| 1e3 * (m + 1e-3));
        }
        // SAFETY: the caller's promise.
        unsafe { (*x, *y, *z) = (at[0], at[1], at[2]) };
        s.knobs.returns
    })
}

/// # Safety
///
/// The pointers are valid.
#[no_mangle]
pub unsafe extern "C" fn dhdGetLinearVelocity(
    x: *mut f64,
    y: *mut f64,
    z: *mut f64,
    id: i32,
) -> i32 {
    with(|s| {
        s.called(id);
        // SAFETY: the caller's promise.
        unsafe { (*x, *y, *z) = (s.v[0], s.v[1], s.v[2]) };
        s.knobs.returns
    })
}

/// # Safety
///
/// The pointers are valid.
#[no_mangle]
pub unsafe extern "C" fn dhdGetAngularVelocityRad(
    x: *mut f64,
    y: *mut f64,
    z: *mut f64,
    id: i32,
) -> i32 {
    with(|s| s.called(id));
    // SAFETY: the caller's promise.
    unsafe { (*x, *y, *z) = (0.1, 0.2, 0.3) };
    0
}

/// A quarter turn about the axis towards the user.
///
/// # Safety
///
/// The pointer is valid for nine doubles.
#[no_mangle]
pub unsafe extern "C" fn dhdGetOrientationFrame(rows: *mut [[f64; 3]; 3], id: i32) -> i32 {
    with(|s| s.called(id));
    // SAFETY: the caller's promise.
    unsafe { *rows = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]] };
    0
}

#[cfg(not(lacks_buttons))]
#[no_mangle]
pub extern "C" fn dhdGetButtonMask(id: i32) -> u32 {
    with(|s| s.called(id));
    0b10
}

#[no_mangle]
pub extern "C" fn dhdHasWrist(id: i32) -> bool {
    with(|s| {
        s.called(id);
        s.knobs.system_type != 60
    })
}

#[no_mangle]
pub extern "C" fn dhdHasGripper(id: i32) -> bool {
    with(|s| {
        s.called(id);
        s.knobs.system_type != 60
    })
}

/// # Safety
///
/// The pointer is valid.
#[no_mangle]
pub unsafe extern "C" fn dhdGetGripperAngleRad(rad: *mut f64, id: i32) -> i32 {
    with(|s| s.called(id));
    // SAFETY: the caller's promise.
    unsafe { *rad = 15_f64.to_radians() };
    0
}

#[no_mangle]
pub extern "C" fn dhdEnableForce(on: u8, id: i32) -> i32 {
    with(|s| {
        s.called(id);
        if s.force != [0.0; 3] && s.knobs.force_error == 0 {
            s.wrong += 1;
            s.note("wrong: switched with a force standing");
        }
        s.on = on != 0;
        s.note(if s.on { "on" } else { "off" });
        0
    })
}

#[no_mangle]
pub extern "C" fn dhdSetForceAndTorqueAndGripperForce(
    fx: f64,
    fy: f64,
    fz: f64,
    tx: f64,
    ty: f64,
    tz: f64,
    fg: f64,
    id: i32,
) -> i32 {
    with(|s| {
        s.called(id);
        if s.knobs.force_error != 0 {
            return s.fails(s.knobs.force_error);
        }
        let force = [fx, fy, fz];
        let n = force.iter().map(|f| f * f).sum::<f64>().sqrt();
        if !n.is_finite() || n > 12.0 + 1e-9 || [tx, ty, tz, fg] != [0.0; 4] {
            s.wrong += 1;
            s.note("wrong: beyond what an omega.7 takes");
        }
        if n > 0.0 && !s.on {
            s.wrong += 1;
            s.note("wrong: force while off");
        }
        if n == 0.0 {
            s.note("zero");
        }
        s.most_n = s.most_n.max(n);
        s.pushes += 1;
        s.force = force;
        if s.knobs.swaps_axes {
            s.force.swap(0, 1);
        }
        if s.knobs.half_force {
            s.force = s.force.map(|f| f / 2.0);
        }
        s.step();
        s.knobs.returns
    })
}

#[no_mangle]
pub extern "C" fn drdIsInitialized(id: i32) -> bool {
    with(|s| {
        s.called(id);
        s.knobs.initialised
    })
}

#[no_mangle]
pub extern "C" fn drdAutoInit(id: i32) -> i32 {
    with(|s| {
        s.called(id);
        s.knobs.initialised = true;
        s.on = true;
        s.note("initialise");
        0
    })
}

#[no_mangle]
pub extern "C" fn drdStop(_forces: bool, id: i32) -> i32 {
    with(|s| {
        s.called(id);
        s.note("stop");
        0
    })
}
