//! Lock-free link between the haptic loop and a driver's own thread, for devices that run on another clock.
//!
//! Two triple buffers carry the newest values, and neither side waits. The loop detects late states by its time;
//! the driver's thread counts its turns, so neither reads a clock.
//!
//! ```text
//! loop    --newest Order-->  driver's thread     no new one for some turns: the force fades
//! loop    <--newest News---  driver's thread     none for 50 ms: no force; none for 500 ms: unplugged
//! ```

mod fade;
mod remote;

pub(super) use fade::{Fade, Share};
pub(super) use remote::{DriverEnd, News, Order, Remote, between};
