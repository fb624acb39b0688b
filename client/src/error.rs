//! Why a run did not end as it should.

use std::path::PathBuf;

use palpate_device::ScriptError;
use palpate_device::backend::replay::MotionError;
use palpate_protocol::link::LinkError;
use palpate_protocol::{ModelHash, ProtocolError, Role};
use palpate_tissue::{FileError, WriteError};
use palpate_transport::TransportError;

use crate::realtime::SpawnError;
use crate::{DeviceError, Summary};

/// Why a run did not end as it should: one sentence each, for people.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The join link can not be read.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The script can not be used.
    #[error("the script {}: {source}", path.display())]
    Script {
        /// Its file.
        path: PathBuf,
        /// What is wrong, and where.
        source: ScriptError,
    },
    /// The motion can not be replayed.
    #[error("the motion {}: {source}", path.display())]
    Motion {
        /// Its file.
        path: PathBuf,
        /// What is wrong, and where.
        source: MotionError,
    },
    /// A role with a tool and nothing that moves it.
    #[error(
        "the role {0} holds a tool, no device for it is plugged in (`palpate-client devices` says what is missing), and the \
         simulated hand needs a script to follow: add --script FILE, or --motion FILE to replay a recorded motion"
    )]
    NoScript(Role),
    /// A thin subscription for a role with a tool.
    #[error(
        "--subscription thin has no tissue of its own to feel, and the role {0} holds a tool: what it felt would be a round \
         trip old; leave the option out, or join with a spectator's link"
    )]
    ThinTool(Role),
    /// The device can not be opened.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The server can not be reached, or is another one.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The name or the tool can not be sent.
    #[error(transparent)]
    Protocol(#[from] ProtocolError),
    /// The server does not let this participant in.
    #[error("the server did not let you in: {0}")]
    Refused(String),
    /// The session ended before it began.
    #[error("the session ended while joining: {0}")]
    EndedWhileJoining(String),
    /// What arrived is not the model that the session runs on.
    #[error(
        "the model arrived damaged: its hash is {found}, the session's is {expected}; join again"
    )]
    ModelDamaged {
        /// The session's.
        expected: ModelHash,
        /// Of what arrived.
        found: ModelHash,
    },
    /// The model can not be decoded.
    #[error("the session's model can not be used: {0}")]
    Model(#[from] FileError),
    /// The force loop did not start.
    #[error(transparent)]
    Haptics(#[from] SpawnError),
    /// The system gave no thread, or no runtime for the network.
    #[error("the system did not start a thread: {0}")]
    System(#[from] std::io::Error),
    /// There is no recording to be written there; told before anybody is bothered.
    #[error("--record {0}")]
    RecordPlace(WriteError),
    /// The recording can not be written.
    #[error("the recording {source}")]
    Record {
        /// Its file, and what the system said.
        source: WriteError,
        /// The run up to its end.
        summary: Box<Summary>,
    },
    /// The server is gone. The force was ramped to zero.
    #[error("the server is gone ({detail}); the force was taken away. Join again when it is back")]
    ServerLost {
        /// What was seen.
        detail: String,
        /// The run up to here.
        summary: Box<Summary>,
    },
    /// The copy of the tissue is not the server's.
    #[error("your copy of the tissue differs from the server's ({detail}); join again")]
    Diverged {
        /// Where.
        detail: String,
        /// The run up to here.
        summary: Box<Summary>,
    },
    /// The session broke in a way that should not be.
    #[error("the session was broken off: {detail}")]
    Broken {
        /// What was wrong.
        detail: String,
        /// The run up to here.
        summary: Box<Summary>,
    },
}

impl ClientError {
    /// The run up to the error, where there was one.
    pub fn summary(&self) -> Option<&Summary> {
        match self {
            Self::ServerLost { summary, .. }
            | Self::Diverged { summary, .. }
            | Self::Broken { summary, .. }
            | Self::Record { summary, .. } => Some(summary),
            _ => None,
        }
    }

    /// 2 where what was typed is wrong, 1 otherwise.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Link(_)
            | Self::Script { .. }
            | Self::Motion { .. }
            | Self::NoScript(_)
            | Self::ThinTool(_)
            | Self::RecordPlace(_)
            | Self::Device(_) => 2,
            _ => 1,
        }
    }
}
