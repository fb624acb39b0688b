//! The session machine.

mod demotion;
mod seats;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use palpate_protocol::compensation::{DelaySchedule, GroupDelay};
use palpate_protocol::handshake::Subscription;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{
    DelayReport, Request, RequestKind, RequestRefusal, RequestRefused,
};
use palpate_protocol::session::{PeerDatagram, PeerEvent, PeerMessage};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{OperationId, ParticipantId, ServerTime, Span, ToolSample, TopologyHash};
use palpate_tissue::{Model, Tool};

use crate::asked::Repetition;
use crate::authority::{Authority, TickReport};
use crate::config::RoomConfig;
use crate::fan_out::FanOut;
use crate::log::Log;
use crate::participant::Participant;
use crate::pictures::Pictures;

/// Scripts begin so much after the last tool has come.
const START_LEAD: Span = Span::from_millis(1000);

/// Displacements are sent so often.
const CORRECTION_PERIOD: Span = Span::from_millis(100);

/// One connection, as the shell numbers them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PeerKey(pub u64);

/// Something for one connection.
#[derive(Debug, Clone)]
pub enum Output {
    /// Reliable and in order.
    Message(PeerKey, PeerMessage),
    /// May get lost.
    Datagram(PeerKey, PeerDatagram),
}

/// One session.
///
/// Calling order: [`handle_event`](Self::handle_event) for everything that peers send, in the order
/// of arrival; [`handle_tick`](Self::handle_tick) when [`poll_timeout`](Self::poll_timeout) has come;
/// after each of them [`poll_output`](Self::poll_output) until `None`.
pub struct Room {
    config: RoomConfig,
    authority: Authority,
    participants: BTreeMap<ParticipantId, Participant>,
    by_peer: BTreeMap<PeerKey, ParticipantId>,
    next_participant: u16,
    log: Log,
    schedule: DelaySchedule,
    group: GroupDelay,
    started_at: Option<ServerTime>,
    /// Grid point of the latest tick, in ticks since time zero.
    settled: Option<i64>,
    next_tick: ServerTime,
    next_correction: ServerTime,
    next_judgement: ServerTime,
    /// Before this moment reports do not count for the group.
    heard_from: ServerTime,
    cuts: u64,
    demotions: u64,
    repetitions: u64,
    refused: u64,
    fan_out: FanOut,
    pictures: Pictures,
    outputs: VecDeque<Output>,
}

impl Room {
    /// An empty session over a model.
    pub fn new(model: Arc<Model>, config: RoomConfig, now: ServerTime) -> Self {
        Self {
            authority: Authority::new(model),
            participants: BTreeMap::new(),
            by_peer: BTreeMap::new(),
            next_participant: 1,
            log: Log::default(),
            schedule: DelaySchedule::new(&config.compensation),
            group: GroupDelay::new(&config.compensation),
            started_at: None,
            settled: None,
            next_tick: now,
            next_correction: now,
            next_judgement: now,
            heard_from: now,
            cuts: 0,
            demotions: 0,
            repetitions: 0,
            refused: 0,
            fan_out: FanOut::default(),
            pictures: Pictures::default(),
            outputs: VecDeque::new(),
            config,
        }
    }

    /// Something that a peer's session learned.
    pub fn handle_event(&mut self, peer: PeerKey, event: PeerEvent, now: ServerTime) {
        match (event, self.by_peer.get(&peer).copied()) {
            (PeerEvent::Hello(hello), None) => self.handle_hello(peer, hello, now),
            (PeerEvent::Request(request), Some(who)) => self.handle_request(who, request, now),
            (PeerEvent::Motion(samples), Some(who)) => self.handle_motion(who, &samples, now),
            (PeerEvent::Delay(report), Some(who)) => self.note_report(who, report, now),
            (PeerEvent::Closed(reason), Some(who)) => self.handle_leave(who, &reason, now),
            // A second hello is the session's business; the rest comes from nobody we know.
            _ => {}
        }
    }

    /// Scripts begin when enough tools have been heard of: a site that still builds its copy of the
    /// tissue has joined, but would miss the beginning.
    fn start_if_due(&mut self, now: ServerTime) {
        // Everybody's motion comes through here, thousands of times a second.
        if self.started_at.is_some() {
            return;
        }
        let tools = self
            .participants
            .values()
            .filter(|p| p.tool.is_some() && p.timeline.newest().is_some())
            .count();
        if tools >= usize::from(self.config.start_when_tools) {
            let at = now + START_LEAD;
            self.started_at = Some(at);
            self.append(ParticipantId::SERVER, OperationKind::Started { at }, now);
        }
    }

    fn handle_request(&mut self, who: ParticipantId, request: Request, now: ServerTime) {
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        match participant.asked.take(request.id) {
            Repetition::New => {}
            Repetition::Done => {
                self.repetitions += 1;
                return;
            }
            Repetition::Refused(refused) => {
                self.repetitions += 1;
                return self.refuse(who, refused);
            }
        }
        let result = match request.kind {
            RequestKind::Cut(cut) => self.handle_cut(who, &cut, now),
            RequestKind::SetTool(tool) => self.handle_tool(who, tool, now),
            RequestKind::ReportDelay(report) => {
                self.note_report(who, report, now);
                Ok(())
            }
            RequestKind::TopologyReport { version, hash } => self.check_topology(version, hash),
            // The session machine turns a leave into a close.
            RequestKind::Leave => Ok(()),
        };
        if let Err(reason) = result {
            let id = request.id;
            let refused = RequestRefused { id, reason };
            if let Some(participant) = self.participants.get_mut(&who) {
                participant.asked.note_refusal(refused.clone());
            }
            self.refuse(who, refused);
        }
    }

    fn handle_cut(
        &mut self,
        who: ParticipantId,
        cut: &palpate_protocol::request::CutRequest,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        use palpate_protocol::tool::ToolKind;
        let author = &self.participants[&who];
        if author.tool.is_none_or(|t| t.kind != ToolKind::Scalpel) {
            return Err(RequestRefusal::NotAllowed);
        }
        if author.demotion.is_demoted() {
            return Err(RequestRefusal::Demoted);
        }
        if !self.log.takes_work() {
            return Err(RequestRefusal::LogFull);
        }
        let stroke = self.authority.cut(cut)?;
        self.cuts += 1;
        self.append_cut(who, OperationKind::Cut(stroke), now);
        Ok(())
    }

    fn handle_tool(
        &mut self,
        who: ParticipantId,
        tool: ToolDescription,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let participant = self
            .participants
            .get_mut(&who)
            .ok_or(RequestRefusal::NotAllowed)?;
        if !participant.role.has_tool() || !tool.is_valid() {
            return Err(RequestRefusal::NotAllowed);
        }
        if participant.demotion.is_demoted() {
            return Err(RequestRefusal::Demoted);
        }
        if !self.log.takes_work() {
            return Err(RequestRefusal::LogFull);
        }
        participant.tool = Some(tool);
        self.append(
            who,
            OperationKind::ToolChanged {
                participant: who,
                tool,
            },
            now,
        );
        Ok(())
    }

    fn check_topology(&self, version: u32, hash: TopologyHash) -> Result<(), RequestRefusal> {
        match self.authority.hash_at(version) {
            Some(ours) if wire_hash(ours) == hash => Ok(()),
            _ => Err(RequestRefusal::TopologyDiffers),
        }
    }

    fn handle_motion(&mut self, who: ParticipantId, samples: &[ToolSample], now: ServerTime) {
        let in_force = self.schedule.delay_at(now);
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        if participant.tool.is_none() || samples.is_empty() {
            return;
        }
        if let Some(newest) = samples.last() {
            participant.delay.handle_arrival(newest.time, now, in_force);
        }
        // The samples of who only watches are measured, so that it is seen when they come in time again.
        if participant.demotion.is_demoted() {
            return;
        }
        for sample in samples {
            participant.timeline.insert(*sample);
        }
        self.start_if_due(now);
        self.fan_out.push(who, samples);
        self.send_motion(now);
    }

    /// Passes motion on, when its round has come, to all but its author.
    fn send_motion(&mut self, now: ServerTime) {
        let Some(tracks) = self.fan_out.poll(now) else {
            return;
        };
        for (peer, id) in &self.by_peer {
            if tracks.iter().any(|track| track.participant != *id) {
                // The session leaves out its own participant's tool.
                let datagram = PeerDatagram::Motion(Arc::clone(&tracks));
                self.outputs.push_back(Output::Datagram(*peer, datagram));
            }
        }
    }

    /// Brings the tissue to the newest moment of the common grid that is due, within what `stop`
    /// allows, and passes on what motion waits. `None` when no tick is due, or its moment has been settled
    /// already.
    pub fn handle_tick(
        &mut self,
        now: ServerTime,
        stop: &mut dyn FnMut() -> bool,
    ) -> Option<TickReport> {
        self.send_motion(now);
        if now < self.next_tick {
            return None;
        }
        let period = self.config.tick_period();
        while self.next_tick <= now {
            self.next_tick = self.next_tick + period;
        }
        self.give_up_kept(now);
        self.judge(now);
        self.change_delay(now);
        let hz = i64::from(self.config.tick_hz.max(1));
        let grid = (self.schedule.shown_at(now).as_micros() * hz).div_euclid(1_000_000);
        if self.settled.is_some_and(|k| k >= grid) {
            return None;
        }
        self.settled = Some(grid);
        let view_time = ServerTime::from_micros((grid * 1_000_000).div_euclid(hz));
        let tools: Vec<Tool> = self
            .participants
            .values_mut()
            .flat_map(|p| p.pressing_at(view_time))
            .collect();
        let report = self.authority.settle(view_time, &tools, stop);
        self.send_corrections(now);
        self.send_picture(now);
        Some(report)
    }

    /// Sends who has no tissue of their own where its surface is.
    fn send_picture(&mut self, now: ServerTime) {
        let thin: Vec<PeerKey> = self.peers_with(Subscription::Thin).collect();
        if thin.is_empty() {
            return;
        }
        let Some(picture) = self.pictures.poll(&self.authority, now) else {
            return;
        };
        for peer in thin {
            let datagram = PeerDatagram::Picture(Arc::clone(&picture));
            self.outputs.push_back(Output::Datagram(peer, datagram));
        }
    }

    /// The connections of those who have this subscription.
    fn peers_with(&self, subscription: Subscription) -> impl Iterator<Item = PeerKey> + '_ {
        let here = self.participants.values();
        let of = here.filter(move |p| p.subscription == subscription);
        of.filter_map(Participant::peer)
    }

    fn change_delay(&mut self, now: ServerTime) {
        let playing = self
            .participants
            .values()
            .filter(|p| !p.demotion.is_demoted());
        let own = playing.filter_map(|p| p.delay.report());
        match own.max_by_key(|r: &DelayReport| r.wanted_us) {
            Some(worst) => self.group.handle_report(ParticipantId::SERVER, worst),
            // What somebody needed who is gone binds nobody.
            None => self.group.remove(ParticipantId::SERVER),
        }
        if !self.log.takes_delay() {
            return;
        }
        if let Some(change) = self.group.poll_change(now, self.group.lead()) {
            self.schedule
                .handle_change(change.delay_us, change.effective_at);
            let kind = OperationKind::Compensation {
                delay_us: change.delay_us,
                effective_at: change.effective_at,
            };
            self.append(ParticipantId::SERVER, kind, now);
        }
    }

    fn send_corrections(&mut self, now: ServerTime) {
        if now < self.next_correction {
            return;
        }
        self.next_correction = now + CORRECTION_PERIOD;
        let Some(corrections) = self.authority.corrections() else {
            return;
        };
        let corrections = Arc::new(corrections);
        let full: Vec<PeerKey> = self.peers_with(Subscription::Full).collect();
        for peer in full {
            let datagram = PeerDatagram::Corrections(Arc::clone(&corrections));
            self.outputs.push_back(Output::Datagram(peer, datagram));
        }
    }

    /// Says goodbye to everybody.
    pub fn handle_close(&mut self, sentence: &str) {
        let peers: Vec<PeerKey> = self.by_peer.keys().copied().collect();
        for peer in peers {
            self.send(peer, PeerMessage::Goodbye(sentence.to_owned()));
        }
    }

    /// When [`handle_tick`](Self::handle_tick) is due: for the next tick, or for motion that waits.
    pub fn poll_timeout(&self) -> ServerTime {
        let motion = self.fan_out.due();
        motion.map_or(self.next_tick, |due| due.min(self.next_tick))
    }

    /// The moment of the next tick.
    pub fn next_tick(&self) -> ServerTime {
        self.next_tick
    }

    /// The next thing to send.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Number of participants, with those whose seat is kept.
    pub fn participant_count(&self) -> usize {
        self.participants.len()
    }

    /// The operations of the log from that number on, the first being 0.
    pub fn operations_since(&self, first: usize) -> &[Arc<Operation>] {
        self.log.since(first)
    }

    /// Number of operations in the log.
    pub fn operation_count(&self) -> usize {
        self.log.len()
    }

    /// Number of cuts.
    pub fn cut_count(&self) -> u64 {
        self.cuts
    }

    /// Number of requests that came a second time and were not done again.
    pub fn repetition_count(&self) -> u64 {
        self.repetitions
    }

    /// Number of hellos that were not let in.
    pub fn refused_count(&self) -> u64 {
        self.refused
    }

    /// Version and hash of the topology.
    pub fn topology(&self) -> (u32, TopologyHash) {
        (self.authority.version(), wire_hash(self.authority.hash()))
    }

    /// Connected components of the cells. Visits the whole model.
    pub fn components(&self) -> usize {
        self.authority.components()
    }

    /// Whether every edge of the boundary belongs to exactly two triangles. Visits the whole surface.
    pub fn boundary_closed(&self) -> bool {
        self.authority.boundary_closed()
    }

    /// The artificial delay at a moment.
    pub fn delay_at(&self, now: ServerTime) -> Span {
        self.schedule.delay_at(now)
    }

    fn refuse(&mut self, who: ParticipantId, refused: RequestRefused) {
        if let Some(peer) = self.participants.get(&who).and_then(Participant::peer) {
            self.send(peer, PeerMessage::RequestRefused(refused));
        }
    }

    fn append(&mut self, author: ParticipantId, kind: OperationKind, now: ServerTime) {
        let version = self.authority.version();
        self.append_between(author, kind, now, version);
    }

    fn append_cut(&mut self, author: ParticipantId, kind: OperationKind, now: ServerTime) {
        let before = self.authority.version() - 1;
        self.append_between(author, kind, now, before);
    }

    fn append_between(
        &mut self,
        author: ParticipantId,
        kind: OperationKind,
        now: ServerTime,
        version_before: u32,
    ) {
        let operation = Arc::new(Operation {
            id: OperationId(self.log.len() as u64),
            at: now,
            author,
            topology_version_before: version_before,
            topology_version_after: self.authority.version(),
            hash_after: wire_hash(self.authority.hash()),
            kind,
        });
        self.log.push(Arc::clone(&operation));
        let peers: Vec<PeerKey> = self.by_peer.keys().copied().collect();
        for peer in peers {
            self.send(peer, PeerMessage::Operation(Arc::clone(&operation)));
        }
    }

    fn send(&mut self, peer: PeerKey, message: PeerMessage) {
        self.outputs.push_back(Output::Message(peer, message));
    }
}

fn wire_hash(hash: palpate_tissue::TopologyHash) -> TopologyHash {
    TopologyHash(hash.0)
}
