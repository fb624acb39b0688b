//! Operations of the log, each in the moment in which everybody sees it.

use palpate_protocol::operation::OperationKind;
use palpate_protocol::request::RequestKind;
use palpate_protocol::{ClientTime, ParticipantId, ServerTime, TopologyHash};

use super::cutting::is_cut;
use super::{Site, SiteError};
use crate::recording::OperationRecord;

impl Site {
    /// Applies what has become due.
    pub fn advance(&mut self, now: ClientTime) -> Result<(), SiteError> {
        match self.moment(now).filter(|_| !self.is_resyncing()) {
            Some((s, _)) => {
                self.prepare_cut(s);
                let result = self.apply_until(Some(s), now);
                let is_all = result.is_ok() && self.deferred.front().is_none_or(|o| o.at > s);
                // One report for all that was due: the server takes fifty requests in a second, and who comes
                // back to a hundred cuts is to have some left for what the hand asks.
                if let Some((version, hash)) = self.unreported.take_if(|_| is_all) {
                    self.report_topology(version, hash);
                }
                self.or_anew(result, now)
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

    /// Applies the first operation that waits. Returns whether it could: a cut that is still being
    /// made holds up what follows it.
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
                    // That they are one's own was compared just now.
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
            OperationKind::Away { participant } => {
                if *participant != self.me {
                    self.roster.lose(*participant);
                    self.notice_of(*participant, "lost the connection; the seat is kept");
                }
                "away"
            }
            OperationKind::Back { participant } => {
                if *participant != self.me {
                    self.notice_of(*participant, "is back");
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
            // A copy that is made anew repeats what is recorded already.
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
            // Only a cut changes it, and what it changed it to was compared.
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
            "after the log of the beginning it has version {} and hash {}, the server's has version {version} and hash {hash}",
            topology.version(),
            topology.hash()
        )))
    }

    /// Somebody's tool is lifted: their network is too slow for the session.
    fn demote(&mut self, who: ParticipantId, wanted_us: u32, cap_us: u32) {
        // Samples that come when it is set down again begin anew.
        self.roster.lose(who);
        self.roster.lift(who, true);
        if who == self.me {
            self.counters.demotions += 1;
            self.notice(format!(
                "your network needs {:.0} ms of delay, and the session waits for {:.0}: your tool is lifted and you watch, \
                 in your seat, until the network has recovered",
                f64::from(wanted_us) * 1e-3,
                f64::from(cap_us) * 1e-3
            ));
        } else {
            self.notice_of(who, "watches for now: the network there is too slow");
        }
    }

    fn restore(&mut self, who: ParticipantId) {
        self.roster.lift(who, false);
        if who == self.me {
            self.notice("your network has recovered: your tool is back".to_owned());
        } else {
            self.notice_of(who, "takes part again");
        }
    }

    pub(super) fn report_topology(&mut self, version: u32, hash: TopologyHash) {
        self.requests
            .push_back(RequestKind::TopologyReport { version, hash });
    }
}
