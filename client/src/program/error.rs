//! Errors of a run.

use std::path::PathBuf;

use palpate_device::ScriptError;
use palpate_protocol::handshake::Refused;
use palpate_protocol::link::LinkError;
use palpate_protocol::name::NameError;
use palpate_protocol::session::CloseReason;
use palpate_protocol::{ModelHash, ProtocolError, Role};
use palpate_tissue::file::{FileError, WriteError};
use palpate_transport::TransportError;

use crate::{DeviceError, LinkSourceError, Summary};

/// Error of a run, with a message for the user.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The join link is invalid.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// No join link can be read.
    #[error(transparent)]
    LinkSource(#[from] LinkSourceError),
    /// The view can not be served there.
    #[error(transparent)]
    ViewAddress(#[from] palpate_view::ViewAddressError),
    /// The script is invalid.
    #[error("the script {}: {source}", path.display())]
    Script {
        /// Path of the script.
        path: PathBuf,
        /// Error and its position.
        source: ScriptError,
    },
    /// The motion can not be replayed.
    #[error("the motion {}: {source}", path.display())]
    Motion {
        /// Path of the motion.
        path: PathBuf,
        /// Error and its position.
        source: ScriptError,
    },
    /// A role with a tool, without a device.
    #[error(
        "the role {0} holds a tool, but no haptic device is connected (see `palpate-client devices`); connect one, \
         add --script FILE for a simulated hand, --motion FILE to replay a recorded motion, or --view for mouse, touch \
         and keys"
    )]
    NoScript(Role),
    /// A thin subscription for a role that needs the tissue.
    #[error(
        "--subscription thin computes no tissue, but the role {0} needs it; remove the option, or join with a spectator \
         link"
    )]
    ThinTool(Role),
    /// The page can not be served.
    #[error(transparent)]
    View(#[from] palpate_view::ViewError),
    /// The device can not be opened.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The server is unreachable, or its certificate differs.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The name can not be shown.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The name or the tool can not be encoded.
    #[error(transparent)]
    Protocol(#[from] ProtocolError),
    /// The server rejected this participant.
    #[error("the server rejected you: {}", .0.sentence)]
    Refused(Refused),
    /// The server ended the session before it admitted this participant.
    #[error("the server rejected you: {0}")]
    Goodbye(String),
    /// The connection was lost before the server admitted this participant.
    #[error("joining failed: {0}")]
    LostWhileJoining(CloseReason),
    /// The session ended while joining.
    #[error("the session ended while joining: {0}")]
    EndedWhileJoining(String),
    /// The hash of the received model differs from the session's.
    #[error(
        "the model arrived damaged: its hash is {found}, the session's is {expected}; join again"
    )]
    ModelDamaged {
        /// Hash in the session.
        expected: ModelHash,
        /// Hash of the received bytes.
        found: ModelHash,
    },
    /// The model can not be decoded.
    #[error("invalid session model: {0}")]
    Model(#[from] FileError),
    /// The force loop did not start.
    #[error("cannot start the haptic thread: {0}")]
    Haptics(std::io::Error),
    /// The operating system failed to start a thread or the network runtime.
    #[error("cannot start a thread: {0}")]
    System(#[from] std::io::Error),
    /// The recording's path is not writable; checked before joining.
    #[error("--record {0}")]
    RecordPlace(WriteError),
    /// The recording can not be written.
    #[error("the recording {source}")]
    Record {
        /// File and error of the operating system.
        source: WriteError,
        /// Summary of the whole run.
        summary: Box<Summary>,
    },
    /// The server is unreachable. The force was ramped to zero.
    #[error(
        "lost the connection to the server ({detail}); the force was set to zero. Join again once the server is reachable"
    )]
    ServerLost {
        /// Observed cause.
        detail: String,
        /// Summary up to this point.
        summary: Box<Summary>,
    },
    /// The server was restarted, or the seat has expired. The force was ramped to zero.
    #[error("the server no longer has your seat ({detail}); the force was set to zero. Join again")]
    SeatGone {
        /// The server's reason.
        detail: String,
        /// Summary up to this point.
        summary: Box<Summary>,
    },
    /// The replica differs from the server.
    #[error("your replica differs from the server ({detail}); join again")]
    Diverged {
        /// The difference.
        detail: String,
        /// Summary up to this point.
        summary: Box<Summary>,
    },
    /// An internal fault ended the session.
    #[error("internal error: {detail}")]
    Broken {
        /// Description of the fault.
        detail: String,
        /// Summary up to this point.
        summary: Box<Summary>,
    },
}

impl ClientError {
    /// The summary up to the error, if the session had begun.
    pub fn summary(&self) -> Option<&Summary> {
        match self {
            Self::ServerLost { summary, .. }
            | Self::SeatGone { summary, .. }
            | Self::Diverged { summary, .. }
            | Self::Broken { summary, .. }
            | Self::Record { summary, .. } => Some(summary),
            _ => None,
        }
    }

    /// 2 for invalid arguments, 1 otherwise.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Link(_)
            | Self::LinkSource(_)
            | Self::ViewAddress(_)
            | Self::Script { .. }
            | Self::Motion { .. }
            | Self::NoScript(_)
            | Self::Name(_)
            | Self::ThinTool(_)
            | Self::RecordPlace(_)
            | Self::View(_)
            | Self::Device(_) => 2,
            _ => 1,
        }
    }
}
