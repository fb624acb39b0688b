//! Sockets and threads of the relay.
//!
//! One thread receives from clients, one thread per client receives from the server, and one thread delivers.
//! The delivery thread sleeps until the next packet is due, on a condition variable with an absolute deadline,
//! which wakes within about 0.1 ms. (Timers of an asynchronous runtime have a resolution of 1 ms and would add
//! jitter.)

use std::collections::HashMap;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use palpate_transport::threads::{self, ThreadClass};

use super::stats::RelayStats;
use crate::histogram::StepHistogram;
use crate::network::{Arrivals, Direction, EventQueue, Path, Profile};

/// Maximum packets in flight; more are dropped and counted as overflowed. At 1200 B this is 80 MB, and 300 ms
/// of 200,000 packets per second.
pub const QUEUE_MAX_PACKETS: usize = 65_536;

/// Maximum clients, each with a socket and a thread; packets of more clients are dropped and counted as
/// overflowed.
pub const CLIENTS_MAX: usize = 64;

/// Stop check interval of the receiving threads.
const STOP_PERIOD: Duration = Duration::from_millis(50);
const PACKET_MAX_BYTES: usize = 65_536;

/// A running relay. Dropping it stops it.
pub struct Relay {
    address: SocketAddr,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

struct Shared {
    profile: Profile,
    seed: u64,
    server: SocketAddr,
    /// Start of the network.
    began: Instant,
    flows: Mutex<Vec<Arc<Flow>>>,
    queue: Mutex<Queue>,
    due: Condvar,
    stop: AtomicBool,
}

#[derive(Default)]
struct Queue {
    parcels: EventQueue<Instant, Parcel>,
    overflowed: u64,
    delivered: u64,
    /// Times in ms, in steps of 0.1 ms.
    delays: StepHistogram<10>,
    lateness: StepHistogram<10>,
}

struct Parcel {
    arrived: Instant,
    way: Arc<Way>,
    /// Its number in this direction.
    n: u64,
    bytes: Vec<u8>,
}

struct Flow {
    up: Arc<Way>,
    down: Arc<Way>,
    answers: Mutex<Answers>,
    rebinds: AtomicU64,
}

struct Answers {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct Way {
    /// Sending socket: that of the flow towards the server, which changes with its address, or the one that all
    /// clients send to.
    socket: Mutex<Arc<UdpSocket>>,
    /// `None` for a connected socket.
    to: Option<SocketAddr>,
    path: Mutex<Path>,
    /// Highest sent packet number plus one.
    newest_out: AtomicU64,
    /// Packets sent after one with a higher number.
    reordered: AtomicU64,
}

/// A poisoned lock means that another relay thread failed; the figures remain valid.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Relay {
    pub fn start(
        listen: SocketAddr,
        to: SocketAddr,
        profile: Profile,
        seed: u64,
    ) -> io::Result<Self> {
        let socket = Arc::new(UdpSocket::bind(listen)?);
        socket.set_read_timeout(Some(STOP_PERIOD))?;
        let address = socket.local_addr()?;
        let shared = Arc::new(Shared {
            profile,
            seed,
            server: to,
            began: Instant::now(),
            flows: Mutex::default(),
            queue: Mutex::default(),
            due: Condvar::new(),
            stop: AtomicBool::new(false),
        });
        let listener = {
            let shared = shared.clone();
            spawn("relay-listen", move || listen_to_clients(&shared, &socket))?
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

    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Changes the address of a client as seen by the server, as after a NAT rebinding or a change of the
    /// network interface. Packets to the old address are lost, and no others. Flows count from 0 in the order
    /// of their first packet. Returns the new address.
    pub fn rebind(&self, flow: usize) -> Result<SocketAddr, String> {
        let (flows, found) = {
            let flows = lock(&self.shared.flows);
            (flows.len(), flows.get(flow).cloned())
        };
        let found = found.ok_or_else(|| {
            format!("there is no flow {flow}: the relay has seen {flows} clients, and the first is flow 0")
        })?;
        let socket = |why| format!("no socket for a new address of flow {flow}: {why}");
        let upstream = towards(self.shared.server).map_err(socket)?;
        let address = upstream.local_addr().map_err(socket)?;
        let answers = answers(&self.shared, &upstream, &found.down).map_err(socket)?;
        *lock(&found.up.socket) = upstream;
        let old = std::mem::replace(&mut *lock(&found.answers), answers);
        old.end();
        found.rebinds.fetch_add(1, Ordering::Relaxed);
        Ok(address)
    }

    pub fn stats(&self) -> RelayStats {
        let mut stats = RelayStats {
            profile: self.shared.profile.name.clone(),
            seed: self.shared.seed,
            ..RelayStats::default()
        };
        for flow in lock(&self.shared.flows).iter() {
            stats.clients += 1;
            stats.rebinds += flow.rebinds.load(Ordering::Relaxed);
            for (way, sum) in [(&flow.up, &mut stats.up), (&flow.down, &mut stats.down)] {
                let counts = lock(&way.path).counts();
                let reordered = way.reordered.load(Ordering::Relaxed);
                sum.add(counts, reordered);
                stats.total.add(counts, reordered);
            }
        }
        let queue = lock(&self.shared.queue);
        RelayStats {
            overflowed: queue.overflowed,
            delivered: queue.delivered,
            delay_mean_ms: queue.delays.mean(),
            delay_p50_ms: queue.delays.quantile(0.5),
            delay_p99_ms: queue.delays.quantile(0.99),
            lateness_p99_ms: queue.lateness.quantile(0.99),
            loss: stats.total.dropped as f64 / stats.total.sent.max(1) as f64,
            ..stats
        }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.due.notify_all();
        for thread in self.threads.drain(..) {
            // A failed thread has no result.
            let _ = thread.join();
        }
        for flow in lock(&self.shared.flows).drain(..) {
            lock(&flow.answers).wait();
        }
    }
}

impl Answers {
    /// Ends this flow while the relay continues.
    fn end(mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.wait();
    }

    fn wait(&mut self) {
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> io::Result<JoinHandle<()>> {
    // Emulated delays must not depend on the load of the machine.
    threads::spawn(ThreadClass::Network, name, work)
}

/// Receives until stopped; socket errors about single packets are ignored.
fn receive(
    is_over: impl Fn() -> bool,
    socket: &UdpSocket,
    mut handle: impl FnMut(&[u8], SocketAddr),
) {
    let mut buffer = vec![0; PACKET_MAX_BYTES];
    while !is_over() {
        // A timeout, or an ICMP error of a closed port: both are transient.
        if let Ok((len, from)) = socket.recv_from(&mut buffer) {
            handle(&buffer[..len], from);
        }
    }
}

fn listen_to_clients(shared: &Arc<Shared>, socket: &Arc<UdpSocket>) {
    let mut clients: HashMap<SocketAddr, Arc<Way>> = HashMap::new();
    let is_over = || shared.stop.load(Ordering::Relaxed);
    receive(is_over, socket, |bytes, from| {
        if !clients.contains_key(&from) {
            let new = (clients.len() < CLIENTS_MAX)
                .then(|| open_flow(shared, socket, from, clients.len() as u64).ok())
                .flatten();
            let Some(flow) = new else {
                lock(&shared.queue).overflowed += 1;
                return;
            };
            clients.insert(from, flow.up.clone());
            lock(&shared.flows).push(flow);
        }
        if let Some(up) = clients.get(&from) {
            shared.take(up, bytes);
        }
    });
}

fn towards(server: SocketAddr) -> io::Result<Arc<UdpSocket>> {
    let any: SocketAddr = if server.is_ipv4() {
        (Ipv4Addr::UNSPECIFIED, 0).into()
    } else {
        (Ipv6Addr::UNSPECIFIED, 0).into()
    };
    let socket = UdpSocket::bind(any)?;
    socket.connect(server)?;
    socket.set_read_timeout(Some(STOP_PERIOD))?;
    Ok(Arc::new(socket))
}

fn open_flow(
    shared: &Arc<Shared>,
    listening: &Arc<UdpSocket>,
    client: SocketAddr,
    flow: u64,
) -> io::Result<Arc<Flow>> {
    let upstream = towards(shared.server)?;
    let way = |socket: &Arc<UdpSocket>, to, direction| {
        let path = Path::new(&shared.profile, shared.seed, flow, direction);
        Arc::new(Way {
            socket: Mutex::new(socket.clone()),
            to,
            path: Mutex::new(path),
            newest_out: AtomicU64::new(0),
            reordered: AtomicU64::new(0),
        })
    };
    let down = way(listening, Some(client), Direction::Down);
    let answers = answers(shared, &upstream, &down)?;
    Ok(Arc::new(Flow {
        up: way(&upstream, None, Direction::Up),
        down,
        answers: Mutex::new(answers),
        rebinds: AtomicU64::new(0),
    }))
}

fn answers(
    shared: &Arc<Shared>,
    upstream: &Arc<UdpSocket>,
    down: &Arc<Way>,
) -> io::Result<Answers> {
    let stop = Arc::new(AtomicBool::new(false));
    let (shared, upstream, down, stopped) =
        (shared.clone(), upstream.clone(), down.clone(), stop.clone());
    let thread = spawn("relay-answers", move || {
        let is_over = || shared.stop.load(Ordering::Relaxed) || stopped.load(Ordering::Relaxed);
        receive(is_over, &upstream, |bytes, _| {
            // A packet that arrived during a rebind was sent to the old address.
            if !stopped.load(Ordering::Relaxed) {
                shared.take(&down, bytes);
            }
        });
    })?;
    Ok(Answers {
        stop,
        thread: Some(thread),
    })
}

impl Shared {
    fn take(&self, way: &Arc<Way>, bytes: &[u8]) {
        let arrived = Instant::now();
        let (n, arrivals) = {
            let mut path = lock(&way.path);
            let at_us = micros(arrived.saturating_duration_since(self.began));
            (path.counts().sent, path.send(at_us, bytes.len()))
        };
        self.queue_up(way, bytes, arrived, n, arrivals);
        self.due.notify_one();
    }

    fn queue_up(&self, way: &Arc<Way>, bytes: &[u8], arrived: Instant, n: u64, arrivals: Arrivals) {
        let mut queue = lock(&self.queue);
        for arrival in arrivals {
            if queue.parcels.len() >= QUEUE_MAX_PACKETS {
                queue.overflowed += 1;
                continue;
            }
            let mut bytes = bytes.to_vec();
            if let Some(corruption) = arrival.corrupted {
                corruption.apply(&mut bytes);
            }
            let parcel = Parcel {
                arrived,
                way: way.clone(),
                n,
                bytes,
            };
            let due = self.began + Duration::from_micros(arrival.at_us);
            queue.parcels.push(due, parcel);
        }
    }

    fn deliver(&self) {
        let mut queue = lock(&self.queue);
        while !self.stop.load(Ordering::Relaxed) {
            let now = Instant::now();
            let Some((due, parcel)) = queue.parcels.pop_due(now) else {
                let wait = queue.parcels.next_at().map_or(STOP_PERIOD, |due| {
                    due.saturating_duration_since(now).min(STOP_PERIOD)
                });
                let waited = self.due.wait_timeout(queue, wait);
                queue = waited.unwrap_or_else(PoisonError::into_inner).0;
                continue;
            };
            queue.note_delivery(&parcel, due, now);
            drop(queue);
            let socket = lock(&parcel.way.socket).clone();
            // If the receiver is gone, the packet is lost.
            let _ = match parcel.way.to {
                Some(to) => socket.send_to(&parcel.bytes, to),
                None => socket.send(&parcel.bytes),
            };
            queue = lock(&self.queue);
        }
    }
}

fn micros(d: Duration) -> u64 {
    u64::try_from(d.as_micros()).unwrap_or(u64::MAX)
}

fn millis(d: Duration) -> f64 {
    d.as_secs_f64() * 1e3
}

impl Queue {
    fn note_delivery(&mut self, parcel: &Parcel, due: Instant, now: Instant) {
        self.delays
            .add(millis(now.saturating_duration_since(parcel.arrived)));
        self.lateness
            .add(millis(now.saturating_duration_since(due)));
        self.delivered += 1;
        let newest = parcel
            .way
            .newest_out
            .fetch_max(parcel.n + 1, Ordering::Relaxed);
        let is_late = u64::from(parcel.n + 1 < newest);
        parcel.way.reordered.fetch_add(is_late, Ordering::Relaxed);
    }
}
