//! The browser view: serves the page and streams the tissue, the tools and the state of a session to it.
//!
//! ```text
//! thread that solves the tissue --Feed::show-----> hub --connection-> pages
//! thread that owns the session  --ViewServer::*-->     <--PageInput-- (hello, motion, requests)
//! ```
//!
//! Both programs serve the same page: a server to participants, a client to its own user. The format is specified in
//! `WIRE.md`. A connection is a WebSocket or a WebTransport session. One task, the hub, owns all pages. Each page has bounded queues, so that a slow page loses frames and
//! delays neither other pages nor the session. A shape is encoded once for all pages.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod address;
mod asset;
mod board;
mod connection;
mod control_message;
mod feed;
mod https;
mod hub;
mod message;
mod motion;
mod origin;
mod page;
mod round_trip;
mod server;
mod shape_code;
mod shape_streams;
mod springs;
mod step_limit;
mod surface;
mod tool_code;
mod web_transport;

pub use address::{CLIENT_VIEW, SERVER_VIEW, ViewAddressError, parse_view};
pub use board::Board;
pub use control_message::{AnnotationMessage, CameraMessage, EmulationMessage};
pub use feed::Feed;
pub use message::{
    InvitationMessage, OpenInvitation, OwnFigures, PageHello, PageRequest, Participant, Seat,
    SessionState, State, ToolMessage, Welcome, WelcomeRegion,
};
pub use page::{PageEvent, PageId, PageInput};
pub use server::{PageAddress, ViewConfig, ViewError, ViewListener, ViewServer};
pub use tool_code::{ShownTool, ToolFrame, ToolPose};
