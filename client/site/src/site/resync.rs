//! Resync: rebuilds the replica from the server's snapshot and log, in the same seat.
//!
//! The site requests both with [`Site::poll_resync`] and ignores further events of the old connection. The
//! connection's owner resumes the seat without any operation. The next welcome resets the site to the uncut model.
//! Until the log is applied there is no force ([`Site::is_resyncing`]).

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::Welcome;
use palpate_protocol::session::ClientEvent;
use palpate_protocol::{ClientTime, ServerTime};

use super::controlled::SessionState;
use super::cutting::Cuts;
use super::resync_policy::{DRIFT_MAX_M, DRIFT_PATIENCE, RESYNCS_MAX, ResyncDecision, WINDOW};
use super::{Site, SiteError, full_replica};
use crate::replica::{Drift, Replica, ReplicaError};
use crate::tools::Roster;

/// Progress of a resync.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ResyncState {
    /// No resync.
    Idle,
    /// The log was requested; further events belong to the old connection.
    Asked,
    /// The log is being applied.
    Applying,
}

impl Site {
    /// The reason for a resync, once per request: resume the seat without any operation.
    pub fn poll_resync(&mut self) -> Option<String> {
        self.resync_reason.take()
    }

    /// Whether a resync is in progress, during which there is no force.
    pub fn is_resyncing(&self) -> bool {
        self.resync_state != ResyncState::Idle
    }

    /// Handles a failure of the cut worker: the replica differs from the session.
    pub fn handle_broken(&mut self, error: ReplicaError, now: ClientTime) -> Result<(), SiteError> {
        self.or_resync(Err(error.into()), now)
    }

    /// Whether an event belongs to the old connection and is ignored.
    pub(super) fn is_from_old_connection(&self, event: &ClientEvent) -> bool {
        self.resync_state == ResyncState::Asked
            && !matches!(
                event,
                ClientEvent::Welcomed(_)
                    | ClientEvent::Closed(_)
                    | ClientEvent::Clock(_)
                    | ClientEvent::LinkLost
                    | ClientEvent::LinkRestored
            )
    }

    /// Converts a difference from the server into a resync, if one is allowed.
    pub(super) fn or_resync(
        &mut self,
        result: Result<(), SiteError>,
        now: ClientTime,
    ) -> Result<(), SiteError> {
        let Err(error) = result else { return Ok(()) };
        if self.resync_state == ResyncState::Asked && !matches!(error, SiteError::Thread(_)) {
            // The replica in error is discarded already, and a resync requested.
            return Ok(());
        }
        if matches!(error, SiteError::Thread(_) | SiteError::Again(_)) {
            return Err(error);
        }
        if !self.resync_policy.handle_difference(now) {
            return Err(SiteError::Again(error.to_string()));
        }
        self.request_resync(error.to_string());
        Ok(())
    }

    fn request_resync(&mut self, why: String) {
        self.notice(format!(
            "your replica differs from the server; resync without force: {why}"
        ));
        self.resync_state = ResyncState::Asked;
        self.resync_policy.restart();
        self.resync_reason = Some(why);
    }

    /// Processes the drift of a past view from the server.
    pub fn handle_drift(&mut self, view_time: ServerTime, drift: Drift, now: ClientTime) {
        self.counters.corrected_nodes += drift.nodes as u64;
        let is_settled = self
            .first_view
            .is_some_and(|first| view_time - first > super::SETTLING);
        if !is_settled || self.is_resyncing() {
            return;
        }
        let max = &mut self.counters.drift_max_m;
        *max = max.max(drift.max_m);
        let is_extrapolated = self
            .extrapolated
            .is_some_and(|extrapolated| view_time - extrapolated < DRIFT_PATIENCE);
        if is_extrapolated || self.roster.is_demoted(self.me) {
            // Poses of a slow network cause this drift; a resync would not help.
            return self.resync_policy.restart();
        }
        match self.resync_policy.handle_drift(view_time, drift.max_m, now) {
            ResyncDecision::NoAction => {}
            ResyncDecision::Resync => {
                let (is, may) = (drift.max_m * 1e3, DRIFT_MAX_M * 1e3);
                self.request_resync(format!("the view differs by {is:.2} mm, more than {may} mm for 1 s"));
            }
            ResyncDecision::TooOften => self.notice(format!(
                "your replica differs from the server by {:.2} mm after {RESYNCS_MAX} resyncs in {} s; rejoin the session",
                drift.max_m * 1e3,
                WINDOW.as_secs_f64()
            )),
        }
    }

    /// Processes a resumed connection: the log continues, or begins again with a resync. A participant that joined
    /// again has another number.
    pub(super) fn handle_resumed(
        &mut self,
        welcome: &Welcome,
        now: ClientTime,
    ) -> Result<(), SiteError> {
        // A seat without a tool may have been given away; its client then continues as a new participant.
        self.me = welcome.participant;
        let had = self.next_operation;
        let first = welcome.first_operation;
        let has_begun = had > 0 || self.is_detached || self.resync_state == ResyncState::Asked;
        if first.0 == 0 && has_begun {
            self.begin_resync(welcome, now);
        } else if self.resync_state == ResyncState::Asked {
            // This connection was resumed for another reason; the requested one follows.
            return Ok(());
        } else if first.0 != had {
            return Err(SiteError::Differs(format!(
                "the client has the log up to operation {had}, but the server resumes at {first}"
            )));
        } else if self.expected.is_some() {
            self.expected = Some((welcome.topology_version, welcome.topology_hash));
        }
        Ok(())
    }

    fn begin_resync(&mut self, welcome: &Welcome, now: ClientTime) {
        let model = Arc::clone(self.replica.topology().model());
        self.replica = if self.is_thin() {
            Replica::thin(model)
        } else {
            full_replica(welcome, model)
        };
        self.roster = Roster::new(&welcome.roster);
        self.session = SessionState::default();
        self.schedule = DelaySchedule::new(&welcome.compensation);
        self.expected = Some((welcome.topology_version, welcome.topology_hash));
        self.started = welcome.session_started_at;
        (self.first_view, self.extrapolated) = (None, None);
        self.deferred = VecDeque::new();
        self.next_operation = 0;
        self.is_detached = false;
        self.unreported = None;
        self.cuts = Cuts::default();
        self.strokes_seen.clear();
        self.last_solve = None;
        self.view_updates = VecDeque::new();
        (self.counters.operations, self.counters.cuts) = (0, 0);
        self.counters.resyncs += 1;
        self.resync_state = ResyncState::Applying;
        self.resync_reason = None;
        self.resync_policy.note(now);
    }

    /// The initial log is applied and the topology matches.
    pub(super) fn end_resync(&mut self) {
        if std::mem::replace(&mut self.resync_state, ResyncState::Idle) != ResyncState::Idle {
            self.notice("resync complete: your replica matches the server".to_owned());
        }
    }
}
