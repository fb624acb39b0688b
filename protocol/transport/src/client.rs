//! Connects a client to the server of a join link.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;

use palpate_protocol::JoinLink;
use quinn::{ConnectionError, Endpoint, TokioRuntime};

use crate::TransportError;
use crate::config::{self, ALPN_BULK, ALPN_SESSION};
use crate::connection::Connection;
use crate::error::describe_connection_error;
use crate::identity::SERVER_NAME;

/// Attempts to reach a silent address; each takes about eight seconds.
const ATTEMPTS: u32 = 2;

/// The TLS alert "no application protocol".
const ALERT_NO_APPLICATION_PROTOCOL: u8 = 120;

/// Connects to the server of a join link and opens the operations stream.
pub async fn connect(link: &JoinLink) -> Result<Connection, TransportError> {
    open(link, ALPN_SESSION).await
}

/// Connects for a model transfer and opens its stream, without a request: for tests of the server.
/// [`fetch_model`](crate::fetch_model) performs a whole transfer.
pub async fn connect_bulk(link: &JoinLink) -> Result<Connection, TransportError> {
    open(link, ALPN_BULK).await
}

async fn open(link: &JoinLink, alpn: &[u8]) -> Result<Connection, TransportError> {
    let (endpoint, quic) = reach(link, alpn).await?;
    let address = quic.remote_address();
    let streams = quic.open_bi().await.map_err(|e| TransportError::Lost {
        address,
        detail: describe_connection_error(&e),
    })?;
    Ok(Connection::new(quic, streams, Some(endpoint)))
}

/// A connection of the kind that `alpn` names.
pub(crate) async fn reach(
    link: &JoinLink,
    alpn: &[u8],
) -> Result<(Endpoint, quinn::Connection), TransportError> {
    let address = resolve(link).await?;
    let socket = socket_towards(address)?;
    let local = socket.local_addr().unwrap_or(address);
    let config = config::client_endpoint();
    let endpoint =
        Endpoint::new(config, None, socket, Arc::new(TokioRuntime)).map_err(|source| {
            TransportError::Bind {
                address: local,
                source,
            }
        })?;
    let mut attempt = 1;
    loop {
        match try_once(&endpoint, link, address, alpn).await {
            Err(TransportError::NoAnswer { .. }) if attempt < ATTEMPTS => attempt += 1,
            Err(error) => return Err(error),
            Ok(quic) => return Ok((endpoint, quic)),
        }
    }
}

/// A socket of this host that reaches `address`, at a port that the system chooses.
pub(crate) fn socket_towards(address: SocketAddr) -> Result<UdpSocket, TransportError> {
    let local: SocketAddr = if address.is_ipv4() {
        (Ipv4Addr::UNSPECIFIED, 0).into()
    } else {
        (Ipv6Addr::UNSPECIFIED, 0).into()
    };
    UdpSocket::bind(local).map_err(|source| TransportError::Bind {
        address: local,
        source,
    })
}

async fn resolve(link: &JoinLink) -> Result<SocketAddr, TransportError> {
    let fail = |detail: String| TransportError::Resolve {
        host: link.host.clone(),
        detail,
    };
    let found: Vec<SocketAddr> = tokio::net::lookup_host((link.host.as_str(), link.port))
        .await
        .map_err(|e| fail(e.to_string()))?
        .collect();
    // Where a name has both, IPv4 passes more home routers.
    let best = found.iter().find(|a| a.is_ipv4()).or(found.first());
    best.copied()
        .ok_or_else(|| fail("it has no address".to_owned()))
}

async fn try_once(
    endpoint: &Endpoint,
    link: &JoinLink,
    address: SocketAddr,
    alpn: &[u8],
) -> Result<quinn::Connection, TransportError> {
    let pinned = config::pinned(link.certificate);
    let config = config::client(pinned.clone(), alpn)?;
    let lost = |detail: String| TransportError::Lost { address, detail };
    let connecting = endpoint
        .connect_with(config, address, SERVER_NAME)
        .map_err(|e| lost(e.to_string()))?;
    connecting.await.map_err(|error| {
        if let Some(found) = pinned.other() {
            return TransportError::WrongCertificate {
                address,
                expected: link.certificate,
                found,
            };
        }
        let alert = quinn::TransportErrorCode::crypto(ALERT_NO_APPLICATION_PROTOCOL);
        match error {
            ConnectionError::TimedOut => TransportError::NoAnswer { address },
            ConnectionError::VersionMismatch => TransportError::NotPalpate { address },
            ConnectionError::ConnectionClosed(close) if close.error_code == alert => {
                TransportError::NotPalpate { address }
            }
            other => lost(describe_connection_error(&other)),
        }
    })
}
