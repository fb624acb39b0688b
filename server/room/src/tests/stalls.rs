//! Sessions of machines that stall: the playout delay D follows the network and not the machines.
//!
//! Session machines and room are those of the product; time is virtual. During its stalls a machine does nothing while
//! samples and datagrams accumulate.

use std::collections::VecDeque;

use palpate_protocol::lateness::StallDetector;
use palpate_protocol::session::{ClientSession, ServerPeer};
use palpate_protocol::{ClientTime, LocalSample};
use proptest::prelude::*;

use super::*;

/// One turn of every machine, µs.
const TURN_US: i64 = 500;

/// Initial delay of the server program.
const INITIAL_DELAY_US: u32 = 10_000;

const CAP_US: u32 = 400_000;

/// The part of a machine that stalls.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    /// The force loop of a client: no samples are taken.
    Hand(usize),
    /// The network thread of a client.
    Client(usize),
    /// The network thread of the server.
    Network,
    /// The thread of the room.
    SimulatedRoom,
}

#[derive(Debug, Clone, Copy)]
struct Stalled {
    part: Part,
    from_ms: i64,
    length_ms: i64,
}

/// One-way delay of every path, in both directions.
#[derive(Debug, Clone, Copy)]
struct Delay {
    base_us: i64,
    jitter_us: i64,
}

const LAN: Delay = Delay {
    base_us: 200,
    jitter_us: 200,
};

#[derive(Debug)]
enum Packet {
    Stream(Vec<u8>),
    Datagram(Vec<u8>),
}

/// One direction of one path.
#[derive(Debug, Default)]
struct Wire {
    /// With the times of arrival, µs.
    packets: VecDeque<(i64, Packet)>,
    stream_us: i64,
    sent: u64,
}

impl Wire {
    /// Sends a packet; one datagram in `lost` is lost, none for 0.
    fn send(&mut self, packet: Packet, now: i64, delay: Delay, lost: u64) {
        self.sent += 1;
        let random = self.sent.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (self.sent << 7);
        let random = (random ^ (random >> 31)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 33;
        let mut at = now + delay.base_us + (random % (delay.jitter_us as u64 + 1)) as i64;
        if matches!(packet, Packet::Stream(_)) {
            at = at.max(self.stream_us + 1);
            self.stream_us = at;
        } else if lost > 0 && random.is_multiple_of(lost) {
            return;
        }
        let place = self.packets.partition_point(|(t, _)| *t <= at);
        self.packets.insert(place, (at, packet));
    }

    fn receive(&mut self, now: i64) -> Option<Packet> {
        if self.packets.front().is_none_or(|(at, _)| *at > now) {
            return None;
        }
        self.packets.pop_front().map(|(_, packet)| packet)
    }
}

struct Client {
    session: ClientSession,
    watch: StallDetector,
    /// Samples on their way from the force loop to the network thread.
    samples: VecDeque<LocalSample>,
    offset_us: i64,
}

impl Client {
    fn now(&self, now: i64) -> ClientTime {
        ClientTime::from_micros(now + self.offset_us)
    }
}

struct Session {
    room: SimulatedRoom,
    clients: Vec<Client>,
    peers: Vec<ServerPeer>,
    watches: Vec<StallDetector>,
    up: Vec<Wire>,
    down: Vec<Wire>,
    inbox: VecDeque<(PeerKey, PeerEvent, ServerTime)>,
    outbox: VecDeque<Output>,
    stalls: Vec<Stalled>,
    lost: u64,
    now: i64,
}

impl Session {
    fn new(clients: usize, stalls: Vec<Stalled>) -> Self {
        let config = RoomConfig {
            epoch: Epoch(1),
            model: ModelInfo {
                hash: ModelHash(1),
                bytes: 1,
            },
            grants: vec![(Role::Trainee, TRAINEE)],
            seats: 8,
            spectators: 4,
            tick_hz: 30,
            compensation: CompensationSettings {
                mode: CompensationMode::Adaptive { cap_us: CAP_US },
                initial_delay_us: INITIAL_DELAY_US,
            },
            fresh_token: |who| ResumeToken([who.0 as u8; 16]),
            fresh_grant: |id| Grant((u128::MAX - u128::from(id)).to_le_bytes()),
            start_when_tools: 0,
        };
        let client = |k: usize| {
            let PeerEvent::Hello(hello) = hello(&format!("p{k}"), Role::Trainee, ToolKind::Probe)
            else {
                unreachable!("a hello is a hello");
            };
            let offset_us = 1_000_000 * (k as i64 + 1);
            Client {
                session: ClientSession::new(hello, ClientTime::from_micros(offset_us)).unwrap(),
                watch: StallDetector::default(),
                samples: VecDeque::new(),
                offset_us,
            }
        };
        let wires = || (0..clients).map(|_| Wire::default()).collect();
        Self {
            room: SimulatedRoom::new(model(), config, ServerTime::ZERO),
            clients: (0..clients).map(client).collect(),
            peers: (0..clients)
                .map(|_| ServerPeer::new(ServerTime::ZERO))
                .collect(),
            watches: vec![StallDetector::default(); clients],
            up: wires(),
            down: wires(),
            inbox: VecDeque::new(),
            outbox: VecDeque::new(),
            stalls,
            lost: 0,
            now: 0,
        }
    }

    fn runs(&self, part: Part) -> bool {
        !self.stalls.iter().any(|s| {
            let from = s.from_ms * 1000;
            s.part == part && (from..from + s.length_ms * 1000).contains(&self.now)
        })
    }

    /// D, ms.
    fn delay_ms(&self) -> f64 {
        let now = ServerTime::from_micros(self.now);
        self.room.delay_at(now).as_millis_f64()
    }

    /// Runs over a network with this delay and returns the largest D, ms.
    fn run_until(&mut self, until_ms: i64, delay: Delay) -> f64 {
        let mut most = 0.0_f64;
        while self.now < until_ms * 1000 {
            self.now += TURN_US;
            for k in 0..self.clients.len() {
                if self.runs(Part::Hand(k)) && self.now % 1000 == 0 {
                    self.sample(k);
                }
                if self.runs(Part::Client(k)) {
                    self.client_turn(k, delay);
                }
            }
            if self.runs(Part::Network) {
                self.network_turn(delay);
            }
            if self.runs(Part::SimulatedRoom) {
                self.room_turn();
            }
            most = most.max(self.delay_ms());
        }
        most
    }

    fn sample(&mut self, k: usize) {
        let client = &mut self.clients[k];
        let time = client.now(self.now);
        let turn = self.now as f64 * 4e-6 + k as f64;
        let pose = Pose {
            position_m: [0.5 + 0.02 * turn.sin(), 0.5, 0.5 + 0.02 * turn.cos()],
            ..Pose::IDENTITY
        };
        client.samples.push_back(LocalSample {
            time,
            pose,
            ..LocalSample::default()
        });
    }

    fn client_turn(&mut self, k: usize, delay: Delay) {
        let at = Span::from_micros(self.now);
        let client = &mut self.clients[k];
        let now = client.now(self.now);
        client.watch.wake(at);
        while let Some(packet) = self.down[k].receive(self.now) {
            match packet {
                Packet::Stream(bytes) => client.session.handle_stream(&bytes, now),
                Packet::Datagram(bytes) => {
                    let stall = client.watch.handle_datagram(at);
                    client.session.handle_waiting_datagram(&bytes, stall, now);
                }
            }
        }
        client.watch.handle_empty(at);
        let is_in = client.session.clock().is_some();
        for sample in client.samples.drain(..).filter(|_| is_in) {
            client.session.send_motion(sample);
        }
        if client.session.poll_timeout().is_some_and(|due| due <= now) {
            client.session.handle_timeout(now);
        }
        while let Some(bytes) = client.session.poll_stream() {
            self.up[k].send(Packet::Stream(bytes), self.now, delay, 0);
        }
        while let Some(bytes) = client.session.poll_datagram(now) {
            self.up[k].send(Packet::Datagram(bytes), self.now, delay, self.lost);
        }
        while let Some(event) = client.session.poll_event() {
            assert!(
                !matches!(event, palpate_protocol::session::ClientEvent::Closed(_)),
                "{event:?}"
            );
        }
        let due = client.session.poll_timeout().unwrap();
        client.watch.waits(at, due - now);
    }

    fn network_turn(&mut self, delay: Delay) {
        let (at, now) = (
            Span::from_micros(self.now),
            ServerTime::from_micros(self.now),
        );
        for output in self.outbox.drain(..) {
            match output {
                Output::Message(key, message) => {
                    self.peers[key.0 as usize].send(&message, now).unwrap();
                }
                Output::Datagram(key, datagram) => {
                    self.peers[key.0 as usize].send_datagram(&datagram, now);
                }
            }
        }
        for (k, peer) in self.peers.iter_mut().enumerate() {
            let watch = &mut self.watches[k];
            watch.wake(at);
            while let Some(packet) = self.up[k].receive(self.now) {
                match packet {
                    Packet::Stream(bytes) => peer.handle_stream(&bytes, now),
                    Packet::Datagram(bytes) => {
                        let stall = watch.handle_datagram(at);
                        peer.handle_waiting_datagram(&bytes, stall, now);
                    }
                }
            }
            watch.handle_empty(at);
            if peer.poll_timeout().is_some_and(|due| due <= now) {
                peer.handle_timeout(now);
            }
            while let Some(bytes) = peer.poll_stream() {
                self.down[k].send(Packet::Stream(bytes), self.now, delay, 0);
            }
            while let Some(bytes) = peer.poll_datagram(now) {
                self.down[k].send(Packet::Datagram(bytes), self.now, delay, self.lost);
            }
            while let Some(event) = peer.poll_event() {
                self.inbox.push_back((PeerKey(k as u64), event, now));
            }
            let due = peer.poll_timeout().unwrap();
            watch.waits(at, due - now);
        }
    }

    fn room_turn(&mut self) {
        let now = ServerTime::from_micros(self.now);
        for (key, event, at) in self.inbox.drain(..) {
            self.room.handle_event(key, event, at);
        }
        if self.room.poll_timeout() <= now {
            self.room.handle_tick(now, &mut || true);
        }
        self.outbox.extend(drain(&mut self.room));
    }

    /// Delay reports that the measured paths did not explain.
    fn unexplained(&self) -> u64 {
        self.room.limits().of(crate::Limit::DelayReport)
    }

    /// The longest stall that each machine reports, ms.
    fn reported_ms(&self) -> Vec<f64> {
        let clients = self.clients.iter().map(|c| {
            let now = c.now(self.now);
            c.session.stats(now).local_stalls.max
        });
        let peers = self.peers.iter().map(|p| p.stats().local_stalls.max);
        clients.chain(peers).map(Span::as_millis_f64).collect()
    }
}

fn any_part() -> impl Strategy<Value = Part> {
    prop_oneof![
        (0_usize..2).prop_map(Part::Hand),
        (0_usize..2).prop_map(Part::Client),
        Just(Part::Network),
        Just(Part::SimulatedRoom),
    ]
}

fn any_stalls(until_ms: i64) -> impl Strategy<Value = Vec<Stalled>> {
    let stall =
        (any_part(), 0..until_ms, 5_i64..300).prop_map(|(part, from_ms, length_ms)| Stalled {
            part,
            from_ms,
            length_ms,
        });
    prop::collection::vec(stall, 0..24)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn machine_stalls_on_a_lan_neither_raise_the_delay_nor_demote(stalls in any_stalls(6000)) {
        let mut session = Session::new(2, stalls);
        session.run_until(1500, LAN);
        let most = session.run_until(8000, LAN);
        prop_assert!(most <= 20.0, "D rose to {most} ms");
        prop_assert_eq!(session.room.demotion_count(), 0);
    }
}

#[test]
fn repeated_stalls_of_one_machine_do_not_raise_the_delay() {
    for part in [
        Part::Hand(0),
        Part::Client(0),
        Part::Client(1),
        Part::Network,
        Part::SimulatedRoom,
    ] {
        let stall = |i: i64| Stalled {
            part,
            from_ms: 1000 + 400 * i,
            length_ms: 100 + 10 * (i % 20),
        };
        let mut session = Session::new(2, (0..20).map(stall).collect());
        let most = session.run_until(10_000, LAN);
        assert!(most <= 20.0, "{part:?}: D rose to {most} ms");
        assert_eq!(session.room.demotion_count(), 0, "{part:?}");
        let reported = session.reported_ms();
        // A stalled force loop does not stall the network thread.
        if !matches!(part, Part::Hand(_)) {
            assert!(
                reported.iter().any(|ms| *ms > 45.0),
                "{part:?}: {reported:?}"
            );
        }
    }
}

#[test]
fn two_clients_on_a_lan_start_with_a_short_delay_and_keep_it() {
    let mut session = Session::new(2, Vec::new());
    let most = session.run_until(5000, LAN);
    assert!(most <= 20.0, "D rose to {most} ms");
    let reported = session.reported_ms();
    assert!(reported.iter().all(|ms| *ms <= 1.0), "{reported:?}");
}

#[test]
fn transatlantic_delay_is_reached_within_a_second_without_excess() {
    let far = Delay {
        base_us: 50_000,
        jitter_us: 20_000,
    };
    let mut session = Session::new(2, Vec::new());
    session.lost = 50;
    let most = session.run_until(10_000, far);
    // Round trip of 120 ms plus four deviations of its jitter, plus one third.
    assert!(most <= 198.0, "D rose to {most} ms");
    let mut session = Session::new(2, Vec::new());
    session.lost = 50;
    session.run_until(1800, far);
    assert!(session.delay_ms() >= 115.0, "{} ms", session.delay_ms());
    assert_eq!(session.unexplained(), 0);
}

#[test]
fn delay_follows_a_network_step_at_once_with_and_without_stalls() {
    let stall = |i: i64| Stalled {
        part: [Part::Client(0), Part::Client(1), Part::SimulatedRoom][i as usize % 3],
        from_ms: 500 + 300 * i,
        length_ms: 60,
    };
    for stalls in [Vec::new(), (0..30).map(stall).collect()] {
        let mut session = Session::new(2, stalls);
        session.run_until(5000, LAN);
        let slow = Delay {
            base_us: 75_000,
            jitter_us: 1000,
        };
        session.run_until(6100, slow);
        let delay = session.delay_ms();
        assert!(delay >= 140.0, "{delay} ms after 1.1 s");
        let most = session.run_until(12_000, slow);
        assert!(most <= 190.0, "D rose to {most} ms");
        assert_eq!(session.room.demotion_count(), 0);
        assert_eq!(session.unexplained(), 0);
    }
}

#[test]
fn network_burst_raises_the_delay_at_once_and_is_forgotten_within_seconds() {
    let mut session = Session::new(2, Vec::new());
    session.run_until(4000, LAN);
    let burst = Delay {
        base_us: 50_000,
        jitter_us: 1000,
    };
    session.run_until(4500, burst);
    let risen = session.delay_ms();
    assert!(risen >= 40.0, "{risen} ms");
    let most = session.run_until(7000, LAN);
    // Half a second is less than 4 % of the session after 13 s. Then D falls by 50 ms in a second.
    let seconds = 7.0 + most / 50.0;
    session.run_until(7000 + (seconds * 1e3) as i64, LAN);
    assert!(session.delay_ms() <= 20.0, "{} ms", session.delay_ms());
    assert_eq!(session.unexplained(), 0);
}
