//! A path between clients and servers, made of UDP sockets on this host: fixed delay, independent loss
//! from a seed, a bottleneck with a finite queue, and a gateway that can change the port from which the
//! server sees its clients.
//!
//! One thread keeps absolute deadlines on a condition variable; a timer of a loaded runtime would add
//! its own jitter to the measurement.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// The largest UDP payload that is carried, bytes.
const PAYLOAD_MAX: usize = 2048;

/// How often a receiving thread checks for the end.
const LOOK: Duration = Duration::from_millis(50);

/// Packets in flight in total; a path beyond it loses them.
const IN_FLIGHT_MAX: usize = 100_000;

/// The properties of a path, equal for both directions; each has its own queue and losses.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Way {
    /// Fixed one-way delay.
    pub(crate) delay: Duration,
    /// Further delay, evenly distributed from nothing to this; packets may overtake.
    pub(crate) jitter: Duration,
    /// The probability that a packet is lost.
    pub(crate) loss: f64,
    /// The bottleneck: bytes per second, and bytes that may wait before it.
    pub(crate) bottleneck: Option<(f64, f64)>,
    /// The seed of losses and jitter.
    pub(crate) seed: u64,
}

impl Way {
    /// A fixed delay, nothing else.
    pub(crate) fn delayed(delay: Duration) -> Self {
        Self {
            delay,
            jitter: Duration::ZERO,
            loss: 0.0,
            bottleneck: None,
            seed: 1,
        }
    }
}

/// One packet in flight. Ordered by due time, then by arrival.
struct Packet {
    due: Instant,
    number: u64,
    bytes: Vec<u8>,
    from: Arc<UdpSocket>,
    to: SocketAddr,
}

impl PartialEq for Packet {
    fn eq(&self, other: &Self) -> bool {
        self.number == other.number
    }
}
impl Eq for Packet {}
impl PartialOrd for Packet {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Packet {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.due, self.number).cmp(&(other.due, other.number))
    }
}

/// The state of one direction.
struct Direction {
    rng: Pcg64Mcg,
    /// When the bottleneck has sent everything that waits before it.
    busy_until: Instant,
}

#[derive(Default)]
struct Under {
    packets: BinaryHeap<Reverse<Packet>>,
    number: u64,
}

struct Shared {
    way: Way,
    under: Mutex<Under>,
    more: Condvar,
    ended: AtomicBool,
    /// The gateway's table: which socket speaks to which server for which client.
    table: Mutex<HashMap<(SocketAddr, SocketAddr), Arc<UdpSocket>>>,
    up: Mutex<Direction>,
    down: Mutex<Direction>,
}

/// A running path; it ends when dropped.
pub(crate) struct Relay {
    shared: Arc<Shared>,
    addresses: Vec<SocketAddr>,
}

fn lock<T>(m: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    m.lock().unwrap_or_else(PoisonError::into_inner)
}

fn socket() -> Arc<UdpSocket> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port on loopback");
    socket
        .set_read_timeout(Some(LOOK))
        .expect("a time-out is accepted");
    Arc::new(socket)
}

impl Relay {
    /// One path, shared by all clients, to every one of `servers`.
    pub(crate) fn start(servers: &[SocketAddr], way: Way) -> Self {
        let direction = |n: u64| {
            Mutex::new(Direction {
                rng: Pcg64Mcg::seed_from_u64(way.seed.wrapping_mul(2).wrapping_add(n)),
                busy_until: Instant::now(),
            })
        };
        let shared = Arc::new(Shared {
            way,
            under: Mutex::default(),
            more: Condvar::new(),
            ended: AtomicBool::new(false),
            table: Mutex::default(),
            up: direction(0),
            down: direction(1),
        });
        let carrier = shared.clone();
        thread::spawn(move || carrier.deliver());
        let open = |server: &SocketAddr| {
            let (front, server) = (socket(), *server);
            let address = front.local_addr().expect("it is bound");
            let shared = shared.clone();
            thread::spawn(move || shared.from_clients(&front, server));
            address
        };
        let addresses = servers.iter().map(open).collect();
        Self { shared, addresses }
    }

    /// Where clients send to, for every server.
    pub(crate) fn addresses(&self) -> &[SocketAddr] {
        &self.addresses
    }

    /// The gateway forgets its table: from the next packet on, the server sees every client at another
    /// port, and packets to the old one are lost.
    #[allow(dead_code, reason = "not every user of this file changes addresses")]
    pub(crate) fn forget(&self) {
        lock(&self.shared.table).clear();
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        self.shared.more.notify_all();
    }
}

impl Shared {
    fn ended(&self) -> bool {
        self.ended.load(Ordering::Relaxed)
    }

    fn from_clients(self: Arc<Self>, front: &Arc<UdpSocket>, server: SocketAddr) {
        let mut buffer = [0; PAYLOAD_MAX];
        while !self.ended() {
            match front.recv_from(&mut buffer) {
                Ok((n, client)) => {
                    let out = self.outlet(front, client, server);
                    self.send(&self.up, &buffer[..n], out, server);
                }
                Err(e) if is_quiet(e.kind()) => {}
                Err(_) => return,
            }
        }
    }

    fn outlet(
        self: &Arc<Self>,
        front: &Arc<UdpSocket>,
        client: SocketAddr,
        server: SocketAddr,
    ) -> Arc<UdpSocket> {
        let mut table = lock(&self.table);
        let known = table.entry((client, server)).or_insert_with(|| {
            let fresh = socket();
            let (shared, outlet, front) = (self.clone(), fresh.clone(), front.clone());
            thread::spawn(move || shared.from_server(&outlet, &front, (client, server)));
            fresh
        });
        known.clone()
    }

    fn from_server(
        self: Arc<Self>,
        outlet: &Arc<UdpSocket>,
        front: &Arc<UdpSocket>,
        ends: (SocketAddr, SocketAddr),
    ) {
        let mut buffer = [0; PAYLOAD_MAX];
        while !self.ended() {
            let received = outlet.recv_from(&mut buffer);
            let in_use = lock(&self.table)
                .get(&ends)
                .is_some_and(|s| Arc::ptr_eq(s, outlet));
            match received {
                _ if !in_use => return,
                Ok((n, _)) => self.send(&self.down, &buffer[..n], front.clone(), ends.0),
                Err(e) if is_quiet(e.kind()) => {}
                Err(_) => return,
            }
        }
    }

    fn send(
        &self,
        direction: &Mutex<Direction>,
        bytes: &[u8],
        from: Arc<UdpSocket>,
        to: SocketAddr,
    ) {
        let now = Instant::now();
        let mut d = lock(direction);
        if d.rng.random::<f64>() < self.way.loss {
            return;
        }
        let mut due = now;
        if let Some((rate, queue)) = self.way.bottleneck {
            let start = d.busy_until.max(now);
            let waiting = (start - now).as_secs_f64() * rate;
            if waiting + bytes.len() as f64 > queue {
                return;
            }
            due = start + Duration::from_secs_f64(bytes.len() as f64 / rate);
            d.busy_until = due;
        }
        due += self.way.delay + self.way.jitter.mul_f64(d.rng.random::<f64>());
        drop(d);
        let mut under = lock(&self.under);
        if under.packets.len() >= IN_FLIGHT_MAX {
            return;
        }
        under.number += 1;
        let number = under.number;
        under.packets.push(Reverse(Packet {
            due,
            number,
            bytes: bytes.to_vec(),
            from,
            to,
        }));
        drop(under);
        self.more.notify_one();
    }

    fn deliver(&self) {
        let mut under = lock(&self.under);
        while !self.ended() {
            let now = Instant::now();
            let wait = match under.packets.peek() {
                Some(Reverse(first)) if first.due <= now => {
                    let first = under.packets.pop();
                    drop(under);
                    if let Some(Reverse(packet)) = first {
                        // A closed port is expected.
                        let _ = packet.from.send_to(&packet.bytes, packet.to);
                    }
                    under = lock(&self.under);
                    continue;
                }
                Some(Reverse(first)) => first.due - now,
                None => LOOK,
            };
            under = self
                .more
                .wait_timeout(under, wait)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
    }
}

fn is_quiet(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::WouldBlock
            | ErrorKind::TimedOut
            | ErrorKind::Interrupted
            | ErrorKind::ConnectionRefused
    )
}
