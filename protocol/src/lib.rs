//! The wire protocol, its session state machines and its timing.
//!
//! This crate never opens a socket, never reads a clock and never spawns: time is an argument, bytes
//! come in through `handle_*` and leave through `poll_*`. It depends neither on tissue nor on devices:
//! messages carry plain arrays and integers, and the room and the client convert.
//!
//! One session state machine per peer handles two kinds of traffic:
//!
//! | kind | carries | how |
//! | --- | --- | --- |
//! | operations | handshake, cuts, joins, compensation | length-prefixed frames on one ordered stream, numbered |
//! | motion | tool samples, displacement corrections, clock probes | datagrams of at most [`DATAGRAM_MAX_BYTES`] |
//!
//! Where to look: [`handshake`], [`name`] and [`link`] for joining, [`operation`], [`request`], [`control`] and
//! [`permission`] for ordered messages, [`datagram`] for messages that may be lost, [`session`] for the two
//! state machines, [`clock`], [`compensation`] and [`timeline`] for the shared time.
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod bounded_list;
pub mod clock;
pub mod codec;
pub mod compensation;
pub mod control;
pub mod datagram;
mod emulation;
mod error;
pub mod examples;
pub mod handshake;
mod ids;
pub mod lateness;
pub mod link;
pub mod name;
pub mod operation;
pub mod permission;
pub mod request;
mod sample;
mod sequence;
pub mod session;
mod time;
pub mod timeline;
mod token_bucket;
pub mod tool;
pub mod verlet;

pub use datagram::DATAGRAM_MAX_BYTES;
pub use emulation::{EMULATED_DELAY_MAX_MS, EMULATED_LOSS_MAX_PERMILLE, Emulation};
pub use error::ProtocolError;
pub use handshake::{ModelInfo, PROTOCOL_VERSION, Role};
pub use ids::{Epoch, ModelHash, OperationId, ParticipantId, RequestId, TopologyHash};
pub use link::{CertificateHash, Grant, JoinLink, ResumeToken};
pub use sample::{LocalSample, Pose, ToolSample, ToolTrack};
pub use sequence::{Arrival, SequenceWindow, WINDOW_BITS};
pub use time::{ClientTime, ServerTime, Span};
pub use token_bucket::TokenBucket;
