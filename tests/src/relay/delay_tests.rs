//! Delays through real sockets follow the requested distribution.
//!
//! A loaded machine delivers late at times and never early. Early packets are judged by Kolmogorov's bound.
//! Late packets are judged against a second relay with a constant delay, which has the same timers, threads and
//! load.

#![allow(clippy::print_stdout)]

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::{Profile, Relay};
use crate::network::{Direction, Jitter, Link, Path};

/// Packets through each relay.
const PACKETS: u64 = 10_000;

/// Critical value of Kolmogorov's statistic times √n at a significance of 0.001.
const KOLMOGOROV: f64 = 1.949;

/// Maximum packets waiting in a socket: the operating system keeps about 250 small ones and drops more.
const WAITING_MAX: u64 = 60;

/// Maximum share of packets later than the slowest hundredth of the constant-delay relay.
const LATER: f64 = 0.1;

const HERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Name, jitter, and its cumulative distribution over ms.
type Law = (&'static str, Jitter, fn(f64) -> f64);

/// A relay of one distribution, its sender and its receiver.
struct Line {
    relay: Relay,
    profile: Profile,
    client: UdpSocket,
    received: Arc<AtomicU64>,
    reader: JoinHandle<Vec<(u64, f64)>>,
}

impl Line {
    fn new(jitter: Jitter, began: Instant) -> Self {
        let link = Link {
            delay_ms: 20.0,
            jitter,
            reorder: true,
            ..Link::default()
        };
        let profile = Profile::both("measured", link);
        let server = UdpSocket::bind(HERE).unwrap();
        server
            .set_read_timeout(Some(Duration::from_secs(30)))
            .unwrap();
        let relay = Relay::start(HERE, server.local_addr().unwrap(), profile.clone(), 6).unwrap();
        let client = UdpSocket::bind(HERE).unwrap();
        client.connect(relay.local_addr()).unwrap();
        let received = Arc::new(AtomicU64::new(0));
        let counter = received.clone();
        let reader = std::thread::spawn(move || {
            let mut all = Vec::new();
            let mut buffer = [0; 16];
            while all.len() < PACKETS as usize && server.recv(&mut buffer).is_ok() {
                let now_us = began.elapsed().as_secs_f64() * 1e6;
                let word = |at: usize| u64::from_le_bytes(buffer[at..at + 8].try_into().unwrap());
                all.push((word(0), (now_us - word(8) as f64) * 1e-3));
                counter.fetch_add(1, Ordering::Relaxed);
            }
            all
        });
        Self {
            relay,
            profile,
            client,
            received,
            reader,
        }
    }

    fn send(&self, n: u64, began: Instant) {
        let mut packet = [0; 16];
        packet[..8].copy_from_slice(&n.to_le_bytes());
        packet[8..].copy_from_slice(&(began.elapsed().as_micros() as u64).to_le_bytes());
        self.client.send(&packet).unwrap();
    }

    /// Whether any socket holds more packets than is safe after `sent` packets.
    fn is_full(&self, sent: u64) -> bool {
        let stats = self.relay.stats();
        let received = self.received.load(Ordering::Relaxed);
        sent - stats.total.sent > WAITING_MAX
            || stats.delivered.saturating_sub(received) > WAITING_MAX
    }

    /// Measured delays, and the lateness of each packet against its fate, ms.
    fn end(self) -> (Vec<f64>, Vec<f64>) {
        let all = self.reader.join().unwrap();
        let mut path = Path::new(&self.profile, 6, 0, Direction::Up);
        // Send times are irrelevant here: the fate of a packet depends on its number.
        let fates: Vec<f64> = (0..PACKETS)
            .map(|n| {
                let arrival = path.send(n * 1_000_000, 16).into_iter().next().unwrap();
                (arrival.at_us - n * 1_000_000) as f64 * 1e-3
            })
            .collect();
        assert_eq!(all.len(), PACKETS as usize);
        all.into_iter()
            .map(|(n, delay_ms)| (delay_ms, delay_ms - fates[n as usize]))
            .unzip()
    }
}

/// Maximum excess of the sample distribution over the law, and of the law over the sample if every packet may
/// be `late_ms` late.
fn early_and_late(sample: &[f64], law: impl Fn(f64) -> f64, late_ms: f64) -> (f64, f64) {
    let mut sorted = sample.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len() as f64;
    let (mut early, mut late) = (0.0_f64, 0.0_f64);
    for (i, x) in sorted.iter().enumerate() {
        early = early.max((i + 1) as f64 / n - law(*x));
        late = late.max(law(x - late_ms) - i as f64 / n);
    }
    (early, late)
}

#[test]
fn delays_through_real_sockets_follow_their_distribution() {
    let began = Instant::now();
    let uniform = Jitter::Uniform { reach_ms: 10.0 };
    // Shape 2 has a closed-form distribution.
    let gamma = Jitter::Gamma {
        mean_ms: 8.0,
        deviation_ms: 8.0 / 2f64.sqrt(),
    };
    let pareto = Jitter::Pareto {
        scale_ms: 4.0,
        exponent: 3.0,
    };
    let laws: [Law; 3] = [
        ("uniform", uniform, |x| ((x - 10.0) / 20.0).clamp(0.0, 1.0)),
        ("gamma", gamma, |x| {
            let z = (x - 20.0).max(0.0) / 4.0;
            1.0 - (-z).exp() * (1.0 + z)
        }),
        ("pareto", pareto, |x| {
            1.0 - (1.0 + (x - 20.0).max(0.0) / 4.0).powi(-3)
        }),
    ];
    let fixed = Line::new(Jitter::None, began);
    let lines = laws.map(|(_, jitter, _)| Line::new(jitter, began));
    for n in 0..PACKETS {
        for line in lines.iter().chain([&fixed]) {
            line.send(n, began);
        }
        std::thread::sleep(Duration::from_micros(400));
        while n % 20 == 0 && lines.iter().chain([&fixed]).any(|l| l.is_full(n + 1)) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    let (_, mut lateness) = fixed.end();
    lateness.sort_by(f64::total_cmp);
    let slow_ms = lateness[lateness.len() * 99 / 100];
    let root = (PACKETS as f64).sqrt();
    for (line, (name, _, law)) in lines.into_iter().zip(laws) {
        let (delays, lateness) = line.end();
        let earliest = lateness.iter().copied().fold(f64::INFINITY, f64::min);
        // Both clocks are the same; the packet is stamped before the relay receives it.
        assert!(earliest > -0.01, "{name}: a packet was {earliest} ms early");
        let (early, late) = early_and_late(&delays, law, slow_ms);
        println!(
            "{name}: too early {:.2} of {KOLMOGOROV}, too late {late:.3} of {LATER}",
            early * root
        );
        assert!(early * root < KOLMOGOROV, "{name}: {early}");
        assert!(late < LATER, "{name}: {late}, allowed {slow_ms} ms");
    }
    // A law shifted by 1 ms is detected on the early side.
    let shifted = |x: f64| ((x - 11.0) / 20.0).clamp(0.0, 1.0);
    let exact: Vec<f64> = (0..1000).map(|i| 10.0 + 0.02 * f64::from(i)).collect();
    assert!(early_and_late(&exact, shifted, 0.0).0 * root > KOLMOGOROV);
}
