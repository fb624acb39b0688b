//! A network in virtual time, for state machines without sockets and clocks.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use super::path::{Arrival, Corruption, Direction, Path, PathCounts};
use super::profile::Profile;

/// Maximum packets in flight; more are dropped and counted as overflowed. It is 300 ms of 200,000 packets per
/// second.
pub const PACKETS_MAX: usize = 65_536;

/// Maximum flows of a network; packets of more flows are dropped and counted as overflowed. It is many times
/// the maximum number of participants.
pub const FLOWS_MAX: usize = 1024;

/// An arrived packet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery<T> {
    /// Send time, microseconds after the start of the network.
    pub sent_us: u64,
    /// Arrival time.
    pub at_us: u64,
    /// Flow.
    pub flow: u64,
    /// Direction.
    pub direction: Direction,
    /// Corruption of its bits. The payload is unchanged; a receiver with bytes applies it.
    pub corrupted: Option<Corruption>,
    /// Payload.
    pub payload: T,
}

/// An emulated network between a server and any number of flows, in virtual time. Pure.
#[derive(Debug, Clone)]
pub struct VirtualNetwork<T> {
    profile: Profile,
    seed: u64,
    /// Flows with an own profile.
    own: BTreeMap<u64, Profile>,
    paths: BTreeMap<(u64, Direction), Path>,
    queue: BinaryHeap<Reverse<InFlight<T>>>,
    next_order: u64,
    overflowed: u64,
}

#[derive(Debug, Clone)]
struct InFlight<T> {
    /// Breaks ties in favour of the packet sent first.
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
    /// A network in which every flow has this profile and independent fates.
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

    /// Sets the profile of a flow. Its packet numbers restart at 0. At most [`FLOWS_MAX`] flows have one; more
    /// are counted as overflowed.
    pub fn set_profile(&mut self, flow: u64, profile: Profile) {
        if self.own.len() >= FLOWS_MAX && !self.own.contains_key(&flow) {
            self.overflowed += 1;
            return;
        }
        for direction in [Direction::Up, Direction::Down] {
            self.paths.remove(&(flow, direction));
        }
        self.own.insert(flow, profile);
    }

    /// Sends a packet with `bytes` of payload at a time in microseconds after the start of the network.
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

    /// Time of the next arrival.
    pub fn next_at(&self) -> Option<u64> {
        self.queue.peek().map(|Reverse(p)| p.delivery.at_us)
    }

    /// Takes the earliest packet that has arrived by now; call it until it returns `None`.
    pub fn pop_due(&mut self, now_us: u64) -> Option<Delivery<T>> {
        if self.next_at()? > now_us {
            return None;
        }
        self.queue.pop().map(|Reverse(p)| p.delivery)
    }

    /// Packet counts of a flow in one direction.
    pub fn counts(&self, flow: u64, direction: Direction) -> PathCounts {
        let path = self.paths.get(&(flow, direction));
        path.map(Path::counts).unwrap_or_default()
    }

    /// Packets and flows without room; independent of the fates, and 0 in a valid run.
    pub fn overflowed(&self) -> u64 {
        self.overflowed
    }
}
