//! A network emulated between the connection of a peer and its session, for lessons under delay.
//!
//! ```text
//! connection --- Way::Up, delay and loss ---> session machine
//! connection <-- Way::Down, delay and loss -- session machine
//! ```
//!
//! The path holds raw bytes, so that the session measures it like a real network: round trips, lateness, lost
//! datagrams, playout delay.
//!
//! - Datagrams are dropped at the rate of the loss.
//! - Stream bytes keep their order. A lost packet of the stream costs one more emulated round trip for the
//!   retransmission, and everything behind it waits as well.

use std::collections::VecDeque;
use std::time::Duration;

use palpate_protocol::{Emulation, ServerTime, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::connection::PathStats;

/// Datagrams that a direction holds; further ones are lost. 0.5 s of 4,000 datagrams per second.
pub(crate) const DATAGRAMS_HELD_MAX: usize = 2048;

/// Stream bytes that a direction holds before it takes no more: 4 Mbit/s at the largest delay.
pub(crate) const STREAM_HELD_MAX_BYTES: usize = 256 * 1024;

/// Stream bytes in a packet.
const PACKET_BYTES: usize = 1200;

/// Retransmissions of one packet. At the largest loss, one packet in 15,000 needs more.
const RETRANSMISSIONS_MAX: i64 = 8;

/// A datagram that leaves the path later than this after it is due was delayed by this machine: timers have a resolution
/// of 1 ms.
const TIMER_TOLERANCE: Span = Span::from_millis(2);

/// A direction of the path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    /// From the participant to the server.
    Up,
    /// From the server to the participant.
    Down,
}

/// See the module. Bytes go in with [`push_stream`](Self::push_stream) and
/// [`push_datagram`](Self::push_datagram), and come out of [`poll_stream`](Self::poll_stream) and
/// [`poll_datagram`](Self::poll_datagram) when they are due.
#[derive(Debug)]
pub(crate) struct EmulatedPath {
    emulation: Emulation,
    up: Direction,
    down: Direction,
}

#[derive(Debug)]
struct Direction {
    random: Pcg64Mcg,
    stream: VecDeque<(ServerTime, Vec<u8>)>,
    stream_bytes: usize,
    datagrams: VecDeque<(ServerTime, Span, Vec<u8>)>,
    /// Datagrams that were dropped.
    lost: u64,
}

impl EmulatedPath {
    /// A path that emulates nothing. Equal seeds and calls lose equal packets.
    pub(crate) fn new(seed: u64) -> Self {
        let direction = |n: u64| Direction {
            random: Pcg64Mcg::seed_from_u64(seed.wrapping_mul(2).wrapping_add(n)),
            stream: VecDeque::new(),
            stream_bytes: 0,
            datagrams: VecDeque::new(),
            lost: 0,
        };
        Self {
            emulation: Emulation::NONE,
            up: direction(0),
            down: direction(1),
        }
    }

    /// Changes delay and loss, which are in range. Bytes on their way keep their due times, and later ones do not
    /// overtake them.
    pub(crate) fn set(&mut self, emulation: Emulation) {
        self.emulation = emulation;
    }

    /// Whether it emulates nothing and holds nothing, so that bytes can bypass it.
    pub(crate) fn is_idle(&self) -> bool {
        let is_empty = |way: &Direction| way.stream.is_empty() && way.datagrams.is_empty();
        self.emulation.is_none() && is_empty(&self.up) && is_empty(&self.down)
    }

    fn direction(&mut self, way: Way) -> &mut Direction {
        match way {
            Way::Up => &mut self.up,
            Way::Down => &mut self.down,
        }
    }

    /// Whether a direction takes stream bytes.
    pub(crate) fn has_room(&self, way: Way) -> bool {
        let direction = match way {
            Way::Up => &self.up,
            Way::Down => &self.down,
        };
        direction.stream_bytes < STREAM_HELD_MAX_BYTES
    }

    /// Takes stream bytes. The caller asks [`has_room`](Self::has_room) first.
    pub(crate) fn push_stream(&mut self, way: Way, bytes: Vec<u8>, now: ServerTime) {
        let Emulation { delay_ms, .. } = self.emulation;
        let loss = self.emulation.loss();
        let direction = self.direction(way);
        let round_trips = direction.retransmissions(bytes.len(), loss);
        let wait = Span::from_millis(i64::from(delay_ms) * (1 + 2 * round_trips));
        let due = not_before(direction.stream.back().map(|(due, _)| *due), now + wait);
        direction.stream_bytes += bytes.len();
        direction.stream.push_back((due, bytes));
    }

    /// Takes a datagram that may have waited for `stall` already, or drops it.
    pub(crate) fn push_datagram(&mut self, way: Way, bytes: Vec<u8>, stall: Span, now: ServerTime) {
        let (delay, loss) = (self.emulation.delay(), self.emulation.loss());
        let direction = self.direction(way);
        let is_full = direction.datagrams.len() >= DATAGRAMS_HELD_MAX;
        if is_full || direction.draw(loss) {
            direction.lost += 1;
            return;
        }
        let last = direction.datagrams.back().map(|(due, ..)| *due);
        let due = not_before(last, now + delay);
        direction.datagrams.push_back((due, stall, bytes));
    }

    /// The next stream bytes that are due.
    pub(crate) fn poll_stream(&mut self, way: Way, now: ServerTime) -> Option<Vec<u8>> {
        let direction = self.direction(way);
        direction.stream.front().filter(|(due, _)| now >= *due)?;
        self.take_stream(way)
    }

    /// The next stream bytes, due or not, when the connection or the session has ended.
    pub(crate) fn take_stream(&mut self, way: Way) -> Option<Vec<u8>> {
        let direction = self.direction(way);
        let (_, bytes) = direction.stream.pop_front()?;
        direction.stream_bytes -= bytes.len();
        Some(bytes)
    }

    /// The next datagram that is due, with the time for which it may have waited because this machine stalled.
    pub(crate) fn poll_datagram(&mut self, way: Way, now: ServerTime) -> Option<(Vec<u8>, Span)> {
        let datagrams = &mut self.direction(way).datagrams;
        datagrams.front().filter(|(due, ..)| now >= *due)?;
        let (due, stall, bytes) = datagrams.pop_front()?;
        let late = now - due;
        let is_stalled = late > TIMER_TOLERANCE;
        Some((bytes, if is_stalled { stall + late } else { stall }))
    }

    /// When the next stream bytes of a direction are due; `None` while it holds none.
    pub(crate) fn stream_due(&self, way: Way) -> Option<ServerTime> {
        let stream = match way {
            Way::Up => &self.up.stream,
            Way::Down => &self.down.stream,
        };
        stream.front().map(|(due, _)| *due)
    }

    /// When the next datagram of either direction is due; `None` while it holds none.
    pub(crate) fn datagram_due(&self) -> Option<ServerTime> {
        let fronts = [&self.up, &self.down].map(|way| way.datagrams.front());
        fronts.into_iter().flatten().map(|(due, ..)| *due).min()
    }

    /// The figures of the transport with those of this path: its delay in both directions, and the datagrams that it
    /// lost on the way down.
    pub(crate) fn add_to(&self, stats: PathStats) -> PathStats {
        let delay_ms = u64::from(self.emulation.delay_ms);
        PathStats {
            rtt: stats.rtt + Duration::from_millis(2 * delay_ms),
            sent_packets: stats.sent_packets + self.down.lost,
            lost_packets: stats.lost_packets + self.down.lost,
            ..stats
        }
    }
}

impl Direction {
    /// Whether a packet is lost.
    fn draw(&mut self, loss: f64) -> bool {
        loss > 0.0 && self.random.random::<f64>() < loss
    }

    /// Round trips until all packets with these stream bytes have arrived.
    fn retransmissions(&mut self, bytes: usize, loss: f64) -> i64 {
        let packets = 0..bytes.div_ceil(PACKET_BYTES);
        let rounds = packets.map(|_| {
            let mut rounds = 0;
            while rounds < RETRANSMISSIONS_MAX && self.draw(loss) {
                rounds += 1;
            }
            rounds
        });
        rounds.max().unwrap_or(0)
    }
}

/// A due time that does not overtake the bytes before.
fn not_before(last: Option<ServerTime>, due: ServerTime) -> ServerTime {
    last.map_or(due, |last| last.max(due))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn ms(ms: i64) -> ServerTime {
        ServerTime::from_micros(1000 * ms)
    }

    fn emulation(delay_ms: u16, loss_permille: u16) -> Emulation {
        Emulation {
            delay_ms,
            loss_permille,
        }
    }

    /// A step of a random path.
    #[derive(Debug, Clone)]
    enum Step {
        Set(u16, u16),
        Stream(usize),
        Datagram,
        Pass(i64),
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            1 => (0_u16..=500, 0_u16..=300).prop_map(|(delay, loss)| Step::Set(delay, loss)),
            4 => (1_usize..5000).prop_map(Step::Stream),
            4 => Just(Step::Datagram),
            3 => (0_i64..200).prop_map(Step::Pass),
        ]
    }

    proptest! {
        #[test]
        fn stream_keeps_every_byte_in_order_and_nothing_comes_before_its_delay(
            steps in prop::collection::vec(step(), 1..200),
            seed in any::<u64>(),
            is_up in any::<bool>(),
        ) {
            let way = if is_up { Way::Up } else { Way::Down };
            let mut path = EmulatedPath::new(seed);
            let mut now = ms(0);
            let mut delay = Span::ZERO;
            // By byte of the stream and by datagram: the earliest time of arrival.
            let (mut stream_due, mut datagram_due) = (Vec::new(), Vec::new());
            let (mut arrived, mut newest, mut is_last) = (0, None, false);
            for step in steps.into_iter().map(Some).chain([None]) {
                match step {
                    Some(Step::Set(delay_ms, loss)) => {
                        path.set(emulation(delay_ms, loss));
                        delay = Span::from_millis(delay_ms.into());
                    }
                    Some(Step::Stream(bytes)) => {
                        let from = stream_due.len();
                        path.push_stream(way, (from..from + bytes).map(|i| i as u8).collect(), now);
                        stream_due.extend(vec![now + delay; bytes]);
                    }
                    Some(Step::Datagram) => {
                        let number = datagram_due.len() as u64;
                        path.push_datagram(way, number.to_le_bytes().to_vec(), Span::ZERO, now);
                        datagram_due.push(now + delay);
                    }
                    Some(Step::Pass(millis)) => now = now + Span::from_millis(millis),
                    None => (now, is_last) = (ms(1_000_000), true),
                }
                while let Some(bytes) = path.poll_stream(way, now) {
                    for byte in bytes {
                        prop_assert_eq!(byte, arrived as u8);
                        prop_assert!(now >= stream_due[arrived]);
                        arrived += 1;
                    }
                }
                while let Some((bytes, late)) = path.poll_datagram(way, now) {
                    let number = u64::from_le_bytes(bytes.try_into().unwrap());
                    prop_assert!(newest < Some(number), "{number} after {newest:?}");
                    prop_assert!(now - late >= datagram_due[number as usize]);
                    newest = Some(number);
                }
                let due = path.stream_due(way).into_iter().chain(path.datagram_due()).min();
                prop_assert!(due.is_none_or(|due| due > now));
            }
            prop_assert!(is_last && arrived == stream_due.len());
            path.set(Emulation::NONE);
            prop_assert!(path.is_idle() && path.has_room(way));
        }

        #[test]
        fn datagrams_are_lost_at_the_rate_of_the_loss(seed in any::<u64>(), permille in 0_u16..=300) {
            let mut path = EmulatedPath::new(seed);
            path.set(emulation(0, permille));
            let mut arrived = 0;
            for t in 0..20_000 {
                path.push_datagram(Way::Down, vec![0], Span::ZERO, ms(t));
                arrived += usize::from(path.poll_datagram(Way::Down, ms(t)).is_some());
            }
            let lost = 1.0 - arrived as f64 / 20_000.0;
            // Six standard deviations.
            let p = f64::from(permille) * 1e-3;
            let tolerance = 6.0 * (p * (1.0 - p) / 20_000.0).sqrt();
            prop_assert!((lost - p).abs() <= tolerance, "{lost} instead of {p}");
            let stats = path.add_to(PathStats::default());
            prop_assert_eq!(stats.lost_packets, 20_000 - arrived as u64);
        }

        #[test]
        fn equal_seeds_lose_equal_datagrams(seed in any::<u64>()) {
            let pattern = || {
                let mut path = EmulatedPath::new(seed);
                path.set(emulation(0, 300));
                let arrives = |t| {
                    path.push_datagram(Way::Up, vec![0], Span::ZERO, ms(t));
                    path.poll_datagram(Way::Up, ms(t)).is_some()
                };
                (0..200).map(arrives).collect::<Vec<_>>()
            };
            prop_assert_eq!(pattern(), pattern());
        }
    }

    #[test]
    fn lost_stream_packet_costs_a_round_trip() {
        let mut path = EmulatedPath::new(1);
        path.set(emulation(100, 300));
        let mut waits = Vec::new();
        for n in 0..1000 {
            let sent = ms(100_000 * n);
            path.push_stream(Way::Up, vec![0; 100], sent);
            waits.push((path.stream_due(Way::Up).unwrap() - sent).as_micros() / 1000);
            assert!(path.take_stream(Way::Up).is_some());
        }
        let count = |wait| waits.iter().filter(|w| **w == wait).count();
        assert!(waits.iter().all(|w| w % 200 == 100));
        assert!((650..750).contains(&count(100)), "{}", count(100));
        assert!((170..250).contains(&count(300)), "{}", count(300));
    }

    #[test]
    fn late_delivery_counts_as_a_stall_of_this_machine() {
        let stall_at = |now| {
            let mut path = EmulatedPath::new(1);
            path.set(emulation(100, 0));
            path.push_datagram(Way::Up, vec![0], Span::from_millis(7), ms(0));
            path.poll_datagram(Way::Up, ms(now)).map(|(_, stall)| stall)
        };
        assert_eq!(stall_at(99), None);
        for (now, stall) in [(100, 7), (102, 7), (130, 37)] {
            assert_eq!(stall_at(now), Some(Span::from_millis(stall)), "{now}");
        }
    }

    #[test]
    fn held_bytes_are_bounded() {
        let mut path = EmulatedPath::new(1);
        path.set(emulation(500, 0));
        for _ in 0..2 * DATAGRAMS_HELD_MAX {
            path.push_datagram(Way::Down, vec![0], Span::ZERO, ms(0));
        }
        let held = std::iter::from_fn(|| path.poll_datagram(Way::Down, ms(500))).count();
        assert_eq!(held, DATAGRAMS_HELD_MAX);
        while path.has_room(Way::Up) {
            path.push_stream(Way::Up, vec![0; 1000], ms(0));
        }
        assert!(path.has_room(Way::Down));
        assert!(path.poll_stream(Way::Up, ms(500)).is_some());
        assert!(path.has_room(Way::Up));
    }

    #[test]
    fn path_is_idle_once_an_ended_emulation_is_empty() {
        let mut path = EmulatedPath::new(1);
        assert!(path.is_idle());
        path.set(emulation(100, 0));
        assert!(!path.is_idle());
        path.push_stream(Way::Down, vec![1], ms(0));
        path.set(Emulation::NONE);
        path.push_stream(Way::Down, vec![2], ms(10));
        assert!(!path.is_idle() && path.poll_stream(Way::Down, ms(99)).is_none());
        let rest: Vec<_> = std::iter::from_fn(|| path.poll_stream(Way::Down, ms(100))).collect();
        assert_eq!(rest, [[1], [2]]);
        assert!(path.is_idle());
    }
}
