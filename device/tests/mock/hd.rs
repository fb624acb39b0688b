//! A mock of libHD with the same C functions, compiled when a test runs. A servo thread calls back, freely or on
//! request; the effector is 0.1 kg on a spring. It logs calls, and counts violations that a real device or library
//! would report.

#![allow(non_snake_case)]

use std::collections::VecDeque;
use std::ffi::{c_char, c_ulong, c_void};
use std::sync::{Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

type Callback = extern "system" fn(*mut c_void) -> u32;

const HANDLE: u32 = 7;
const MAX_FORCE_N: f64 = 3.3;

struct State {
    // Knobs.
    runs_freely: bool,
    each_frame: u32,
    calibration: u32,
    init_error: u32,
    not_a_number: bool,
    floods: bool,
    micrometres: bool,
    swaps_axes: bool,
    half_force: bool,
    errors_per_frame: u32,
    // The device.
    open: bool,
    current: u32,
    in_frame: bool,
    output: bool,
    set: [f64; 3],
    applied: [f64; 3],
    x: [f64; 3],
    v: [f64; 3],
    errors: VecDeque<u32>,
    // The scheduler.
    job: Option<(Callback, usize)>,
    running: bool,
    in_turn: bool,
    steps: u64,
    turns: u64,
    // Observed by tests.
    wrong: u32,
    most_n: f64,
    log: String,
}

static STATE: Mutex<State> = Mutex::new(State {
    runs_freely: true,
    each_frame: 0,
    calibration: 0x5000,
    init_error: 0,
    not_a_number: false,
    floods: false,
    micrometres: false,
    swaps_axes: false,
    half_force: false,
    errors_per_frame: 0,
    open: false,
    current: 0,
    in_frame: false,
    output: true,
    set: [0.0; 3],
    applied: [0.0; 3],
    x: [0.0; 3],
    v: [0.0; 3],
    errors: VecDeque::new(),
    job: None,
    running: false,
    in_turn: false,
    steps: 0,
    turns: 0,
    wrong: 0,
    most_n: 0.0,
    log: String::new(),
});
static CHANGED: Condvar = Condvar::new();
static THREAD: Mutex<Option<JoinHandle<()>>> = Mutex::new(None);

fn lock() -> MutexGuard<'static, State> {
    STATE.lock().unwrap_or_else(|e| e.into_inner())
}

impl State {
    fn note(&mut self, word: &str) {
        if self.log.len() < 4_000_000 {
            self.log.push_str(word);
            self.log.push('\n');
        }
    }

    fn wrong(&mut self, why: &str) {
        self.wrong += 1;
        self.note(&format!("wrong: {why}"));
    }

    /// Checks for a frame of the current device.
    fn within(&mut self, what: &str) {
        if !self.in_frame || self.current != HANDLE {
            self.wrong(&format!("{what} outside of a frame"));
        }
    }

    fn end_frame(&mut self) {
        self.applied = if self.output { self.set } else { [0.0; 3] };
        if self.swaps_axes {
            self.applied.swap(0, 1);
        }
        if self.half_force {
            self.applied = self.applied.map(|f| f / 2.0);
        }
        for i in 0..3 {
            let a = (self.applied[i] - 400.0 * self.x[i] - 12.0 * self.v[i]) / 0.1;
            self.v[i] += a * 1e-3;
            self.x[i] += self.v[i] * 1e-3;
        }
        for _ in 0..self.errors_per_frame {
            self.errors.push_back(0x0200);
        }
        if self.each_frame != 0 {
            self.errors.push_back(self.each_frame);
        }
    }
}

/// Whether the servo thread makes a turn; `None` when it is to leave.
fn next_turn() -> Option<(Callback, usize)> {
    let mut s = lock();
    loop {
        if !s.running {
            return None;
        }
        if let Some(job) = s.job.filter(|_| s.runs_freely || s.steps > 0) {
            s.steps = s.steps.saturating_sub(1);
            s.in_turn = true;
            return Some(job);
        }
        s = CHANGED.wait(s).unwrap_or_else(|e| e.into_inner());
    }
}

fn servo() {
    while let Some((callback, data)) = next_turn() {
        let again = callback(data as *mut c_void);
        let mut s = lock();
        s.in_turn = false;
        s.turns += 1;
        if s.in_frame {
            s.wrong("a frame left open");
        }
        if again == 0 {
            s.note("done");
            s.job = None;
        }
        let runs_freely = s.runs_freely;
        drop(s);
        CHANGED.notify_all();
        if runs_freely {
            std::thread::park_timeout(Duration::from_micros(200));
        }
    }
}

/// Lets the servo thread make `n` turns, and waits for them.
fn step(n: u64) {
    let mut s = lock();
    let until = s.turns + n;
    s.steps += n;
    CHANGED.notify_all();
    while s.turns < until && s.running && s.job.is_some() {
        s = CHANGED.wait(s).unwrap_or_else(|e| e.into_inner());
    }
}

#[no_mangle]
pub extern "C" fn mock_set(knob: u32, value: f64) {
    if knob == 8 {
        return step(value as u64);
    }
    let mut s = lock();
    match knob {
        0 => {
            s.runs_freely = value != 0.0;
            CHANGED.notify_all();
            while !s.runs_freely && s.in_turn {
                s = CHANGED.wait(s).unwrap_or_else(|e| e.into_inner());
            }
        }
        1 => s.each_frame = value as u32,
        3 => s.calibration = value as u32,
        4 => s.init_error = value as u32,
        6 => s.not_a_number = value != 0.0,
        7 => s.floods = value != 0.0,
        9 => s.micrometres = value != 0.0,
        10 => s.swaps_axes = value != 0.0,
        11 => s.half_force = value != 0.0,
        12 => s.errors_per_frame = value as u32,
        _ => s.wrong("an unknown knob"),
    }
}

#[no_mangle]
pub extern "C" fn mock_get(what: u32) -> f64 {
    let s = lock();
    match what {
        0 => f64::from(s.wrong),
        1 => s.turns as f64,
        2 => s.most_n,
        3..=5 => s.applied[what as usize - 3],
        6 => f64::from(u8::from(s.output)),
        7 => f64::from(u8::from(s.running)),
        8 => f64::from(u8::from(s.open)),
        9 => s.errors.len() as f64,
        _ => f64::NAN,
    }
}

/// Copies the notes to `out` and gives their length.
///
/// # Safety
///
/// `out` has room for `room` bytes.
#[no_mangle]
pub unsafe extern "C" fn mock_log(out: *mut u8, room: usize) -> usize {
    let s = lock();
    let n = s.log.len().min(room);
    // SAFETY: the caller's promise; at most `room` bytes are written.
    unsafe { std::ptr::copy_nonoverlapping(s.log.as_ptr(), out, n) };
    s.log.len()
}

/// # Safety
///
/// `name` is null or a text that ends with a zero.
#[no_mangle]
pub unsafe extern "system" fn hdInitDevice(name: *const c_char) -> u32 {
    let name = if name.is_null() {
        "null".to_owned()
    } else {
        // SAFETY: the caller's promise.
        unsafe { std::ffi::CStr::from_ptr(name) }
            .to_string_lossy()
            .into_owned()
    };
    let mut s = lock();
    if s.open {
        s.wrong("opened twice");
    }
    s.note(&format!("init {name}"));
    if s.init_error != 0 {
        let code = s.init_error;
        s.errors.push_back(code);
        return u32::MAX;
    }
    s.open = true;
    HANDLE
}

#[no_mangle]
pub extern "system" fn hdDisableDevice(handle: u32) {
    let mut s = lock();
    if s.running || handle != HANDLE || !s.open || s.applied != [0.0; 3] {
        s.wrong("closed while the scheduler runs, under force, or another device");
    }
    s.open = false;
    s.note("close");
}

#[no_mangle]
pub extern "system" fn hdMakeCurrentDevice(handle: u32) {
    lock().current = handle;
}

#[no_mangle]
pub extern "system" fn hdBeginFrame(handle: u32) {
    let mut s = lock();
    if s.in_frame || handle != HANDLE || !s.open {
        s.wrong("a frame within a frame, or of no open device");
    }
    s.in_frame = true;
}

#[no_mangle]
pub extern "system" fn hdEndFrame(handle: u32) {
    let mut s = lock();
    if !s.in_frame || handle != HANDLE {
        s.wrong("an end without a beginning");
    }
    s.in_frame = false;
    s.end_frame();
}

#[no_mangle]
pub extern "system" fn hdEnable(capability: u32) {
    let mut s = lock();
    if capability == 0x4000 {
        s.output = true;
        s.note("on");
    }
}

#[no_mangle]
pub extern "system" fn hdDisable(capability: u32) {
    let mut s = lock();
    if capability == 0x4000 {
        if s.set != [0.0; 3] {
            s.wrong("switched off with a force standing");
        }
        s.output = false;
        s.note("off");
    }
}

/// # Safety
///
/// `out` has room for the parameter's values: 16 doubles for a transform.
#[no_mangle]
pub unsafe extern "system" fn hdGetDoublev(parameter: u32, out: *mut f64) {
    let mut s = lock();
    let unit = if s.micrometres { 1e6 } else { 1e3 };
    let mm = |m: f64| (m + f64::from(u8::from(s.micrometres)) * 1e-3) * unit;
    let (x, v) = (s.x.map(mm), s.v.map(mm));
    let x = if s.not_a_number { [f64::NAN; 3] } else { x };
    if parameter < 0x2500 {
        s.within("a reading");
    }
    let numbers: Vec<f64> = match parameter {
        0x2050 => x.to_vec(),
        0x2051 => v.to_vec(),
        // A quarter turn about y.
        0x2052 => vec![
            0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, x[0], x[1], x[2], 1.0,
        ],
        0x2053 => vec![0.1, 0.2, 0.3],
        0x2550 => vec![-210.0, -110.0, -85.0, 210.0, 205.0, 130.0],
        0x2600 => vec![1000.0],
        0x2602 => vec![1.02],
        0x2603 => vec![MAX_FORCE_N],
        0x2604 => vec![0.88],
        _ => {
            s.errors.push_back(0x0100);
            return;
        }
    };
    // SAFETY: the caller's promise.
    unsafe { std::ptr::copy_nonoverlapping(numbers.as_ptr(), out, numbers.len()) };
}

/// # Safety
///
/// `out` has room for the parameter's values.
#[no_mangle]
pub unsafe extern "system" fn hdGetIntegerv(parameter: u32, out: *mut i32) {
    let mut s = lock();
    let number = match parameter {
        0x2000 => {
            s.within("a reading");
            0b01
        }
        0x2553 => 6,
        0x2555 => 0b110,
        _ => {
            s.errors.push_back(0x0100);
            return;
        }
    };
    // SAFETY: the caller's promise.
    unsafe { *out = number };
}

#[no_mangle]
pub extern "system" fn hdGetString(parameter: u32) -> *const c_char {
    match parameter {
        0x2501 => c"Touch".as_ptr(),
        0x2504 => c"20146700001".as_ptr(),
        _ => std::ptr::null(),
    }
}

/// # Safety
///
/// `numbers` points to three doubles.
#[no_mangle]
pub unsafe extern "system" fn hdSetDoublev(parameter: u32, numbers: *const f64) {
    // SAFETY: the caller's promise.
    let force = unsafe { [*numbers, *numbers.add(1), *numbers.add(2)] };
    let mut s = lock();
    s.within("a force");
    let n = force.iter().map(|f| f * f).sum::<f64>().sqrt();
    if parameter != 0x2700 || !n.is_finite() || n > MAX_FORCE_N + 1e-9 {
        s.wrong("beyond what a Touch takes");
    }
    if n > 0.0 && !s.output {
        s.wrong("a force while off");
    }
    if s.set != [0.0; 3] && n == 0.0 {
        s.note("zero");
    }
    s.set = force;
    s.most_n = s.most_n.max(n);
}

#[repr(C)]
pub struct ErrorInfo {
    code: u32,
    internal: i32,
    device: u32,
}

#[no_mangle]
pub extern "system" fn hdGetError() -> ErrorInfo {
    let mut s = lock();
    let code = if s.floods {
        0x0204
    } else {
        s.errors.pop_front().unwrap_or(0)
    };
    ErrorInfo {
        code,
        internal: -1,
        device: HANDLE,
    }
}

#[no_mangle]
pub extern "system" fn hdGetErrorString(_code: u32) -> *const c_char {
    c"Device could not be initialised".as_ptr()
}

#[no_mangle]
pub extern "system" fn hdStartScheduler() {
    let mut s = lock();
    if s.running || !s.open {
        s.wrong("started twice or without a device");
        return;
    }
    s.running = true;
    s.note("start");
    drop(s);
    *THREAD.lock().unwrap_or_else(|e| e.into_inner()) = Some(std::thread::spawn(servo));
}

#[no_mangle]
pub extern "system" fn hdStopScheduler() {
    let mut s = lock();
    if s.output || s.set != [0.0; 3] {
        s.wrong("the scheduler stopped with forces on");
    }
    s.running = false;
    s.note("stop");
    drop(s);
    CHANGED.notify_all();
    let thread = THREAD.lock().unwrap_or_else(|e| e.into_inner()).take();
    if let Some(thread) = thread {
        let _ = thread.join();
    }
}

#[no_mangle]
pub extern "system" fn hdScheduleAsynchronous(
    callback: Callback,
    data: *mut c_void,
    priority: u16,
) -> c_ulong {
    let mut s = lock();
    if priority != 32_767 {
        s.wrong("another priority");
    }
    s.job = Some((callback, data as usize));
    s.note("schedule");
    42
}

#[cfg(not(lacks_unschedule))]
#[no_mangle]
pub extern "system" fn hdUnschedule(job: c_ulong) {
    let mut s = lock();
    if job != 42 {
        s.wrong("another job");
    }
    s.job = None;
    s.note("unschedule");
}

#[no_mangle]
pub extern "system" fn hdCheckCalibration() -> u32 {
    lock().calibration
}

#[no_mangle]
pub extern "system" fn hdUpdateCalibration(style: u32) {
    let mut s = lock();
    s.note(&format!("calibrate {style}"));
    s.calibration = 0x5000;
}
