//! The event loop of a session.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use palpate_protocol::operation::OperationKind;
use palpate_protocol::session::PeerEvent;
use palpate_protocol::{ServerTime, Span};
use palpate_room::{Cutter, Output, PeerKey, Room, RoomConfig, TissueOrder, TissueReport};
use palpate_tissue::{Model, Tissue};
use palpate_transport::threads::{self, CpuTime, ThreadClass};
use palpate_transport::{
    ModelSource, PeerHandle, PeerId, PeerInput, Server, ServerIdentity, spawn_peer,
};
use palpate_view::{Feed, PageAddress, PageInput};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;
use tracing::Instrument as _;

use super::announcements::Announcements;
use super::links::Links;
use super::options::HostOptions;
use super::page_site::PageSite;
use super::pages::Pages;
use super::session_file::{Continued, SessionFile};
use super::summary::{HostSummary, Refused, TickTimes, limits};
use super::tissue::{Answer, TissueThreads};
use super::tokens::SeatTokens;
use crate::ServerError;

/// Messages from all peers that may wait for the room. Four samples every 4 ms from 64 participants are 16,000
/// datagrams per second, so this is a quarter of a second. Beyond it the tasks of the peers wait, and their sessions
/// drop motion first.
const INBOX_MAX: usize = 4096;

/// Part of the tick's period that the solver may use.
const SOLVER_SHARE: f64 = 0.5;

/// CPU time of a tick after which no further iteration begins, so that sessions on one machine share it.
const SOLVER_LIMIT: Duration = Duration::from_millis(10);

/// Upper bound of the histogram of tick times, in µs.
const TICK_US_MAX: u64 = 10_000_000;

/// I/O threads for all peers; more than two are idle.
const NETWORK_THREADS: usize = 2;

/// CPU time of a tick after which no further iteration begins, for this tick period.
pub fn solver_limit(period: Duration) -> Duration {
    period.mul_f64(SOLVER_SHARE).min(SOLVER_LIMIT)
}

/// Events of the loop.
enum Moved {
    Peer(PeerInput),
    Joined(Box<PeerHandle>),
    Tissue(Box<Answer>),
    Page(Box<PageInput>),
    Time,
    Over(String),
}

struct Session {
    room: Room,
    tissue: TissueThreads,
    peers: BTreeMap<PeerKey, PeerHandle>,
    /// Peers are numbered in the order of their handles.
    newest_peer: u64,
    began: Instant,
    cpu_began: CpuTime,
    ticks_us: Histogram<u64>,
    late_us: Histogram<u64>,
    cuts_us: Histogram<u64>,
    skipped: u64,
    /// Counters of closed connections.
    refused: Refused,
    announcements: Announcements,
    /// Participants in browsers, if the session has a page.
    pages: Option<Pages>,
    tokens: SeatTokens,
    /// Keeps the cuts.
    file: Option<SessionFile>,
    /// Joins and seats at the last update of the tokens.
    seats_known: (u64, usize),
}

/// Announces the address that the server listens on, the links, and the address of the page.
type Announce<'a> = dyn Fn(SocketAddr, &Links, Option<PageAddress>) -> Result<(), ServerError> + 'a;

/// Serves one session, with a source of its model for the seats in `tokens`. `announce` receives the address once the
/// server listens; if it fails, no session is served.
pub(super) fn serve(
    options: &HostOptions,
    (identity, site): (&ServerIdentity, Option<&PageSite>),
    (models, tokens): (ModelSource, SeatTokens),
    model: Model,
    config: RoomConfig,
    announce: &Announce<'_>,
) -> Result<HostSummary, ServerError> {
    let io = |doing: &str| {
        let doing = doing.to_owned();
        move |source| ServerError::Io { doing, source }
    };
    let mut network = tokio::runtime::Builder::new_multi_thread();
    threads::enter_workers(&mut network, ThreadClass::Network);
    let network = network
        .worker_threads(NETWORK_THREADS)
        .enable_all()
        .build()
        .map_err(io("the network threads could not be started"))?;
    let (server, door) = {
        let _inside = network.enter();
        match site {
            Some(site) => {
                let names = site.names.clone();
                let bound = Server::bind_with_pages(options.listen, identity, models, names)?;
                (bound.0, Some(bound.1))
            }
            None => (Server::bind(options.listen, identity, models)?, None),
        }
    };
    let model = Arc::new(model);
    // The tissue is built before participants can join, which takes half a second for 60,000 nodes.
    let (file, continued) = match &options.session {
        Some(path) => {
            let (file, continued) = SessionFile::open(path, &model)?;
            (Some(file), continued)
        }
        None => (None, None),
    };
    let tick = Duration::from_micros(config.tick_period().as_micros().unsigned_abs());
    let began = Instant::now();
    let address = server.local_addr();
    let links = Links::new(options, address, identity.certificate_hash(), site);
    let pages = site.map(|site| {
        let clock = Box::new(move || server_time(began));
        Pages::start((site, door), clock, &model, &config, links.clone())
    });
    let (mut pages, feed) = pages.transpose()?.unzip();
    if let (Some(pages), Some(continued)) = (&mut pages, &continued) {
        pages.set_strokes(continued.strokes.clone());
    }
    let span = tracing::error_span!("session", epoch = config.epoch.0);
    let limit = solver_limit(tick);
    let (room, tissue) = begin(continued, model, config, (limit, feed))?;
    let mut session = Session {
        room,
        tissue,
        peers: BTreeMap::new(),
        newest_peer: 0,
        began,
        cpu_began: threads::cpu_time(),
        ticks_us: histogram()?,
        late_us: histogram()?,
        cuts_us: histogram()?,
        skipped: 0,
        refused: Refused::default(),
        announcements: Announcements::new(),
        pages,
        tokens,
        file,
        seats_known: (0, 0),
    };
    let server = Arc::new(server);
    let (joined, inbox) = span.in_scope(|| accept(&network, Arc::clone(&server), began));
    let page = session.pages.as_ref().map(Pages::address);
    announce(server.local_addr(), &links, page)?;
    // This thread runs the room: it relays motion and computes no tissue.
    let _membership = threads::enter(ThreadClass::Network);
    let here = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(io("the room's event loop could not be started"))?;
    let ended = here.block_on(session.run(options, joined, inbox).instrument(span));
    let file = session.file.take();
    let summary = HostSummary {
        are_cuts_kept: file.map(SessionFile::finish),
        ..session.summary(tick, ended)
    };
    network.block_on(server.close("the host ended the session"));
    network.shutdown_timeout(Duration::from_secs(1));
    Ok(summary)
}

/// The room and the threads of the tissue, with the cuts of a session file.
fn begin(
    continued: Option<Continued>,
    model: Arc<Model>,
    config: RoomConfig,
    (limit, feed): (Duration, Option<Feed>),
) -> Result<(Room, TissueThreads), ServerError> {
    let (tissue, before) = match continued {
        Some(continued) => {
            let (cuts, state) = (continued.strokes[0].len(), continued.state);
            super::progress(&format!(
                "continuing with the {cuts} cuts of the session file"
            ));
            let before = (state, continued.snapshot, continued.newest);
            (continued.tissue, Some(before))
        }
        None => (Tissue::new(model), None),
    };
    let (tissue, hash) = TissueThreads::start(tissue, limit, feed)?;
    let mut room = Room::new(hash, config, ServerTime::ZERO);
    if let Some((state, snapshot, newest)) = before
        && !room.continue_from(state, &snapshot, newest)
    {
        return Err(ServerError::Option(format!(
            "the cuts of the session file are {} MiB, more than a participant can receive; give another file to begin \
             with uncut tissue",
            snapshot.len() >> 20
        )));
    }
    Ok((room, tissue))
}

/// Accepts peers in the background; each reaches the room through the inbox.
fn accept(
    network: &Runtime,
    server: Arc<Server>,
    began: Instant,
) -> (mpsc::Receiver<PeerHandle>, mpsc::Receiver<PeerInput>) {
    let (joined, joined_receiver) = mpsc::channel(16);
    let (inbox, inbox_receiver) = mpsc::channel(INBOX_MAX);
    let accepting = async move {
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
    };
    network.spawn(accepting.in_current_span());
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
    /// Runs until the session is over. Returns the reason.
    async fn run(
        &mut self,
        options: &HostOptions,
        mut joined: mpsc::Receiver<PeerHandle>,
        mut inbox: mpsc::Receiver<PeerInput>,
    ) -> String {
        let over = over(options.duration);
        tokio::pin!(over);
        loop {
            let page_due = self.pages.as_ref().and_then(Pages::poll_timeout);
            let due = self.room.poll_timeout();
            let due = page_due.map_or(due, |page| page.min(due)) - server_time(self.began);
            let wait = Duration::from_micros(u64::try_from(due.as_micros()).unwrap_or(0));
            let moved = tokio::select! {
                biased;
                why = &mut over => Moved::Over(why),
                Some(handle) = joined.recv() => Moved::Joined(Box::new(handle)),
                Some(answer) = self.tissue.answers.recv() => Moved::Tissue(Box::new(answer)),
                Some(input) = inbox.recv() => Moved::Peer(input),
                Some(input) = next_page(&mut self.pages) => Moved::Page(Box::new(input)),
                () = tokio::time::sleep(wait) => Moved::Time,
            };
            match moved {
                Moved::Over(why) => {
                    self.room.handle_close("the host ended the session");
                    self.deliver();
                    // Leaves time to send the goodbye.
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    return why;
                }
                Moved::Joined(handle) => self.handle_joined(*handle),
                Moved::Peer(input) => {
                    // The first messages of a peer may overtake its handle, which takes another path. A reply
                    // without the handle would be lost.
                    while input.peer.0 > self.newest_peer
                        && let Some(handle) = joined.recv().await
                    {
                        self.handle_joined(handle);
                    }
                    self.handle_input(input);
                }
                Moved::Tissue(answer) => self.handle_answer(*answer),
                Moved::Page(input) => {
                    if let Some(pages) = &mut self.pages {
                        pages.handle(*input, &mut self.room);
                    }
                }
                Moved::Time => {}
            }
            if let Some(pages) = &mut self.pages {
                pages.handle_tick(&mut self.room, server_time(self.began));
            }
            // Continuous motion must not delay the tick.
            if server_time(self.began) >= self.room.poll_timeout() {
                self.tick();
            }
            while let Some(order) = self.room.poll_order() {
                if let (TissueOrder::Settle(tick), Some(pages)) = (&order, &self.pages) {
                    let now = server_time(self.began);
                    pages.show_tools(&mut self.room, tick.view_time, now);
                }
                if !self.tissue.order(order) {
                    return "the threads of the tissue failed; this is a fault of the program"
                        .to_owned();
                }
            }
            self.publish_seats();
            self.emulate_networks();
            self.deliver();
            let new = self.room.operations_since(self.announcements.next());
            if let Some(file) = &self.file {
                file.note(new);
            }
            self.announcements.announce(new);
            let now = server_time(self.began);
            self.announcements.announce_limits(self.room.limits(), now);
            if let Some(pages) = &mut self.pages {
                pages.show_state(&self.room, &self.peers, now);
            }
        }
    }

    fn handle_joined(&mut self, handle: PeerHandle) {
        self.newest_peer = handle.id().0;
        self.peers.insert(PeerKey(handle.id().0), handle);
    }

    fn handle_input(&mut self, input: PeerInput) {
        let peer = PeerKey(input.peer.0);
        let closed = matches!(input.event, PeerEvent::Closed(_));
        // Motion logs nothing and is too frequent for a span.
        let is_motion = matches!(input.event, PeerEvent::Motion(_));
        let participant = self.room.participant_of(peer).filter(|_| !is_motion);
        let _span = participant
            .map(|who| tracing::error_span!("participant", id = who.0, peer = peer.0).entered());
        if let PeerEvent::Closed(reason) = &input.event {
            tracing::info!(peer = peer.0, %reason, "peer disconnected");
        }
        self.room.handle_event(peer, input.event, input.at);
        if closed && let Some(handle) = self.peers.remove(&peer) {
            let stats = handle.stats();
            self.skipped += stats.path.skipped_datagrams;
            self.refused.add(&stats);
        }
    }

    fn tick(&mut self) {
        let now = server_time(self.began);
        let late = now - self.room.next_tick();
        // Waiting motion wakes the loop, too.
        if late >= Span::ZERO {
            let late_us = u64::try_from(late.as_micros()).unwrap_or(0);
            self.late_us.saturating_record(late_us.max(1));
        }
        self.room.handle_tick(now);
    }

    fn handle_answer(&mut self, answer: Answer) {
        let us = u64::try_from(answer.took.as_micros()).unwrap_or(TICK_US_MAX);
        match &answer.report {
            TissueReport::Settled { tick, inserted, .. } => {
                if let Some(pages) = &mut self.pages {
                    pages.note_inserted(inserted, tick.view_time);
                }
                self.ticks_us.saturating_record(us.max(1));
                tracing::trace!(?tick, us, "tick");
            }
            TissueReport::Cut { result, .. } => {
                tracing::debug!(us, made = result.is_ok(), "cut");
            }
            TissueReport::Prepared { .. } => self.cuts_us.saturating_record(us.max(1)),
            TissueReport::Snapshot { version, bytes } => {
                tracing::debug!(us, version, bytes = bytes.len(), "snapshot");
                if let Some(file) = &self.file {
                    file.cover(*version, bytes);
                }
            }
        }
        self.room
            .handle_report(answer.report, server_time(self.began));
    }

    /// Publishes the tokens when the seats have changed: before the welcome leaves, which contains one.
    fn publish_seats(&mut self) {
        let seats = (self.room.joined_count(), self.room.participant_count());
        if self.seats_known != seats {
            self.seats_known = seats;
            self.tokens.set(self.room.seats());
        }
    }

    /// Emulates the networks that new operations of the log ask for, also on the new connections of resumed seats.
    fn emulate_networks(&mut self) {
        let new = self.room.operations_since(self.announcements.next());
        let concerns = |kind: &OperationKind| {
            matches!(
                kind,
                OperationKind::Emulated { .. } | OperationKind::Reconnected { .. }
            )
        };
        if !new.iter().any(|operation| concerns(&operation.kind)) {
            return;
        }
        for seat in self.room.seat_figures() {
            let Some(peer) = seat.peer else { continue };
            if let Some(handle) = self.peers.get(&peer) {
                handle.emulate(seat.emulation);
            } else if let Some(pages) = &mut self.pages {
                pages.emulate(peer, seat.emulation);
            }
        }
    }

    fn deliver(&mut self) {
        while let Some(output) = self.room.poll_output() {
            match output {
                Output::Message(peer, message) => {
                    if let Some(pages) = &mut self.pages
                        && pages.deliver(peer, &message, &self.room)
                    {
                        continue;
                    }
                    if let Some(handle) = self.peers.get(&peer) {
                        // The task of a slow peer closes the connection and reports it.
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

    fn summary(self, tick: Duration, ended: String) -> HostSummary {
        let cpu = threads::cpu_time().usage_since(&self.cpu_began);
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
        let late_ms = times(&self.late_us);
        let ticks_skipped = self.room.skipped_tick_count();
        let tissue = self.tissue.finish();
        HostSummary {
            ticks: self.ticks_us.len(),
            tick_ms: times(&self.ticks_us),
            late_ms,
            ticks_skipped,
            cut_ms: times(&self.cuts_us),
            cpu,
            tick_period_ms: tick.as_secs_f64() * 1e3,
            operations: self.room.operation_count(),
            cuts: self.room.cut_count(),
            topology_version: version,
            topology_hash: hash.to_string(),
            components: tissue.as_ref().map_or(0, Cutter::components),
            boundary_closed: tissue.as_ref().is_some_and(Cutter::boundary_closed),
            participants: self.room.joined_count(),
            compensation_ms: self.room.delay_at(server_time(self.began)).as_millis_f64(),
            datagrams_skipped: self.skipped + alive,
            demotions: self.room.demotion_count(),
            limits: limits(self.room.limits()),
            refused,
            seconds: self.began.elapsed().as_secs_f64(),
            are_cuts_kept: None,
            ended,
        }
    }
}

/// The next event of a page; never, without a page.
async fn next_page(pages: &mut Option<Pages>) -> Option<PageInput> {
    match pages {
        Some(pages) => pages.recv().await,
        None => std::future::pending().await,
    }
}

/// Completes with the reason when the session must end.
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
