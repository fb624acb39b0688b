//! Lock-free link between the haptic loop and a driver's own thread, for devices that run on another clock.
//!
//! Two triple buffers carry the newest values, and neither side waits. The loop detects late states by its time;
//! the driver's thread counts its turns, so neither reads a clock.
//!
//! ```text
//! loop    --newest order-->   driver's thread     no new one for some turns: the force fades
//! loop    <--newest state---  driver's thread     none for 50 ms: no force; none for 500 ms: unplugged
//! ```

mod ends;
mod fade;

pub(super) use ends::{DeviceState, DriverEnd, LoopEnd, Order, mailbox};
pub(super) use fade::{Fade, Share};
