//! Between our loop and a driver's own thread, for devices that run on another clock.
//!
//! Neither waits for the other: what is newest is handed over in a triple buffer, and what comes too late is noticed by
//! whoever needs it. The loop has a time to go by; the driver's thread counts its own turns, so that neither reads a
//! clock.
//!
//! ```text
//! loop    --newest Order-->  driver's thread     no new one for some turns: the force fades
//! loop    <--newest News---  driver's thread     none for 50 ms: no force; none for 500 ms: unplugged
//! ```

mod fade;
mod remote;

pub(super) use fade::{Fade, Share};
pub(super) use remote::{DriverEnd, News, Order, Remote, between};
