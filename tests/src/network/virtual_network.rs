//! A network in virtual time, for machines without sockets and clocks.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use super::path::{Arrival, Corruption, Direction, Path, PathCounts};
use super::profile::Profile;

/// Packets on the way at once; further ones are dropped and counted as overflowed. It is 300 ms of
/// 200,000 packets a second.
pub const PACKETS_MAX: usize = 65_536;

/// Flows of one network; packets of further ones are dropped and counted as overflowed. It is many
/// times the most participants of a session.
pub const FLOWS_MAX: usize = 1024;

/// A packet that has arrived.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery<T> {
    /// When it was sent, microseconds after the network began.
    pub sent_us: u64,
    /// When it arrived.
    pub at_us: u64,
    /// Whose it is.
    pub flow: u64,
    /// Which way it went.
    pub direction: Direction,
    /// What happened to its bits. The payload is as it was sent: whoever has bytes applies it.
    pub corrupted: Option<Corruption>,
    /// What was sent.
    pub payload: T,
}

/// An emulated network between a server and any number of flows, in virtual time. Pure.
#[derive(Debug, Clone)]
pub struct VirtualNetwork<T> {
    profile: Profile,
    seed: u64,
    /// Flows with a network of their own.
    own: BTreeMap<u64, Profile>,
    paths: BTreeMap<(u64, Direction), Path>,
    queue: BinaryHeap<Reverse<InFlight<T>>>,
    next_order: u64,
    overflowed: u64,
}

#[derive(Debug, Clone)]
struct InFlight<T> {
    /// Breaks ties in favour of the packet that was sent first.
    order: u64,
    delivery: Delivery<T>,
}

impl<T> PartialEq for InFlight<T> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl<T> Eq for InFlight<T> {}

impl<T> PartialOrd for InFlight<T> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> Ord for InFlight<T> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        let key = |p: &Self| (p.delivery.at_us, p.order);
        key(self).cmp(&key(other))
    }
}

impl<T: Clone> VirtualNetwork<T> {
    /// A network on which every flow has the same profile and fates of its own.
    pub fn new(profile: Profile, seed: u64) -> Self {
        Self {
            profile,
            seed,
            own: BTreeMap::new(),
            paths: BTreeMap::new(),
            queue: BinaryHeap::new(),
            next_order: 0,
            overflowed: 0,
        }
    }

    /// Gives a flow a network of its own, before its first packet or for those from now on.
    pub fn set_profile(&mut self, flow: u64, profile: Profile) {
        for direction in [Direction::Up, Direction::Down] {
            self.paths.remove(&(flow, direction));
        }
        self.own.insert(flow, profile);
    }

    /// Sends a packet with `bytes` of payload at a time in microseconds after the network began.
    pub fn send(&mut self, at_us: u64, flow: u64, direction: Direction, bytes: usize, payload: T) {
        let is_new = !self.paths.contains_key(&(flow, direction));
        if is_new && self.paths.len() >= 2 * FLOWS_MAX {
            self.overflowed += 1;
            return;
        }
        let path = self.paths.entry((flow, direction)).or_insert_with(|| {
            let profile = self.own.get(&flow).unwrap_or(&self.profile);
            Path::new(profile, self.seed, flow, direction)
        });
        for Arrival {
            at_us: arrives_us,
            corrupted,
        } in path.send(at_us, bytes)
        {
            if self.queue.len() >= PACKETS_MAX {
                self.overflowed += 1;
                continue;
            }
            let delivery = Delivery {
                sent_us: at_us,
                at_us: arrives_us,
                flow,
                direction,
                corrupted,
                payload: payload.clone(),
            };
            let order = self.next_order;
            self.next_order += 1;
            self.queue.push(Reverse(InFlight { order, delivery }));
        }
    }

    /// When the next packet arrives.
    pub fn next_at(&self) -> Option<u64> {
        self.queue.peek().map(|Reverse(p)| p.delivery.at_us)
    }

    /// Takes the next packet that has arrived by now, the earliest first; call it until there is
    /// none.
    pub fn pop_due(&mut self, now_us: u64) -> Option<Delivery<T>> {
        if self.next_at()? > now_us {
            return None;
        }
        self.queue.pop().map(|Reverse(p)| p.delivery)
    }

    /// What became of a flow's packets in one direction so far.
    pub fn counts(&self, flow: u64, direction: Direction) -> PathCounts {
        let path = self.paths.get(&(flow, direction));
        path.map(Path::counts).unwrap_or_default()
    }

    /// Packets for which there was no room; not part of their fates, and 0 in any sound run.
    pub fn overflowed(&self) -> u64 {
        self.overflowed
    }
}
