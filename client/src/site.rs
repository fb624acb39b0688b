//! One participant's site as a pure machine: what the session says and the hand does comes in, what
//! is felt and what is seen comes out.
//!
//! ```text
//! D(t)   artificial delay, from the operations log        s = t - D(t)   the moment that is seen
//! the view is solved on the common grid s = k / tick_hz, so that all sites solve for the same moments
//! an operation stamped `at` is applied when s >= at, or at once when it comes later than that
//! ```
//!
//! It reads no clock: every call is given the time.

mod anew;
mod applying;
mod cutting;
mod grid;
mod hand;
mod resync;
mod thin;

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::clock::ClockMap;
use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::datagram::Corrections;
use palpate_protocol::handshake::{RosterEntry, Welcome};
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{RequestKind, RequestRefusal};
use palpate_protocol::session::{ClientEvent, CloseReason};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    ClientTime, LocalSample, ParticipantId, ServerTime, Span, ToolSample, TopologyHash,
};
use palpate_tissue::{Budget, Model, Shape};

use anew::Anew;
use cutting::Cuts;
use hand::Felt;
use resync::Resync;

pub use resync::{DRIFT_MAX_M, RESYNCS_MAX};

use crate::ahead::{Ahead, ReplicaError};
use crate::recording::OperationRecord;
use crate::replica::Replica;
use crate::roster::{Roster, ToolAt};
use crate::stroke::StrokeCollector;
use crate::view::{View, ViewCut};

pub use grid::{grid_index, grid_moment};

/// Operations that wait for their moment. They wait for D, 0.2 s, so this is never reached; beyond
/// it the oldest is applied early.
const DEFERRED_MAX: usize = 4096;

/// Drift is not counted so soon after the first view: a copy that has just joined is still on its
/// way to the shape that the others have.
const SETTLING: Span = Span::from_millis(1000);

/// The session can not go on at this site.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SiteError {
    /// The copy of the tissue is not the server's.
    #[error(transparent)]
    Diverged(#[from] ReplicaError),
    /// It was not from the beginning, or the server says so.
    #[error("{0}")]
    Differs(String),
    /// It differs again, after it was made anew.
    #[error("it was made anew from the server's log, and differs again: {0}")]
    Again(String),
    /// Cuts can not be made, or views not be solved.
    #[error("a thread for cuts or views could not be used: {0}")]
    Thread(String),
}

/// A view that is to be solved.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewFrame {
    /// The moment that it shows.
    pub s: ServerTime,
    /// Its number on the common grid: s = k / `tick_hz`.
    pub k: i64,
    /// The artificial delay with which it is shown.
    pub delay: Span,
    /// Everybody's tool at that moment.
    pub tools: Vec<ToolAt>,
}

/// What a view elsewhere has to be told, in this order.
pub enum ViewNews {
    /// A cut to take over.
    Cut(Box<ViewCut>),
    /// What the server says of a past view.
    Corrections(Corrections),
}

/// What a site counted.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct SiteCounters {
    /// Operations applied.
    pub operations: u64,
    /// Cuts among them.
    pub cuts: u64,
    /// Requests to cut that the server refused.
    pub cuts_refused: u64,
    /// Moments of the common grid that were left out.
    pub views_skipped: u64,
    /// Nodes that were corrected.
    pub corrected_nodes: u64,
    /// Farthest that a node was from where the server had it, m.
    pub drift_max_m: f64,
    /// How often the copy was made anew from the server's log.
    pub resyncs: u64,
    /// How often one's own tool was lifted because of the network.
    pub demotions: u64,
    /// Solves of what the hand feels.
    pub haptic_solves: u64,
}

/// One participant's site.
///
/// Calling order: [`handle_event`](Self::handle_event) and [`handle_own`](Self::handle_own) as they
/// come; then [`advance`](Self::advance), [`haptic_step`](Self::haptic_step) and
/// [`view_step`](Self::view_step) every few milliseconds; then the `poll_*` until `None`.
pub struct Site {
    me: ParticipantId,
    replica: Replica,
    roster: Roster,
    schedule: DelaySchedule,
    clock: Option<ClockMap>,
    tick_hz: i64,
    /// The newest view's place on the grid.
    last_k: Option<i64>,
    first_view: Option<ServerTime>,
    /// The newest view in which tools were made up, because the network was too slow.
    made_up: Option<ServerTime>,
    deferred: VecDeque<Operation>,
    /// Whether cuts are made elsewhere, ahead of their moment.
    is_detached: bool,
    cuts: Cuts,
    /// `None` before the first solve of this copy.
    felt: Option<Felt>,
    /// What the view has to be told, where it is elsewhere.
    view_news: VecDeque<ViewNews>,
    /// What the topology must be when the log of the beginning is applied.
    expected: Option<(u32, TopologyHash)>,
    /// The newest topology of which the server was not told.
    unreported: Option<(u32, TopologyHash)>,
    strokes: Option<StrokeCollector>,
    started: Option<ServerTime>,
    requests: VecDeque<RequestKind>,
    notices: VecDeque<String>,
    applied: VecDeque<OperationRecord>,
    closed: Option<CloseReason>,
    resync: Resync,
    anew: Anew,
    rejoin: Option<String>,
    /// The first operation that was not given to the recording.
    unrecorded: u64,
    counters: SiteCounters,
}

impl Site {
    /// A site after its welcome, with the uncut model. `blade_length_m` is that of one's own blade,
    /// if one holds a blade.
    pub fn new(welcome: &Welcome, model: Arc<Model>, blade_length_m: Option<f64>) -> Self {
        let replica = Replica::new(model, welcome.role.has_tool());
        Self::with(welcome, replica, blade_length_m)
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
            made_up: None,
            deferred: VecDeque::new(),
            is_detached: false,
            cuts: Cuts::default(),
            felt: None,
            view_news: VecDeque::new(),
            expected: Some((welcome.topology_version, welcome.topology_hash)),
            unreported: None,
            strokes: blade_length_m.map(StrokeCollector::new),
            started: welcome.session_started_at,
            requests: VecDeque::new(),
            notices: VecDeque::new(),
            applied: VecDeque::new(),
            closed: None,
            resync: Resync::default(),
            anew: Anew::No,
            rejoin: None,
            unrecorded: 0,
            counters: SiteCounters::default(),
        }
    }

    /// Something from the session.
    pub fn handle_event(&mut self, event: ClientEvent, now: ClientTime) -> Result<(), SiteError> {
        if self.is_of_the_old(&event) {
            return Ok(());
        }
        let result = self.take_event(event, now);
        self.or_anew(result, now)
    }

    fn take_event(&mut self, event: ClientEvent, now: ClientTime) -> Result<(), SiteError> {
        match event {
            ClientEvent::Operation(operation) => self.handle_operation(operation, now)?,
            ClientEvent::CaughtUp => {
                if let Some((version, hash)) = self.expected.take() {
                    self.compare(version, hash)?;
                    self.end_anew();
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
                    self.notice(format!("the server refused {}: {reason}", refused.id));
                }
            },
            // One's own samples come from the hand itself.
            ClientEvent::Motion(track) if track.participant != self.me => {
                for sample in track.samples {
                    self.roster.insert(track.participant, sample);
                }
            }
            ClientEvent::Displacements(news) => self.handle_picture(news, now),
            // Who is thin has nothing to correct.
            ClientEvent::Corrections(_) if self.is_thin() => {}
            ClientEvent::Corrections(corrections) => {
                if let Some(view) = self.replica.view_mut() {
                    if let Some(drift) = view.correct(&corrections) {
                        self.handle_drift(corrections.view_time, drift, now);
                    }
                } else {
                    let news = ViewNews::Corrections(corrections);
                    self.view_news.push_back(news);
                }
            }
            ClientEvent::Clock(map) => self.take_clock(map, now),
            ClientEvent::LinkLost => self.notice("nothing comes from the server".to_owned()),
            ClientEvent::LinkRestored => self.notice("the server is back".to_owned()),
            ClientEvent::Closed(reason) => self.closed = Some(reason),
            ClientEvent::Welcomed(welcome) => self.handle_return(&welcome, now)?,
            ClientEvent::Motion(_) | ClientEvent::Delays(_) => {}
        }
        Ok(())
    }

    fn handle_operation(&mut self, operation: Operation, now: ClientTime) -> Result<(), SiteError> {
        match &operation.kind {
            OperationKind::Compensation {
                delay_us,
                effective_at,
            } => match self.clock.map(|c| c.to_server(now)) {
                // What the log tells of before is not late.
                Some(here) if self.expected.is_none() => {
                    (self.schedule).handle_late_change(*delay_us, *effective_at, here);
                }
                _ => self.schedule.handle_change(*delay_us, *effective_at),
            },
            OperationKind::Started { at } => self.started = Some(*at),
            // A seat first, so that the samples that follow find it; its tool shows from its first
            // sample on.
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

    /// Lets cuts be made and views be solved elsewhere from now on: gives what does it, once, when the
    /// log of the beginning is applied. Give the first what [`poll_cut_order`](Self::poll_cut_order) gives, and tell
    /// [`handle_cut`](Self::handle_cut) what comes of it; give the second what
    /// [`poll_view_news`](Self::poll_view_news) and [`next_view`](Self::next_view) give.
    pub fn detach(&mut self) -> Option<(Ahead, View)> {
        let is_under_way = self.expected.is_some() || self.is_resyncing();
        if is_under_way || self.is_detached || self.deferred.iter().any(cutting::is_cut) {
            return None;
        }
        let ahead = self.replica.ahead()?;
        let view = self.replica.detach_view()?;
        self.is_detached = true;
        Some((ahead, view))
    }

    /// The next that the view has to be told.
    pub fn poll_view_news(&mut self) -> Option<ViewNews> {
        self.view_news.pop_front()
    }

    /// A sample of one's own tool.
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

    /// The moment that is to be seen now, and D. `None` until the clock is known.
    pub fn moment(&self, now: ClientTime) -> Option<(ServerTime, Span)> {
        let t = self.clock?.to_server(now);
        Some((self.schedule.shown_at(t), self.schedule.delay_at(t)))
    }

    /// The newest moment of the common grid that is to be seen now; `None` when it was given already.
    /// Moments that were missed are counted.
    pub fn next_view(&mut self, now: ClientTime) -> Option<ViewFrame> {
        let (s, delay) = self.moment_shown(now)?;
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
        let s = grid_moment(k, self.tick_hz);
        self.first_view.get_or_insert(s);
        if self.roster.is_made_up(s) {
            self.made_up = Some(s);
        }
        if let Some(thin) = self.replica.thin_view_mut() {
            thin.advance(s);
        }
        Some(ViewFrame {
            s,
            k,
            delay,
            tools: self.roster.tools_seen_at(s),
        })
    }

    /// Solves [`next_view`](Self::next_view), where the view is here.
    pub fn view_step(&mut self, now: ClientTime, budget: Budget<'_>) -> Option<ViewFrame> {
        let frame = self.next_view(now)?;
        if self.is_thin() {
            return Some(frame);
        }
        let view = self.replica.view_mut()?;
        view.step(frame.s, &frame.tools, budget);
        Some(frame)
    }

    /// What was seen last and the version of its topology; `None` where the view is elsewhere.
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

    /// The next sentence for the status line.
    pub fn poll_notice(&mut self) -> Option<String> {
        self.notices.pop_front()
    }

    /// The next operation that was applied.
    pub fn poll_applied(&mut self) -> Option<OperationRecord> {
        self.applied.pop_front()
    }

    /// Why the session is over, once it is.
    pub fn closed(&self) -> Option<&CloseReason> {
        self.closed.as_ref()
    }

    /// When scripts began or begin, on one's own clock; `None` while that is not known.
    pub fn script_start(&self) -> Option<ClientTime> {
        Some(self.clock?.to_client(self.started?))
    }

    /// The newest map to the server's clock.
    pub fn clock(&self) -> Option<ClockMap> {
        self.clock
    }

    /// Whether the operations of the beginning are still being applied.
    pub fn is_catching_up(&self) -> bool {
        self.expected.is_some()
    }

    /// One's own copy of the tissue.
    pub fn replica(&self) -> &Replica {
        &self.replica
    }

    /// Who is here.
    pub fn roster(&self) -> &Roster {
        &self.roster
    }

    /// What was counted.
    pub fn counters(&self) -> SiteCounters {
        self.counters
    }

    /// Whether one's own tool is lifted because of the network.
    pub fn is_watching(&self) -> bool {
        self.roster.is_lifted(self.me)
    }

    fn own_tool(&self) -> Option<ToolDescription> {
        self.roster.tool_of(self.me)
    }

    /// What somebody does. The log of the beginning tells no news: who is here is said otherwise, and a copy that is
    /// made anew repeats what was said.
    fn notice_of(&mut self, who: ParticipantId, what: &str) {
        if self.expected.is_some() {
            return;
        }
        if let Some(name) = self.roster.name_of(who) {
            self.notice(format!("{name} {what}"));
        }
    }

    fn notice(&mut self, sentence: String) {
        /// Sentences that wait for the status line; older ones are of no interest any more.
        const NOTICES_MAX: usize = 64;
        if self.notices.len() == NOTICES_MAX {
            self.notices.pop_front();
        }
        self.notices.push_back(sentence);
    }
}

#[cfg(test)]
mod states;
#[cfg(test)]
mod tests;
