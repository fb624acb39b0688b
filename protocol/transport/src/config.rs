//! The settings of quinn, measured for this traffic: its defaults would delay motion by a second.

use std::sync::Arc;
use std::time::Duration;

use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{
    AckFrequencyConfig, ClientConfig, EndpointConfig, IdleTimeout, ServerConfig, TransportConfig,
    VarInt,
};
use quinn_proto::RandomConnectionIdGenerator;
use rustls::crypto::CryptoProvider;
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;

use crate::TransportError;
use crate::certificate::ShortLived;
use crate::controller::FloorConfig;
use crate::identity::{Pinned, ServerIdentity};

/// The ALPN of a session's connection.
pub(crate) const ALPN_SESSION: &[u8] = b"palpate/1";

/// The ALPN of a model transfer's connection.
pub(crate) const ALPN_BULK: &[u8] = b"palpate-bulk/1";

/// The ALPN of a browser's connection: HTTP/3, for WebTransport.
pub(crate) const ALPN_PAGE: &[u8] = b"h3";

/// One-way streams that a browser opens: HTTP/3 control, QPACK encoder and decoder.
const BROWSER_UNI_STREAMS: u32 = 3;

/// Datagrams waiting inside quinn, bytes: 14 of the largest. A longer queue is only delay.
const DATAGRAM_SEND_BUFFER: usize = 16 * 1024;

/// Datagrams that arrived at a client and were not read, bytes; the oldest are dropped beyond.
const DATAGRAM_RECEIVE_BUFFER: usize = 256 * 1024;

/// ... and at the server, for each client: two seconds of motion, 250 datagrams of 50 B a second with
/// quinn's 32 B for each. Older samples are useless.
const SERVER_DATAGRAM_RECEIVE_BUFFER: usize = 32 * 1024;

/// The idle timeout of a connection. The sessions notice silence much sooner. The timeout must outlast a
/// handshake that loses several packets in a row with doubling waits (at 3 s, sessions over a path with
/// 20 % loss often failed to start).
const IDLE: Duration = Duration::from_secs(8);

/// The longest time without a packet, so that silence is detected.
const KEEP_ALIVE: Duration = Duration::from_millis(500);

/// Incoming attempts that wait for the server's decision; quinn drops more.
const INCOMING_MAX: usize = 1024;

/// Bytes of further packets of such an attempt, and of all of them. The decision takes microseconds; the
/// client repeats a lost packet.
const INCOMING_BYTES_MAX: u64 = 4 * 1024;
const INCOMING_BYTES_TOTAL_MAX: u64 = 1024 * 1024;

/// A packet counts as lost after this many later arrivals. The default of 3 mistakes jitter for loss.
const PACKET_THRESHOLD: u32 = 64;

/// ... or after this many round trips. The default is 1.125.
const TIME_THRESHOLD: f32 = 1.5;

/// Packets that may arrive before an acknowledgement goes out alone; the time for it, 25 ms, is not changed.
const ACKNOWLEDGED_BEYOND: u32 = 12;

/// Bytes of one stream that may arrive unread at a client, and that it may send ahead: the largest frame
/// many times over.
const STREAM_WINDOW: u32 = 2 * 1024 * 1024;

/// Bytes that a client may send on its streams before it is admitted: its preamble and the longest hello
/// take 4.1 KiB.
const PENDING_WINDOW: u32 = 8 * 1024;

/// ... and afterwards: four of the largest frames.
pub(crate) const ADMITTED_WINDOW: u32 = 256 * 1024;

/// Bytes of the operations stream in flight to one client: 10 Mbit/s over 200 ms.
const SERVER_SEND_WINDOW: u64 = 256 * 1024;

/// ... and of a model: 80 Mbit/s over 100 ms.
pub(crate) const BULK_SEND_WINDOW: u64 = 1024 * 1024;

/// TLS messages that may arrive out of order at the server, bytes; a client's first one has at most 2 KiB.
const SERVER_CRYPTO_BUFFER: usize = 4 * 1024;

/// Length of the connection id in every packet towards a server, bytes; quinn's default is 8. It only
/// finds the connection (the packet's authentication tag proves the sender). An id in use is drawn
/// again, so that there must be many more than can be in use. Of these there are 16 million.
const SERVER_ID_BYTES: usize = 3;

/// ... and towards a client: it has one connection per socket and knows its packets by that.
const CLIENT_ID_BYTES: usize = 0;

pub(crate) fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

pub(crate) fn certificate_error(e: impl std::fmt::Display) -> TransportError {
    TransportError::Certificate(e.to_string())
}

fn session_transport() -> TransportConfig {
    let mut t = TransportConfig::default();
    // Acknowledgements go with the data that is sent every few milliseconds anyway. A packet for each
    // second one that arrives, and for each that overtook another, was a fifth of all packets.
    let mut acknowledge = AckFrequencyConfig::default();
    acknowledge
        .ack_eliciting_threshold(VarInt::from_u32(ACKNOWLEDGED_BEYOND))
        .reordering_threshold(VarInt::from_u32(PACKET_THRESHOLD - 1));
    t.max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(0))
        .stream_receive_window(VarInt::from_u32(STREAM_WINDOW))
        .receive_window(VarInt::from_u32(STREAM_WINDOW))
        .send_window(u64::from(STREAM_WINDOW))
        .max_idle_timeout(Some(idle(IDLE)))
        .keep_alive_interval(Some(KEEP_ALIVE))
        .packet_threshold(PACKET_THRESHOLD)
        .ack_frequency_config(Some(acknowledge))
        .time_threshold(TIME_THRESHOLD)
        // Half of an intercontinental round trip: a lost first packet is sent again after 0.3 s.
        .initial_rtt(Duration::from_millis(100))
        .datagram_send_buffer_size(DATAGRAM_SEND_BUFFER)
        .datagram_receive_buffer_size(Some(DATAGRAM_RECEIVE_BUFFER))
        // MTU probes would only add to the motion packets.
        .mtu_discovery_config(None)
        .enable_segmentation_offload(false)
        .congestion_controller_factory(Arc::new(FloorConfig));
    t
}

/// Bounds what one connection makes the server buffer; see the crate's DECISIONS.md for the sum. `uni_streams` is the
/// number of one-way streams that the other side may open.
fn server_transport(uni_streams: u32) -> TransportConfig {
    let mut t = session_transport();
    t.max_concurrent_uni_streams(VarInt::from_u32(uni_streams));
    // The window of a stream can not be changed later; that of the connection bounds all streams.
    t.stream_receive_window(VarInt::from_u32(ADMITTED_WINDOW))
        .receive_window(VarInt::from_u32(PENDING_WINDOW))
        .send_window(SERVER_SEND_WINDOW)
        .crypto_buffer_size(SERVER_CRYPTO_BUFFER)
        .datagram_receive_buffer_size(Some(SERVER_DATAGRAM_RECEIVE_BUFFER));
    t
}

fn bulk_transport() -> TransportConfig {
    let mut t = TransportConfig::default();
    t.max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(0))
        .initial_rtt(Duration::from_millis(100))
        .max_idle_timeout(Some(idle(2 * IDLE)))
        .keep_alive_interval(Some(2 * KEEP_ALIVE))
        .packet_threshold(PACKET_THRESHOLD)
        .time_threshold(TIME_THRESHOLD)
        .datagram_receive_buffer_size(None);
    t
}

fn idle(d: Duration) -> IdleTimeout {
    IdleTimeout::try_from(d).expect("some seconds fit into a QUIC number")
}

fn endpoint(id_bytes: usize) -> EndpointConfig {
    let mut config = EndpointConfig::default();
    config.cid_generator(move || Box::new(RandomConnectionIdGenerator::new(id_bytes)));
    config
}

/// The endpoint of a server. At 250 packets a second a byte of the connection id is 2 kbit/s.
pub(crate) fn server_endpoint() -> EndpointConfig {
    endpoint(SERVER_ID_BYTES)
}

/// The endpoint of a client, for one connection.
pub(crate) fn client_endpoint() -> EndpointConfig {
    endpoint(CLIENT_ID_BYTES)
}

/// Presents the identity to programs and a certificate of short validity to browsers.
#[derive(Debug)]
struct ByAlpn {
    session: Arc<CertifiedKey>,
    page: Option<Arc<ShortLived>>,
}

impl ResolvesServerCert for ByAlpn {
    fn resolve(&self, hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        let is_page = hello
            .alpn()
            .is_some_and(|mut offered| offered.all(|alpn| alpn == ALPN_PAGE));
        match &self.page {
            Some(page) if is_page => Some(page.key()),
            _ => Some(Arc::clone(&self.session)),
        }
    }
}

/// `page` is the certificate for browsers; without it they are not served.
pub(crate) fn server(
    identity: &ServerIdentity,
    page: Option<Arc<ShortLived>>,
) -> Result<ServerConfig, TransportError> {
    let chain = vec![identity.certificate()];
    let session = CertifiedKey::from_der(chain, identity.key(), &provider());
    let session = Arc::new(session.map_err(certificate_error)?);
    let mut alpn = vec![ALPN_SESSION.to_vec(), ALPN_BULK.to_vec()];
    let mut uni_streams = 0;
    if page.is_some() {
        alpn.push(ALPN_PAGE.to_vec());
        // Browsers reject a lower limit, and the kind of a connection is unknown before its handshake. Bytes that a
        // program sends on such a stream stay unread within the connection's window.
        uni_streams = BROWSER_UNI_STREAMS;
    }
    let mut tls = rustls::ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(certificate_error)?
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(ByAlpn { session, page }));
    tls.alpn_protocols = alpn;
    // Early data can be replayed by an attacker: never for grants.
    tls.max_early_data_size = 0;
    let quic = QuicServerConfig::try_from(tls).map_err(certificate_error)?;
    let mut config = ServerConfig::with_crypto(Arc::new(quic));
    config.transport_config(Arc::new(server_transport(uni_streams)));
    config
        .max_incoming(INCOMING_MAX)
        .incoming_buffer_size(INCOMING_BYTES_MAX)
        .incoming_buffer_size_total(INCOMING_BYTES_TOTAL_MAX);
    // Gateways forget their mappings, and clients change networks.
    config.migration(true);
    Ok(config)
}

/// For both kinds of connection: the server learns the kind only after it has chosen.
pub(crate) fn client(pinned: Arc<Pinned>, alpn: &[u8]) -> Result<ClientConfig, TransportError> {
    let mut tls = rustls::ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(certificate_error)?
        .dangerous()
        .with_custom_certificate_verifier(pinned)
        .with_no_client_auth();
    tls.alpn_protocols = vec![alpn.to_vec()];
    tls.enable_early_data = false;
    let quic = QuicClientConfig::try_from(tls).map_err(certificate_error)?;
    let mut config = ClientConfig::new(Arc::new(quic));
    let transport = if alpn == ALPN_BULK {
        bulk_transport()
    } else {
        session_transport()
    };
    config.transport_config(Arc::new(transport));
    Ok(config)
}

pub(crate) fn pinned(expected: palpate_protocol::CertificateHash) -> Arc<Pinned> {
    Pinned::new(expected, &provider())
}
