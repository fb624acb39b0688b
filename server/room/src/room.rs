//! The state machine of a session.

mod controls;
mod cuts;
mod demotion;
mod inviting;
mod seats;
mod shown;

pub use shown::{SeatFigures, ToolShown};

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use palpate_protocol::compensation::{DelaySchedule, GroupDelay};
use palpate_protocol::handshake::Subscription;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{
    DelayReport, Request, RequestKind, RequestRefusal, RequestRefused,
};
use palpate_protocol::session::{PeerDatagram, PeerEvent, PeerMessage, PeerMotion};
use palpate_protocol::{
    OperationId, ParticipantId, RequestId, ResumeToken, ServerTime, Span, TokenBucket, TopologyHash,
};
use palpate_tissue::Tool;

use crate::authority::{Settling, TissueOrder, TissueReport};
use crate::config::RoomConfig;
use crate::control_state::ControlState;
use crate::cut_queue::CutQueue;
use crate::fan_out::FanOut;
use crate::joins::Joins;
use crate::limits::{Limit, LimitCounters};
use crate::log::{Log, TopologyState};
use crate::participant::Participant;
use crate::request_history::Repetition;

/// Time from the arrival of the last tool to the start of scripts.
const START_LEAD: Span = Span::from_millis(1000);

/// Time between two corrections of displacements.
const CORRECTION_PERIOD: Span = Span::from_millis(100);

/// Changes of the delay at once, and per second in the long run. Networks need a few per second for a while; with this
/// rate the log takes them for more than four hours.
const DELAY_CHANGES_BURST: f64 = 4000.0;
const DELAY_CHANGES_PER_S: f64 = 0.25;

/// Number of a connection, assigned by the server program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PeerKey(pub u64);

/// A message for one connection.
#[derive(Debug, Clone)]
pub enum Output {
    /// Reliable and in order.
    Message(PeerKey, PeerMessage),
    /// Unreliable.
    Datagram(PeerKey, PeerDatagram),
}

/// One session.
///
/// Calling order: [`handle_event`](Self::handle_event) for every event of a peer, in order of arrival;
/// [`handle_tick`](Self::handle_tick) when [`poll_timeout`](Self::poll_timeout) is due;
/// [`handle_report`](Self::handle_report) for every report of the tissue; after each of them
/// [`poll_order`](Self::poll_order) and [`poll_output`](Self::poll_output) until `None`. The room computes no
/// tissue, so that it relays motion at once.
pub struct Room {
    config: RoomConfig,
    /// Before the first operation.
    beginning: TopologyState,
    /// After the newest cut in the log.
    topology: TopologyState,
    participants: BTreeMap<ParticipantId, Participant>,
    by_peer: BTreeMap<PeerKey, ParticipantId>,
    next_participant: u16,
    joined: u64,
    log: Log,
    schedule: DelaySchedule,
    group: GroupDelay,
    started_at: Option<ServerTime>,
    /// Grid point of the latest tick, in ticks since time zero.
    settled: Option<i64>,
    next_tick: ServerTime,
    next_correction: ServerTime,
    next_demotion_decision: ServerTime,
    /// Delay reports before this time do not count for the group.
    reports_count_from: ServerTime,
    cuts: u64,
    demotions: u64,
    repetitions: u64,
    refused: u64,
    fan_out: FanOut,
    /// Whether the tissue is solving a tick.
    is_settling: bool,
    ticks_skipped: u64,
    cut_queue: CutQueue,
    /// Log space of the cuts of participants who have left, bytes.
    departed_log: u64,
    joins: Joins,
    delay_changes: TokenBucket,
    controls: ControlState,
    limits: LimitCounters,
    orders: VecDeque<TissueOrder>,
    outputs: VecDeque<Output>,
}

impl Room {
    /// An empty session over tissue with this hash of the uncut topology.
    pub fn new(uncut: TopologyHash, config: RoomConfig, now: ServerTime) -> Self {
        Self {
            beginning: (0, uncut),
            topology: (0, uncut),
            participants: BTreeMap::new(),
            by_peer: BTreeMap::new(),
            next_participant: 1,
            joined: 0,
            log: Log::default(),
            schedule: DelaySchedule::new(&config.compensation),
            group: GroupDelay::new(&config.compensation),
            started_at: None,
            settled: None,
            next_tick: now,
            next_correction: now,
            next_demotion_decision: now,
            reports_count_from: now,
            cuts: 0,
            demotions: 0,
            repetitions: 0,
            refused: 0,
            fan_out: FanOut::default(),
            is_settling: false,
            ticks_skipped: 0,
            cut_queue: CutQueue::default(),
            departed_log: 0,
            joins: Joins::new(now),
            delay_changes: TokenBucket::new(
                DELAY_CHANGES_PER_S,
                DELAY_CHANGES_BURST,
                now - ServerTime::ZERO,
            ),
            controls: ControlState::new(now),
            limits: LimitCounters::default(),
            orders: VecDeque::new(),
            outputs: VecDeque::new(),
            config,
        }
    }

    /// Continues the tissue of an earlier session, before the first event. `snapshot` restores this state for newcomers;
    /// `newest` is the latest participant that has cut. Returns whether the snapshot fits.
    pub fn continue_from(
        &mut self,
        state: TopologyState,
        snapshot: &[u8],
        newest: ParticipantId,
    ) -> bool {
        self.beginning = state;
        self.topology = state;
        self.next_participant = newest.0.wrapping_add(1).max(1);
        self.log.cover(state.0, snapshot)
    }

    /// Handles an event of a peer's session.
    pub fn handle_event(&mut self, peer: PeerKey, event: PeerEvent, now: ServerTime) {
        match (event, self.by_peer.get(&peer).copied()) {
            (PeerEvent::Hello(hello), None) => self.handle_hello(peer, hello, now),
            (PeerEvent::Request(request), Some(who)) => self.handle_request(who, request, now),
            (PeerEvent::Motion(motion), Some(who)) => self.handle_motion(who, motion, now),
            (PeerEvent::Delay(report), Some(who)) => self.note_report(who, report, now),
            (PeerEvent::Closed(reason), Some(who)) => self.handle_leave(who, &reason, now),
            // The session machine handles a second hello. Other events belong to unknown peers.
            _ => {}
        }
    }

    /// Starts scripts once enough tools have sent samples: a client that still builds its replica has joined, but
    /// would miss the start.
    fn start_if_due(&mut self, now: ServerTime) {
        // All motion passes here, thousands of times per second.
        if self.started_at.is_some() {
            return;
        }
        let tools = self
            .participants
            .values()
            .filter(|p| p.tool.is_some() && p.motion.newest().is_some())
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
        match participant.requests.take(request.id) {
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
            RequestKind::Cut(cut) => self.order_cut(who, request.id, cut, now),
            RequestKind::TopologyReport { version, hash } => self.check_topology(version, hash),
            // The session machine turns a leave into a close.
            RequestKind::Leave => Ok(()),
            RequestKind::SetTool(tool) => self.set_tool(who, tool, now),
            RequestKind::Control(control) => self.control(who, request.id, control, now),
        };
        if let Err(reason) = result {
            self.note_refusal(who, request.id, reason);
        }
    }

    fn note_refusal(&mut self, who: ParticipantId, id: RequestId, reason: RequestRefusal) {
        let refused = RequestRefused { id, reason };
        if let Some(participant) = self.participants.get_mut(&who) {
            participant.requests.note_refusal(refused.clone());
        }
        self.refuse(who, refused);
    }

    /// Handles a report of the tissue.
    pub fn handle_report(&mut self, report: TissueReport, now: ServerTime) {
        match report {
            TissueReport::Settled {
                corrections,
                picture,
                ..
            } => {
                self.is_settling = false;
                if let Some(corrections) = corrections {
                    self.send_to(Subscription::Full, &PeerDatagram::Corrections(corrections));
                }
                if let Some(picture) = picture {
                    self.send_to(Subscription::Thin, &PeerDatagram::Picture(picture));
                }
            }
            TissueReport::Cut {
                author,
                request,
                result,
            } => self.handle_cut(author, request, result, now),
            TissueReport::Prepared { author, took } => self.handle_prepared(author, took, now),
            TissueReport::Snapshot { version, bytes } => self.handle_snapshot(version, &bytes),
        }
    }

    /// The next order for the tissue.
    pub fn poll_order(&mut self) -> Option<TissueOrder> {
        self.orders.pop_front()
    }

    fn send_to(&mut self, subscription: Subscription, datagram: &PeerDatagram) {
        let peers: Vec<PeerKey> = self.peers_with(subscription).collect();
        for peer in peers {
            self.outputs
                .push_back(Output::Datagram(peer, datagram.clone()));
        }
    }

    fn check_topology(&self, version: u32, hash: TopologyHash) -> Result<(), RequestRefusal> {
        let (newest, newest_hash) = self.topology;
        let is_ours = if version == newest {
            hash == newest_hash
        } else {
            // A version that the log no longer has is too old to compare.
            version < newest && self.log.hash_of(version).is_none_or(|ours| ours == hash)
        };
        if is_ours {
            Ok(())
        } else {
            Err(RequestRefusal::TopologyDiffers)
        }
    }

    fn handle_motion(&mut self, who: ParticipantId, mut motion: PeerMotion, now: ServerTime) {
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        let Some(arrival) = motion.arrival().filter(|_| participant.tool.is_some()) else {
            return;
        };
        let age = participant.delay.handle_arrival(arrival);
        participant.note_motion(motion.round_trip, now);
        motion.samples.retain(|sample| {
            let is_reached = participant.track.note(sample);
            if !is_reached {
                self.limits.count(Limit::Sample);
            }
            is_reached
        });
        // Samples of an inactive tool, and those after the begin of a freeze, are only measured.
        let shown = &mut participant.motion;
        motion.samples.retain(|sample| shown.shows(sample.time));
        if participant.is_inactive() || motion.samples.is_empty() {
            return;
        }
        for sample in &motion.samples {
            participant.motion.insert(*sample);
        }
        self.start_if_due(now);
        self.fan_out.push(who, &motion, age);
        self.send_motion(now);
    }

    /// Relays the waiting motion, if its round is due, to all participants but its author.
    fn send_motion(&mut self, now: ServerTime) {
        let Some(round) = self.fan_out.poll(now).map(Arc::new) else {
            return;
        };
        for (peer, id) in &self.by_peer {
            if round.tracks.iter().any(|t| t.participant != *id) {
                // The session leaves out its own participant's tool.
                let datagram = PeerDatagram::Motion(Arc::clone(&round));
                self.outputs.push_back(Output::Datagram(*peer, datagram));
            }
        }
    }

    /// Relays waiting motion. If a tick is due, orders a solve for the newest time of the shared grid. A tick that finds
    /// the tissue busy is skipped and counted.
    pub fn handle_tick(&mut self, now: ServerTime) {
        self.send_motion(now);
        if now < self.next_tick {
            return;
        }
        let period = self.config.tick_period();
        while self.next_tick <= now {
            self.next_tick = self.next_tick + period;
        }
        self.remove_expired_seats(now);
        self.log.compact(now);
        self.decide_demotions(now);
        self.change_delay(now);
        let hz = i64::from(self.config.tick_hz.max(1));
        let grid = (self.schedule.shown_at(now).as_micros() * hz).div_euclid(1_000_000);
        if self.settled.is_some_and(|k| k >= grid) {
            return;
        }
        if self.is_settling {
            self.ticks_skipped += 1;
            return;
        }
        self.settled = Some(grid);
        let view_time = ServerTime::from_micros((grid * 1_000_000).div_euclid(hz));
        let tools: Vec<Tool> = self
            .participants
            .values_mut()
            .flat_map(|p| p.pressing_at(view_time))
            .collect();
        let edge = |p: &mut Participant| Some((p.id, p.cutting_at(view_time)?));
        let blades = self.participants.values_mut().filter_map(edge).collect();
        let returns = |p: &mut Participant| {
            p.shown_at(view_time)
                .is_some_and(|(_, shown)| shown.returns)
        };
        let returns = self.participants.values_mut().any(returns);
        let wants_corrections = now >= self.next_correction;
        if wants_corrections {
            self.next_correction = now + CORRECTION_PERIOD;
        }
        let has_thin_subscriber = self.peers_with(Subscription::Thin).next().is_some();
        self.is_settling = true;
        self.orders.push_back(TissueOrder::Settle(Settling {
            view_time,
            tools,
            blades,
            returns,
            wants_corrections,
            wants_picture: has_thin_subscriber.then_some(now),
        }));
    }

    /// The connections with this subscription.
    fn peers_with(&self, subscription: Subscription) -> impl Iterator<Item = PeerKey> + '_ {
        let here = self.participants.values();
        let of = here.filter(move |p| p.subscription == subscription);
        of.filter_map(Participant::peer)
    }

    fn change_delay(&mut self, now: ServerTime) {
        self.pass_reports();
        let playing = self
            .participants
            .values()
            .filter(|p| !p.demotion.is_demoted());
        let uplinks: Vec<DelayReport> = playing.filter_map(Participant::explained_uplink).collect();
        // A participant beyond the cap does not hide the others.
        let within = uplinks.iter().filter(|r| self.group.can_bridge(r));
        match within.max_by_key(|r| r.wanted_us) {
            Some(worst) => self.group.handle_report(ParticipantId::SERVER, *worst),
            // The requirement ends with the last participant that caused it.
            None if uplinks.is_empty() => self.group.remove(ParticipantId::SERVER),
            None => {}
        }
        let at = now - ServerTime::ZERO;
        if !self.log.takes_delay() || !self.delay_changes.has(1.0, at) {
            self.limits.count(Limit::DelayChange);
            return;
        }
        if let Some(change) = self.group.poll_change(now, self.group.lead()) {
            self.schedule
                .handle_change(change.delay_us, change.effective_at);
            self.delay_changes.take(1.0, at);
            let kind = OperationKind::Compensation {
                delay_us: change.delay_us,
                effective_at: change.effective_at,
            };
            self.append(ParticipantId::SERVER, kind, now);
        }
    }

    /// Sends a goodbye to all participants.
    pub fn handle_close(&mut self, sentence: &str) {
        let peers: Vec<PeerKey> = self.by_peer.keys().copied().collect();
        for peer in peers {
            self.send(peer, PeerMessage::Goodbye(sentence.to_owned()));
        }
    }

    /// Due time of [`handle_tick`](Self::handle_tick): the next tick or the next round of motion.
    pub fn poll_timeout(&self) -> ServerTime {
        let motion = self.fan_out.due();
        motion.map_or(self.next_tick, |due| due.min(self.next_tick))
    }

    /// Time of the next tick.
    pub fn next_tick(&self) -> ServerTime {
        self.next_tick
    }

    /// The next message to send.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// The participant of a connection, once admitted.
    pub fn participant_of(&self, peer: PeerKey) -> Option<ParticipantId> {
        self.by_peer.get(&peer).copied()
    }

    /// Number of joins since the session began; resumptions do not count.
    pub fn joined_count(&self) -> u64 {
        self.joined
    }

    /// Number of participants, including kept seats.
    pub fn participant_count(&self) -> usize {
        self.participants.len()
    }

    /// All participants, including kept seats, with the tokens of their welcomes.
    pub fn seats(&self) -> impl Iterator<Item = (ParticipantId, ResumeToken)> + '_ {
        self.participants.values().map(|seat| (seat.id, seat.token))
    }

    /// The operations of the log from this number on.
    pub fn operations_since(&self, first: OperationId) -> &[Arc<Operation>] {
        self.log.since(first)
    }

    /// Number of operations so far.
    pub fn operation_count(&self) -> usize {
        usize::try_from(self.log.next().0).unwrap_or(usize::MAX)
    }

    /// How often each limit took effect.
    pub fn limits(&self) -> &LimitCounters {
        &self.limits
    }

    /// Number of cuts.
    pub fn cut_count(&self) -> u64 {
        self.cuts
    }

    /// Number of repeated requests, which were not executed again.
    pub fn repetition_count(&self) -> u64 {
        self.repetitions
    }

    /// Number of refused hellos.
    pub fn refused_count(&self) -> u64 {
        self.refused
    }

    /// Version and hash of the topology.
    pub fn topology(&self) -> (u32, TopologyHash) {
        self.topology
    }

    fn version(&self) -> u32 {
        self.topology.0
    }

    fn hash(&self) -> TopologyHash {
        self.topology.1
    }

    /// Number of ticks skipped because the tissue was busy.
    pub fn skipped_tick_count(&self) -> u64 {
        self.ticks_skipped
    }

    /// The parts of a participant's tool that press at time t.
    #[cfg(test)]
    pub(crate) fn pressing_at(&mut self, who: ParticipantId, t: ServerTime) -> Vec<Tool> {
        let seat = self.participants.get_mut(&who);
        seat.map_or_else(Vec::new, |seat| seat.pressing_at(t))
    }

    /// The playout delay at a time.
    pub fn delay_at(&self, now: ServerTime) -> Span {
        self.schedule.delay_at(now)
    }

    fn refuse(&mut self, who: ParticipantId, refused: RequestRefused) {
        if let Some(peer) = self.participants.get(&who).and_then(Participant::peer) {
            self.send(peer, PeerMessage::RequestRefused(refused));
        }
    }

    fn append(&mut self, author: ParticipantId, kind: OperationKind, now: ServerTime) {
        let version = self.version();
        self.append_between(author, kind, now, version);
    }

    /// Appends an operation. Returns the log space that it uses if it is a cut, bytes.
    fn append_between(
        &mut self,
        author: ParticipantId,
        kind: OperationKind,
        now: ServerTime,
        version_before: u32,
    ) -> u64 {
        let operation = Arc::new(Operation {
            id: self.log.next(),
            at: now,
            author,
            topology_version_before: version_before,
            topology_version_after: self.version(),
            hash_after: self.hash(),
            kind,
        });
        let bytes = self.log.push(Arc::clone(&operation));
        let peers: Vec<PeerKey> = self.by_peer.keys().copied().collect();
        for peer in peers {
            self.send(peer, PeerMessage::Operation(Arc::clone(&operation)));
        }
        bytes
    }

    fn send(&mut self, peer: PeerKey, message: PeerMessage) {
        self.outputs.push_back(Output::Message(peer, message));
    }
}
