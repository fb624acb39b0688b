//! Safe wrappers of the C functions of libHD, and the callback on the library's servo thread.
//!
//! Types and numbers are those of the public headers `hd.h`, `hdDevice.h`, `hdScheduler.h` and `hdDefines.h` (3.x): handles
//! and enumerations are 32 bits, truth values one byte, an error is a struct of 12 bytes that is returned by value.

use std::ffi::{CString, c_char, c_int, c_uint, c_ulong, c_ushort, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::OpenError;
use crate::backend::library::sys::{functions, text};
use crate::backend::library::{Library, Wanted};

/// The library's names on this system, and how to install it.
const WANTED: Wanted = Wanted {
    what: "OpenHaptics (libHD)",
    names: if cfg!(windows) {
        &["HD.dll"]
    } else if cfg!(target_os = "macos") {
        &[
            "/Library/Frameworks/OpenHaptics.framework/OpenHaptics",
            "libHD.dylib",
        ]
    } else {
        &["libHD.so", "libHD.so.3.4", "libHD.so.3.0", "libHD.so.3"]
    },
    how: "Get the device driver and the OpenHaptics developer edition of your device from its maker (3D Systems), install \
          both, and pair the device in Touch Setup; or name the library in PALPATE_LIBHD.",
};

/// `HDErrorInfo`.
#[repr(C)]
#[derive(Clone, Copy)]
struct ErrorInfo {
    code: c_uint,
    _internal: c_int,
    _device: c_uint,
}

type Callback = extern "system" fn(*mut c_void) -> c_uint;
type Number = unsafe extern "system" fn(c_uint);

/// The library's device number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Handle(c_uint);

/// `HD_INVALID_HANDLE`.
const INVALID: c_uint = 0xffff_ffff;
/// The middle of the priorities.
const PRIORITY: c_ushort = 32_767;
/// Results of a callback: stop, and call again.
const DONE: c_uint = 0;
const CONTINUE: c_uint = 1;

functions! {
    WANTED;
    init: unsafe extern "system" fn(*const c_char) -> c_uint = "hdInitDevice",
    disable_device: Number = "hdDisableDevice",
    make_current: Number = "hdMakeCurrentDevice",
    begin: Number = "hdBeginFrame",
    end: Number = "hdEndFrame",
    enable: Number = "hdEnable",
    disable: Number = "hdDisable",
    doubles: unsafe extern "system" fn(c_uint, *mut f64) = "hdGetDoublev",
    integers: unsafe extern "system" fn(c_uint, *mut c_int) = "hdGetIntegerv",
    text: unsafe extern "system" fn(c_uint) -> *const c_char = "hdGetString",
    set_doubles: unsafe extern "system" fn(c_uint, *const f64) = "hdSetDoublev",
    error: unsafe extern "system" fn() -> ErrorInfo = "hdGetError",
    error_text: unsafe extern "system" fn(c_uint) -> *const c_char = "hdGetErrorString",
    start: unsafe extern "system" fn() = "hdStartScheduler",
    stop: unsafe extern "system" fn() = "hdStopScheduler",
    schedule: unsafe extern "system" fn(Callback, *mut c_void, c_ushort) -> c_ulong = "hdScheduleAsynchronous",
    unschedule: unsafe extern "system" fn(c_ulong) = "hdUnschedule",
    check_calibration: unsafe extern "system" fn() -> c_uint = "hdCheckCalibration",
    update_calibration: Number = "hdUpdateCalibration",
}

impl Api {
    /// Opens the device of this name, or the default one, and makes it current.
    pub(super) fn init(&self, name: Option<&CString>) -> Option<Handle> {
        let name = name.map_or(std::ptr::null(), |n| n.as_ptr());
        // SAFETY: null, or a text that ends with a zero and lives through the call.
        let handle = unsafe { (self.init)(name) };
        (handle != INVALID).then_some(Handle(handle))
    }

    /// Closes it.
    pub(super) fn disable_device(&self, handle: Handle) {
        // SAFETY: takes a number.
        unsafe { (self.disable_device)(handle.0) }
    }

    /// Makes this device current: later calls on this thread apply to it.
    pub(super) fn make_current(&self, handle: Handle) {
        // SAFETY: takes a number.
        unsafe { (self.make_current)(handle.0) }
    }

    /// Begins a frame: its queries refer to one moment.
    pub(super) fn begin(&self, handle: Handle) {
        // SAFETY: takes a number.
        unsafe { (self.begin)(handle.0) }
    }

    /// Ends a frame: its settings are sent to the device.
    pub(super) fn end(&self, handle: Handle) {
        // SAFETY: takes a number.
        unsafe { (self.end)(handle.0) }
    }

    /// Switches a capability of the current device.
    pub(super) fn switch(&self, capability: u32, on: bool) {
        let function = if on { self.enable } else { self.disable };
        // SAFETY: takes a number.
        unsafe { function(capability) }
    }

    /// Numbers of a parameter; unused entries stay 0.
    pub(super) fn doubles(&self, parameter: u32) -> [f64; 16] {
        let mut numbers = [0.0; 16];
        // SAFETY: 16 doubles are what the widest parameter, a transform, writes.
        unsafe { (self.doubles)(parameter, numbers.as_mut_ptr()) };
        numbers
    }

    /// A whole number of a parameter.
    pub(super) fn integer(&self, parameter: u32) -> i32 {
        // Encoder values would be six; the parameters used here have one.
        let mut numbers: [c_int; 16] = [0; 16];
        // SAFETY: a valid pointer to more numbers than any parameter has.
        unsafe { (self.integers)(parameter, numbers.as_mut_ptr()) };
        numbers[0]
    }

    pub(super) fn text(&self, parameter: u32) -> String {
        // SAFETY: takes a number, gives null or a text of the library's own.
        unsafe { text((self.text)(parameter)) }
    }

    /// Sets a parameter of three numbers within a frame.
    pub(super) fn set(&self, parameter: u32, numbers: [f64; 3]) {
        // SAFETY: a valid pointer to as many doubles as the parameters have that are set here.
        unsafe { (self.set_doubles)(parameter, numbers.as_ptr()) }
    }

    /// The oldest unread error.
    pub(super) fn error(&self) -> Option<u32> {
        // SAFETY: takes nothing and returns plain numbers.
        let info = unsafe { (self.error)() };
        (info.code != 0).then_some(info.code)
    }

    /// The library's text for a code.
    pub(super) fn words(&self, code: u32) -> String {
        // SAFETY: takes a number, gives null or a text of the library's own.
        unsafe { text((self.error_text)(code)) }
    }

    /// Calibration state of the current device.
    pub(super) fn check_calibration(&self) -> u32 {
        // SAFETY: takes nothing and returns a number.
        unsafe { (self.check_calibration)() }
    }

    /// Calibrates the current device by one of its styles.
    pub(super) fn update_calibration(&self, style: u32) {
        // SAFETY: takes a number.
        unsafe { (self.update_calibration)(style) }
    }
}

/// Callback of the library's servo thread; returns whether to call it again.
pub(super) type ServoCallback = Box<dyn FnMut() -> bool + Send>;

/// Callback after a panic in a turn: it removes the force.
pub(super) type Rescue = Box<dyn FnMut() + Send>;

/// Target of the pointer that the library passes to the callback.
struct Turns {
    turn: ServoCallback,
    rescue: Rescue,
    end: Arc<End>,
}

/// End of the servo thread's turns.
#[derive(Debug, Default)]
struct End {
    ended: AtomicBool,
    panicked: AtomicBool,
}

extern "system" fn trampoline(data: *mut c_void) -> c_uint {
    // SAFETY: `Servo::start` handed a `Turns` over and does not touch it while this may be called. The library has one
    // servo thread, which calls a callback again only after it returned.
    let turns = unsafe { &mut *data.cast::<Turns>() };
    if one_turn(turns) { CONTINUE } else { DONE }
}

/// Runs one turn. A panic does not cross the C function, and ends the turns.
fn one_turn(turns: &mut Turns) -> bool {
    if turns.end.ended.load(Ordering::Acquire) {
        return false;
    }
    let again = catch_unwind(AssertUnwindSafe(|| (turns.turn)()));
    if again.is_err() {
        turns.end.panicked.store(true, Ordering::Release);
        // A second panic changes nothing: the turns end.
        let _ = catch_unwind(AssertUnwindSafe(|| (turns.rescue)()));
    }
    let again = again.unwrap_or(false);
    if !again {
        turns.end.ended.store(true, Ordering::Release);
    }
    again
}

/// The library's scheduler with one callback.
#[derive(Debug)]
pub(super) struct Servo {
    api: Arc<Api>,
    job: c_ulong,
    turns: *mut Turns,
    end: Arc<End>,
}

// SAFETY: the pointer is only kept here, to be freed when the servo thread is done with it; whichever thread holds a
// `Servo` may do that.
unsafe impl Send for Servo {}

impl Servo {
    /// Starts the scheduler; its thread calls `turn` about once per millisecond, until `turn` returns false.
    pub(super) fn start(api: Arc<Api>, turn: ServoCallback, rescue: Rescue) -> Self {
        let end = Arc::new(End::default());
        let turns = Box::into_raw(Box::new(Turns {
            turn,
            rescue,
            end: Arc::clone(&end),
        }));
        // SAFETY: the callback has the header's type, and its data stays valid until `stop` knows that it is not called
        // any more.
        let job = unsafe { (api.schedule)(trampoline, turns.cast(), PRIORITY) };
        // SAFETY: takes nothing.
        unsafe { (api.start)() };
        Self {
            api,
            job,
            turns,
            end,
        }
    }

    /// Whether the turns have ended.
    pub(super) fn has_ended(&self) -> bool {
        self.end.ended.load(Ordering::Acquire)
    }

    /// Whether a panic ended them.
    pub(super) fn has_panicked(&self) -> bool {
        self.end.panicked.load(Ordering::Acquire)
    }

    /// Removes the callback from the scheduler, after the wait for its last turn timed out.
    pub(super) fn unschedule(&self) {
        // SAFETY: the number that scheduling gave.
        unsafe { (self.api.unschedule)(self.job) };
    }

    /// Stops the scheduler, after `turn` was asked to return false and had time for it.
    pub(super) fn stop(self) {
        let has_ended = self.has_ended();
        // SAFETY: takes nothing. It returns when the servo thread has left.
        unsafe { (self.api.stop)() };
        if has_ended {
            // SAFETY: made by `Box::into_raw`, freed once, as `stop` takes `self`; the last turn said no, and no other
            // comes.
            drop(unsafe { Box::from_raw(self.turns) });
        } else {
            // A late thread may still be within its turn. Its data are leaked: some hundred bytes, and the library.
            std::mem::forget(Arc::clone(&self.api));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::{CONTINUE, DONE, End, ErrorInfo, Turns, trampoline};

    /// Results of the callback for `n` calls.
    fn called(turn: super::ServoCallback, n: usize) -> (Vec<u32>, Arc<End>) {
        let end = Arc::new(End::default());
        let rescued = Arc::new(AtomicU32::new(0));
        let count = Arc::clone(&rescued);
        let mut turns = Turns {
            turn,
            rescue: Box::new(move || {
                count.fetch_add(1, Ordering::AcqRel);
                panic!("and another");
            }),
            end: Arc::clone(&end),
        };
        let data = std::ptr::from_mut(&mut turns);
        let returned = (0..n).map(|_| trampoline(data.cast())).collect();
        let panicked = u32::from(end.panicked.load(Ordering::Acquire));
        assert_eq!(rescued.load(Ordering::Acquire), panicked);
        (returned, end)
    }

    #[test]
    fn a_panic_stays_in_the_callback_and_removes_the_force() {
        let mut n = 0;
        let turn = move || {
            n += 1;
            assert!(n != 3, "a mistake of ours");
            true
        };
        let (returned, end) = called(Box::new(turn), 5);
        assert_eq!(returned, [CONTINUE, CONTINUE, DONE, DONE, DONE]);
        assert!(end.panicked.load(Ordering::Acquire));
    }

    #[test]
    fn a_turn_that_returns_false_is_the_last() {
        let (returned, end) = called(Box::new(|| false), 2);
        assert_eq!(returned, [DONE, DONE]);
        assert!(!end.panicked.load(Ordering::Acquire));
    }

    #[test]
    fn an_error_is_twelve_bytes() {
        assert_eq!(size_of::<ErrorInfo>(), 12);
    }
}
