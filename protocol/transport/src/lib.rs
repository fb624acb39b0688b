//! Drives a protocol session over quinn and tokio.
//!
//! This crate contains no tissue logic, and is the only one that uses quinn. A shell gives it a clock
//! and channels:
//!
//! ```text
//! client   connect(&link) -> Connection;        spawn_client(connection, session, clock) -> ClientHandle
//! server   Server::bind(..).accept() -> Connection;  spawn_peer(connection, id, clock, inbox) -> PeerHandle
//! model    fetch_model(&link, ModelRequest::of(&welcome), progress), on a connection of its own
//! ```
//!
//! [`threads`] schedules the threads of every program that has a session.
//!
//! TLS 1.3 always. A client authenticates its server by the hash of the certificate in the join link.
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod admission;
mod bulk;
mod certificate;
mod client;
mod config;
mod connection;
mod controller;
mod drive;
mod error;
mod identity;
mod log;
mod page_connection;
mod page_tls;
mod rate_cap;
mod server;
mod slots;
pub mod state;
pub mod threads;

pub use admission::AdmissionStats;
pub use bulk::{MODEL_MAX_BYTES, ModelRequest, ModelSource, fetch_model};
pub use client::{connect, connect_bulk};
pub use connection::{Connection, PathStats};
pub use drive::DriverStats;
pub use drive::client::{ClientCommand, ClientHandle, spawn_client};
pub use drive::peer::{
    DATAGRAM_QUEUE_MAX, PeerHandle, PeerId, PeerInput, RELIABLE_QUEUE_MAX, spawn_peer,
};
pub use error::TransportError;
pub use identity::ServerIdentity;
pub use log::start_log;
pub use page_connection::{
    Delivery, PageAttempt, PageBytes, PageDoor, PageEndpoint, PageReceiver, PageSender,
};
pub use page_tls::{PageStream, PageTls, PageTlsError};
pub use server::Server;
pub use tracing_subscriber::filter::LevelFilter;
