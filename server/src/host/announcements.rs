//! Announcements on standard error: one line per join, leave, cut and demotion, and a limited rate of lines about
//! limits that took effect.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};

use palpate_protocol::operation::{LeaveReason, Operation, OperationKind};
use palpate_protocol::{OperationId, ParticipantId, ServerTime, Span};
use palpate_room::{Limit, LimitCounters};

/// Maximum waiting lines; further ones are dropped, because a full pipe has no reader.
const WAITING_MAX: usize = 256;

/// Names of the participants, for the text of operations.
#[derive(Debug, Default)]
struct Names(BTreeMap<ParticipantId, String>);

impl Names {
    /// The text of an operation; `None` for operations that are not announced.
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
                Some(format!("{name} {}", left(*reason)))
            }
            OperationKind::Disconnected { participant } => {
                self.of(*participant, "lost the connection; the seat is kept")
            }
            OperationKind::Reconnected { participant } => self.of(*participant, "reconnected"),
            OperationKind::Cut(_) => self.of(operation.author, "made a cut"),
            OperationKind::Demoted { participant, .. } => {
                self.of(*participant, "demoted to spectator: network too slow")
            }
            OperationKind::Restored { participant } => {
                self.of(*participant, "restored: tool active again")
            }
            OperationKind::Muted {
                participant,
                is_muted,
            } => self.of(
                *participant,
                if *is_muted { "muted" } else { "active again" },
            ),
            OperationKind::Frozen { is_frozen, .. } => {
                let what = if *is_frozen { "froze" } else { "continued" };
                self.of(operation.author, &format!("{what} the session"))
            }
            OperationKind::Reset => self.of(operation.author, "returned to the uncut tissue"),
            OperationKind::Undone => self.of(operation.author, "took back the last cut"),
            OperationKind::Redone => self.of(operation.author, "repeated the last cut"),
            OperationKind::ForceLimit {
                participant,
                newtons,
            } => {
                let limit = newtons.map_or("of the device".to_owned(), |n| format!("{n:.1} N"));
                self.of(*participant, &format!("has the force limit {limit}"))
            }
            OperationKind::Emulated {
                participant,
                emulation,
            } => {
                let what = if emulation.is_none() {
                    "has no emulated network any more".to_owned()
                } else {
                    let percent = f64::from(emulation.loss_permille) / 10.0;
                    let delay_ms = emulation.delay_ms;
                    format!("has an emulated network: {delay_ms} ms one way, {percent} % loss")
                };
                self.of(*participant, &what)
            }
            OperationKind::Access {
                is_locked, seats, ..
            } => {
                let state = if *is_locked { "locked" } else { "open" };
                self.of(
                    operation.author,
                    &format!("changed access: {state}, {seats} seats"),
                )
            }
            OperationKind::CompensationMode { .. } => {
                self.of(operation.author, "changed the rule for the delay")
            }
            OperationKind::Invited { id, role, name, .. } => {
                let for_name = name
                    .as_ref()
                    .map_or_else(String::new, |n| format!(" and the name {n}"));
                let what = format!("created invitation {id} for the role {role}{for_name}");
                self.of(operation.author, &what)
            }
            OperationKind::InvitationUsed { id } => {
                self.of(operation.author, &format!("has used invitation {id} up"))
            }
            OperationKind::InvitationRevoked { id } => {
                self.of(operation.author, &format!("revoked invitation {id}"))
            }
            OperationKind::ToolChanged { .. }
            | OperationKind::Started { .. }
            | OperationKind::Compensation { .. }
            | OperationKind::Annotated(_)
            | OperationKind::AnnotationRemoved { .. }
            | OperationKind::CameraShown(_) => None,
        }
    }

    fn of(&self, who: ParticipantId, what: &str) -> Option<String> {
        let name = self.0.get(&who)?;
        Some(format!("{name} {what}"))
    }
}

/// How a participant left.
fn left(reason: LeaveReason) -> &'static str {
    match reason {
        LeaveReason::Left => "left",
        LeaveReason::Silent => "removed: no connection for too long",
        LeaveReason::Violation => "disconnected: protocol violation",
        LeaveReason::TooSlow => "disconnected: connection too slow",
        LeaveReason::Removed => "disconnected by the server",
    }
}

/// Least time between two lines about one limit.
const LIMIT_PERIOD: Span = Span::from_millis(5000);

/// Rate-limited lines about limits.
#[derive(Debug, Default)]
struct LimitLines {
    /// By limit: the count of the last line, and the earliest time of the next one.
    announced: [(u64, ServerTime); Limit::ALL.len()],
}

impl LimitLines {
    /// The lines that are due.
    fn due(&mut self, counters: &LimitCounters, now: ServerTime) -> Vec<String> {
        let mut lines = Vec::new();
        for (limit, (announced, next)) in Limit::ALL.into_iter().zip(&mut self.announced) {
            let count = counters.of(limit);
            if count > *announced && now >= *next {
                lines.push(format!("{} {limit}", count - *announced));
                (*announced, *next) = (count, now + LIMIT_PERIOD);
            }
        }
        lines
    }
}

/// Announces new operations. Its own thread prints, so that a blocked terminal does not stop the session.
#[derive(Debug)]
pub(super) struct Announcements {
    names: Names,
    next: OperationId,
    limits: LimitLines,
    lines: SyncSender<String>,
}

impl Announcements {
    /// Starts the thread that prints.
    pub(super) fn new() -> Self {
        let (lines, waiting) = sync_channel::<String>(WAITING_MAX);
        // The thread ends with the channel. Without the thread all announcements are dropped.
        let _ = std::thread::Builder::new()
            .name("announcements".to_owned())
            .spawn(move || {
                for line in waiting {
                    // A closed standard error is ignored.
                    let _ = writeln!(std::io::stderr(), "{line}");
                }
            });
        Self {
            names: Names::default(),
            next: OperationId(0),
            limits: LimitLines::default(),
            lines,
        }
    }

    /// The next operation to announce.
    pub(super) fn next(&self) -> OperationId {
        self.next
    }

    /// Announces limits that took effect, at most one line per limit and [`LIMIT_PERIOD`].
    pub(super) fn announce_limits(&mut self, counters: &LimitCounters, now: ServerTime) {
        for line in self.limits.due(counters, now) {
            let _ = self.lines.try_send(line);
        }
    }

    /// Announces the next operations.
    pub(super) fn announce(&mut self, operations: &[Arc<Operation>]) {
        for operation in operations {
            self.next = operation.id.next();
            if let Some(line) = self.names.sentence(operation) {
                let _ = self.lines.try_send(line);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::{Role, TopologyHash};

    use super::*;

    #[test]
    fn joins_leaves_and_lost_connections_are_announced() {
        let ann = ParticipantId(1);
        let mut names = Names::default();
        let mut line = |kind: OperationKind| {
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
        assert_eq!(line(joined).unwrap(), "ann joined (trainee)");
        let away = OperationKind::Disconnected { participant: ann };
        assert!(line(away).unwrap().starts_with("ann lost"));
        let delay = OperationKind::Compensation {
            delay_us: 1,
            effective_at: ServerTime::ZERO,
        };
        assert_eq!(line(delay), None);
        let left = OperationKind::Left {
            participant: ann,
            reason: LeaveReason::Left,
        };
        assert_eq!(line(left).unwrap(), "ann left");
        let back = OperationKind::Reconnected { participant: ann };
        assert_eq!(line(back), None, "unknown participant");
    }
}
