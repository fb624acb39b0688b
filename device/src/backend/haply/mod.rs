//! The Haply Inverse3, through its maker's local service.
//!
//! The Haply Inverse Service comes with the Haply Hub (haply.co) or alone, runs in the background and exchanges
//! JSON over two WebSockets. On port 10001 it answers every message with one state, so that the sender is the
//! clock. On port 10020 it sends safety events. Its frame is x to the right, y away from the user and z up, in
//! metres, metres per second and newtons. The key of the force is `vector` since version 3.5, and `values` before;
//! the first message shows which.
//!
//! Two threads of the driver own these connections; [`Haply`] exchanges the newest values with them and never
//! waits. A message goes out after each write of the loop, and every 2 ms without one.
//!
//! | the service sends | it becomes |
//! | --- | --- |
//! | `ebrake_triggered`, until `ebrake_released` | [`Faults::EMERGENCY_STOP`](crate::Faults::EMERGENCY_STOP) |
//! | `fod_stage_changed` as a warning, until it comes as no warning | [`Faults::OVER_FORCE`](crate::Faults::OVER_FORCE) |
//! | `stall_detected`, `stability_ceiling` | the same for 250 messages |
//! | a state without the device, `device-disconnected` | [`DeviceFault::Unplugged`](crate::DeviceFault::Unplugged) |
//! | no state, or none that can be read, for 50 ms | [`Faults::COMMUNICATION`](crate::Faults::COMMUNICATION) and no force |
//!
//! Orientation and buttons are those of the first VerseGrip that the service lists, wireless ones first.

mod alarms;
mod device;
mod link;
mod message;
mod session;

pub use device::Haply;

use self::link::{Link, Received};
use self::message::Message;
use super::found::Found;
use crate::OpenError;

/// Where the service listens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Service {
    /// For states and forces, `ws://host:port`.
    pub simulation: String,
    /// For safety events; `None` goes without.
    pub events: Option<String>,
}

impl Default for Service {
    /// Where it listens unless it was configured otherwise.
    fn default() -> Self {
        Self {
            simulation: "ws://localhost:10001".to_owned(),
            events: Some("ws://localhost:10020".to_owned()),
        }
    }
}

/// Remedy when no device is found.
const HINT: &str = "look at its cable and power supply, and whether the Haply Hub shows it";

/// The devices that the service knows.
pub fn find(service: &Service) -> Result<Vec<Found>, OpenError> {
    Ok(inventory(&service.simulation)?.1.found())
}

/// Opens the device with this id, or the only one.
pub fn open(service: &Service, which: Option<&str>) -> Result<Haply, OpenError> {
    Haply::open(service, which)
}

/// A connection and its first message, which the service sends unasked.
fn inventory(url: &str) -> Result<(Link, Message), OpenError> {
    let mut link = Link::open(url)?;
    let unfit = |why: String| {
        OpenError::new(format_args!(
            "the service at {url} does not send the inventory of a Haply service: {why}"
        ))
    };
    match link.receive() {
        Received::Text(text) => match Message::read(&text) {
            Ok(message) => Ok((link, message)),
            Err(why) => Err(unfit(why)),
        },
        Received::Nothing => Err(silent(url)),
        Received::Unfit(why) | Received::Closed(why) => Err(unfit(why)),
    }
}

fn silent(url: &str) -> OpenError {
    OpenError::new(format_args!(
        "the Haply service at {url} sends nothing; restart it"
    ))
}
