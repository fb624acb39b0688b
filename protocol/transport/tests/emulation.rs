//! An emulated network is measured like a real one, over real quinn.
#![allow(clippy::unwrap_used)]

#[path = "support/session.rs"]
mod session;

use std::time::{Duration, Instant};

use palpate_protocol::compensation::{DelayEstimator, GroupDelay};
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_protocol::request::RequestKind;
use palpate_protocol::session::{ClientEvent, CloseReason, PeerEvent};
use palpate_protocol::{Emulation, LocalSample, ParticipantId, Pose, Span};
use palpate_transport::{ClientCommand, ClientHandle, PeerInput};
use session::{
    PATIENCE, admit, client_clock, next_event, next_input, operation, serve, server_clock,
};
use tokio::sync::mpsc;

/// The emulated one-way delay, ms.
const DELAY_MS: u16 = 100;

/// A loaded machine may add this to a round trip, ms.
const TOLERANCE_MS: f64 = 60.0;

fn emulation(delay_ms: u16, loss_permille: u16) -> Emulation {
    Emulation {
        delay_ms,
        loss_permille,
    }
}

/// Sends motion of the client's tool until the client ends.
fn keep_moving(client: &ClientHandle, since: Instant) {
    let (commands, clock) = (client.commands.clone(), client_clock(since));
    tokio::spawn(async move {
        loop {
            let now = clock();
            let x = (now.as_micros() as f64 * 1e-6).sin() * 0.01;
            let sample = |age_ms: i64| LocalSample {
                time: now - Span::from_millis(age_ms),
                pose: Pose {
                    position_m: [x, 0.0, 0.0],
                    ..Pose::IDENTITY
                },
                ..LocalSample::default()
            };
            let samples = [3, 2, 1, 0].map(sample).to_vec();
            if commands.send(ClientCommand::Motion(samples)).await.is_err() {
                return;
            }
            tokio::time::sleep(Duration::from_millis(4)).await;
        }
    });
}

/// The server's measurements: its playout delay, and the newest round trip of the client.
struct Measured {
    estimator: DelayEstimator,
    group: GroupDelay,
    delay: Span,
    round_trip: Option<Span>,
}

impl Measured {
    async fn handle_next(&mut self, inbox: &mut mpsc::Receiver<PeerInput>, since: Instant) {
        let PeerEvent::Motion(motion) = next_input(inbox).await.event else {
            return;
        };
        self.round_trip = motion.round_trip;
        self.estimator.handle_arrival(motion.arrival().unwrap());
        if let Some(report) = self.estimator.report() {
            self.group.handle_report(ParticipantId::SERVER, report);
        }
        let now = server_clock(since)();
        if let Some(change) = self.group.poll_change(now, self.group.lead()) {
            self.delay = Span::from_micros(change.delay_us.into());
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn round_trips_grow_by_both_ways_and_the_playout_delay_follows() {
    let (server, link) = serve();
    let (sender, mut inbox) = mpsc::channel(4096);
    let since = Instant::now();
    let (peer, mut client) = admit(&server, &link, 1, &(sender, since), &mut inbox).await;
    tokio::spawn(async move { while client.events.recv().await.is_some() {} });
    let stats = client.stats.clone();
    let settings = CompensationSettings {
        mode: CompensationMode::Adaptive { cap_us: 400_000 },
        initial_delay_us: 10_000,
    };
    let mut measured = Measured {
        estimator: DelayEstimator::default(),
        group: GroupDelay::new(&settings),
        delay: Span::from_millis(10),
        round_trip: None,
    };
    let client = ClientHandle {
        events: mpsc::channel(1).1,
        ..client
    };
    keep_moving(&client, since);
    let rtt_ms = || stats.borrow().link.rtt.map_or(0.0, Span::as_millis_f64);
    while measured.round_trip.is_none() || rtt_ms() == 0.0 {
        measured.handle_next(&mut inbox, since).await;
    }
    let (near_ms, both_ways_ms) = (rtt_ms(), 2.0 * f64::from(DELAY_MS));
    assert!(near_ms < TOLERANCE_MS, "{near_ms} ms without emulation");
    let transport_ms = peer.stats().path.rtt.as_secs_f64() * 1e3;

    peer.emulate(emulation(DELAY_MS, 0));
    let is_long = |trip: Option<Span>| trip.map_or(0.0, Span::as_millis_f64) >= both_ways_ms;
    let follows = |delay: Span| delay >= Span::from_millis(DELAY_MS.into());
    while rtt_ms() < both_ways_ms || !is_long(measured.round_trip) || !follows(measured.delay) {
        measured.handle_next(&mut inbox, since).await;
    }
    let far_ms = rtt_ms();
    assert!(
        far_ms <= near_ms + both_ways_ms + TOLERANCE_MS,
        "{far_ms} ms"
    );
    let most = Span::from_millis(i64::from(DELAY_MS) + TOLERANCE_MS as i64);
    assert!(
        measured.delay <= most,
        "D is {} ms",
        measured.delay.as_millis_f64()
    );
    let shown_ms = peer.stats().path.rtt.as_secs_f64() * 1e3;
    assert!(
        shown_ms >= both_ways_ms + 0.5 * transport_ms,
        "{shown_ms} ms"
    );

    peer.emulate(Emulation::NONE);
    while rtt_ms() >= both_ways_ms {
        measured.handle_next(&mut inbox, since).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn emulated_loss_is_measured_at_both_ends() {
    let (server, link) = serve();
    let (sender, mut inbox) = mpsc::channel(4096);
    let since = Instant::now();
    let (peer, client) = admit(&server, &link, 1, &(sender, since), &mut inbox).await;
    peer.emulate(emulation(5, 200));
    keep_moving(&client, since);
    while peer.stats().link.expected < 1500 {
        next_input(&mut inbox).await;
    }
    let stats = peer.stats();
    let loss = stats.link.loss_in();
    assert!((0.14..0.26).contains(&loss), "uplink {loss}");
    assert!(stats.path.lost_packets > 0 && stats.path.sent_packets > stats.path.lost_packets);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn operations_and_requests_pass_a_bad_network_in_order() {
    let (server, link) = serve();
    let (sender, mut inbox) = mpsc::channel(4096);
    let since = Instant::now();
    let (peer, mut client) = admit(&server, &link, 1, &(sender, since), &mut inbox).await;
    peer.emulate(emulation(30, 300));
    for id in 0..200 {
        assert!(peer.send(operation(id)));
        if id == 100 {
            peer.emulate(emulation(5, 300));
        }
    }
    let mut next = 0;
    while next < 200 {
        if let ClientEvent::Operation(operation) = next_event(&mut client).await {
            assert_eq!(operation.id.0, next);
            next += 1;
        }
    }
    // The farewell may still be on its way when the connection ends.
    let leave = ClientCommand::Request(RequestKind::Leave);
    client.commands.send(leave).await.unwrap();
    let closed = tokio::time::timeout(PATIENCE, async {
        loop {
            if let PeerEvent::Closed(reason) = next_input(&mut inbox).await.event {
                return reason;
            }
        }
    });
    assert_eq!(closed.await.unwrap(), CloseReason::Left);
}
