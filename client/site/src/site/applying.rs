//! Applying operations of the log at their due time.

use palpate_protocol::operation::OperationKind;
use palpate_protocol::request::RequestKind;
use palpate_protocol::{ClientTime, ParticipantId, ServerTime, TopologyHash};

use super::cutting::is_cut;
use super::operation_record::OperationRecord;
use super::{Site, SiteError};

impl Site {
    /// Applies all operations that are due.
    pub fn advance(&mut self, now: ClientTime) -> Result<(), SiteError> {
        match self.common_time(now).filter(|_| !self.is_resyncing()) {
            Some((s, _)) => {
                self.prepare_cut(s);
                let result = self.apply_until(Some(s), now);
                let is_all = result.is_ok() && self.deferred.front().is_none_or(|o| o.at > s);
                // One report covers all due operations: the server accepts 50 requests per second, and a client that
                // replays a hundred cuts must leave some for the hand.
                if let Some((version, hash)) = self.unreported.take_if(|_| is_all) {
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
            if s.is_some_and(|s| first.at > s) || !self.apply_first(now)? {
                break;
            }
        }
        Ok(())
    }

    /// Applies the first waiting operation. Returns whether it could: a cut in preparation blocks its successors.
    pub(super) fn apply_first(&mut self, now: ClientTime) -> Result<bool, SiteError> {
        let Some(operation) = self.deferred.front() else {
            return Ok(false);
        };
        if self.is_detached && is_cut(operation) {
            if !self.exchange() {
                return Ok(false);
            }
        } else {
            self.replica.apply(operation)?;
        }
        let Some(operation) = self.deferred.pop_front() else {
            return Ok(false);
        };
        self.counters.operations += 1;
        let word = match &operation.kind {
            OperationKind::Cut(_) => {
                self.counters.cuts += 1;
                if self.expected.is_none() {
                    // The operation's version and hash were verified above.
                    self.unreported =
                        Some((operation.topology_version_after, operation.hash_after));
                }
                "cut"
            }
            OperationKind::Joined { participant, .. } => {
                if *participant != self.me {
                    self.notice_of(*participant, "joined");
                }
                "joined"
            }
            OperationKind::Left { participant, .. } => {
                self.notice_of(*participant, "left");
                self.roster.leave(*participant);
                "left"
            }
            OperationKind::Disconnected { participant } => {
                if *participant != self.me {
                    self.roster.lose(*participant);
                    self.notice_of(*participant, "lost the connection; the seat is kept");
                }
                "away"
            }
            OperationKind::Reconnected { participant } => {
                if *participant != self.me {
                    self.notice_of(*participant, "reconnected");
                }
                "back"
            }
            OperationKind::ToolChanged { participant, tool } => {
                self.roster.change_tool(*participant, *tool);
                "tool-changed"
            }
            OperationKind::Started { .. } => "started",
            OperationKind::Compensation { .. } => "compensation",
            OperationKind::Demoted {
                participant,
                wanted_us,
                cap_us,
            } => {
                self.demote(*participant, *wanted_us, *cap_us);
                "demoted"
            }
            OperationKind::Restored { participant } => {
                self.restore(*participant);
                "restored"
            }
        };
        if operation.id.0 < self.unrecorded {
            // A resync repeats recorded operations.
            return Ok(true);
        }
        self.unrecorded = operation.id.0 + 1;
        let topology = self.replica.topology();
        self.applied.push_back(OperationRecord {
            id: operation.id.0,
            kind: word.to_owned(),
            at_us: operation.at.as_micros(),
            applied_us: now.as_micros(),
            version: topology.version(),
            // Only a cut changes the hash, and its hash was verified.
            hash: operation.hash_after.to_string(),
            stroke: match &operation.kind {
                OperationKind::Cut(stroke) => Some(stroke.clone()),
                _ => None,
            },
        });
        Ok(true)
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
