//! The real-time thread: a device, the haptic chain and a clock, a thousand times a second.
//!
//! The thread never allocates, locks, logs or waits for anybody once it runs; what goes in and
//! out passes through wait-free buffers of fixed size:
//!
//! ```text
//! solver  --newest ContactModel-->  thread  --newest Frame-->  solver, view
//!                                   thread  --every Frame-->   network (ring)
//!                                   thread  --LoopStats, 4 Hz-->  status line
//! ```
//!
//! [`spawn`] starts it, [`HapticHandle`] steers it, [`HapticHandle::stop`] ramps the force down,
//! closes the device and hands out the [`LoopSummary`]. All `unsafe` of the client is in `sys`.

mod clock;
mod handle;
#[cfg(test)]
mod input_tests;
mod pace;
mod priority;
mod stats;
mod sys;
#[cfg(test)]
mod tests;
mod thread;
mod trace;

pub use clock::{device_time, monotonic_now, sleep_until, worked};
pub use handle::{HapticHandle, LoopSummary};
pub use priority::{Priority, lower_priority_of_this_thread};
pub use stats::{LoopStats, Percentiles};
pub use thread::{Frame, HapticPorts, RealtimeConfig, SpawnError, spawn};
pub use trace::{Trace, TracePoint};
