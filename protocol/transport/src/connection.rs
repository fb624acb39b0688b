//! One connection: the operations stream, datagrams, statistics.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use quinn::{RecvStream, SendStream, VarInt};

use crate::TransportError;
use crate::client::socket_towards;
use crate::error::{GOODBYE, describe_connection_error};
use crate::rate_cap::RateCap;
use crate::slots::Slot;

/// The longest reason that is sent when closing, bytes.
const REASON_MAX_BYTES: usize = 200;

/// Statistics of a connection, from the transport's counters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PathStats {
    /// Round trip time, smoothed.
    pub rtt: Duration,
    /// Packets sent.
    pub sent_packets: u64,
    /// Sent packets that were lost.
    pub lost_packets: u64,
    /// Bytes sent as UDP payload, with everything that QUIC adds; the headers of IP and UDP, 28 bytes
    /// a packet with IPv4, are not in it.
    pub sent_bytes: u64,
    /// Bytes received, counted alike.
    pub received_bytes: u64,
    /// Datagrams that were not sent, because the buffer was full or the rate cap reached.
    pub skipped_datagrams: u64,
    /// Received datagrams that were dropped unread, because the peer exceeded the rate cap.
    pub refused_datagrams: u64,
}

/// One connection with its operations stream. Give it to
/// [`spawn_client`](crate::spawn_client) or [`spawn_peer`](crate::spawn_peer).
pub struct Connection {
    quic: quinn::Connection,
    pub(crate) send: SendStream,
    pub(crate) recv: RecvStream,
    cap: RateCap,
    skipped: u64,
    receiving: RateCap,
    refused: u64,
    /// A client's own endpoint lives as long as its connection.
    endpoint: Option<quinn::Endpoint>,
    /// The slot of a server's connection that is not admitted yet.
    slot: Option<Slot>,
}

impl Connection {
    pub(crate) fn new(
        quic: quinn::Connection,
        (send, recv): (SendStream, RecvStream),
        endpoint: Option<quinn::Endpoint>,
    ) -> Self {
        Self {
            quic,
            send,
            recv,
            cap: RateCap::sending(Instant::now()),
            skipped: 0,
            receiving: RateCap::receiving(Instant::now()),
            refused: 0,
            endpoint,
            slot: None,
        }
    }

    /// A server's connection, which is pending as long as it has the slot.
    pub(crate) fn pending(
        quic: quinn::Connection,
        streams: (SendStream, RecvStream),
        slot: Slot,
    ) -> Self {
        let mut connection = Self::new(quic, streams, None);
        connection.slot = Some(slot);
        connection
    }

    /// Admits a connection of a server: its time is no longer limited, and the other side may send more at
    /// once. [`spawn_peer`](crate::spawn_peer) does this at the welcome.
    pub fn admit(&mut self) {
        if let Some(slot) = self.slot.take() {
            slot.admit();
        }
    }

    pub(crate) fn take_slot(&mut self) -> Option<Slot> {
        self.slot.take()
    }

    /// The address of the other side.
    pub fn remote_address(&self) -> SocketAddr {
        self.quic.remote_address()
    }

    /// Sends bytes on the operations stream; returns the number accepted.
    pub async fn write(&mut self, bytes: &[u8]) -> Result<usize, String> {
        self.send.write(bytes).await.map_err(|e| e.to_string())
    }

    /// Receives some bytes of the operations stream; `None` at its end.
    pub async fn read(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, String> {
        self.recv.read(buffer).await.map_err(|e| e.to_string())
    }

    /// Sends a datagram, or skips it and counts where the buffer is full, the rate cap reached or
    /// the path too narrow. `false` when skipped.
    pub fn send_datagram(&mut self, bytes: Vec<u8>) -> bool {
        let fits = self.quic.datagram_send_buffer_space() >= bytes.len()
            && self.cap.take(bytes.len(), Instant::now());
        let sent = fits && self.quic.send_datagram(bytes.into()).is_ok();
        self.skipped += u64::from(!sent);
        sent
    }

    /// Whether the receive cap allows a datagram of `len` bytes now. Otherwise it is counted and must be
    /// dropped.
    pub(crate) fn accepts(&mut self, len: usize) -> bool {
        let taken = self.receiving.take(len, Instant::now());
        self.refused += u64::from(!taken);
        taken
    }

    /// The next datagram, without a rate cap. The drivers of sessions apply the cap.
    pub async fn read_datagram(&self) -> Result<Vec<u8>, String> {
        self.quic
            .read_datagram()
            .await
            .map(Vec::from)
            .map_err(|e| describe_connection_error(&e))
    }

    /// Moves the connection to another socket of this host, after a change of network. The other side
    /// follows. A server's connections have no socket of their own.
    pub fn rebind(&self) -> Result<(), TransportError> {
        let Some(endpoint) = &self.endpoint else {
            return Ok(());
        };
        let socket = socket_towards(self.quic.remote_address())?;
        let address = socket.local_addr().unwrap_or(self.quic.remote_address());
        endpoint
            .rebind(socket)
            .map_err(|source| TransportError::Bind { address, source })
    }

    /// A second handle of the same connection, for receiving datagrams while the stream is used.
    pub(crate) fn quic(&self) -> quinn::Connection {
        self.quic.clone()
    }

    /// Its statistics.
    pub fn stats(&self) -> PathStats {
        let all = self.quic.stats();
        let path = all.path;
        PathStats {
            rtt: path.rtt,
            sent_packets: path.sent_packets,
            lost_packets: path.lost_packets,
            sent_bytes: all.udp_tx.bytes,
            received_bytes: all.udp_rx.bytes,
            skipped_datagrams: self.skipped,
            refused_datagrams: self.refused,
        }
    }

    /// Closes with a reason for people, after the written bytes have arrived (or half a second has
    /// passed).
    pub async fn close(self, reason: &str) {
        self.end(reason, 0).await;
    }

    /// The same, with the code that this side does not reconnect.
    pub(crate) async fn close_for_good(self, reason: &str) {
        self.end(reason, GOODBYE).await;
    }

    async fn end(mut self, reason: &str, code: u32) {
        if self.send.finish().is_ok() {
            let arrived = self.send.stopped();
            // The peer may be gone; then no acknowledgement arrives.
            let _ = tokio::time::timeout(Duration::from_millis(500), arrived).await;
        }
        let mut end = reason.len().min(REASON_MAX_BYTES);
        while !reason.is_char_boundary(end) {
            end -= 1;
        }
        self.quic
            .close(VarInt::from_u32(code), &reason.as_bytes()[..end]);
        if let Some(endpoint) = self.endpoint.take() {
            let _ = tokio::time::timeout(Duration::from_millis(500), endpoint.wait_idle()).await;
        }
    }
}
