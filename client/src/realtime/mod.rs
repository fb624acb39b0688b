//! The real-time thread: a device, the haptic chain and a clock, a thousand times a second.
//!
//! The running thread never allocates, locks, logs or waits for another thread. Data passes through wait-free buffers
//! of fixed size:
//!
//! ```text
//! solver  --newest ContactModel-->  thread  --newest Frame-->  solver
//!                                   thread  --every Frame-->   network (ring)
//!                                   thread  --LoopStats, 4 Hz-->  status line
//! ```
//!
//! [`spawn`] starts it, [`HapticHandle`] controls it. [`HapticHandle::stop`] ramps the force down, closes the device
//! and returns the [`LoopSummary`]. One tick is [`HandLoop::turn`], which knows neither thread nor clock, on the grid
//! of [`Pace`].

mod alone;
mod clock;
mod hand_loop;
mod handle;
mod haptic_thread;
mod horizon;
#[cfg(test)]
mod input_tests;
mod pace;
mod stats;
#[cfg(test)]
mod tests;
mod trace;

pub(crate) use alone::single_thread_pool;
pub use clock::{device_time, monotonic_now, park_until, sleep_until, worked};
pub use hand_loop::{
    DeviceCounts, ENABLE_EVERY, Frame, HandLoop, LoopCommands, Turned, local_sample, tool_buttons,
};
pub use handle::{HapticHandle, LoopSummary};
pub use haptic_thread::{HapticPorts, RealtimeConfig, spawn};
pub use horizon::Horizon;
pub use pace::Pace;
pub use stats::{Lateness, LoopStats};
pub use trace::Trace;
