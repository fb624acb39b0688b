//! Fairness: two sessions at the rate cap and a bulk flow share a narrow path.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "support/relay.rs"]
mod relay;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use palpate_protocol::{Grant, JoinLink, Role};
use palpate_transport::{Connection, ModelSource, Server, ServerIdentity, connect};
use quinn::Endpoint;
use relay::{Relay, Way};
use rustls::pki_types::{CertificateDer, PrivatePkcs8KeyDer};

const ANY_PORT: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// 10 Mbit/s, in bytes per second.
const BOTTLENECK: f64 = 1_250_000.0;

/// Bytes that wait before the bottleneck; further ones are dropped (tail drop).
const QUEUE: f64 = 64.0 * 1024.0;

/// One-way delay of the path without its queue.
const DELAY: Duration = Duration::from_millis(20);

/// How long the shares are counted, after all flows have reached a steady state.
const COUNTED: Duration = Duration::from_secs(9);
const SETTLING: Duration = Duration::from_secs(3);

/// Counts the bytes of everything that arrives.
#[derive(Clone, Default)]
struct Count(Arc<AtomicU64>);

impl Count {
    fn add(&self, bytes: usize) {
        self.0.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    fn take(&self) -> f64 {
        self.0.swap(0, Ordering::Relaxed) as f64
    }
}

/// Sends the largest datagrams at the rate cap, for ever.
async fn press(mut connection: Connection) {
    loop {
        while connection.send_datagram(vec![7; 1100]) {}
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

async fn count_datagrams(connection: Connection, count: Count) {
    while let Ok(bytes) = connection.read_datagram().await {
        count.add(bytes.len());
    }
}

/// Two sessions over one path; bytes that arrive at their clients are counted.
async fn sessions(server: &Server, link: &JoinLink, counts: &[Count; 2]) {
    for count in counts {
        let mut client = connect(link).await.unwrap();
        // A stream becomes visible to the other side with its first byte.
        client.write(&[0]).await.unwrap();
        let mut served = server.accept().await.unwrap();
        served.admit();
        tokio::spawn(press(served));
        tokio::spawn(count_datagrams(client, count.clone()));
    }
}

/// quinn with its default Cubic: a sender of an endless stream, and its address.
fn bulk_sender() -> (Endpoint, CertificateDer<'static>) {
    let made = rcgen::generate_simple_self_signed(["bulk".to_owned()]).unwrap();
    let certificate = made.cert.der().clone();
    let key = PrivatePkcs8KeyDer::from(made.signing_key.serialize_der());
    let config =
        quinn::ServerConfig::with_single_cert(vec![certificate.clone()], key.into()).unwrap();
    let endpoint = Endpoint::server(config, ANY_PORT).unwrap();
    let listener = endpoint.clone();
    tokio::spawn(async move {
        while let Some(incoming) = listener.accept().await {
            let connection = incoming.await.unwrap();
            tokio::spawn(async move {
                let mut stream = connection.open_uni().await.unwrap();
                while stream.write_all(&[1; 16 * 1024]).await.is_ok() {}
            });
        }
    });
    (endpoint, certificate)
}

async fn bulk(address: SocketAddr, certificate: CertificateDer<'static>, count: Count) {
    let mut roots = rustls::RootCertStore::empty();
    roots.add(certificate).unwrap();
    let config = quinn::ClientConfig::with_root_certificates(Arc::new(roots)).unwrap();
    let endpoint = Endpoint::client(ANY_PORT).unwrap();
    let connection = endpoint
        .connect_with(config, address, "bulk")
        .unwrap()
        .await
        .unwrap();
    let mut stream = connection.accept_uni().await.unwrap();
    let mut buffer = vec![0; 64 * 1024];
    while let Ok(Some(n)) = stream.read(&mut buffer).await {
        count.add(n);
    }
}

/// The shares of the bottleneck: bulk, first session, second session.
async fn shares(bulk_first: bool) -> [f64; 3] {
    let identity = ServerIdentity::generate().unwrap();
    let models: ModelSource = Arc::new(|_, _, _| None);
    let server = Server::bind(ANY_PORT, &identity, models).unwrap();
    let (bulk_endpoint, certificate) = bulk_sender();
    let narrow = Way {
        bottleneck: Some((BOTTLENECK, QUEUE)),
        ..Way::delayed(DELAY)
    };
    let others = [server.local_addr(), bulk_endpoint.local_addr().unwrap()];
    let path = Relay::start(&others, narrow);
    let link = JoinLink {
        host: "127.0.0.1".to_owned(),
        port: path.addresses()[0].port(),
        role: Role::Trainee,
        certificate: identity.certificate_hash(),
        grant: Grant([9; 16]),
    };
    let (of_bulk, of_sessions) = (Count::default(), [Count::default(), Count::default()]);
    let start_bulk = || {
        let to = path.addresses()[1];
        tokio::spawn(bulk(to, certificate.clone(), of_bulk.clone()));
    };
    if bulk_first {
        start_bulk();
        tokio::time::sleep(SETTLING).await;
    }
    sessions(&server, &link, &of_sessions).await;
    if !bulk_first {
        tokio::time::sleep(SETTLING).await;
        start_bulk();
    }
    tokio::time::sleep(SETTLING).await;
    let all = [&of_bulk, &of_sessions[0], &of_sessions[1]];
    for count in all {
        count.take();
    }
    let start = std::time::Instant::now();
    tokio::time::sleep(COUNTED).await;
    let could = BOTTLENECK * start.elapsed().as_secs_f64();
    all.map(|count| count.take() / could)
}

/// Measurements of the shares. Other load on the machine takes packets from a flow; it does not give it any.
const ATTEMPTS: usize = 3;

async fn fair(bulk_first: bool) {
    for attempt in 1.. {
        let [bulk, first, second] = shares(bulk_first).await;
        println!("bulk {bulk:.3}, sessions {first:.3} and {second:.3}");
        // A session keeps 100 kbit/s of 10 Mbit/s.
        let is_fair = bulk >= 0.35 && first >= 0.01 && second >= 0.01;
        if is_fair {
            break;
        }
        assert!(
            attempt < ATTEMPTS,
            "the bulk flow keeps {bulk:.3}, the sessions {first:.4} and {second:.4}"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn later_bulk_flow_gets_a_third_of_the_bottleneck() {
    fair(false).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn later_sessions_leave_a_third_to_the_bulk_flow() {
    fair(true).await;
}
