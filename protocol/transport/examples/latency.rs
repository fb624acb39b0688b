//! One-way latency and bytes of session connections over paths with delay, jitter and loss.
//!
//! ```text
//! cargo run --release -p palpate-transport --example latency -- [--json] [--seconds N] [--seed N]
//! ```
//!
//! Both ends are in this process, so that one clock stamps both; the path between them consists of UDP
//! sockets. Every case sends at its own pace from a thread with absolute deadlines: a timer of the
//! runtime would send late, and its lateness would look like the network's.

#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "printing is its purpose"
)]

#[path = "../tests/support/relay.rs"]
mod relay;

use std::net::{Ipv4Addr, SocketAddr};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_protocol::{Grant, JoinLink, Role};
use palpate_transport::{Connection, ModelSource, PathStats, Server, ServerIdentity, connect};
use relay::{Relay, Way};
use tokio::sync::mpsc;

type Failure = Box<dyn std::error::Error>;

/// The load and path of one case.
struct Case {
    name: &'static str,
    /// Ticks per second, datagrams per tick, and their bytes: down, and up.
    down: (f64, usize, usize),
    up: (f64, usize, usize),
    jitter: Duration,
    loss: f64,
}

/// The design's table with the load in both directions, and a typical session.
const CASES: [Case; 4] = [
    Case {
        name: "250 Hz x 4 x 1100 B, 25 ms, 5 % loss",
        down: (250.0, 4, 1100),
        up: (250.0, 1, 20),
        jitter: Duration::ZERO,
        loss: 0.05,
    },
    Case {
        name: "1 kHz x 48 B, 25 + 0-5 ms, 1 % loss",
        down: (1000.0, 1, 48),
        up: (250.0, 1, 20),
        jitter: Duration::from_millis(5),
        loss: 0.01,
    },
    Case {
        name: "session, 25 ms, no loss",
        down: (250.0, 1, 40),
        up: (250.0, 1, 20),
        jitter: Duration::ZERO,
        loss: 0.0,
    },
    Case {
        name: "session, 25 ms, 5 % loss",
        down: (250.0, 1, 40),
        up: (250.0, 1, 20),
        jitter: Duration::ZERO,
        loss: 0.05,
    },
];

/// One-way delay in every case.
const DELAY: Duration = Duration::from_millis(25);

/// The arrivals of one direction.
#[derive(Default)]
struct Arrived {
    latencies_ms: Vec<f64>,
    sent: usize,
}

impl Arrived {
    fn quantile(&self, q: f64) -> f64 {
        let mut sorted = self.latencies_ms.clone();
        sorted.sort_by(f64::total_cmp);
        let at = (sorted.len() as f64 * q) as usize;
        sorted
            .get(at.min(sorted.len().saturating_sub(1)))
            .copied()
            .unwrap_or(f64::NAN)
    }

    fn delivered(&self) -> f64 {
        self.latencies_ms.len() as f64 / self.sent.max(1) as f64
    }
}

/// A thread that calls at a fixed pace; the receiver ends with it.
fn pace(hz: f64, seconds: f64) -> mpsc::Receiver<()> {
    let (sender, receiver) = mpsc::channel(64);
    std::thread::spawn(move || {
        let start = Instant::now();
        for tick in 0..(hz * seconds) as u64 {
            let due = start + Duration::from_secs_f64(tick as f64 / hz);
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
            if sender.blocking_send(()).is_err() {
                return;
            }
        }
    });
    receiver
}

/// Sends at the pace of `load` and receives until one second after the last datagram.
async fn run(
    mut connection: Connection,
    (hz, per_tick, bytes): (f64, usize, usize),
    epoch: Instant,
    seconds: f64,
) -> (usize, Vec<f64>, PathStats, PathStats) {
    let before = connection.stats();
    let mut ticks = pace(hz, seconds);
    let (mut sent, mut latencies) = (0, Vec::new());
    let mut at_end = None;
    let end = epoch + Duration::from_secs_f64(seconds + 1.0);
    loop {
        tokio::select! {
            tick = ticks.recv(), if at_end.is_none() => match tick {
                Some(()) => for _ in 0..per_tick {
                    let mut datagram = vec![0; bytes];
                    let now = epoch.elapsed().as_micros() as u64;
                    datagram[..8].copy_from_slice(&now.to_le_bytes());
                    connection.send_datagram(datagram);
                    sent += 1;
                },
                None => at_end = Some(connection.stats()),
            },
            datagram = connection.read_datagram() => {
                let Ok(datagram) = datagram else { break };
                let mut stamp = [0; 8];
                stamp.copy_from_slice(&datagram[..8]);
                let now = epoch.elapsed().as_micros() as u64;
                latencies.push((now - u64::from_le_bytes(stamp)) as f64 / 1e3);
            }
            () = tokio::time::sleep_until(end.into()) => break,
        }
    }
    let at_end = at_end.unwrap_or_else(|| connection.stats());
    (sent, latencies, before, at_end)
}

async fn measure(case: &Case, seconds: f64, seed: u64, json: bool) -> Result<(), Failure> {
    let identity = ServerIdentity::generate()?;
    let models: ModelSource = Arc::new(|_, _, _| None);
    let any_port: SocketAddr = (Ipv4Addr::LOCALHOST, 0).into();
    let server = Server::bind(any_port, &identity, models)?;
    let way = Way {
        jitter: case.jitter,
        loss: case.loss,
        seed,
        ..Way::delayed(DELAY)
    };
    let path = Relay::start(&[server.local_addr()], way);
    let link = JoinLink {
        host: "127.0.0.1".to_owned(),
        port: path.addresses()[0].port(),
        role: Role::Trainee,
        certificate: identity.certificate_hash(),
        grant: Grant([0; 16]),
    };
    let mut client = connect(&link).await?;
    client.write(&[0]).await?;
    let mut served = server.accept().await.ok_or("the server closed")?;
    served.admit();
    // The handshake's own packets are not the session's.
    tokio::time::sleep(Duration::from_millis(500)).await;
    let epoch = Instant::now();
    let down = tokio::spawn(run(served, case.down, epoch, seconds));
    let (sent_up, got_down, before_up, after_up) = run(client, case.up, epoch, seconds).await;
    let (sent_down, got_up, before_down, after_down) = down.await?;
    let rate = |before: PathStats, after: PathStats| {
        (after.sent_bytes - before.sent_bytes) as f64 * 8.0 / 1e3 / seconds
    };
    let (up_kbps, down_kbps) = (rate(before_up, after_up), rate(before_down, after_down));
    let packets = |before: PathStats, after: PathStats| {
        (after.sent_packets - before.sent_packets) as f64 / seconds
    };
    let skipped = after_down.skipped_datagrams;
    let (up_pps, down_pps) = (
        packets(before_up, after_up),
        packets(before_down, after_down),
    );
    let arrived = |sent, latencies_ms| Arrived { latencies_ms, sent };
    let (down, up) = (arrived(sent_down, got_down), arrived(sent_up, got_up));
    let [p50, p99] = [0.5, 0.99].map(|q| down.quantile(q));
    let (delivered, up_p99) = (down.delivered(), up.quantile(0.99));
    let name = case.name;
    if json {
        println!(
            "{{\"case\":\"{name}\",\"seed\":{seed},\"p50_ms\":{p50:.2},\"p99_ms\":{p99:.2},\
             \"delivered\":{delivered:.4},\"skipped\":{skipped},\"up_p99_ms\":{up_p99:.2},\
             \"up_delivered\":{:.4},\"up_kbit_per_s\":{up_kbps:.1},\"down_kbit_per_s\":{down_kbps:.1},\
             \"up_packets_per_s\":{up_pps:.1},\"down_packets_per_s\":{down_pps:.1}}}",
            up.delivered()
        );
    } else {
        println!("{name}");
        println!("  down: p50 {p50:.1} ms, p99 {p99:.1} ms, {delivered:.3} delivered");
        println!(
            "  up:   p99 {up_p99:.1} ms, {:.3} delivered",
            up.delivered()
        );
        println!("  UDP payload: {up_kbps:.1} kbit/s up, {down_kbps:.1} kbit/s down");
        println!("  packets: {up_pps:.1} a second up, {down_pps:.1} down; {skipped} skipped");
    }
    server.close("measured").await;
    Ok(())
}

/// `--json`, `--seconds`, `--seed`.
fn arguments() -> Result<(bool, f64, u64), Failure> {
    let (mut json, mut seconds, mut seed) = (false, 10.0, 1);
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let mut value = || {
            words
                .next()
                .ok_or(format!("{word} needs a number behind it"))
        };
        match word.as_str() {
            "--json" => json = true,
            "--seconds" => {
                seconds = value()?.parse()?;
                if !(1.0..=600.0).contains(&seconds) {
                    return Err(format!("--seconds is 1 to 600, not {seconds}").into());
                }
            }
            "--seed" => seed = value()?.parse()?,
            other => {
                return Err(
                    format!("unknown: {other}; there are --json, --seconds N, --seed N").into(),
                );
            }
        }
    }
    Ok((json, seconds, seed))
}

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> ExitCode {
    let outcome = async {
        let (json, seconds, seed) = arguments()?;
        for case in &CASES {
            measure(case, seconds, seed, json).await?;
        }
        Ok::<(), Failure>(())
    };
    match outcome.await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("latency: {error}");
            ExitCode::FAILURE
        }
    }
}
