//! One participant's site as a pure state machine: session events and hand samples in, contact models and views out.
//!
//! ```text
//! D(t)   artificial delay, from the operation log        s = t - D(t)   the displayed time
//! the view is solved on the common grid s = k / tick_hz, so all sites solve for the same times
//! an operation stamped `at` is applied when s >= at, or at once if it arrives later
//! ```
//!
//! It reads no clock: every call passes the time.

mod applying;
mod controlled;
mod cutting;
mod grid;
mod hand;
mod operation_record;
mod resync;
mod resync_policy;
mod thin_site;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use palpate_protocol::clock::ClockMap;
use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::datagram::Corrections;
use palpate_protocol::handshake::{RosterEntry, Welcome};
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{RequestKind, RequestRefusal};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    ClientTime, LocalSample, ParticipantId, ServerTime, Span, ToolSample, TopologyHash,
};
use palpate_tissue::{Budget, Model, PreparedCut, Shape};

use cutting::Cuts;
use hand::LastSolve;
use resync::ResyncState;
use resync_policy::ResyncPolicy;

use crate::replica::{Prefetch, Replica, ReplicaError, View};
use crate::tools::{Roster, StrokeCollector, ToolAt};

pub use controlled::{Access, SessionState};
pub use grid::{grid_index, grid_time};
pub use hand::HandPose;
pub use operation_record::OperationRecord;
pub use resync_policy::RESYNCS_MAX;

/// Maximum number of operations waiting for their due time. They wait for D, 0.2 s, so the limit is never reached in
/// practice; beyond it the oldest is applied early.
const DEFERRED_MAX: usize = 4096;

/// Time after the first view without drift checks: a new replica still converges to the shape of the other sites.
const SETTLING: Span = Span::from_millis(1000);

/// Error that ends the session at this site.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SiteError {
    /// The replica differs from the server.
    #[error(transparent)]
    Diverged(#[from] ReplicaError),
    /// The replica differed from the start, or the server reports a difference.
    #[error("{0}")]
    Differs(String),
    /// The replica differs again after a resync.
    #[error("the replica differs again after a resync: {0}")]
    Again(String),
    /// The cut worker or the view thread failed.
    #[error("the cut worker or the view thread failed: {0}")]
    Thread(String),
}

/// A view to be solved.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewFrame {
    /// The time that it shows.
    pub s: ServerTime,
    /// Its index on the common grid: s = k / `tick_hz`.
    pub k: i64,
    /// The artificial delay of the view.
    pub delay: Span,
    /// All tools at that time.
    pub tools: Vec<ToolAt>,
}

impl ViewFrame {
    /// Whether a tool returns from a hold.
    pub fn returns(&self) -> bool {
        self.tools.iter().any(|tool| tool.returns)
    }
}

/// Updates for a detached view, in order.
pub enum ViewUpdate {
    /// A cut to adopt.
    Cut(Box<PreparedCut>),
    /// Corrections of a past view.
    Corrections(Corrections),
}

/// Counters of a site.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct SiteCounters {
    /// Operations applied.
    pub operations: u64,
    /// Strokes that cut among them and in the snapshot before them.
    pub cuts: u64,
    /// Cut requests that the server rejected.
    pub cuts_refused: u64,
    /// Skipped points of the common grid.
    pub views_skipped: u64,
    /// Corrected nodes.
    pub corrected_nodes: u64,
    /// Largest distance between a node and its position at the server, m.
    pub drift_max_m: f64,
    /// Number of resyncs from the server's log.
    pub resyncs: u64,
    /// Number of demotions of this participant.
    pub demotions: u64,
    /// Haptic solves.
    pub haptic_solves: u64,
}

/// One participant's site. Calling order: [`handle_event`](Self::handle_event) and [`handle_own`](Self::handle_own)
/// as they arrive; then [`advance`](Self::advance), [`haptic_step`](Self::haptic_step) and
/// [`view_step`](Self::view_step) every few milliseconds; then the `poll_*` until `None`.
pub struct Site {
    me: ParticipantId,
    replica: Replica,
    roster: Roster,
    schedule: DelaySchedule,
    clock: Option<ClockMap>,
    tick_hz: i64,
    /// Grid index of the newest view.
    last_k: Option<i64>,
    first_view: Option<ServerTime>,
    /// The newest view with poses extrapolated too far, because a network was too slow.
    extrapolated: Option<ServerTime>,
    deferred: VecDeque<Operation>,
    /// Whether the cut worker and the view thread run elsewhere.
    is_detached: bool,
    cuts: Cuts,
    /// `None` before the first solve of this replica.
    last_solve: Option<LastSolve>,
    /// Updates for a detached view.
    view_updates: VecDeque<ViewUpdate>,
    /// Expected topology after the initial log.
    expected: Option<(u32, TopologyHash)>,
    /// The newest topology that was not reported to the server.
    unreported: Option<(u32, TopologyHash)>,
    next_report: Option<ClientTime>,
    strokes: Option<StrokeCollector>,
    /// The latest stroke of every participant.
    strokes_seen: BTreeMap<ParticipantId, u64>,
    started: Option<ServerTime>,
    requests: VecDeque<RequestKind>,
    notices: VecDeque<String>,
    applied: VecDeque<OperationRecord>,
    resync_policy: ResyncPolicy,
    resync_state: ResyncState,
    /// Reason of a resync that the connection has not yet received.
    resync_reason: Option<String>,
    /// The number after that of the last operation received.
    next_operation: u64,
    /// The first operation that is not recorded yet.
    unrecorded: u64,
    counters: SiteCounters,
    session: SessionState,
}

/// The replica of a full subscriber who has nothing of the log yet.
fn full_replica(welcome: &Welcome, model: Arc<Model>) -> Replica {
    let with_hand = welcome.role.has_tool();
    if welcome.topology_version == 0 {
        Replica::new(model, with_hand)
    } else {
        Replica::before_replay(model, with_hand)
    }
}

impl Site {
    /// A site after its welcome, with the uncut model. `blade_length_m` is the length of this participant's blade, if
    /// any.
    pub fn new(welcome: &Welcome, model: Arc<Model>, blade_length_m: Option<f64>) -> Self {
        Self::with(welcome, full_replica(welcome, model), blade_length_m)
    }

    fn with(welcome: &Welcome, replica: Replica, blade_length_m: Option<f64>) -> Self {
        Self {
            me: welcome.participant,
            replica,
            roster: Roster::new(&welcome.roster),
            schedule: DelaySchedule::new(&welcome.compensation),
            clock: None,
            tick_hz: i64::from(welcome.tick_hz.max(1)),
            last_k: None,
            first_view: None,
            extrapolated: None,
            deferred: VecDeque::new(),
            is_detached: false,
            cuts: Cuts::default(),
            last_solve: None,
            view_updates: VecDeque::new(),
            expected: Some((welcome.topology_version, welcome.topology_hash)),
            unreported: None,
            next_report: None,
            strokes: blade_length_m.map(StrokeCollector::new),
            strokes_seen: BTreeMap::new(),
            started: welcome.session_started_at,
            requests: VecDeque::new(),
            notices: VecDeque::new(),
            applied: VecDeque::new(),
            resync_policy: ResyncPolicy::default(),
            resync_state: ResyncState::Idle,
            resync_reason: None,
            next_operation: 0,
            unrecorded: 0,
            counters: SiteCounters::default(),
            session: SessionState::default(),
        }
    }

    /// Adds a request of this participant: another tool, or a control.
    pub fn request(&mut self, kind: RequestKind) {
        self.requests.push_back(kind);
    }

    /// Processes a session event.
    pub fn handle_event(&mut self, event: ClientEvent, now: ClientTime) -> Result<(), SiteError> {
        if self.is_from_old_connection(&event) {
            return Ok(());
        }
        let result = self.take_event(event, now);
        self.or_resync(result, now)
    }

    fn take_event(&mut self, event: ClientEvent, now: ClientTime) -> Result<(), SiteError> {
        match event {
            ClientEvent::Snapshot(bytes) => self.restore_snapshot(&bytes)?,
            ClientEvent::Operation(operation) => self.handle_operation(operation, now)?,
            ClientEvent::CaughtUp => {
                if let Some((version, hash)) = self.expected.take() {
                    self.replica.end_replay();
                    self.compare(version, hash)?;
                    self.end_resync();
                    self.report_topology(version, hash);
                }
            }
            ClientEvent::RequestRefused(refused) => match refused.reason {
                RequestRefusal::TopologyDiffers => {
                    return Err(SiteError::Differs(
                        RequestRefusal::TopologyDiffers.to_string(),
                    ));
                }
                reason => {
                    self.counters.cuts_refused += 1;
                    self.notice(format!("the server rejected {}: {reason}", refused.id));
                }
            },
            ClientEvent::Invitation(invitation) => {
                // Notices are printed and recorded; the grant is for the page alone.
                let id = invitation.id;
                self.notice(format!("invitation {id} is ready; its link is on the page"));
            }
            // This participant's samples come from the hand itself.
            ClientEvent::Motion(track) if track.participant != self.me => {
                for sample in track.samples {
                    self.roster.insert(track.participant, sample);
                }
            }
            ClientEvent::Displacements(news) => self.handle_displacements(news, now),
            // A thin subscriber has nothing to correct.
            ClientEvent::Corrections(_) if self.is_thin() => {}
            ClientEvent::Corrections(corrections) => {
                if let Some(view) = self.replica.view_mut() {
                    if let Some(drift) = view.correct(&corrections) {
                        self.handle_drift(corrections.view_time, drift, now);
                    }
                } else {
                    let news = ViewUpdate::Corrections(corrections);
                    self.view_updates.push_back(news);
                }
            }
            ClientEvent::Clock(map) => self.take_clock(map, now),
            ClientEvent::LinkLost => self.notice("no packets from the server".to_owned()),
            ClientEvent::LinkRestored => self.notice("the server is reachable again".to_owned()),
            ClientEvent::Welcomed(welcome) => self.handle_resumed(&welcome, now)?,
            ClientEvent::Motion(_) | ClientEvent::Delays(_) | ClientEvent::Closed(_) => {}
        }
        Ok(())
    }

    fn handle_operation(&mut self, operation: Operation, now: ClientTime) -> Result<(), SiteError> {
        self.next_operation = operation.id.0 + 1;
        match &operation.kind {
            OperationKind::Compensation {
                delay_us,
                effective_at,
            } => match self.clock.map(|c| c.to_server(now)) {
                // Operations of the initial log are not late.
                Some(here) if self.expected.is_none() => {
                    (self.schedule).handle_late_change(*delay_us, *effective_at, here);
                }
                _ => self.schedule.handle_change(*delay_us, *effective_at),
            },
            OperationKind::Started { at } => self.started = Some(*at),
            // The seat is added at once, so that samples find it. Its tool appears with its first sample.
            OperationKind::Joined {
                participant,
                name,
                role,
                tool,
            } => self.roster.join(RosterEntry {
                participant: *participant,
                name: name.clone(),
                role: *role,
                tool: *tool,
            }),
            _ => {}
        }
        if self.is_detached && cutting::is_cut(&operation) {
            self.cuts.make(&operation);
        }
        self.deferred.push_back(operation);
        if self.expected.is_some() || self.is_thin() {
            self.apply_until(None, now)?;
        }
        while self.deferred.len() > DEFERRED_MAX && self.apply_first(now)? {}
        Ok(())
    }

    /// Moves cut worker and view to other threads, once, when the initial log is applied. The cut worker takes orders
    /// from [`poll_cut_order`](Self::poll_cut_order) and returns results to [`handle_cut`](Self::handle_cut). The
    /// view takes [`poll_view_update`](Self::poll_view_update) and [`next_view`](Self::next_view).
    pub fn detach(&mut self) -> Option<(Prefetch, View)> {
        let is_under_way = self.expected.is_some() || self.is_resyncing();
        if is_under_way || self.is_detached {
            return None;
        }
        let prefetch = self.replica.prefetch()?;
        let view = self.replica.detach_view()?;
        self.is_detached = true;
        for cut in self.deferred.iter().filter(|o| cutting::is_cut(o)) {
            self.cuts.make(cut);
        }
        Some((prefetch, view))
    }

    /// The next update for a detached view.
    pub fn poll_view_update(&mut self) -> Option<ViewUpdate> {
        self.view_updates.pop_front()
    }

    /// Adds a sample of this participant's tool.
    pub fn handle_own(&mut self, sample: &LocalSample) {
        let Some(map) = self.clock else { return };
        let time = map.to_server(sample.time);
        self.roster.insert(
            self.me,
            ToolSample {
                time,
                pose: sample.pose,
                buttons: sample.buttons,
                force_n: sample.force_n,
            },
        );
        if let Some(strokes) = &mut self.strokes
            && let Some(cut) = strokes.push(time, &sample.pose, sample.buttons & 1 == 1)
        {
            self.requests.push_back(RequestKind::Cut(cut));
        }
    }

    /// The displayed time s and the delay D. `None` until the clock offset is known.
    pub fn common_time(&self, now: ClientTime) -> Option<(ServerTime, Span)> {
        let t = self.clock?.to_server(now);
        Some((self.schedule.shown_at(t), self.schedule.delay_at(t)))
    }

    /// Views per second of the session.
    pub fn tick_hz(&self) -> i64 {
        self.tick_hz
    }

    /// The newest grid point to display; `None` if it was returned already. Skipped points are counted.
    pub fn next_view(&mut self, now: ClientTime) -> Option<ViewFrame> {
        let (s, delay) = self.displayed_time(now)?;
        let k = grid_index(s, self.tick_hz);
        if self.expected.is_some()
            || self.is_resyncing()
            || self.last_k.is_some_and(|last| k <= last)
        {
            return None;
        }
        if let Some(last) = self.last_k {
            self.counters.views_skipped += (k - last - 1) as u64;
        }
        self.last_k = Some(k);
        let s = grid_time(k, self.tick_hz);
        self.first_view.get_or_insert(s);
        if self.roster.is_extrapolated(s) {
            self.extrapolated = Some(s);
        }
        if let Some(thin) = self.replica.thin_view_mut() {
            thin.advance(s);
        }
        Some(ViewFrame {
            s,
            k,
            delay,
            tools: self.roster.view_tools_at(s),
        })
    }

    /// Solves [`next_view`](Self::next_view), unless the view is detached.
    pub fn view_step(&mut self, now: ClientTime, budget: Budget<'_>) -> Option<ViewFrame> {
        let frame = self.next_view(now)?;
        if self.is_thin() {
            return Some(frame);
        }
        let view = self.replica.view_mut()?;
        view.step(frame.s, &frame.tools, budget);
        Some(frame)
    }

    /// The latest shape of the view and its topology version; `None` if the view is detached.
    pub fn seen(&self) -> Option<(&Shape, u32)> {
        if let Some(thin) = self.replica.thin_view() {
            return Some((thin.shape(), self.replica.topology().version()));
        }
        let view = self.replica.view()?;
        Some((view.shape(), view.topology().version()))
    }

    /// The next request for the server.
    pub fn poll_request(&mut self) -> Option<RequestKind> {
        self.requests.pop_front()
    }

    /// The next message for the status line.
    pub fn poll_notice(&mut self) -> Option<String> {
        self.notices.pop_front()
    }

    /// The next applied operation.
    pub fn poll_applied(&mut self) -> Option<OperationRecord> {
        self.applied.pop_front()
    }

    /// Start of the scripts, on the client's clock; `None` if unknown.
    pub fn script_start(&self) -> Option<ClientTime> {
        Some(self.clock?.to_client(self.started?))
    }

    /// The newest clock map to the server.
    pub fn clock(&self) -> Option<ClockMap> {
        self.clock
    }

    /// Whether the initial log is still being applied.
    pub fn is_catching_up(&self) -> bool {
        self.expected.is_some()
    }

    /// The replica of the tissue.
    pub fn replica(&self) -> &Replica {
        &self.replica
    }

    /// The participants.
    pub fn roster(&self) -> &Roster {
        &self.roster
    }

    /// The counters.
    pub fn counters(&self) -> SiteCounters {
        self.counters
    }

    /// Whether this participant is demoted because of the network.
    pub fn is_demoted(&self) -> bool {
        self.roster.is_demoted(self.me)
    }

    /// The own tool; `None` while it is inactive or holds its pose, and then there is no force.
    fn own_tool(&self) -> Option<ToolDescription> {
        let tool = self.roster.tool_of(self.me);
        tool.filter(|_| !self.roster.is_frozen())
    }

    /// Notice of a participant's action. The initial log and a resync give none, because the roster already contains
    /// them.
    fn notice_of(&mut self, who: ParticipantId, what: &str) {
        if self.expected.is_some() {
            return;
        }
        if let Some(name) = self.roster.name_of(who) {
            self.notice(format!("{name} {what}"));
        }
    }

    fn notice(&mut self, sentence: String) {
        /// Maximum number of queued messages; older ones are dropped.
        const NOTICES_MAX: usize = 64;
        if self.notices.len() == NOTICES_MAX {
            self.notices.pop_front();
        }
        self.notices.push_back(sentence);
    }
}

#[cfg(test)]
mod applying_tests;
#[cfg(test)]
mod controlled_tests;
#[cfg(test)]
mod snapshot_tests;
#[cfg(test)]
mod states;
#[cfg(test)]
mod tests;
