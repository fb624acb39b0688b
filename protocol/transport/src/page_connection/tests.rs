//! Laws of WebTransport sessions, with a client that stands for a browser.

use std::net::SocketAddr;

use quinn::crypto::rustls::QuicClientConfig;
use quinn::{ClientConfig, Connection, Endpoint};
use web_transport_proto::Http3CapsuleReader;
use web_transport_proto::http::HeaderValue;

use super::*;
use crate::config::{self, ALPN_PAGE};
use crate::{Server, ServerIdentity, TransportError, connect};

const ANYWHERE: &str = "127.0.0.1:0";

fn host() -> (Server, PageDoor, ServerIdentity) {
    let identity = ServerIdentity::generate().unwrap();
    let names = vec!["localhost".to_owned()];
    let models = Arc::new(|_, _, _| None);
    let (server, door) =
        Server::bind_with_pages(ANYWHERE.parse().unwrap(), &identity, models, names).unwrap();
    (server, door, identity)
}

/// A browser with a WebTransport session that is requested, but not yet accepted.
struct Browser {
    quic: Connection,
    connect: (SendStream, RecvStream),
    _control: (SendStream, RecvStream),
    _endpoint: Endpoint,
}

impl Browser {
    /// Connects, trusting one certificate.
    async fn connect(port: u16, pinned: CertificateHash) -> Result<(Connection, Endpoint), String> {
        let mut tls = rustls::ClientConfig::builder_with_provider(config::provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .dangerous()
            .with_custom_certificate_verifier(config::pinned(pinned))
            .with_no_client_auth();
        tls.alpn_protocols = vec![ALPN_PAGE.to_vec()];
        let tls = QuicClientConfig::try_from(tls).unwrap();
        let config = ClientConfig::new(Arc::new(tls));
        let endpoint = Endpoint::client(ANYWHERE.parse().unwrap()).unwrap();
        let address = SocketAddr::from(([127, 0, 0, 1], port));
        let connecting = endpoint
            .connect_with(config, address, "localhost")
            .map_err(|e| e.to_string())?;
        let quic = connecting.await.map_err(|e| e.to_string())?;
        Ok((quic, endpoint))
    }

    async fn request(door: &PageDoor, origin: &str) -> Self {
        let endpoint = door.endpoint();
        let (quic, client) = Self::connect(endpoint.port(), endpoint.certificate_hash())
            .await
            .unwrap();
        let mut control_send = quic.open_uni().await.unwrap();
        let mut settings = Settings::default();
        settings.enable_webtransport(1);
        settings.write(&mut control_send).await.unwrap();
        let mut control_recv = quic.accept_uni().await.unwrap();
        let settings = Settings::read(&mut control_recv).await.unwrap();
        assert!(settings.supports_webtransport() > 0);
        let (mut send, recv) = quic.open_bi().await.unwrap();
        let url = format!("https://localhost:{}/session", endpoint.port());
        let request = ConnectRequest::new(url.parse::<url::Url>().unwrap())
            .with_header(ORIGIN, HeaderValue::from_str(origin).unwrap());
        request.write(&mut send).await.unwrap();
        Self {
            quic,
            connect: (send, recv),
            _control: (control_send, control_recv),
            _endpoint: client,
        }
    }

    /// Awaits the answer and opens the page's stream.
    async fn open(&mut self) -> (SendStream, RecvStream) {
        let answer = ConnectResponse::read(&mut self.connect.1).await.unwrap();
        assert_eq!(answer.status, StatusCode::OK);
        let (mut send, recv) = self.quic.open_bi().await.unwrap();
        let mut head = Vec::new();
        Frame::WEBTRANSPORT.encode(&mut head);
        Number::from_u32(0).encode(&mut head);
        send.write_all(&head).await.unwrap();
        (send, recv)
    }
}

/// A session, from both ends.
async fn session(
    door: &mut PageDoor,
) -> (
    (PageSender, PageReceiver),
    Browser,
    (SendStream, RecvStream),
) {
    let mut browser = Browser::request(door, "http://localhost:1").await;
    let attempt = door.accept().await.unwrap();
    assert_eq!(attempt.origin().as_deref(), Some("http://localhost:1"));
    assert_eq!((attempt.host(), attempt.path()), ("localhost", "/session"));
    let (page, streams) = tokio::join!(attempt.accept(), browser.open());
    (page.unwrap(), browser, streams)
}

#[tokio::test]
async fn browsers_get_a_certificate_of_their_own_and_programs_the_identity() {
    let (server, door, identity) = host();
    let endpoint = door.endpoint();
    let of_pages = endpoint.certificate_hash();
    assert_ne!(of_pages, identity.certificate_hash());
    Browser::connect(endpoint.port(), of_pages).await.unwrap();
    Browser::connect(endpoint.port(), identity.certificate_hash())
        .await
        .unwrap_err();
    let link = |certificate| palpate_protocol::JoinLink {
        host: "127.0.0.1".to_owned(),
        port: endpoint.port(),
        role: palpate_protocol::Role::Spectator,
        certificate,
        grant: palpate_protocol::Grant([0; 16]),
    };
    connect(&link(identity.certificate_hash())).await.unwrap();
    let error = connect(&link(of_pages)).await.err().unwrap();
    assert!(matches!(error, TransportError::WrongCertificate { .. }));
    drop(server);
}

#[tokio::test]
async fn server_without_pages_serves_no_browser() {
    let identity = ServerIdentity::generate().unwrap();
    let models = Arc::new(|_, _, _| None);
    let server = Server::bind(ANYWHERE.parse().unwrap(), &identity, models).unwrap();
    let port = server.local_addr().port();
    let found = Browser::connect(port, identity.certificate_hash()).await;
    assert!(found.is_err());
}

#[tokio::test]
async fn stream_datagrams_and_shapes_arrive() {
    let (_server, mut door, _identity) = host();
    let ((mut sender, mut receiver), browser, (mut send, mut recv)) = session(&mut door).await;
    send.write_all(b"hello").await.unwrap();
    let Some(PageBytes::Stream(bytes)) = receiver.receive().await else {
        panic!("no bytes of the stream");
    };
    assert_eq!(bytes, b"hello");
    browser.quic.send_datagram(vec![0, 16, 1].into()).unwrap();
    let Some(PageBytes::Datagram(bytes)) = receiver.receive().await else {
        panic!("no datagram");
    };
    assert_eq!(bytes, [16, 1]);

    assert!(sender.send(b"state").await);
    let mut buffer = [0; 5];
    recv.read_exact(&mut buffer).await.unwrap();
    assert_eq!(&buffer, b"state");
    assert!(sender.datagram_max() > 1000);
    sender.send_datagram(&[3, 4]);
    assert_eq!(browser.quic.read_datagram().await.unwrap()[..], [0, 3, 4]);

    let shape = sender.send_apart(vec![2; 10_000]);
    let mut stream = browser.quic.accept_uni().await.unwrap();
    let bytes = stream.read_to_end(20_000).await.unwrap();
    assert_eq!((&bytes[..3], bytes.len()), (&[0x40, 0x54, 0][..], 10_003));
    while !shape.is_done() {
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn shape_that_is_given_up_is_reset() {
    let (_server, mut door, _identity) = host();
    let ((sender, _receiver), browser, _streams) = session(&mut door).await;
    // More than the windows of sender and receiver hold.
    let shape = sender.send_apart(vec![2; 4 << 20]);
    let mut stream = browser.quic.accept_uni().await.unwrap();
    let mut first = [0; 3];
    stream.read_exact(&mut first).await.unwrap();
    assert!(!shape.is_done());
    shape.reset();
    let end = stream.read_to_end(8 << 20).await;
    assert!(end.is_err(), "a shape that was given up arrived whole");
}

#[tokio::test]
async fn close_hands_code_and_sentence_to_the_page() {
    let (_server, mut door, _identity) = host();
    let ((sender, _receiver), browser, _streams) = session(&mut door).await;
    let closing = tokio::spawn(sender.close(1008, "a second hello"));
    let mut capsules = Http3CapsuleReader::new(browser.connect.1);
    let Ok(Some(Capsule::CloseWebTransportSession { code, reason })) = capsules.read().await else {
        panic!("no close");
    };
    assert_eq!((code, reason.as_str()), (1008, "a second hello"));
    closing.await.unwrap();
}

#[tokio::test]
async fn refused_browser_gets_the_status() {
    let (_server, mut door, _identity) = host();
    let mut browser = Browser::request(&door, "http://evil.example").await;
    let attempt = door.accept().await.unwrap();
    let refusing = tokio::spawn(attempt.refuse(403));
    let mut answer = ConnectResponse::read(&mut browser.connect.1).await;
    let text = format!("{:?}", answer.as_mut().unwrap_err());
    assert!(text.contains("403"), "{text}");
    refusing.await.unwrap();
}

#[tokio::test]
async fn page_that_ends_its_session_is_gone() {
    let (_server, mut door, _identity) = host();
    let ((_sender, mut receiver), mut browser, _streams) = session(&mut door).await;
    browser.connect.0.finish().unwrap();
    assert!(receiver.receive().await.is_none());
}

#[tokio::test]
async fn browser_without_a_hello_loses_its_slot_and_one_with_a_hello_keeps_it() {
    let (server, mut door, _identity) = host();
    let ((_sender, mut silent), _quiet, _unused) = session(&mut door).await;
    let ((mut greeted, _receiver), _browser, _streams) = session(&mut door).await;
    greeted.handle_hello();
    greeted.admit();
    assert!(silent.receive().await.is_none(), "closed by the server");
    let state = greeted.http.quic.close_reason();
    assert!(state.is_none(), "{state:?}");
    drop(server);
}
