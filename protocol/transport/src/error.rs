//! Errors between two hosts.

use std::io;
use std::net::SocketAddr;

use palpate_protocol::CertificateHash;

/// An error between two hosts.
#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    /// The port is in use.
    #[error(
        "can not listen on {address}: another program already does; stop it, or choose another port (port 0 takes any free one)"
    )]
    PortTaken {
        /// The address.
        address: SocketAddr,
    },
    /// The address can not be listened on.
    #[error(
        "can not listen on {address}: {source}; choose an address of this machine, such as 0.0.0.0:4433"
    )]
    Bind {
        /// The address.
        address: SocketAddr,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The host in a join link has no address.
    #[error(
        "can not find the host \"{host}\" of the join link: {detail}; check its spelling and the network"
    )]
    Resolve {
        /// The host.
        host: String,
        /// The error of the operating system.
        detail: String,
    },
    /// The server did not answer.
    #[error(
        "no answer from {address}; is the server running there, and does the network let UDP to this port pass?"
    )]
    NoAnswer {
        /// The address without an answer.
        address: SocketAddr,
    },
    /// Another server, or an impostor, answered.
    #[error(
        "the server at {address} has the certificate {found}, but the join link asks for {expected}: it is another server, or the link is old; ask the host for a new link"
    )]
    WrongCertificate {
        /// The address that answered.
        address: SocketAddr,
        /// The hash in the link.
        expected: CertificateHash,
        /// The hash of the certificate that was shown.
        found: CertificateHash,
    },
    /// The server that answered speaks QUIC but not palpate.
    #[error("the server at {address} does not speak palpate; check host and port of the join link")]
    NotPalpate {
        /// The address that answered.
        address: SocketAddr,
    },
    /// The connection could not be established, or is lost.
    #[error("the connection to {address} was lost: {detail}")]
    Lost {
        /// The other side.
        address: SocketAddr,
        /// The reason.
        detail: String,
    },
    /// The server does not give the model to this participant.
    #[error(
        "the server does not give out the model {hash}: the participant or the model is unknown to it; join the session again"
    )]
    ModelRefused {
        /// The hash of the model.
        hash: palpate_protocol::ModelHash,
    },
    /// The model is larger than a client accepts.
    #[error(
        "the model has {bytes} bytes, more than the limit of {limit}; build it with a coarser spacing"
    )]
    ModelTooLarge {
        /// Its size in bytes.
        bytes: u64,
        /// The limit in bytes.
        limit: u64,
    },
    /// The certificate can not be made or used.
    #[error("the certificate can not be used: {0}")]
    Certificate(String),
    /// A message of this program can not be sent.
    #[error(transparent)]
    Protocol(#[from] palpate_protocol::ProtocolError),
}

/// The close code of an end that does not reconnect: the farewell on the stream may be lost with the
/// stream. After any other code the client may reconnect.
pub(crate) const GOODBYE: u32 = 1;

/// Whether the other side ended a connection for good.
pub(crate) fn is_goodbye(error: &quinn::ConnectionError) -> bool {
    match error {
        quinn::ConnectionError::ApplicationClosed(close) => close.error_code == GOODBYE.into(),
        _ => false,
    }
}

/// The end of a connection, described for people.
pub(crate) fn describe_connection_error(error: &quinn::ConnectionError) -> String {
    use quinn::ConnectionError as E;
    match error {
        E::TimedOut => "the other side was silent for too long".to_owned(),
        E::ApplicationClosed(close) if !close.reason.is_empty() => {
            String::from_utf8_lossy(&close.reason).into_owned()
        }
        E::Reset => "the other side was restarted".to_owned(),
        E::LocallyClosed => "this side closed it".to_owned(),
        other => other.to_string(),
    }
}
