//! A UDP forwarder for one client that lets a handshake begin and never end.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};

use palpate_protocol::JoinLink;
use palpate_transport::connect;
use tokio::net::UdpSocket;
use tokio::time::{Instant, timeout_at};

/// Largest forwarded datagram, bytes.
const DATAGRAM_MAX: usize = 2048;

/// Bits of the first byte of a QUIC Retry packet (RFC 9000, 17.2.5): long header and packet type 3.
const RETRY_BITS: u8 = 0xb0;

/// Progress of a half-open handshake.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Progress {
    /// The server has received nothing.
    Closed,
    /// The server has received the first packet and may have spent work on it.
    Begun,
    /// The server has asked for a proof of the address and has not received it.
    Asked,
    /// The server has received the proof of the address too.
    Proven,
}

/// The packets that pass: the client's first one, the server's Retry, and the client's answer to it.
#[derive(Debug, Clone, Copy)]
struct Gate(Progress);

impl Gate {
    /// Whether a datagram of the client passes.
    fn passes_to_server(&mut self) -> bool {
        self.0 = match self.0 {
            Progress::Closed => Progress::Begun,
            Progress::Asked => Progress::Proven,
            Progress::Begun | Progress::Proven => return false,
        };
        true
    }

    /// Whether a datagram of the server passes.
    fn passes_to_client(&mut self, bytes: &[u8]) -> bool {
        let is_retry = bytes.first().is_some_and(|b| b & RETRY_BITS == RETRY_BITS);
        let passes = is_retry && self.0 == Progress::Begun;
        if passes {
            self.0 = Progress::Asked;
        }
        passes
    }
}

/// Sockets between one client and the server. Each client has its own port towards the server.
struct Forwarder {
    client_side: UdpSocket,
    server_side: UdpSocket,
    client: Option<SocketAddr>,
    gate: Gate,
}

impl Forwarder {
    async fn towards(server: SocketAddr) -> io::Result<Self> {
        let client_side = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await?;
        let server_side = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).await?;
        server_side.connect(server).await?;
        Ok(Self {
            client_side,
            server_side,
            client: None,
            gate: Gate(Progress::Closed),
        })
    }

    /// Forwards until it is dropped.
    async fn forward(&mut self) -> io::Result<()> {
        let mut up = [0; DATAGRAM_MAX];
        let mut down = [0; DATAGRAM_MAX];
        loop {
            tokio::select! {
                received = self.client_side.recv_from(&mut up) => {
                    let (n, from) = received?;
                    self.client = Some(from);
                    if self.gate.passes_to_server() {
                        self.server_side.send(&up[..n]).await?;
                    }
                }
                received = self.server_side.recv(&mut down) => {
                    let n = received?;
                    if self.gate.passes_to_client(&down[..n]) && let Some(client) = self.client {
                        self.client_side.send_to(&down[..n], client).await?;
                    }
                }
            }
        }
    }
}

/// Begins a handshake and keeps its port silent until a time.
pub(super) async fn half_open(link: &JoinLink, until: Instant) -> io::Result<Progress> {
    let server = tokio::net::lookup_host((link.host.as_str(), link.port)).await?;
    let server = { server }.next().ok_or(io::ErrorKind::NotFound)?;
    let mut forwarder = Forwarder::towards(server).await?;
    let mut through = link.clone();
    let address = forwarder.client_side.local_addr()?;
    through.host = address.ip().to_string();
    through.port = address.port();
    let attempt = async {
        tokio::select! {
            // The client gives up after some seconds, because the handshake never ends.
            _ = connect(&through) => Ok(()),
            error = forwarder.forward() => error,
        }
    };
    match timeout_at(until, attempt).await {
        Ok(Err(error)) => Err(error),
        Ok(Ok(())) | Err(_) => Ok(forwarder.gate.0),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::net::UdpSocket;
    use tokio::time::timeout;

    use super::{Forwarder, Gate, Progress};

    const INITIAL: [u8; 4] = [0xc3, 0, 0, 1];
    const RETRY: [u8; 4] = [0xf0, 0, 0, 1];

    #[test]
    fn only_the_first_packet_passes_without_a_retry() {
        let mut gate = Gate(Progress::Closed);
        assert!(!gate.passes_to_client(&RETRY), "no client is known");
        assert!(gate.passes_to_server());
        assert!(!gate.passes_to_server() && !gate.passes_to_client(&INITIAL));
        assert!(!gate.passes_to_client(&[]));
        assert_eq!(gate.0, Progress::Begun);
    }

    #[test]
    fn the_answer_to_a_retry_passes_once() {
        let mut gate = Gate(Progress::Closed);
        assert!(gate.passes_to_server() && gate.passes_to_client(&RETRY));
        assert!(!gate.passes_to_client(&RETRY));
        assert!(gate.passes_to_server());
        assert!(!gate.passes_to_server() && !gate.passes_to_client(&RETRY));
        assert_eq!(gate.0, Progress::Proven);
    }

    #[test]
    fn forwarder_is_silent_after_the_first_packets() {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(async {
            let server = UdpSocket::bind("127.0.0.1:0").await.unwrap();
            let address = server.local_addr().unwrap();
            let mut forwarder = Forwarder::towards(address).await.unwrap();
            let entrance = forwarder.client_side.local_addr().unwrap();
            let forwarding = tokio::spawn(async move { forwarder.forward().await });
            let client = UdpSocket::bind("127.0.0.1:0").await.unwrap();
            client.connect(entrance).await.unwrap();
            let mut buffer = [0; 64];
            client.send(&INITIAL).await.unwrap();
            let (n, from) = server.recv_from(&mut buffer).await.unwrap();
            assert_eq!(&buffer[..n], INITIAL);
            server.send_to(&INITIAL, from).await.unwrap();
            server.send_to(&RETRY, from).await.unwrap();
            let n = client.recv(&mut buffer).await.unwrap();
            assert_eq!(&buffer[..n], RETRY, "the server's other packet was dropped");
            for _ in 0..3 {
                client.send(&INITIAL).await.unwrap();
            }
            server.recv_from(&mut buffer).await.unwrap();
            let more = server.recv_from(&mut buffer);
            assert!(timeout(Duration::from_millis(50), more).await.is_err());
            forwarding.abort();
        });
    }
}
