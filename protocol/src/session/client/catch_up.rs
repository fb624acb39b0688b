//! From the welcome to the newest operation: snapshot, then log.

use super::incoming_snapshot::{IncomingSnapshot, Progress};
use super::{ClientSession, DELAY_REPORT_PERIOD, Joined, State};
use crate::handshake::{ROSTER_MAX, Welcome};
use crate::operation::{Operation, OperationKind};
use crate::session::ClientEvent;
use crate::{ClientTime, ProtocolError};

impl ClientSession {
    pub(super) fn join(
        &mut self,
        welcome: Box<Welcome>,
        now: ClientTime,
    ) -> Result<(), ProtocolError> {
        if welcome.roster.len() > ROSTER_MAX {
            return Err(ProtocolError::OutOfRange {
                what: "the roster",
                detail: format!("{} entries, at most {ROSTER_MAX}", welcome.roster.len()),
            });
        }
        let first = welcome.first_operation;
        let is_continued = first.0 == 0 || self.resumes_at == Some(first);
        if !is_continued || first.0 > welcome.operations_so_far {
            return Err(ProtocolError::OutOfRange {
                what: "the beginning of the log",
                detail: format!(
                    "{first} of {}, where {} was asked for",
                    welcome.operations_so_far,
                    self.resumes_at.unwrap_or_default()
                ),
            });
        }
        let snapshot = welcome.snapshot.map(IncomingSnapshot::new).transpose()?;
        self.link.open(welcome.epoch, welcome.participant);
        let schedule = self.schedule_after(&welcome);
        self.delay.set_cap(welcome.compensation.mode.cap());
        self.state = State::Joined(Box::new(Joined {
            participant: welcome.participant,
            next_operation: first,
            catch_up: Some(welcome.operations_so_far),
            snapshot,
            schedule,
            newest_shown: Vec::new(),
            last_motion_at: now,
        }));
        self.probe_due = now;
        self.report_due = now + DELAY_REPORT_PERIOD;
        self.emit(ClientEvent::Welcomed(welcome));
        self.note_caught_up();
        Ok(())
    }

    /// Reports once that the snapshot and the log of the welcome have arrived.
    fn note_caught_up(&mut self) {
        if let State::Joined(joined) = &mut self.state
            && joined.snapshot.is_none()
            && joined.catch_up == Some(joined.next_operation.0)
        {
            joined.catch_up = None;
            self.emit(ClientEvent::CaughtUp);
        }
    }

    pub(super) fn handle_snapshot(&mut self, piece: &[u8]) -> Result<(), ProtocolError> {
        let State::Joined(joined) = &mut self.state else {
            return Ok(());
        };
        let Some(snapshot) = joined.snapshot.take() else {
            return Err(ProtocolError::OutOfOrder {
                what: "piece of a snapshot",
                state: "none is missing",
            });
        };
        match snapshot.push(piece)? {
            Progress::Partial(snapshot) => joined.snapshot = Some(snapshot),
            Progress::Complete(bytes) => {
                self.emit(ClientEvent::Snapshot(bytes));
                self.note_caught_up();
            }
        }
        Ok(())
    }

    pub(super) fn handle_operation(&mut self, operation: Operation) -> Result<(), ProtocolError> {
        let State::Joined(joined) = &mut self.state else {
            return Ok(());
        };
        if joined.snapshot.is_some() {
            return Err(ProtocolError::OutOfOrder {
                what: "operation",
                state: "the snapshot is not complete",
            });
        }
        // A gap stands for operations that no longer matter.
        if operation.id < joined.next_operation {
            return Err(ProtocolError::OperationOrder {
                expected: joined.next_operation.0,
                found: operation.id.0,
            });
        }
        joined.next_operation = operation.id.next();
        if !operation.kind.is_valid() {
            let what = match operation.kind {
                OperationKind::Cut(_) => "a stroke",
                _ => "an operation",
            };
            return Err(ProtocolError::OutOfRange {
                what,
                detail: format!("a number or text of {} is not allowed", operation.id),
            });
        }
        match &operation.kind {
            OperationKind::Compensation {
                delay_us,
                effective_at,
            } => {
                joined.schedule.handle_change(*delay_us, *effective_at);
            }
            OperationKind::CompensationMode { mode } => self.delay.set_cap(mode.cap()),
            OperationKind::Left { participant, .. }
            | OperationKind::Disconnected { participant }
            | OperationKind::Demoted { participant, .. }
            | OperationKind::Muted {
                participant,
                is_muted: true,
            } => {
                joined.newest_shown.retain(|(p, _)| p != participant);
                // The last delay estimate is void: no other participant's motion arrives.
                if joined.newest_shown.is_empty() {
                    self.delay.restart();
                }
            }
            _ => {}
        }
        self.emit(ClientEvent::Operation(operation));
        self.note_caught_up();
        Ok(())
    }
}
