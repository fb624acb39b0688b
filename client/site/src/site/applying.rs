//! Applying operations of the log at their due time.

use palpate_protocol::operation::{CutStroke, Operation, OperationKind};
use palpate_protocol::request::RequestKind;
use palpate_protocol::{ClientTime, ParticipantId, ServerTime, Span, TopologyHash};
use palpate_tissue::CutHistory;

use super::controlled::Access;
use super::cutting::is_cut;
use super::operation_record::{OperationRecord, word};
use super::{Site, SiteError};

/// Minimum time between two reports of the topology.
const REPORT_PERIOD: Span = Span::from_millis(200);

impl Site {
    /// Applies all operations that are due.
    pub fn advance(&mut self, now: ClientTime) -> Result<(), SiteError> {
        match self.common_time(now).filter(|_| !self.is_resyncing()) {
            Some((s, _)) => {
                let result = self.apply_until(Some(s), now);
                let is_all = result.is_ok() && self.deferred.front().is_none_or(|o| o.at > s);
                // One report covers all due operations: the server accepts 50 requests per second, and the hand's own
                // strokes and the replay of the log must leave some for each other.
                let is_due = is_all && self.next_report.is_none_or(|at| now >= at);
                if let Some((version, hash)) = self.unreported.take_if(|_| is_due) {
                    self.next_report = Some(now + REPORT_PERIOD);
                    self.report_topology(version, hash);
                }
                self.or_resync(result, now)
            }
            None => Ok(()),
        }
    }

    pub(super) fn apply_until(
        &mut self,
        s: Option<ServerTime>,
        now: ClientTime,
    ) -> Result<(), SiteError> {
        while let Some(first) = self.deferred.front() {
            // Cuts behind it in the log have the earlier time of their blade.
            let waits = first.kind.waits() && s.is_some_and(|s| first.at > s);
            if waits || !self.apply_first(now)? {
                break;
            }
        }
        Ok(())
    }

    /// Begins with the cuts of a snapshot.
    pub(super) fn restore_snapshot(&mut self, bytes: &[u8]) -> Result<(), SiteError> {
        self.replica.restore(bytes)?;
        let history = self.replica.history();
        let strokes = history.map(CutHistory::stroke_numbers).unwrap_or_default();
        self.counters.cuts = strokes.iter().map(|list| list.len() as u64).sum();
        let seen = strokes.concat().into_iter();
        self.strokes_seen = seen.map(|n| (CutStroke::author_of(n), n)).collect();
        Ok(())
    }

    /// Applies the first waiting operation. Returns whether it could: a cut in preparation blocks its successors.
    pub(super) fn apply_first(&mut self, now: ClientTime) -> Result<bool, SiteError> {
        let Some(operation) = self.deferred.front() else {
            return Ok(false);
        };
        if self.is_detached && is_cut(operation) {
            if !self.adopt_cut() {
                return Ok(false);
            }
        } else if self.expected.is_some() {
            self.replica.replay(operation)?;
        } else {
            self.replica.apply(operation)?;
        }
        let Some(operation) = self.deferred.pop_front() else {
            return Ok(false);
        };
        self.counters.operations += 1;
        if is_cut(&operation) && self.expected.is_none() {
            // The operation's version and hash were verified above.
            self.unreported = Some((operation.topology_version_after, operation.hash_after));
        }
        self.take_effect(&operation);
        if operation.id.0 < self.unrecorded {
            // A resync repeats recorded operations.
            return Ok(true);
        }
        self.unrecorded = operation.id.0 + 1;
        let shown = self.common_time(now).filter(|_| self.expected.is_none());
        let topology = self.replica.topology();
        self.applied.push_back(OperationRecord {
            id: operation.id.0,
            kind: word(&operation.kind).to_owned(),
            at_us: operation.at.as_micros(),
            applied_us: now.as_micros(),
            late_us: shown.map(|(s, _)| (s - operation.at).as_micros()),
            version: topology.version(),
            // Only changes of the topology change the hash, and their hashes were verified.
            hash: operation.hash_after.to_string(),
            script_at_us: match &operation.kind {
                OperationKind::Started { at } => Some(at.as_micros()),
                _ => None,
            },
            stroke: match &operation.kind {
                OperationKind::Cut(stroke) => Some(stroke.clone()),
                _ => None,
            },
        });
        Ok(true)
    }

    /// The effect of an operation on participants and counters. The replica has applied it.
    fn take_effect(&mut self, operation: &Operation) {
        match &operation.kind {
            OperationKind::Cut(part) => {
                let number = part.number(operation.author);
                let latest = self.strokes_seen.insert(operation.author, number);
                self.counters.cuts += u64::from(latest != Some(number));
            }
            OperationKind::Joined { participant, .. } => {
                if *participant != self.me {
                    self.notice_of(*participant, "joined");
                }
            }
            OperationKind::Left { participant, .. } => {
                self.notice_of(*participant, "left");
                self.roster.leave(*participant);
            }
            OperationKind::Disconnected { participant } => {
                if *participant == self.me {
                    // The server released the tool that a freeze held.
                    self.roster.release_held(self.me);
                } else {
                    self.roster.lose(*participant);
                    self.notice_of(*participant, "lost the connection; the seat is kept");
                }
            }
            OperationKind::Reconnected { participant } => {
                if *participant != self.me {
                    self.notice_of(*participant, "reconnected");
                }
            }
            OperationKind::ToolChanged { participant, tool } => {
                self.change_tool(*participant, *tool);
            }
            OperationKind::Demoted {
                participant,
                wanted_us,
                cap_us,
            } => {
                self.demote(*participant, *wanted_us, *cap_us);
            }
            OperationKind::Restored { participant } => {
                self.restore(*participant);
            }
            _ => self.take_control(operation),
        }
    }

    /// The effect of an operation that follows from a control; others have their effect on arrival.
    fn take_control(&mut self, operation: &Operation) {
        match &operation.kind {
            OperationKind::Muted {
                participant,
                is_muted,
            } => {
                self.mute(*participant, *is_muted);
            }
            OperationKind::Frozen { is_frozen, held } => {
                self.freeze(is_frozen.then_some(held), operation.at);
            }
            OperationKind::Reset => {
                self.notice_of(operation.author, "has returned to the uncut tissue");
            }
            OperationKind::Undone => {
                self.notice_of(operation.author, "has taken back the last cut");
            }
            OperationKind::Redone => {
                self.notice_of(operation.author, "has repeated the last cut");
            }
            OperationKind::ForceLimit {
                participant,
                newtons,
            } => {
                self.limit_force(*participant, *newtons);
            }
            OperationKind::Access {
                is_locked,
                seats,
                spectators,
            } => {
                let access = Access {
                    is_locked: *is_locked,
                    seats: *seats,
                    spectators: *spectators,
                };
                self.change_access(operation.author, access);
            }
            OperationKind::CompensationMode { mode } => {
                self.session.compensation = Some(*mode);
                self.notice_of(operation.author, "has changed the rule for the delay");
            }
            OperationKind::Annotated(annotation) => {
                self.session.annotate(annotation);
            }
            OperationKind::AnnotationRemoved { id } => {
                self.session.annotations.remove(id);
            }
            OperationKind::CameraShown(view) => {
                self.session.camera = Some(*view);
            }
            _ => {}
        }
    }

    pub(super) fn compare(&self, version: u32, hash: TopologyHash) -> Result<(), SiteError> {
        let topology = self.replica.topology();
        if topology.version() == version && topology.hash().0 == hash.0 {
            return Ok(());
        }
        Err(SiteError::Differs(format!(
            "after replaying the log the client has version {} and hash {}, the server version {version} and hash {hash}",
            topology.version(),
            topology.hash()
        )))
    }

    /// Demotes a participant whose network is too slow for the session.
    fn demote(&mut self, who: ParticipantId, wanted_us: u32, cap_us: u32) {
        // After the demotion the timeline starts with new samples.
        self.roster.lose(who);
        self.roster.set_demoted(who, true);
        if who == self.me {
            self.counters.demotions += 1;
            self.notice(format!(
                "your network needs {:.0} ms of delay, but the session allows {:.0} ms: your tool is inactive \
                 and you are a spectator until the network recovers",
                f64::from(wanted_us) * 1e-3,
                f64::from(cap_us) * 1e-3
            ));
        } else {
            self.notice_of(who, "is demoted to spectator: the network is too slow");
        }
    }

    fn restore(&mut self, who: ParticipantId) {
        self.roster.set_demoted(who, false);
        if who == self.me {
            self.notice("your network has recovered: your tool is active again".to_owned());
        } else {
            self.notice_of(who, "participates again");
        }
    }

    pub(super) fn report_topology(&mut self, version: u32, hash: TopologyHash) {
        self.requests
            .push_back(RequestKind::TopologyReport { version, hash });
    }
}
