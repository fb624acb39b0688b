//! Client and server sessions connected in virtual time over a bad link.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;
use crate::codec;
use crate::handshake::{
    ModelInfo, Preamble, Resume, SNAPSHOT_PIECE_BYTES, SnapshotInfo, Subscription,
};
use crate::operation::{CompensationMode, CompensationSettings, OperationKind};
use crate::request::{RequestKind, ServerMessage};
use crate::timeline::Timeline;
use crate::tool::ToolDescription;
use crate::{
    ClientTime, Epoch, Grant, LocalSample, ModelHash, OperationId, Pose, ResumeToken, Role,
    ServerTime, TopologyHash,
};

const OFFSET_US: i64 = 42_000_000;

#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Cargo {
    Stream(Vec<u8>),
    Datagram(Vec<u8>),
}

/// One direction: a stream that is never lost, datagrams that are.
pub(super) struct Path {
    rng: Pcg64,
    delay_us: i64,
    jitter_us: i64,
    pub(super) loss: f64,
    pub(super) stream_due: i64,
    order: u64,
    /// Datagrams and their bytes, for counting.
    pub(super) datagrams: (u64, u64),
    on_the_way: BinaryHeap<Reverse<(i64, u64, Cargo)>>,
}

impl Path {
    fn send(&mut self, now_us: i64, cargo: Cargo) {
        if let Cargo::Datagram(bytes) = &cargo {
            self.datagrams.0 += 1;
            self.datagrams.1 += bytes.len() as u64;
        }
        let mut due = now_us + self.delay_us + self.rng.random_range(0..=self.jitter_us);
        let lost = self.rng.random_bool(self.loss);
        let doubled = self.rng.random_bool(0.02);
        self.order += 1;
        match cargo {
            Cargo::Stream(bytes) => {
                // A lost packet of a stream is sent again.
                due += if lost { 3 * self.delay_us } else { 0 };
                self.stream_due = self.stream_due.max(due);
                self.on_the_way
                    .push(Reverse((self.stream_due, self.order, Cargo::Stream(bytes))));
            }
            Cargo::Datagram(_) if lost => {}
            Cargo::Datagram(bytes) => {
                if doubled {
                    let copy = Cargo::Datagram(bytes.clone());
                    self.on_the_way
                        .push(Reverse((due + 5000, self.order, copy)));
                }
                self.on_the_way
                    .push(Reverse((due, self.order, Cargo::Datagram(bytes))));
            }
        }
    }

    fn arrived(&mut self, now_us: i64) -> Option<Cargo> {
        let Reverse((due, ..)) = self.on_the_way.peek()?;
        if *due > now_us {
            return None;
        }
        self.on_the_way.pop().map(|Reverse((_, _, cargo))| cargo)
    }
}

/// A client, a server's peer and the link between them. The server's clock is 42 s ahead.
pub(super) struct Pair {
    pub(super) now_us: i64,
    /// The step of the client's clock.
    pub(super) set_us: i64,
    pub(super) client: ClientSession,
    pub(super) server: ServerPeer,
    pub(super) up: Path,
    pub(super) down: Path,
    pub(super) client_events: Vec<ClientEvent>,
    pub(super) server_events: Vec<PeerEvent>,
}

pub(super) fn hello() -> Hello {
    Hello {
        name: "pair".to_owned(),
        role: Role::Trainee,
        grant: Grant([1; 16]),
        tool: Some(ToolDescription::scalpel(0.001, 0.02)),
        subscription: Subscription::Full,
        resume: None,
    }
}

impl Pair {
    pub(super) fn new(seed: u64, delay_us: i64, jitter_us: i64, loss: f64) -> Self {
        let path = |stream| Path {
            rng: Pcg64::new(u128::from(seed), stream),
            delay_us,
            jitter_us,
            loss,
            stream_due: 0,
            order: 0,
            datagrams: (0, 0),
            on_the_way: BinaryHeap::new(),
        };
        Self {
            now_us: 0,
            set_us: 0,
            client: ClientSession::new(hello(), ClientTime::ZERO).unwrap(),
            server: ServerPeer::new(ServerTime::from_micros(OFFSET_US)),
            up: path(1),
            down: path(2),
            client_events: Vec::new(),
            server_events: Vec::new(),
        }
    }

    pub(super) fn client_now(&self) -> ClientTime {
        ClientTime::from_micros(self.now_us + self.set_us)
    }

    pub(super) fn server_now(&self) -> ServerTime {
        ServerTime::from_micros(self.now_us + OFFSET_US)
    }

    /// One millisecond.
    pub(super) fn step(&mut self) {
        self.now_us += 1000;
        let (c, s) = (self.client_now(), self.server_now());
        while let Some(cargo) = self.up.arrived(self.now_us) {
            match cargo {
                Cargo::Stream(bytes) => self.server.handle_stream(&bytes, s),
                Cargo::Datagram(bytes) => self.server.handle_datagram(&bytes, s),
            }
        }
        while let Some(cargo) = self.down.arrived(self.now_us) {
            match cargo {
                Cargo::Stream(bytes) => self.client.handle_stream(&bytes, c),
                Cargo::Datagram(bytes) => self.client.handle_datagram(&bytes, c),
            }
        }
        if self.client.poll_timeout().is_some_and(|t| t <= c) {
            self.client.handle_timeout(c);
        }
        if self.server.poll_timeout().is_some_and(|t| t <= s) {
            self.server.handle_timeout(s);
        }
        while let Some(bytes) = self.client.poll_stream() {
            self.up.send(self.now_us, Cargo::Stream(bytes));
        }
        while let Some(bytes) = self.client.poll_datagram(c) {
            self.up.send(self.now_us, Cargo::Datagram(bytes));
        }
        while let Some(bytes) = self.server.poll_stream() {
            self.down.send(self.now_us, Cargo::Stream(bytes));
        }
        while let Some(bytes) = self.server.poll_datagram(s) {
            self.down.send(self.now_us, Cargo::Datagram(bytes));
        }
        self.client_events
            .extend(std::iter::from_fn(|| self.client.poll_event()));
        self.server_events
            .extend(std::iter::from_fn(|| self.server.poll_event()));
    }

    pub(super) fn steps(&mut self, ms: i64) {
        (0..ms).for_each(|_| self.step());
    }

    pub(super) fn send(&mut self, message: &PeerMessage) {
        self.server.send(message, self.server_now()).unwrap();
    }

    /// Runs until the client has joined, with `log` operations before it.
    pub(super) fn join(&mut self, log: u64) {
        while !matches!(self.server_events.last(), Some(PeerEvent::Hello(_))) {
            self.step();
        }
        let server_time = self.server_now();
        let mut welcome = welcome(0, log);
        welcome.server_time = server_time;
        self.send(&PeerMessage::Welcome(Box::new(welcome)));
        (0..log).for_each(|id| self.send(&operation(id)));
    }
}

/// A welcome to a log of which the operations from `first` up to `log` follow.
pub(super) fn welcome(first: u64, log: u64) -> Welcome {
    Welcome {
        participant: ParticipantId(5),
        epoch: Epoch(2),
        role: Role::Trainee,
        server_time: ServerTime::ZERO,
        model: ModelInfo {
            hash: ModelHash(1),
            bytes: 1,
        },
        roster: Vec::new(),
        topology_version: 0,
        topology_hash: TopologyHash(0),
        first_operation: OperationId(first),
        snapshot: None,
        operations_so_far: log,
        compensation: CompensationSettings {
            mode: CompensationMode::Fixed,
            initial_delay_us: 150_000,
        },
        tick_hz: 250,
        session_started_at: None,
        resume_token: ResumeToken([0; 16]),
    }
}

pub(super) fn operation_at(id: u64) -> Operation {
    Operation {
        id: OperationId(id),
        at: ServerTime::ZERO,
        author: ParticipantId::SERVER,
        topology_version_before: 0,
        topology_version_after: 0,
        hash_after: TopologyHash(0),
        kind: OperationKind::Started {
            at: ServerTime::from_micros(id as i64),
        },
    }
}

pub(super) fn operation(id: u64) -> PeerMessage {
    PeerMessage::Operation(Arc::new(operation_at(id)))
}

fn hand(t_us: i64) -> [f64; 3] {
    let t = t_us as f64 * 1e-6;
    [0.02 * (3.0 * t).sin(), 0.015 * (4.0 * t).cos(), 0.05]
}

#[test]
fn operations_arrive_once_and_in_order_over_any_link() {
    for seed in 0..5 {
        let mut pair = Pair::new(seed, 60_000, 20_000, 0.2);
        pair.join(20);
        for id in 20..60 {
            pair.steps(20);
            pair.send(&operation(id));
        }
        pair.steps(1500);
        let ids: Vec<u64> = pair
            .client_events
            .iter()
            .filter_map(|e| match e {
                ClientEvent::Operation(o) => Some(o.id.0),
                _ => None,
            })
            .collect();
        assert_eq!(ids, (0..60).collect::<Vec<_>>(), "seed {seed}");
        let caught_up = pair
            .client_events
            .iter()
            .filter(|e| **e == ClientEvent::CaughtUp);
        assert_eq!(caught_up.count(), 1);
    }
}

#[test]
fn snapshot_arrives_whole_and_before_the_log() {
    let bytes: Vec<u8> = (0..200_000_u32).map(|i| (i % 251) as u8).collect();
    for log in [0, 20] {
        let mut pair = Pair::new(1, 60_000, 20_000, 0.2);
        let mut welcome = welcome(0, log);
        welcome.snapshot = Some(SnapshotInfo {
            bytes: bytes.len() as u32,
            topology_version: 7,
        });
        pair.steps(300);
        pair.send(&PeerMessage::Welcome(Box::new(welcome)));
        for piece in bytes.chunks(SNAPSHOT_PIECE_BYTES) {
            pair.send(&PeerMessage::Snapshot(piece.into()));
        }
        (0..log).for_each(|id| pair.send(&operation(id)));
        pair.steps(3000);
        let is_of_log = |e: &&ClientEvent| {
            matches!(
                e,
                ClientEvent::Snapshot(_) | ClientEvent::Operation(_) | ClientEvent::CaughtUp
            )
        };
        let events: Vec<&ClientEvent> = pair.client_events.iter().filter(is_of_log).collect();
        assert_eq!(events.len() as u64, 2 + log);
        assert_eq!(events[0], &ClientEvent::Snapshot(bytes.clone()));
        assert_eq!(events[events.len() - 1], &ClientEvent::CaughtUp);
    }
}

#[test]
fn the_clock_is_known_within_half_the_round_trip() {
    for seed in 0..5 {
        let mut pair = Pair::new(seed, 60_000, 20_000, 0.1);
        pair.join(0);
        pair.steps(1000);
        for _ in 0..10_000 {
            pair.step();
            let map = pair.client.clock().unwrap();
            let error = (map.to_server(pair.client_now()) - pair.server_now()).abs();
            assert!(error <= map.error_bound(), "seed {seed}: {error:?}");
            assert!(error < Span::from_millis(60));
        }
        let rtt = pair.client.stats(pair.client_now()).rtt.unwrap();
        assert!((120_000..=170_000).contains(&rtt.as_micros()));
    }
}

#[test]
fn motion_over_a_bad_link_is_shown_within_a_tenth_of_a_millimetre() {
    let mut unacknowledged = Vec::new();
    for seed in 0..5 {
        let mut pair = Pair::new(seed, 60_000, 20_000, 0.05);
        pair.join(0);
        pair.steps(1000);
        let mut timeline = Timeline::default();
        let (mut worst_mm, mut shown_count) = (0.0_f64, 0);
        for _ in 0..4000 {
            let time = pair.client_now();
            let pose = Pose {
                position_m: hand(pair.now_us),
                ..Pose::IDENTITY
            };
            pair.client.send_motion(LocalSample {
                time,
                pose,
                ..LocalSample::default()
            });
            pair.step();
            for event in std::mem::take(&mut pair.server_events) {
                if let PeerEvent::Motion(motion) = event {
                    for sample in motion.samples {
                        timeline.insert(sample);
                    }
                }
            }
            // The moment as the client's clock map sees it, 150 ms ago.
            let map = pair.client.clock().unwrap();
            let then = pair.client_now() - Span::from_millis(150);
            if let Some(shown) = timeline.at(map.to_server(then))
                && pair.now_us > 2_000_000
            {
                let want = hand(then.as_micros());
                let error: f64 = shown
                    .pose
                    .position_m
                    .iter()
                    .zip(want)
                    .map(|(a, b)| (a - b).powi(2))
                    .sum();
                worst_mm = worst_mm.max(error.sqrt() * 1e3);
                shown_count += 1;
            }
        }
        assert!(shown_count > 2500);
        assert!(worst_mm < 0.1, "seed {seed}: {worst_mm} mm");
        let stats = pair.server.stats();
        assert!(
            (0.02..0.09).contains(&stats.loss_in()),
            "{}",
            stats.loss_in()
        );
        let client = pair.client.stats(pair.client_now());
        unacknowledged.push(1.0 - client.acknowledged as f64 / client.sent as f64);
        assert!(stats.noise.duplicate > 0 && stats.noise.malformed == 0);
    }
    // A fifth of single sessions have more than this.
    let mean = unacknowledged.iter().sum::<f64>() / 5.0;
    assert!((0.0..0.12).contains(&mean), "{unacknowledged:?}");
}

#[test]
fn noise_is_counted_and_changes_nothing() {
    let mut pair = Pair::new(1, 20_000, 0, 0.0);
    pair.join(0);
    pair.steps(500);
    let before = (pair.client_events.len(), pair.server_events.len());
    let mut rng = Pcg64::seed_from_u64(5);
    for len in 0..300 {
        let noise: Vec<u8> = (0..len).map(|_| rng.random()).collect();
        let (c, s) = (pair.client_now(), pair.server_now());
        pair.client.handle_datagram(&noise, c);
        pair.server.handle_datagram(&noise, s);
    }
    assert_eq!(pair.client.stats(pair.client_now()).noise.total(), 300);
    assert_eq!(pair.server.stats().noise.total(), 300);
    assert_eq!(before, (pair.client_events.len(), pair.server_events.len()));
    assert!(!pair.client.is_closed() && !pair.server.is_closed());
}

#[test]
fn silence_closes_the_peer_after_two_seconds_and_warns_the_client_after_one() {
    let mut pair = Pair::new(1, 20_000, 0, 0.0);
    pair.join(0);
    pair.steps(500);
    pair.up.loss = 1.0;
    pair.down.loss = 1.0;
    pair.steps(900);
    assert!(!pair.client_events.contains(&ClientEvent::LinkLost));
    pair.steps(300);
    assert!(pair.client_events.contains(&ClientEvent::LinkLost));
    assert!(!pair.server.is_closed());
    pair.steps(1000);
    assert_eq!(
        pair.server_events.last(),
        Some(&PeerEvent::Closed(CloseReason::Silent(PEER_SILENCE)))
    );
}

#[test]
fn recovered_link_is_reported() {
    let mut pair = Pair::new(1, 20_000, 0, 0.0);
    pair.join(0);
    pair.steps(500);
    (pair.up.loss, pair.down.loss) = (1.0, 1.0);
    pair.steps(1300);
    (pair.up.loss, pair.down.loss) = (0.0, 0.0);
    pair.steps(300);
    assert!(pair.client_events.contains(&ClientEvent::LinkRestored));
    assert!(!pair.server.is_closed());
}

#[test]
fn violating_client_receives_the_reason() {
    let mut pair = Pair::new(1, 20_000, 0, 0.0);
    pair.join(0);
    pair.steps(200);
    let now = pair.server_now();
    pair.server.handle_stream(&[0xff; 16], now);
    pair.steps(100);
    assert!(matches!(
        pair.server_events.last(),
        Some(PeerEvent::Closed(CloseReason::Violation(
            ProtocolError::FrameTooLong { .. }
        )))
    ));
    let last = pair.client_events.last();
    assert!(
        matches!(last, Some(ClientEvent::Closed(CloseReason::Goodbye(s))) if s.contains("frame"))
    );
}

#[test]
fn excess_requests_are_refused_and_the_session_continues() {
    let mut pair = Pair::new(1, 20_000, 0, 0.0);
    pair.join(0);
    pair.steps(200);
    for version in 0..REQUESTS_BURST_MAX + 30 {
        let kind = RequestKind::TopologyReport {
            version,
            hash: TopologyHash(0),
        };
        pair.client.request(kind).unwrap();
    }
    pair.steps(200);
    let refused = pair
        .client_events
        .iter()
        .filter(|e| matches!(e, ClientEvent::RequestRefused(_)));
    assert_eq!(refused.count(), 30);
    assert!(!pair.server.is_closed());
}

#[test]
fn a_hello_without_a_name_is_refused_with_a_sentence() {
    let mut pair = Pair::new(1, 20_000, 0, 0.0);
    let nameless = Hello {
        name: " ".to_owned(),
        ..hello()
    };
    pair.client = ClientSession::new(nameless, ClientTime::ZERO).unwrap();
    pair.steps(200);
    let last = pair.client_events.last();
    assert!(
        matches!(last, Some(ClientEvent::Closed(CloseReason::Refused(r))) if r.sentence.contains("name"))
    );
}

pub(super) fn returning(next: u64) -> ClientSession {
    let seat = Resume {
        participant: ParticipantId(5),
        token: ResumeToken([0; 16]),
        next_operation: OperationId(next),
        topology_version: 0,
        topology_hash: TopologyHash(0),
    };
    let hello = Hello {
        resume: Some(seat),
        ..hello()
    };
    ClientSession::new(hello, ClientTime::ZERO).unwrap()
}

#[test]
fn reconnected_client_receives_the_log_from_its_position() {
    let mut pair = Pair::new(1, 20_000, 5_000, 0.1);
    pair.client = returning(7);
    while !matches!(pair.server_events.last(), Some(PeerEvent::Hello(_))) {
        pair.step();
    }
    pair.send(&PeerMessage::Welcome(Box::new(welcome(7, 9))));
    (7..12).for_each(|id| pair.send(&operation(id)));
    pair.steps(500);
    let told: Vec<u64> = pair
        .client_events
        .iter()
        .filter_map(|e| match e {
            ClientEvent::Operation(o) => Some(o.id.0),
            ClientEvent::CaughtUp => Some(100),
            _ => None,
        })
        .collect();
    assert_eq!(told, [7, 8, 100, 9, 10, 11]);
}

#[test]
fn log_from_a_position_not_requested_is_a_violation() {
    let begins = |mut client: ClientSession, first, log| {
        let frame = ServerMessage::Welcome(Box::new(welcome(first, log)));
        client.handle_stream(&Preamble::OURS.to_bytes(), ClientTime::ZERO);
        client.handle_stream(&codec::encode_frame(&frame).unwrap(), ClientTime::ZERO);
        !client.is_closed()
    };
    let newcomer = || ClientSession::new(hello(), ClientTime::ZERO).unwrap();
    assert!(begins(newcomer(), 0, 4));
    assert!(
        !begins(newcomer(), 3, 4),
        "it has nothing of the first three"
    );
    assert!(begins(returning(3), 3, 3));
    assert!(begins(returning(3), 0, 4), "the whole log always does");
    assert!(!begins(returning(3), 2, 4));
    assert!(!begins(returning(3), 3, 2), "beyond its end");
}
