//! The event loop of a session.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use palpate_protocol::ServerTime;
use palpate_protocol::session::PeerEvent;
use palpate_room::{Output, PeerKey, Room, RoomConfig};
use palpate_tissue::Model;
use palpate_transport::{
    ModelSource, PeerHandle, PeerId, PeerInput, Server, ServerIdentity, spawn_peer,
};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

use super::news::News;
use super::options::HostOptions;
use super::summary::{HostSummary, Refused, TickTimes};
use crate::ServerError;

/// Messages from all peers that may wait for the room. Four samples every 4 ms from 64 participants
/// are 16,000 a second, so this is a quarter of a second; beyond it the peers' own tasks wait, and
/// their sessions drop motion first.
const INBOX_MAX: usize = 4096;

/// Part of the tick's period that the solver may use; the rest is for what peers send.
const SOLVER_SHARE: f64 = 0.5;

/// Longest that the solver may keep the room from relaying motion.
const SOLVER_LIMIT: Duration = Duration::from_millis(10);

/// Longest tick that is told apart from longer ones, in µs.
const TICK_US_MAX: u64 = 10_000_000;

/// Threads that move bytes for all peers: more than two find nothing to do.
const NETWORK_THREADS: usize = 2;

/// How long the solver may work on a tick of that period before its last iteration begins.
pub fn solver_limit(period: Duration) -> Duration {
    period.mul_f64(SOLVER_SHARE).min(SOLVER_LIMIT)
}

/// What moves the loop.
enum Moved {
    Peer(PeerInput),
    Joined(Box<PeerHandle>),
    Time,
    Over(String),
}

struct Session {
    room: Room,
    peers: BTreeMap<PeerKey, PeerHandle>,
    /// Peers are numbered in the order in which their handles come.
    newest_peer: u64,
    began: Instant,
    solver_limit: Duration,
    ticks_us: Histogram<u64>,
    late_us: Histogram<u64>,
    participants: u64,
    skipped: u64,
    /// Of those who are gone.
    refused: Refused,
    news: News,
}

/// Serves one session. `announce` is told the address once it listens; where it can not tell anybody, nothing is served.
pub(super) fn serve(
    options: &HostOptions,
    identity: &ServerIdentity,
    models: ModelSource,
    model: Model,
    config: RoomConfig,
    announce: &dyn Fn(SocketAddr) -> Result<(), ServerError>,
) -> Result<HostSummary, ServerError> {
    let io = |doing: &str| {
        let doing = doing.to_owned();
        move |source| ServerError::Io { doing, source }
    };
    let network = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(NETWORK_THREADS)
        .enable_all()
        .build()
        .map_err(io("the network threads could not be started"))?;
    let server = {
        let _inside = network.enter();
        Server::bind(options.listen, identity, models)?
    };
    let began = Instant::now();
    let tick = Duration::from_micros(config.tick_period().as_micros().unsigned_abs());
    let mut session = Session {
        room: Room::new(Arc::new(model), config, ServerTime::ZERO),
        peers: BTreeMap::new(),
        newest_peer: 0,
        began,
        solver_limit: solver_limit(tick),
        ticks_us: histogram()?,
        late_us: histogram()?,
        participants: 0,
        skipped: 0,
        refused: Refused::default(),
        news: News::new(),
    };
    let server = Arc::new(server);
    let (joined, inbox) = accept(&network, Arc::clone(&server), began);
    announce(server.local_addr())?;
    // The room has a thread of its own, this one: the solver may use all of it.
    let here = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(io("the room's event loop could not be started"))?;
    let ended = here.block_on(session.run(options, joined, inbox));
    let summary = session.summary(tick, ended);
    network.block_on(server.close("the host ended the session"));
    network.shutdown_timeout(Duration::from_secs(1));
    Ok(summary)
}

/// Accepts peers in the background; each reaches the room through the inbox.
fn accept(
    network: &Runtime,
    server: Arc<Server>,
    began: Instant,
) -> (mpsc::Receiver<PeerHandle>, mpsc::Receiver<PeerInput>) {
    let (joined, joined_receiver) = mpsc::channel(16);
    let (inbox, inbox_receiver) = mpsc::channel(INBOX_MAX);
    network.spawn(async move {
        let mut next = 0;
        while let Some(connection) = server.accept().await {
            next += 1;
            let handle = spawn_peer(
                connection,
                PeerId(next),
                move || server_time(began),
                inbox.clone(),
            );
            if joined.send(handle).await.is_err() {
                return;
            }
        }
    });
    (joined_receiver, inbox_receiver)
}

fn histogram() -> Result<Histogram<u64>, ServerError> {
    let made = Histogram::new_with_bounds(1, TICK_US_MAX, 3);
    made.map_err(|e| ServerError::Option(e.to_string()))
}

fn times(us: &Histogram<u64>) -> TickTimes {
    let ms = |us: u64| us as f64 / 1e3;
    TickTimes {
        p50: ms(us.value_at_quantile(0.5)),
        p99: ms(us.value_at_quantile(0.99)),
        max: ms(us.max()),
    }
}

fn server_time(began: Instant) -> ServerTime {
    ServerTime::from_micros(i64::try_from(began.elapsed().as_micros()).unwrap_or(i64::MAX))
}

impl Session {
    /// Runs until the session is over; says why.
    async fn run(
        &mut self,
        options: &HostOptions,
        mut joined: mpsc::Receiver<PeerHandle>,
        mut inbox: mpsc::Receiver<PeerInput>,
    ) -> String {
        let over = over(options.duration_s);
        tokio::pin!(over);
        loop {
            let due = self.room.poll_timeout() - server_time(self.began);
            let wait = Duration::from_micros(u64::try_from(due.as_micros()).unwrap_or(0));
            let moved = tokio::select! {
                biased;
                why = &mut over => Moved::Over(why),
                Some(handle) = joined.recv() => Moved::Joined(Box::new(handle)),
                Some(input) = inbox.recv() => Moved::Peer(input),
                () = tokio::time::sleep(wait) => Moved::Time,
            };
            match moved {
                Moved::Over(why) => {
                    self.room.handle_close("the host ended the session");
                    self.deliver();
                    // A moment for the farewell to leave.
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    return why;
                }
                Moved::Joined(handle) => self.handle_joined(*handle),
                Moved::Peer(input) => {
                    // A peer's first words may overtake its handle, which comes another way; an
                    // answer without the handle would be lost.
                    while input.peer.0 > self.newest_peer
                        && let Some(handle) = joined.recv().await
                    {
                        self.handle_joined(handle);
                    }
                    self.handle_input(input);
                }
                Moved::Time => {}
            }
            // Motion that keeps coming must not put the tick off.
            if server_time(self.began) >= self.room.poll_timeout() {
                self.tick();
            }
            self.deliver();
            let news = self.room.operations_since(self.news.told());
            self.news.tell(news);
        }
    }

    fn handle_joined(&mut self, handle: PeerHandle) {
        self.newest_peer = handle.id().0;
        self.peers.insert(PeerKey(handle.id().0), handle);
    }

    fn handle_input(&mut self, input: PeerInput) {
        let peer = PeerKey(input.peer.0);
        let closed = matches!(input.event, PeerEvent::Closed(_));
        if let PeerEvent::Closed(reason) = &input.event {
            tracing::info!(peer = peer.0, %reason, "a peer is gone");
        }
        let before = self.room.participant_count();
        self.room.handle_event(peer, input.event, input.at);
        self.participants += u64::from(self.room.participant_count() > before);
        if closed && let Some(handle) = self.peers.remove(&peer) {
            let stats = handle.stats();
            self.skipped += stats.path.skipped_datagrams;
            self.refused.add(&stats);
        }
    }

    fn tick(&mut self) {
        let now = Instant::now();
        let late = server_time(self.began) - self.room.next_tick();
        let limit = self.solver_limit;
        let mut stop = || now.elapsed() >= limit;
        if let Some(report) = self.room.handle_tick(server_time(self.began), &mut stop) {
            let us = u64::try_from(now.elapsed().as_micros()).unwrap_or(TICK_US_MAX);
            self.ticks_us.saturating_record(us.max(1));
            let late_us = u64::try_from(late.as_micros()).unwrap_or(0);
            self.late_us.saturating_record(late_us.max(1));
            tracing::trace!(?report, us, "tick");
        }
    }

    fn deliver(&mut self) {
        while let Some(output) = self.room.poll_output() {
            match output {
                Output::Message(peer, message) => {
                    if let Some(handle) = self.peers.get(&peer) {
                        // A peer that is too slow is closed by its own task, which tells us.
                        handle.send(message);
                    }
                }
                Output::Datagram(peer, datagram) => {
                    if let Some(handle) = self.peers.get(&peer) {
                        handle.send_datagram(datagram);
                    }
                }
            }
        }
    }

    fn summary(&self, tick: Duration, ended: String) -> HostSummary {
        let (version, hash) = self.room.topology();
        let mut refused = Refused {
            joins: self.room.refused_count(),
            repetitions: self.room.repetition_count(),
            ..self.refused
        };
        for peer in self.peers.values() {
            refused.add(&peer.stats());
        }
        let alive = self
            .peers
            .values()
            .map(|p| p.stats().path.skipped_datagrams)
            .sum::<u64>();
        HostSummary {
            ticks: self.ticks_us.len(),
            tick_ms: times(&self.ticks_us),
            late_ms: times(&self.late_us),
            tick_period_ms: tick.as_secs_f64() * 1e3,
            operations: self.room.operation_count(),
            cuts: self.room.cut_count(),
            topology_version: version,
            topology_hash: hash.to_string(),
            components: self.room.components(),
            boundary_closed: self.room.boundary_closed(),
            participants: self.participants,
            compensation_ms: self.room.delay_at(server_time(self.began)).as_millis_f64(),
            datagrams_skipped: self.skipped + alive,
            demotions: self.room.demotion_count(),
            refused,
            seconds: self.began.elapsed().as_secs_f64(),
            ended,
        }
    }
}

/// Completes when the session is to end, with the reason.
async fn over(duration_s: Option<f64>) -> String {
    let time = async {
        match duration_s {
            Some(s) => tokio::time::sleep(Duration::from_secs_f64(s)).await,
            None => std::future::pending().await,
        }
    };
    tokio::select! {
        () = time => "the session ended".to_owned(),
        () = interrupted() => "interrupted".to_owned(),
    }
}

#[cfg(unix)]
async fn interrupted() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else {
        return std::future::pending().await;
    };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = tokio::signal::ctrl_c() => {}
    }
}

#[cfg(not(unix))]
async fn interrupted() {
    let _ = tokio::signal::ctrl_c().await;
}
