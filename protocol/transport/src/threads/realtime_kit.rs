//! Real-time priority from RealtimeKit, the system service that desktops offer to users without
//! privileges.
//!
//! The service rejects a process that could run for ever, so that the limit `RLIMIT_RTTIME` is set
//! first; the supervisor keeps threads far below it.

use std::io;

use super::sys::{self, ThreadId};

const SERVICE: &str = "org.freedesktop.RealtimeKit1";
const PATH: &str = "/org/freedesktop/RealtimeKit1";

/// Asks for the highest priority that the service gives, less `below`. Returns the priority.
pub(super) fn promote(thread: ThreadId, below: i32) -> io::Result<i32> {
    let failed = |error: zbus::Error| io::Error::other(format!("RealtimeKit: {error}"));
    let bus = zbus::blocking::Connection::system().map_err(failed)?;
    let service = zbus::blocking::Proxy::new(&bus, SERVICE, PATH, SERVICE).map_err(failed)?;
    let highest: i32 = service
        .get_property("MaxRealtimePriority")
        .map_err(failed)?;
    let limit_us: i64 = service.get_property("RTTimeUSecMax").map_err(failed)?;
    sys::limit_real_time(limit_us)?;
    let priority = (highest - below).max(1);
    let (number, wanted) = (thread as u64, priority as u32);
    service
        .call::<_, _, ()>("MakeThreadRealtime", &(number, wanted))
        .map_err(failed)?;
    Ok(priority)
}
