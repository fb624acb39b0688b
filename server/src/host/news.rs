//! What a host is told of who comes and goes, cuts and watches: a line each, on standard error.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};

use palpate_protocol::ParticipantId;
use palpate_protocol::operation::{LeaveReason, Operation, OperationKind};

/// Lines that wait; what comes when so many do is not told. Nobody reads a pipe that is full.
const WAITING_MAX: usize = 256;

/// Turns operations into sentences.
#[derive(Debug, Default)]
struct Names(BTreeMap<ParticipantId, String>);

impl Names {
    /// What a person wants to know of it, if anything.
    fn sentence(&mut self, operation: &Operation) -> Option<String> {
        match &operation.kind {
            OperationKind::Joined {
                participant,
                name,
                role,
                ..
            } => {
                self.0.insert(*participant, name.clone());
                Some(format!("{name} joined ({role})"))
            }
            OperationKind::Left {
                participant,
                reason,
            } => {
                let name = self.0.remove(participant)?;
                Some(match reason {
                    LeaveReason::Left => format!("{name} left"),
                    LeaveReason::Silent => {
                        format!("{name} is gone: nothing was heard for too long")
                    }
                    LeaveReason::Violation => {
                        format!("{name} was sent away: what came was not the protocol")
                    }
                    LeaveReason::TooSlow => {
                        format!("{name} was sent away: the connection there is too slow")
                    }
                    LeaveReason::Removed => format!("{name} was sent away"),
                })
            }
            OperationKind::Away { participant } => {
                self.of(*participant, "lost the connection; the seat is kept")
            }
            OperationKind::Back { participant } => self.of(*participant, "is back"),
            OperationKind::Cut(_) => self.of(operation.author, "made a cut"),
            OperationKind::Demoted { participant, .. } => self.of(
                *participant,
                "watches for now: the network there is too slow",
            ),
            OperationKind::Restored { participant } => self.of(*participant, "takes part again"),
            OperationKind::ToolChanged { .. }
            | OperationKind::Started { .. }
            | OperationKind::Compensation { .. } => None,
        }
    }

    fn of(&self, who: ParticipantId, what: &str) -> Option<String> {
        let name = self.0.get(&who)?;
        Some(format!("{name} {what}"))
    }
}

/// Tells of new operations. A thread of its own writes, so that a terminal that stands still stops no session.
#[derive(Debug)]
pub(super) struct News {
    names: Names,
    told: usize,
    lines: SyncSender<String>,
}

impl News {
    /// Nothing has been told.
    pub(super) fn new() -> Self {
        let (lines, waiting) = sync_channel::<String>(WAITING_MAX);
        // It ends with the channel; should there be no thread, nothing is told.
        let _ = std::thread::Builder::new()
            .name("news".to_owned())
            .spawn(move || {
                for line in waiting {
                    // Nobody is left to be told when standard error is gone.
                    let _ = writeln!(std::io::stderr(), "{line}");
                }
            });
        Self {
            names: Names::default(),
            told: 0,
            lines,
        }
    }

    /// The first operation that was not told.
    pub(super) fn told(&self) -> usize {
        self.told
    }

    /// Tells of the next ones.
    pub(super) fn tell(&mut self, operations: &[Arc<Operation>]) {
        for operation in operations {
            self.told += 1;
            if let Some(line) = self.names.sentence(operation) {
                let _ = self.lines.try_send(line);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::{OperationId, Role, ServerTime, TopologyHash};

    use super::*;

    #[test]
    fn a_host_hears_who_comes_goes_and_watches() {
        let ann = ParticipantId(1);
        let mut names = Names::default();
        let mut told = |kind: OperationKind| {
            names.sentence(&Operation {
                id: OperationId(0),
                at: ServerTime::ZERO,
                author: ann,
                topology_version_before: 0,
                topology_version_after: 0,
                hash_after: TopologyHash(0),
                kind,
            })
        };
        let joined = OperationKind::Joined {
            participant: ann,
            name: "ann".into(),
            role: Role::Trainee,
            tool: None,
        };
        assert_eq!(told(joined).unwrap(), "ann joined (trainee)");
        let away = OperationKind::Away { participant: ann };
        assert!(told(away).unwrap().starts_with("ann lost"));
        let delay = OperationKind::Compensation {
            delay_us: 1,
            effective_at: ServerTime::ZERO,
        };
        assert_eq!(told(delay), None);
        let left = OperationKind::Left {
            participant: ann,
            reason: LeaveReason::Left,
        };
        assert_eq!(told(left).unwrap(), "ann left");
        let back = OperationKind::Back { participant: ann };
        assert_eq!(told(back), None, "nobody of that number");
    }
}
