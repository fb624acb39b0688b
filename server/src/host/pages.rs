//! Participants in browsers: a page is a peer of the room like any client, with its session machine at the host.

use std::collections::BTreeMap;

use palpate_protocol::handshake::{Hello, Refused, Resume, Subscription, Welcome};
use palpate_protocol::operation::OperationKind;
use palpate_protocol::request::{Invitation, Request, RequestKind, RequestRefusal};
use palpate_protocol::session::{
    CloseReason, PeerEvent, PeerMessage, PeerMotion, REQUESTS_PER_SECOND_MAX,
};
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_protocol::{
    Emulation, OperationId, ParticipantId, ProtocolError, RequestId, ServerTime, Span, TokenBucket,
    ToolSample, name,
};
use palpate_room::{PeerKey, Room, RoomConfig, ToolShown};
use palpate_site::{StrokeCollector, StrokeRefusals};
use palpate_tissue::Model;
use palpate_transport::threads;
use palpate_transport::{PageDoor, PeerHandle};
use palpate_view::{
    Feed, InvitationMessage, PageAddress, PageEvent, PageHello, PageId, PageInput, PageRequest,
    Seat, ToolFrame, ToolPose, ViewConfig, ViewListener, ViewServer, WelcomeRegion,
};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

use super::BROWSER_ROLES;
use super::emulated_page::EmulatedPage;
use super::links::Links;
use super::page_site::PageSite;
use super::session_view::SessionView;
use super::steered_tool::{SAMPLE_PERIOD, SteeredTool};
use crate::ServerError;

/// Requests of a page per second in the long run, and at once, as of any other peer.
const REQUESTS_PER_S: f64 = REQUESTS_PER_SECOND_MAX as f64;
const REQUESTS_BURST: f64 = REQUESTS_PER_S;

/// The number of the first request of a connection, above all numbers of earlier connections of its seat: it rises by
/// 500 per second, and a connection uses a burst of 50 and 50 per second. A page waits 0.25 s before it connects again.
fn first_request(now: ServerTime) -> u32 {
    (now.as_micros() / 2000).unsigned_abs() as u32 + 1
}

/// Whether a peer is a page.
pub(super) fn is_page(peer: PeerKey) -> bool {
    page_of(peer).is_some()
}

/// Bit of the peer keys of pages; the keys of other peers count up from 1.
const PAGE_BIT: u64 = 1 << 63;

/// The peer of a page.
fn key_of(page: PageId) -> PeerKey {
    PeerKey(page.0 | PAGE_BIT)
}

/// The page of a peer, if it is one.
fn page_of(peer: PeerKey) -> Option<PageId> {
    (peer.0 & PAGE_BIT != 0).then_some(PageId(peer.0 & !PAGE_BIT))
}

/// A page with a seat, or on its way to one.
struct Player {
    /// Between the page and the room.
    network: EmulatedPage,
    /// Its tool, once the page has sent a pose.
    tool: Option<SteeredTool>,
    round_trip: Option<Span>,
    participant: Option<ParticipantId>,
    /// Collects strokes, while its seat has a blade.
    strokes: Option<StrokeCollector>,
    refusals: StrokeRefusals,
    next_request: u32,
    /// Budget of requests.
    requests: TokenBucket,
    /// Whether it asked to leave.
    leaves: bool,
}

/// All pages of a session.
pub(super) struct Pages {
    view: ViewServer,
    inputs: mpsc::Receiver<PageInput>,
    players: BTreeMap<PageId, Player>,
    /// Time of the next samples.
    due: ServerTime,
    regions: Vec<WelcomeRegion>,
    tick_hz: u32,
    links: Links,
    state: SessionView,
    /// Serves the page at background priority.
    _runtime: Runtime,
}

impl Pages {
    /// Serves the page, by WebTransport through `door`. Returns the solver's end as well.
    pub(super) fn start(
        (site, door): (&PageSite, Option<PageDoor>),
        clock: Box<dyn Fn() -> ServerTime + Send + Sync>,
        model: &Model,
        config: &RoomConfig,
        links: Links,
    ) -> Result<(Self, Feed), ServerError> {
        let runtime = threads::background_runtime().map_err(|source| ServerError::Io {
            doing: "the thread of the page could not be started".to_owned(),
            source,
        })?;
        let at = ViewConfig {
            listener: ViewListener::bind(site.listen)?,
            host: site.public.clone(),
            tls: site.tls.clone(),
            web_transport: door,
            clock,
        };
        let (view, feed, inputs) = ViewServer::start(at, runtime.handle())?;
        let pages = Self {
            view,
            inputs,
            players: BTreeMap::new(),
            due: ServerTime::ZERO,
            regions: WelcomeRegion::all(model),
            tick_hz: config.tick_hz,
            links,
            state: SessionView::new(config),
            _runtime: runtime,
        };
        Ok((pages, feed))
    }

    /// Takes the strokes that the session begins with: in effect, and taken back.
    pub(super) fn set_strokes(&mut self, strokes: [Vec<u64>; 2]) {
        self.state.set_strokes(strokes);
    }

    /// The address of the page.
    pub(super) fn address(&self) -> PageAddress {
        self.view.address()
    }

    /// Shows the tools at a displayed time.
    pub(super) fn show_tools(&self, room: &mut Room, s: ServerTime, now: ServerTime) {
        if !self.view.is_watched() {
            return;
        }
        let pose = |tool: ToolShown| ToolPose {
            participant: tool.participant,
            is_active: true,
            buttons: tool.buttons,
            pose: tool.pose,
            returns: tool.returns,
            ..ToolPose::default()
        };
        self.view.show_tools(ToolFrame {
            delay: room.delay_at(now),
            time: s,
            sent: now,
            tools: room.tools_at(s).into_iter().map(pose).collect(),
        });
    }

    /// Shows the state of the session, if it is due.
    pub(super) fn show_state(
        &mut self,
        room: &Room,
        peers: &BTreeMap<PeerKey, PeerHandle>,
        now: ServerTime,
    ) {
        self.state.follow(room, now);
        if self.view.is_watched()
            && let Some(state) = self.state.poll(room, peers, now)
        {
            self.view.show_state(&state);
        }
    }

    /// The next event of a page.
    pub(super) async fn recv(&mut self) -> Option<PageInput> {
        self.inputs.recv().await
    }

    /// Emulates a network for the page of a peer.
    pub(super) fn emulate(&mut self, peer: PeerKey, emulation: Emulation) {
        let player = page_of(peer).and_then(|page| self.players.get_mut(&page));
        if let Some(player) = player {
            player.network.set(emulation);
        }
    }

    /// Passes an event of a page to the room, by way of its emulated network.
    pub(super) fn handle(&mut self, input: PageInput, room: &mut Room) {
        let PageInput { page, at, event } = input;
        if let Some(player) = self.players.get_mut(&page) {
            let network = &mut player.network;
            if matches!(event, PageEvent::Closed { .. }) {
                let requests: Vec<_> = std::iter::from_fn(|| network.take_request()).collect();
                for request in requests {
                    self.handle_arrived(page, request, room, at);
                }
            } else if !network.is_idle() {
                return network.push(event, at);
            }
        }
        self.handle_arrived(page, event, room, at);
    }

    /// Passes the events to the room that their emulated networks have delivered by now.
    fn handle_due(&mut self, room: &mut Room, now: ServerTime) {
        let mut due = Vec::new();
        for (page, player) in &mut self.players {
            due.extend(std::iter::from_fn(|| player.network.poll(now)).map(|event| (*page, event)));
        }
        for (page, event) in due {
            self.handle_arrived(page, event, room, now);
        }
    }

    fn handle_arrived(&mut self, page: PageId, event: PageEvent, room: &mut Room, now: ServerTime) {
        let peer = key_of(page);
        match event {
            PageEvent::Hello(hello) => self.greet(page, &hello, room, now),
            PageEvent::Motion {
                samples,
                round_trip,
            } => self.steer(page, &samples, round_trip, now),
            PageEvent::Request(PageRequest::Tool(tool)) => {
                self.request(page, RequestKind::SetTool(tool), room, now);
            }
            PageEvent::Request(PageRequest::Control(control)) => {
                self.request(page, RequestKind::Control(control), room, now);
            }
            PageEvent::Request(PageRequest::Leave) => {
                if let Some(player) = self.players.get_mut(&page) {
                    player.leaves = true;
                }
                room.handle_event(peer, PeerEvent::Closed(CloseReason::Left), now);
                self.view.goodbye(page, "you left the session");
            }
            PageEvent::Closed { violation } => {
                let Some(player) = self.players.remove(&page) else {
                    return;
                };
                if player.leaves {
                    return;
                }
                let reason = match violation {
                    Some(sentence) => CloseReason::Violation(ProtocolError::Page(sentence)),
                    None => CloseReason::ConnectionLost("the page is gone".to_owned()),
                };
                room.handle_event(peer, PeerEvent::Closed(reason), now);
            }
        }
    }

    fn greet(&mut self, page: PageId, hello: &PageHello, room: &mut Room, now: ServerTime) {
        let Some(role) = hello.role else {
            return self
                .view
                .refuse(page, "the link of the page names no role", false);
        };
        let name = match name::normalise(&hello.name) {
            Ok(name) => name,
            Err(error) => return self.view.refuse(page, &error.to_string(), false),
        };
        let (topology_version, topology_hash) = room.topology();
        // The room draws for the page, so no operation is missing there.
        let resume = hello.seat.map(|(participant, token)| Resume {
            participant,
            token,
            next_operation: OperationId(room.operation_count() as u64),
            topology_version,
            topology_hash,
        });
        let tool = hello.tool.filter(|_| role.has_tool());
        let player = Player {
            network: EmulatedPage::new(page.0),
            tool: None,
            round_trip: None,
            participant: None,
            strokes: None,
            refusals: StrokeRefusals::default(),
            next_request: first_request(now),
            requests: TokenBucket::new(REQUESTS_PER_S, REQUESTS_BURST, now - ServerTime::ZERO),
            leaves: false,
        };
        self.players.insert(page, player);
        let hello = Hello {
            name,
            role,
            grant: hello.grant,
            tool,
            subscription: Subscription::Full,
            resume,
        };
        room.handle_event(key_of(page), PeerEvent::Hello(hello), now);
    }

    /// Moves the tool of a page to the newest of its poses.
    fn steer(
        &mut self,
        page: PageId,
        samples: &[ToolSample],
        round_trip: Option<Span>,
        now: ServerTime,
    ) {
        let newest = samples.last();
        let Some((player, newest)) = self.players.get_mut(&page).zip(newest) else {
            return;
        };
        player.round_trip = round_trip;
        let tool = &mut player.tool;
        if (tool.take_if(|tool| !tool.continues(&newest.pose, now))).is_some() {
            // The blade did not move here through the tissue.
            player
                .strokes
                .iter_mut()
                .for_each(StrokeCollector::drop_open);
        }
        tool.get_or_insert_with(|| SteeredTool::new(&newest.pose, now))
            .steer(&newest.pose, newest.buttons, now);
    }

    /// Notes whose needles the tissue holds at a displayed time.
    pub(super) fn note_inserted(&mut self, inserted: &[ParticipantId], view_time: ServerTime) {
        for player in self.players.values_mut() {
            let is_inserted = player
                .participant
                .is_some_and(|who| inserted.contains(&who));
            if let Some(tool) = &mut player.tool {
                tool.hold(is_inserted, view_time);
            }
        }
    }

    /// Time of the next [`handle_tick`](Self::handle_tick); `None` while no page holds a tool and no message waits.
    pub(super) fn poll_timeout(&self) -> Option<ServerTime> {
        let mut tools = self.players.values().filter_map(|p| p.tool.as_ref());
        let holds_tool = tools.any(|tool| tool.is_held(self.due));
        let waiting = self.players.values().map(|p| p.network.poll_timeout());
        waiting
            .chain([holds_tool.then_some(self.due)])
            .flatten()
            .min()
    }

    /// Passes messages that are due to the room, the motion of all tools, and finished strokes.
    pub(super) fn handle_tick(&mut self, room: &mut Room, now: ServerTime) {
        self.handle_due(room, now);
        if now < self.due {
            return;
        }
        self.due = now + SAMPLE_PERIOD;
        let mut cuts = Vec::new();
        for (page, player) in &mut self.players {
            let Some(sample) = player.tool.as_mut().and_then(|tool| tool.poll(now)) else {
                continue;
            };
            if let Some(strokes) = &mut player.strokes {
                let cut = strokes.push(now, &sample.pose, sample.buttons & 1 == 1);
                cuts.extend(cut.map(|cut| (*page, RequestKind::Cut(cut))));
            }
            let motion = PeerMotion {
                round_trip: player.round_trip,
                ..PeerMotion::on_time(vec![sample], now)
            };
            room.handle_event(key_of(*page), PeerEvent::Motion(motion), now);
        }
        for (page, cut) in cuts {
            self.request(page, cut, room, now);
        }
    }

    fn request(&mut self, page: PageId, kind: RequestKind, room: &mut Room, now: ServerTime) {
        let Some(player) = self.players.get_mut(&page) else {
            return;
        };
        if !player.requests.take(1.0, now - ServerTime::ZERO) {
            let sentence = RequestRefusal::TooMany.to_string();
            return self.view.notice(Some(page), &sentence);
        }
        let id = RequestId(player.next_request);
        player.next_request += 1;
        if let RequestKind::Cut(part) = &kind {
            player.refusals.note_sent(id, part);
        }
        let request = Request { id, kind };
        room.handle_event(key_of(page), PeerEvent::Request(request), now);
    }

    /// Passes a message of the room to its page. Returns whether the peer is a page.
    pub(super) fn deliver(&mut self, peer: PeerKey, message: &PeerMessage, room: &Room) -> bool {
        let Some(page) = page_of(peer) else {
            return false;
        };
        match message {
            PeerMessage::Welcome(welcome) => self.welcome(page, welcome),
            PeerMessage::Refused(Refused { reason, sentence }) => {
                self.players.remove(&page);
                self.view.refuse(page, sentence, reason.is_temporary());
            }
            PeerMessage::RequestRefused(refused) => {
                let player = self.players.get_mut(&page);
                if player.is_none_or(|player| player.refusals.is_shown(refused)) {
                    self.view.notice(Some(page), &refused.reason.to_string());
                }
            }
            PeerMessage::Invitation(invitation) => self.show_invitation(page, invitation, room),
            PeerMessage::Goodbye(sentence) => self.view.goodbye(page, sentence),
            // Pages see the state and the tissue, not the log.
            PeerMessage::Snapshot(_) => {}
            PeerMessage::Operation(operation) => {
                let Some(player) = self.players.get_mut(&page) else {
                    return true;
                };
                match &operation.kind {
                    OperationKind::ToolChanged { participant, tool }
                        if player.participant == Some(*participant) =>
                    {
                        player.strokes = strokes_of(tool);
                    }
                    OperationKind::Cut(part) if player.participant == Some(operation.author) => {
                        player.refusals.note_cut(part);
                    }
                    _ => {}
                }
            }
        }
        true
    }

    /// Shows a page the addresses of the invitation that it requested.
    fn show_invitation(&self, page: PageId, &Invitation { id, grant }: &Invitation, room: &Room) {
        let Some(invited) = room.invitation(id) else {
            return;
        };
        let (role, name) = (invited.role, invited.name.as_deref());
        // Recording takes a program.
        let is_for_browsers = BROWSER_ROLES.contains(&role);
        let url = (self.links).page(self.view.address(), role, grant, name);
        let message = InvitationMessage {
            id,
            link: self.links.link(role, grant).to_string(),
            url: is_for_browsers.then_some(url),
        };
        self.view.show_invitation(Some(page), &message);
    }

    fn welcome(&mut self, page: PageId, welcome: &Welcome) {
        let me = welcome.participant;
        let own = welcome.roster.iter().find(|e| e.participant == me);
        if let Some(player) = self.players.get_mut(&page) {
            player.participant = Some(me);
            // A resumed seat keeps its tool, whatever the page has chosen since.
            player.strokes = own.and_then(|entry| strokes_of(entry.tool.as_ref()?));
        }
        self.view.welcome(
            page,
            &palpate_view::Welcome {
                participant: me.0,
                name: own.map_or_else(String::new, |entry| entry.name.clone()),
                role: welcome.role.word(),
                source: "server",
                can_steer: welcome.role.has_tool(),
                tick_hz: self.tick_hz,
                regions: self.regions.clone(),
                seat: Some(Seat::new(me, welcome.resume_token)),
            },
        );
    }
}

/// The collector of strokes of a blade.
fn strokes_of(tool: &ToolDescription) -> Option<StrokeCollector> {
    (tool.kind == ToolKind::Scalpel).then(|| StrokeCollector::new(tool.length_m))
}
