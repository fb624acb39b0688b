//! 6-DOF mice of 3Dconnexion: a cap that is pushed and twisted steers the tool; no force.
//!
//! - [`Report`]: one message of the device; [`Cap`]: the state after all of them.
//! - [`known`]: the supported devices.
//! - [`Port`]: source of the messages. The hardware's port is built with the feature `spacemouse`.
//!
//! The device's own axes are x to the right, y towards the user and z down; deflections are turned half about x into
//! the scene's: x to the right, y away and z up. That is a rotation, so twists turn along with pushes.

mod cap;
mod known;
mod report;
#[cfg(feature = "spacemouse")]
mod system;
#[cfg(test)]
mod tests;

use std::time::Duration;

use super::steered::{DeviceLost, Kind, RateControl, Source, SourceEvent, Space, Steered};
use crate::OpenError;

pub use cap::Cap;
pub use known::{MULTI_AXIS, VENDORS, known};
pub use report::{BadReport, FULL, REPORT_BYTES_MAX, Report};
#[cfg(feature = "spacemouse")]
pub use system::open;

/// A held cap repeats its message every 8 to 16 ms (published measurements of a SpaceNavigator and a SpaceMouse
/// Wireless); a longer silence means that it is out of reach, µs.
pub const SILENCE_MAX_US: i64 = 250_000;

/// Source of messages of a 6-DOF mouse.
pub trait Port: Send {
    /// Waits at most `patience` for the next message and writes it to `into`; returns its length, 0 for none.
    fn report(
        &mut self,
        into: &mut [u8; REPORT_BYTES_MAX],
        patience: Duration,
    ) -> Result<usize, DeviceLost>;

    /// Looks once, without waiting, for the lost device; returns whether it is back.
    fn reopen(&mut self) -> bool;
}

/// Steers a tool in `space` with the mouse behind `port`, which is called `name`.
pub fn over(
    port: impl Port + 'static,
    name: String,
    rate: RateControl,
    space: &Space,
) -> Result<Steered, OpenError> {
    let kind = Kind {
        name,
        dof_in: 6,
        silence_max_us: Some(SILENCE_MAX_US),
        rate,
        rumble: None,
    };
    let listener = Listener {
        port,
        cap: Cap::default(),
    };
    Steered::open(Box::new(listener), kind, space)
}

/// A port and the state of its cap.
struct Listener<P> {
    port: P,
    cap: Cap,
}

impl<P: Port> Source for Listener<P> {
    fn listen(&mut self, patience: Duration) -> Result<SourceEvent, DeviceLost> {
        let mut bytes = [0; REPORT_BYTES_MAX];
        let n = self.port.report(&mut bytes, patience)?;
        if n == 0 {
            return Ok(SourceEvent::Quiet);
        }
        let bytes = &bytes[..n.min(REPORT_BYTES_MAX)];
        Ok(match Report::parse(bytes) {
            Ok(Some(report)) => SourceEvent::Controls(self.cap.take(report)),
            Ok(None) => SourceEvent::Quiet,
            Err(_) => SourceEvent::Garbled,
        })
    }

    fn reopen(&mut self) -> bool {
        self.cap = Cap::default();
        self.port.reopen()
    }
}
