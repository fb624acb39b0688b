//! One state machine per end of a connection: bytes in, events out.
//!
//! [`ClientSession`] is the client's end, [`ServerPeer`] the server's end for one client. Both are pure:
//! the shell reads the clock, owns the socket and calls, after any event,
//!
//! ```text
//! handle_stream / handle_datagram / handle_timeout / a request          (one of them)
//! then poll_stream, poll_datagram and poll_event, each until None
//! then sleeps until poll_timeout
//! ```
//!
//! A protocol violation closes that one session with a [`CloseReason`]. A noise datagram is only
//! counted, because datagrams can arrive late, twice or truncated.

mod client;
mod copies;
mod link;
mod loss;
mod motion_batch;
mod outbox;
mod picture;
mod preamble;
mod round_trip;
mod server;

use std::sync::Arc;

use crate::clock::ClockMap;
use crate::compensation::MotionArrival;
use crate::datagram::{Corrections, Displacements};
use crate::handshake::{Hello, Refused, Welcome};
use crate::lateness::Lateness;
use crate::operation::Operation;
use crate::request::{DelayReport, Invitation, Request, RequestRefused};
use crate::{ParticipantId, ProtocolError, ServerTime, Span, ToolSample, ToolTrack};

use link::Link;

pub use client::{ClientSession, DELAY_REPORT_PERIOD, PROBE_PERIOD, PROBE_PERIOD_FIRST};
pub use copies::{COPY_MAX_BYTES, MessageCopy};
pub use link::{LinkStats, NoiseCounters};
pub use picture::{PICTURE_RATE_BITS_PER_S, PICTURE_STEP_UM, Picture, PictureStats};
pub use server::{
    FUTURE_MAX, REFUSALS_BURST_MAX, REQUESTS_BURST_MAX, REQUESTS_PER_SECOND_MAX, ServerPeer,
};

/// A participant that is silent for this long is removed together with its tool.
pub const PEER_SILENCE: Span = Span::from_millis(2000);

/// After this silence of the server the link counts as lost for the moment: the force goes to zero.
pub const SERVER_SILENCE: Span = Span::from_millis(1000);

/// A longer handshake is aborted.
pub const HANDSHAKE_TIMEOUT: Span = Span::from_millis(10_000);

/// The longest time between two datagrams of either side, so that silence is detected.
pub const HEARTBEAT: Span = Span::from_millis(100);

/// The most bytes that wait for one peer on the operations stream, encoded or not: a new client receives the longest
/// snapshot and the longest log at once. Beyond, the peer is too slow and is closed.
pub const STREAM_BACKLOG_MAX_BYTES: usize = 32 * 1024 * 1024;

/// The high-water mark of encoded operations for one peer, bytes. Above it the shell leaves operations in
/// its own queue, where all peers share each of them ([`ServerPeer::has_room`]). It is the product of
/// 10 Mbit/s and 200 ms.
pub const OUTBOX_HIGH_WATER_BYTES: usize = 256 * 1024;

/// A peer whose operations stream takes nothing for this long, while operations wait, is closed. It is
/// checked once per such time, hence after at most twice as long.
pub const STREAM_STALL_MAX: Span = Span::from_millis(10_000);

/// The most datagrams that may wait in one session; beyond, the oldest is dropped and counted.
pub const DATAGRAM_BACKLOG_MAX: usize = 64;

/// The most events that one session queues between two drains. Beyond it motion is dropped; a peer that
/// causes more reliable events is closed.
pub const EVENTS_MAX: usize = 4096;

/// The reason for the end of a session.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CloseReason {
    /// The other side violated the protocol.
    #[error(transparent)]
    Violation(#[from] ProtocolError),
    /// The other side was silent for too long.
    #[error("the other side was silent for {} ms", .0.as_millis_f64())]
    Silent(Span),
    /// The handshake did not finish in time.
    #[error("the handshake was not finished within {} s", HANDSHAKE_TIMEOUT.as_secs_f64())]
    HandshakeTimeout,
    /// The server refused this client.
    #[error("{}", .0.sentence)]
    Refused(Refused),
    /// The participant asked to leave.
    #[error("the participant left")]
    Left,
    /// The server sent a farewell.
    #[error("the server ended the session: {0}")]
    Goodbye(String),
    /// The connection of the session is lost.
    #[error("the connection was lost: {0}")]
    ConnectionLost(String),
}

/// An event of a client's session.
#[derive(Debug, Clone, PartialEq)]
pub enum ClientEvent {
    /// The handshake is done. The snapshot and the operations of the log follow as events.
    Welcomed(Box<Welcome>),
    /// The snapshot that the welcome announced, before the first operation.
    Snapshot(Vec<u8>),
    /// The next operation of the log, in order. A gap in the numbers stands for operations that no longer matter.
    Operation(Operation),
    /// All operations that were in the log at the welcome have been returned.
    CaughtUp,
    /// A request was refused.
    RequestRefused(RequestRefused),
    /// The secret of an invitation that this participant requested.
    Invitation(Invitation),
    /// Samples of another participant's tool, oldest first; some may be repeated. For that tool's
    /// [`Timeline`](crate::timeline::Timeline).
    Motion(ToolTrack),
    /// Displacements of some nodes on the server.
    Corrections(Corrections),
    /// Displacements of the nodes in view; only for a client without its own tissue.
    Displacements(Displacements),
    /// Each participant's delay estimate, for display.
    Delays(Vec<(ParticipantId, DelayReport)>),
    /// The clock estimate moved: the map from now on. The first one means that it is locked.
    Clock(ClockMap),
    /// The server was silent for [`SERVER_SILENCE`]: set the force to zero and display a warning.
    LinkLost,
    /// The server's datagrams arrive again.
    LinkRestored,
    /// The session is over. It is the last event.
    Closed(CloseReason),
}

/// An event of a server's session with one client.
#[derive(Debug, Clone, PartialEq)]
pub enum PeerEvent {
    /// A client asks to join. Answer with [`PeerMessage::Welcome`] or [`PeerMessage::Refused`].
    Hello(Hello),
    /// A request; its numbers are within their ranges.
    Request(Request),
    /// Samples of this participant's tool.
    Motion(PeerMotion),
    /// This participant's delay estimate.
    Delay(DelayReport),
    /// The session is over. It is the last event; the tool goes away.
    Closed(CloseReason),
}

/// Motion of one participant as it reached the server.
#[derive(Debug, Clone, PartialEq)]
pub struct PeerMotion {
    /// The samples, oldest first; some may have been given before.
    pub samples: Vec<ToolSample>,
    /// When the datagram was handled.
    pub arrived: ServerTime,
    /// The lateness that the sender caused.
    pub late: Lateness,
    /// How long it may have waited for a stalled receiver.
    pub stall: Span,
    /// The longest round trip of the last half minute, from acknowledgements; `None` before the first one.
    pub round_trip: Option<Span>,
}

impl PeerMotion {
    /// Samples that no machine delayed.
    pub fn on_time(samples: Vec<ToolSample>, arrived: ServerTime) -> Self {
        Self {
            samples,
            arrived,
            late: Lateness::NONE,
            stall: Span::ZERO,
            round_trip: None,
        }
    }

    /// Its arrival, for a [`DelayEstimator`](crate::compensation::DelayEstimator); `None` without samples.
    pub fn arrival(&self) -> Option<MotionArrival> {
        Some(MotionArrival {
            generated: self.samples.last()?.time,
            arrived: self.arrived,
            late: self.late,
            stall: self.stall,
        })
    }
}

/// Motion that the server relays in one round.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionRound {
    /// When the round was released. Waiting time from then until sending is lateness of the server.
    pub released: ServerTime,
    /// The tools; the lateness of each is that at the release.
    pub tracks: Vec<ToolTrack>,
}

/// A reliable, ordered message of the server to one client.
#[derive(Debug, Clone, PartialEq)]
pub enum PeerMessage {
    /// Accepts the client. The snapshot that it announces is sent after it, then every operation of the log, from the
    /// first that it names.
    Welcome(Box<Welcome>),
    /// The next piece of the snapshot.
    Snapshot(Arc<[u8]>),
    /// Refuses the client; closes the session.
    Refused(Refused),
    /// The next operation.
    Operation(Arc<Operation>),
    /// Refuses a request.
    RequestRefused(RequestRefused),
    /// Returns the secret of an invitation to its requester.
    Invitation(Invitation),
    /// Ends the session.
    Goodbye(String),
}

/// A message of the server to one client that may be dropped for want of room.
#[derive(Debug, Clone, PartialEq)]
pub enum PeerDatagram {
    /// The tools of all participants; the session omits the client's own tool when sending.
    Motion(Arc<MotionRound>),
    /// Node displacements, one piece of [`Corrections::pieces`].
    Corrections(Arc<Corrections>),
    /// Displacements of the nodes in view, one piece of [`Displacements::pieces`].
    Displacements(Arc<Displacements>),
    /// The displacements of all nodes in view, for a thin subscriber; the session selects and schedules
    /// them.
    Picture(Arc<Picture>),
    /// Each participant's delay estimate.
    Delays(Arc<[(ParticipantId, DelayReport)]>),
}

#[cfg(test)]
mod bad_peer_tests;
#[cfg(test)]
mod copy_tests;
#[cfg(test)]
mod overload_tests;
#[cfg(test)]
mod set_clock_tests;
#[cfg(test)]
mod states;
#[cfg(test)]
mod tests;

#[cfg(test)]
mod rate_tests;
