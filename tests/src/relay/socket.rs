//! The relay's sockets and threads.
//!
//! One thread listens, one thread per client listens to the server's answers, and one thread
//! delivers: it sleeps until the next packet is due, on a condition variable with an absolute
//! deadline, which wakes within some 0.1 ms. (A timer of an asynchronous runtime counts in
//! milliseconds and would add its own jitter.)

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::fate::{Direction, Fates};
use super::profile::Profile;
use super::stats::{Histogram, RelayStats};

/// Packets on the way at once; further ones are dropped and counted as overflowed. At 1200 B it is
/// 80 MB, and 300 ms of 200,000 packets a second.
pub const QUEUE_MAX_PACKETS: usize = 65_536;

/// Clients that a relay serves, each with a socket and a thread; packets of further ones are
/// dropped and counted as overflowed.
pub const CLIENTS_MAX: usize = 64;

/// How often the listening threads look whether they are to stop.
const STOP_PERIOD: Duration = Duration::from_millis(50);

/// The largest UDP payload.
const PACKET_MAX_BYTES: usize = 65_536;

/// A running relay. Dropping it stops it.
pub struct Relay {
    address: SocketAddr,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

struct Shared {
    fates: Fates,
    queue: Mutex<Queue>,
    due: Condvar,
    stop: AtomicBool,
}

#[derive(Default)]
struct Queue {
    parcels: BinaryHeap<Reverse<Parcel>>,
    next_order: u64,
    stats: RelayStats,
    delays: Histogram,
    lateness: Histogram,
}

/// A packet on its way.
struct Parcel {
    due: Instant,
    /// Breaks ties in favour of the packet that came first.
    order: u64,
    arrived: Instant,
    way: Arc<Way>,
    /// Its number on this way.
    n: u64,
    bytes: Vec<u8>,
}

/// One direction of one flow.
struct Way {
    socket: Arc<UdpSocket>,
    /// `None` for a connected socket.
    to: Option<SocketAddr>,
    flow: u64,
    direction: Direction,
    progress: Mutex<Progress>,
}

#[derive(Default)]
struct Progress {
    /// Packets that came in.
    count: u64,
    /// The latest deadline so far, for networks that keep the order.
    last_due: Option<Instant>,
    /// The highest number that went out.
    newest_out: Option<u64>,
}

impl PartialEq for Parcel {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Parcel {}

impl PartialOrd for Parcel {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Parcel {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.due, self.order).cmp(&(other.due, other.order))
    }
}

/// A poisoned lock means that another relay thread failed; the figures are still worth having.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Relay {
    /// Listens on `listen` and passes on to `to` what arrives there, and back what is answered.
    pub fn start(
        listen: SocketAddr,
        to: SocketAddr,
        profile: Profile,
        seed: u64,
    ) -> io::Result<Self> {
        let socket = Arc::new(UdpSocket::bind(listen)?);
        socket.set_read_timeout(Some(STOP_PERIOD))?;
        let address = socket.local_addr()?;
        let mut queue = Queue::default();
        queue.stats.profile.clone_from(&profile.name);
        queue.stats.seed = seed;
        let shared = Arc::new(Shared {
            fates: Fates::new(profile, seed),
            queue: Mutex::new(queue),
            due: Condvar::new(),
            stop: AtomicBool::new(false),
        });
        let listener = {
            let shared = shared.clone();
            spawn("relay-listen", move || {
                listen_to_clients(&shared, &socket, to);
            })?
        };
        let deliverer = {
            let shared = shared.clone();
            spawn("relay-deliver", move || shared.deliver())?
        };
        Ok(Self {
            address,
            shared,
            threads: vec![listener, deliverer],
        })
    }

    /// Where it listens, with the port that was chosen when 0 was asked for.
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// What it did so far.
    pub fn stats(&self) -> RelayStats {
        let queue = lock(&self.shared.queue);
        let sent = queue.stats.sent.max(1) as f64;
        RelayStats {
            delay_mean_ms: queue.delays.mean_ms(),
            delay_p50_ms: queue.delays.quantile_ms(0.5),
            delay_p99_ms: queue.delays.quantile_ms(0.99),
            lateness_p99_ms: queue.lateness.quantile_ms(0.99),
            loss: queue.stats.dropped as f64 / sent,
            ..queue.stats.clone()
        }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.due.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that failed has nothing more to say.
            let _ = thread.join();
        }
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> io::Result<JoinHandle<()>> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn(work)
}

/// Receives until it is time to stop, whatever errors the system reports about single packets.
fn receive(shared: &Shared, socket: &UdpSocket, mut handle: impl FnMut(&[u8], SocketAddr)) {
    let mut buffer = vec![0; PACKET_MAX_BYTES];
    while !shared.stop.load(Ordering::Relaxed) {
        // A timeout, or the echo of a closed port: both pass.
        if let Ok((len, from)) = socket.recv_from(&mut buffer) {
            handle(&buffer[..len], from);
        }
    }
}

fn listen_to_clients(shared: &Arc<Shared>, socket: &Arc<UdpSocket>, to: SocketAddr) {
    let mut clients: HashMap<SocketAddr, Arc<Way>> = HashMap::new();
    let mut threads = Vec::new();
    receive(shared, socket, |bytes, from| {
        if !clients.contains_key(&from) {
            let flow = clients.len() as u64;
            let new = (clients.len() < CLIENTS_MAX)
                .then(|| open_flow(shared, socket, from, to, flow).ok())
                .flatten();
            let Some((up, thread)) = new else {
                lock(&shared.queue).stats.overflowed += 1;
                return;
            };
            clients.insert(from, up);
            threads.push(thread);
            lock(&shared.queue).stats.clients += 1;
        }
        if let Some(up) = clients.get(&from) {
            shared.take(up, bytes);
        }
    });
    for thread in threads {
        let _ = thread.join();
    }
}

/// A socket towards the server for one client, and the thread that takes the answers.
fn open_flow(
    shared: &Arc<Shared>,
    listening: &Arc<UdpSocket>,
    client: SocketAddr,
    server: SocketAddr,
    flow: u64,
) -> io::Result<(Arc<Way>, JoinHandle<()>)> {
    let any: SocketAddr = if server.is_ipv4() {
        (Ipv4Addr::UNSPECIFIED, 0).into()
    } else {
        (Ipv6Addr::UNSPECIFIED, 0).into()
    };
    let upstream = Arc::new(UdpSocket::bind(any)?);
    upstream.connect(server)?;
    upstream.set_read_timeout(Some(STOP_PERIOD))?;
    let way = |socket: &Arc<UdpSocket>, to, direction| {
        let progress = Mutex::default();
        Arc::new(Way {
            socket: socket.clone(),
            to,
            flow,
            direction,
            progress,
        })
    };
    let up = way(&upstream, None, Direction::Up);
    let down = way(listening, Some(client), Direction::Down);
    let shared = shared.clone();
    let thread = spawn("relay-answers", move || {
        receive(&shared, &upstream, |bytes, _| shared.take(&down, bytes));
    })?;
    Ok((up, thread))
}

impl Shared {
    /// Takes a packet in: it meets its fate, and waits.
    fn take(&self, way: &Arc<Way>, bytes: &[u8]) {
        let arrived = Instant::now();
        let mut progress = lock(&way.progress);
        let n = progress.count;
        progress.count += 1;
        let fate = self.fates.fate(way.flow, way.direction, n);
        let mut due = arrived + Duration::from_micros(fate.delay_us);
        if fate.copies > 0 && !self.fates.profile().reorder {
            due = progress.last_due.map_or(due, |last| last.max(due));
            progress.last_due = Some(due);
        }
        drop(progress);
        let mut queue = lock(&self.queue);
        queue.stats.sent += 1;
        queue.stats.dropped += u64::from(fate.copies == 0);
        queue.stats.duplicated += u64::from(fate.copies > 1);
        for _ in 0..fate.copies {
            if queue.parcels.len() >= QUEUE_MAX_PACKETS {
                queue.stats.overflowed += 1;
                return;
            }
            let order = queue.next_order;
            queue.next_order += 1;
            let way = way.clone();
            queue.parcels.push(Reverse(Parcel {
                due,
                order,
                arrived,
                way,
                n,
                bytes: bytes.into(),
            }));
        }
        drop(queue);
        self.due.notify_one();
    }

    /// Sends what is due, until it is time to stop.
    fn deliver(&self) {
        let mut queue = lock(&self.queue);
        while !self.stop.load(Ordering::Relaxed) {
            let now = Instant::now();
            let wait = queue.parcels.peek().map_or(STOP_PERIOD, |Reverse(p)| {
                p.due.saturating_duration_since(now).min(STOP_PERIOD)
            });
            if !wait.is_zero() || queue.parcels.is_empty() {
                let waited = self.due.wait_timeout(queue, wait);
                queue = waited.unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            let Some(Reverse(parcel)) = queue.parcels.pop() else {
                continue;
            };
            queue.note_delivery(&parcel, now);
            drop(queue);
            // The receiver may be gone; then the packet is lost like any other.
            let _ = match parcel.way.to {
                Some(to) => parcel.way.socket.send_to(&parcel.bytes, to),
                None => parcel.way.socket.send(&parcel.bytes),
            };
            queue = lock(&self.queue);
        }
    }
}

impl Queue {
    fn note_delivery(&mut self, parcel: &Parcel, now: Instant) {
        let us = |d: Duration| u64::try_from(d.as_micros()).unwrap_or(u64::MAX);
        self.delays
            .record(us(now.saturating_duration_since(parcel.arrived)));
        self.lateness
            .record(us(now.saturating_duration_since(parcel.due)));
        self.stats.delivered += 1;
        let mut progress = lock(&parcel.way.progress);
        match progress.newest_out {
            Some(newest) if parcel.n < newest => self.stats.reordered += 1,
            _ => progress.newest_out = Some(parcel.n),
        }
    }
}

#[cfg(test)]
#[allow(clippy::print_stdout)]
mod tests {
    use super::super::profile::Jitter;
    use super::*;

    const HERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

    /// A server that answers every packet with itself.
    fn echo() -> (SocketAddr, Arc<AtomicBool>, JoinHandle<()>) {
        let socket = UdpSocket::bind(HERE).unwrap();
        socket.set_read_timeout(Some(STOP_PERIOD)).unwrap();
        let address = socket.local_addr().unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            let mut buffer = [0; 2048];
            while !stopped.load(Ordering::Relaxed) {
                if let Ok((len, from)) = socket.recv_from(&mut buffer) {
                    socket.send_to(&buffer[..len], from).unwrap();
                }
            }
        });
        (address, stop, thread)
    }

    /// Sends `count` numbered packets one by one and gives the numbers that came back, in order.
    fn run(profile: Profile, seed: u64, count: u32) -> (Vec<u32>, RelayStats) {
        let (server, stop, thread) = echo();
        let relay = Relay::start(HERE, server, profile, seed).unwrap();
        let client = UdpSocket::bind(HERE).unwrap();
        client.connect(relay.local_addr()).unwrap();
        client
            .set_read_timeout(Some(Duration::from_millis(400)))
            .unwrap();
        // Read while sending: the system keeps only some 250 small packets for a socket.
        let reader = client.try_clone().unwrap();
        let reader = std::thread::spawn(move || {
            let mut back = Vec::new();
            let mut buffer = [0; 16];
            while let Ok(len) = reader.recv(&mut buffer) {
                back.push(u32::from_le_bytes(buffer[..len].try_into().unwrap()));
            }
            back
        });
        for i in 0..count {
            client.send(&i.to_le_bytes()).unwrap();
            std::thread::sleep(Duration::from_micros(500));
        }
        let back = reader.join().unwrap();
        stop.store(true, Ordering::Relaxed);
        thread.join().unwrap();
        (back, relay.stats())
    }

    #[test]
    fn without_loss_and_reordering_everything_comes_back_in_order() {
        let profile = Profile {
            jitter: Jitter::Uniform(3.0),
            ..Profile::named("metro").unwrap()
        };
        let (back, stats) = run(
            Profile {
                loss: 0.0,
                ..profile
            },
            1,
            400,
        );
        assert_eq!(back, (0..400).collect::<Vec<_>>());
        assert_eq!(
            (stats.sent, stats.delivered, stats.reordered, stats.clients),
            (800, 800, 0, 1)
        );
        println!("{stats:?}");
    }

    #[test]
    fn what_comes_back_is_what_the_fates_say() {
        let profile = Profile {
            duplicate: 0.0,
            ..Profile::named("lossy").unwrap()
        };
        let (back, stats) = run(profile.clone(), 42, 400);
        let fates = Fates::new(profile, 42);
        let arrives = |way, n| fates.fate(0, way, n).copies > 0;
        let up = (0..400).filter(|n| arrives(Direction::Up, *n)).count() as u64;
        let down = (0..up).filter(|n| arrives(Direction::Down, *n)).count();
        assert_eq!(back.len(), down);
        assert!(stats.reordered > 0);
        assert_eq!(stats.dropped, 400 - up + up - down as u64);
        println!("{stats:?}");
    }
}
