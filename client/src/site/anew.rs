//! One's own copy, made anew from the server's log in the same seat.
//!
//! The site says that it wants the log from its beginning ([`Site::poll_rejoin`]) and hears nothing of
//! what still comes of the old one; whoever owns the connection takes the seat again with no operation
//! in hand; with the welcome the site begins with the uncut model, as when it joined. Until the log is
//! applied there is no force ([`Site::is_resyncing`]).

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::Welcome;
use palpate_protocol::session::ClientEvent;
use palpate_protocol::{ClientTime, ServerTime};

use super::cutting::Cuts;
use super::resync::{DRIFT_MAX_M, DRIFT_PATIENCE, RESYNCS_MAX, Verdict, WINDOW};
use super::{Site, SiteError};
use crate::ahead::ReplicaError;
use crate::replica::Replica;
use crate::roster::Roster;
use crate::view::Drift;

/// Where a copy stands that is being made anew.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Anew {
    /// It is not.
    No,
    /// The log is asked for; what comes meanwhile is of the old connection.
    Asked,
    /// It is being applied.
    Applying,
}

impl Site {
    /// Why the log is wanted from its beginning, once per time: take the seat again without an operation
    /// in hand.
    pub fn poll_rejoin(&mut self) -> Option<String> {
        self.rejoin.take()
    }

    /// Whether the copy is being made anew: there is to be no force.
    pub fn is_resyncing(&self) -> bool {
        self.anew != Anew::No
    }

    /// How often the copy was made anew. What was taken out of the site before belongs to an old copy.
    pub fn resyncs(&self) -> u64 {
        self.counters.resyncs
    }

    /// Cuts could not be made ahead: the copy is not the session's.
    pub fn handle_broken(&mut self, error: ReplicaError, now: ClientTime) -> Result<(), SiteError> {
        self.or_anew(Err(error.into()), now)
    }

    /// Whether an event is of the old connection, and nothing to a copy that is to be made anew.
    pub(super) fn is_of_the_old(&self, event: &ClientEvent) -> bool {
        self.anew == Anew::Asked
            && !matches!(
                event,
                ClientEvent::Welcomed(_)
                    | ClientEvent::Closed(_)
                    | ClientEvent::Clock(_)
                    | ClientEvent::LinkLost
                    | ClientEvent::LinkRestored
            )
    }

    /// A copy that differs is made anew, if that may help.
    pub(super) fn or_anew(
        &mut self,
        result: Result<(), SiteError>,
        now: ClientTime,
    ) -> Result<(), SiteError> {
        let Err(error) = result else { return Ok(()) };
        if self.anew == Anew::Asked && !matches!(error, SiteError::Thread(_)) {
            // The copy that this is about is given up already, and a new one asked for.
            return Ok(());
        }
        if matches!(error, SiteError::Thread(_) | SiteError::Again(_)) {
            return Err(error);
        }
        if !self.resync.handle_difference(now) {
            return Err(SiteError::Again(error.to_string()));
        }
        self.ask_anew(error.to_string());
        Ok(())
    }

    fn ask_anew(&mut self, why: String) {
        self.notice(format!(
            "your copy of the tissue differs from the server's and is made anew, without force meanwhile: {why}"
        ));
        self.anew = Anew::Asked;
        self.resync.restart();
        self.rejoin = Some(why);
    }

    /// The view of a moment was so far from what the server says.
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
        let is_made_up = self
            .made_up
            .is_some_and(|made_up| view_time - made_up < DRIFT_PATIENCE);
        if is_made_up || self.roster.is_lifted(self.me) {
            // A network that is too slow shows tools elsewhere; a new copy would not help.
            return self.resync.restart();
        }
        match self.resync.handle_drift(view_time, drift.max_m, now) {
            Verdict::GoOn => {}
            Verdict::Anew => {
                let (is, may) = (drift.max_m * 1e3, DRIFT_MAX_M * 1e3);
                self.ask_anew(format!("it is off by {is:.2} mm, more than {may} mm for 1 s"));
            }
            Verdict::TooOften => self.notice(format!(
                "your copy of the tissue is off by {:.2} mm; it was made anew {RESYNCS_MAX} times in {} s, which did not help",
                drift.max_m * 1e3,
                WINDOW.as_secs_f64()
            )),
        }
    }

    /// The connection was made anew: the log goes on where it stopped, or begins again and the copy with it.
    pub(super) fn handle_return(
        &mut self,
        welcome: &Welcome,
        now: ClientTime,
    ) -> Result<(), SiteError> {
        let had = self.counters.operations + self.deferred.len() as u64;
        let first = welcome.first_operation;
        if first.0 == 0 && (had > 0 || self.anew == Anew::Asked) {
            self.begin_anew(welcome, now);
        } else if self.anew == Anew::Asked {
            // A connection that was made anew for another reason; the one that is asked for comes.
            return Ok(());
        } else if first.0 != had {
            return Err(SiteError::Differs(format!(
                "it has {had} operations of the log, and the server begins again with {first}"
            )));
        } else if self.expected.is_some() {
            self.expected = Some((welcome.topology_version, welcome.topology_hash));
        }
        Ok(())
    }

    fn begin_anew(&mut self, welcome: &Welcome, now: ClientTime) {
        let model = Arc::clone(self.replica.topology().model());
        self.replica = if self.is_thin() {
            Replica::thin(model)
        } else {
            Replica::new(model, welcome.role.has_tool())
        };
        self.roster = Roster::new(&welcome.roster);
        self.schedule = DelaySchedule::new(&welcome.compensation);
        self.expected = Some((welcome.topology_version, welcome.topology_hash));
        self.started = welcome.session_started_at;
        (self.first_view, self.made_up) = (None, None);
        self.deferred = VecDeque::new();
        self.is_detached = false;
        self.unreported = None;
        self.cuts = Cuts::default();
        self.felt = None;
        self.view_news = VecDeque::new();
        (self.counters.operations, self.counters.cuts) = (0, 0);
        self.counters.resyncs += 1;
        self.anew = Anew::Applying;
        self.rejoin = None;
        self.resync.note(now);
    }

    /// The log of the beginning is applied, and the same.
    pub(super) fn end_anew(&mut self) {
        if std::mem::replace(&mut self.anew, Anew::No) != Anew::No {
            self.notice("your copy of the tissue is the server's again".to_owned());
        }
    }
}
