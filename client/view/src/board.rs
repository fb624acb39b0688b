//! The state of a session that follows from its log, for pages.

use std::collections::BTreeMap;

use palpate_protocol::ParticipantId;
use palpate_protocol::handshake::{RosterEntry, Welcome};
use palpate_protocol::operation::{
    CompensationMode, CompensationSettings, Operation, OperationKind,
};

use crate::control_message::{AnnotationMessage, CameraMessage};
use crate::message::{OpenInvitation, Participant, State};

/// Follows the log of a session. The host adds measurements to [`state`](Self::state).
#[derive(Debug, Clone, Default)]
pub struct Board {
    /// Number of the next operation; earlier ones are repetitions.
    next: u64,
    state: State,
    participants: BTreeMap<u16, Participant>,
    annotations: BTreeMap<u32, AnnotationMessage>,
    invitations: BTreeMap<u32, OpenInvitation>,
    /// Strokes in effect since the last reset, and strokes that were taken back since the last cut; the latest last.
    undoable: Vec<u64>,
    redoable: Vec<u64>,
}

impl Board {
    /// The board of a session without participants.
    pub fn new(compensation: &CompensationSettings, seats: Option<(u16, u16)>) -> Self {
        let mut board = Self::default();
        board.set_mode(compensation.mode);
        board.state.session.seats = seats.map(|(seats, _)| seats);
        board.state.session.spectators = seats.map(|(_, spectators)| spectators);
        board
    }

    /// The board of a newcomer; the operations of its log follow.
    pub fn of(welcome: &Welcome) -> Self {
        let mut board = Self::new(&welcome.compensation, None);
        for entry in &welcome.roster {
            board.join(entry);
        }
        board
    }

    fn join(&mut self, entry: &RosterEntry) {
        let participant = Participant {
            id: entry.participant.0,
            name: entry.name.clone(),
            role: entry.role.word(),
            tool: entry.tool.map(Into::into),
            is_connected: true,
            ..Participant::default()
        };
        // The log of a newcomer repeats the joins of its roster.
        self.participants
            .entry(entry.participant.0)
            .or_insert(participant);
    }

    fn set_mode(&mut self, mode: CompensationMode) {
        let (word, cap_ms) = match mode {
            CompensationMode::None => ("none", None),
            CompensationMode::Fixed => ("fixed", None),
            CompensationMode::Adaptive { cap_us } => ("adaptive", Some(f64::from(cap_us) / 1e3)),
        };
        self.state.session.delay_mode = word;
        self.state.session.delay_cap_ms = cap_ms;
    }

    /// Replaces the strokes in effect and those that were taken back by those of a snapshot; the latest last.
    pub fn set_strokes(&mut self, [done, undone]: [Vec<u64>; 2]) {
        (self.undoable, self.redoable) = (done, undone);
    }

    /// Applies the next operation of the log.
    pub fn apply(&mut self, operation: &Operation) {
        if operation.id.0 < self.next {
            return;
        }
        self.next = operation.id.0 + 1;
        let session = &mut self.state.session;
        session.operations = Some(self.next);
        session.topology_version = operation.topology_version_after;
        session.topology_hash = format!("{:016x}", operation.hash_after.0);
        match &operation.kind {
            OperationKind::Cut(part) => {
                let stroke = part.number(operation.author);
                // Of blades that take turns, the stroke with the latest part is the latest.
                self.undoable.retain(|done| *done != stroke);
                self.undoable.push(stroke);
                self.redoable.clear();
            }
            OperationKind::Undone => self.redoable.extend(self.undoable.pop()),
            OperationKind::Redone => self.undoable.extend(self.redoable.pop()),
            OperationKind::Reset => {
                self.undoable.clear();
                self.redoable.clear();
            }
            OperationKind::Joined {
                participant,
                name,
                role,
                tool,
            } => self.join(&RosterEntry {
                participant: *participant,
                name: name.clone(),
                role: *role,
                tool: *tool,
            }),
            OperationKind::Left { participant, .. } => {
                self.participants.remove(&participant.0);
            }
            OperationKind::Disconnected { participant } => {
                self.change(*participant, |p| p.is_connected = false);
            }
            OperationKind::Reconnected { participant } => {
                self.change(*participant, |p| p.is_connected = true);
            }
            OperationKind::ToolChanged { participant, tool } => {
                self.change(*participant, |p| p.tool = Some((*tool).into()));
            }
            OperationKind::Demoted { participant, .. } => {
                self.change(*participant, |p| p.is_demoted = true);
            }
            OperationKind::Restored { participant } => {
                self.change(*participant, |p| p.is_demoted = false);
            }
            OperationKind::Muted {
                participant,
                is_muted,
            } => self.change(*participant, |p| p.is_muted = *is_muted),
            OperationKind::ForceLimit {
                participant,
                newtons,
            } => self.change(*participant, |p| p.force_limit_n = *newtons),
            OperationKind::Emulated {
                participant,
                emulation,
            } => self.change(*participant, |p| {
                p.emulation = (!emulation.is_none()).then(|| (*emulation).into());
            }),
            OperationKind::Frozen { is_frozen, .. } => session.is_frozen = *is_frozen,
            OperationKind::Access {
                is_locked,
                seats,
                spectators,
            } => {
                session.is_locked = *is_locked;
                session.seats = Some(*seats);
                session.spectators = Some(*spectators);
            }
            OperationKind::CompensationMode { mode } => self.set_mode(*mode),
            OperationKind::Annotated(annotation) => {
                self.annotations.insert(annotation.id, annotation.into());
            }
            OperationKind::AnnotationRemoved { id } => {
                self.annotations.remove(id);
            }
            OperationKind::CameraShown(view) => {
                self.state.camera = Some(CameraMessage::new(operation.id.0, view));
            }
            OperationKind::Invited { .. } => self.invite(operation),
            OperationKind::InvitationUsed { id } | OperationKind::InvitationRevoked { id } => {
                self.invitations.remove(id);
            }
            OperationKind::Started { .. } | OperationKind::Compensation { .. } => {}
        }
    }

    /// Adds an invitation. Expired ones leave the log without an operation, so they are dropped here.
    fn invite(&mut self, operation: &Operation) {
        let OperationKind::Invited {
            id,
            role,
            name,
            expires_at,
            is_single_use,
        } = &operation.kind
        else {
            return;
        };
        let now_us = operation.at.as_micros();
        self.invitations.retain(|_, i| now_us < i.expires_us);
        let open = OpenInvitation {
            id: *id,
            role: role.word(),
            name: name.clone(),
            expires_us: expires_at.as_micros(),
            is_single_use: *is_single_use,
        };
        self.invitations.insert(*id, open);
    }

    fn change(&mut self, who: ParticipantId, change: impl FnOnce(&mut Participant)) {
        if let Some(participant) = self.participants.get_mut(&who.0) {
            change(participant);
        }
    }

    /// The state so far, without measurements.
    pub fn state(&self) -> State {
        let mut state = self.state.clone();
        state.session.cuts = self.undoable.len() as u64;
        state.session.can_undo = !self.undoable.is_empty();
        state.session.can_redo = !self.redoable.is_empty();
        state.participants = self.participants.values().cloned().collect();
        state.annotations = self.annotations.values().cloned().collect();
        state.invitations = self.invitations.values().cloned().collect();
        state
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::examples;
    use palpate_protocol::operation::CutStroke;
    use palpate_protocol::{OperationId, Role, ServerTime, TopologyHash};

    use super::*;

    fn apply(board: &mut Board, kind: OperationKind) -> State {
        let operation = Operation {
            id: OperationId(board.next),
            at: ServerTime::ZERO,
            author: ParticipantId(1),
            topology_version_before: 0,
            topology_version_after: 0,
            hash_after: TopologyHash(7),
            kind,
        };
        board.apply(&operation);
        // A repetition changes nothing.
        let state = board.state();
        board.apply(&operation);
        assert_eq!(board.state(), state);
        state
    }

    fn board() -> Board {
        let compensation = CompensationSettings {
            mode: CompensationMode::None,
            initial_delay_us: 0,
        };
        Board::new(&compensation, Some((16, 8)))
    }

    #[test]
    fn cuts_can_be_undone_and_redone_until_the_next_cut() {
        let mut board = board();
        let cut = |stroke: i64| {
            OperationKind::Cut(CutStroke {
                began: ServerTime::from_micros(stroke),
                joins: false,
                points: Vec::new(),
                width_m: 0.0,
            })
        };
        let can = |state: State| (state.session.can_undo, state.session.can_redo);
        assert_eq!(can(board.state()), (false, false));
        for part in [1, 1, 2, 1, 2] {
            assert_eq!(can(apply(&mut board, cut(part))), (true, false));
        }
        assert_eq!(board.state().session.cuts, 2, "strokes, not parts");
        assert_eq!(can(apply(&mut board, OperationKind::Undone)), (true, true));
        assert_eq!(can(apply(&mut board, OperationKind::Undone)), (false, true));
        assert_eq!(can(apply(&mut board, OperationKind::Redone)), (true, true));
        assert_eq!(can(apply(&mut board, cut(3))), (true, false));
        assert_eq!(can(apply(&mut board, OperationKind::Reset)), (false, false));
        board.set_strokes([vec![1, 2], vec![3]]);
        assert_eq!(can(board.state()), (true, true));
        assert_eq!(board.state().session.cuts, 2);
        assert_eq!(can(apply(&mut board, OperationKind::Redone)), (true, false));
    }

    #[test]
    fn controls_show_at_their_participant_and_session() {
        let mut board = board();
        let ann = ParticipantId(1);
        let joined = OperationKind::Joined {
            participant: ann,
            name: "ann".to_owned(),
            role: Role::Trainee,
            tool: None,
        };
        assert_eq!(apply(&mut board, joined).participants[0].name, "ann");
        let muted = OperationKind::Muted {
            participant: ann,
            is_muted: true,
        };
        assert!(apply(&mut board, muted).participants[0].is_muted);
        let emulated = |delay_ms, loss_permille| OperationKind::Emulated {
            participant: ann,
            emulation: palpate_protocol::Emulation {
                delay_ms,
                loss_permille,
            },
        };
        let shown = apply(&mut board, emulated(100, 55)).participants[0].emulation;
        assert_eq!(
            shown.map(|e| (e.delay_ms, e.loss_percent)),
            Some((100, 5.5))
        );
        let shown = apply(&mut board, emulated(0, 0)).participants[0].emulation;
        assert_eq!(shown, None);
        let locked = OperationKind::Access {
            is_locked: true,
            seats: 4,
            spectators: 2,
        };
        let session = apply(&mut board, locked).session;
        assert!(session.is_locked && session.seats == Some(4));
        let pin = apply(&mut board, OperationKind::Annotated(examples::annotation()));
        assert_eq!(pin.annotations.len(), 1);
        let id = examples::annotation().id;
        assert!(
            apply(&mut board, OperationKind::AnnotationRemoved { id })
                .annotations
                .is_empty()
        );
        assert!(
            apply(&mut board, OperationKind::CameraShown(examples::CAMERA))
                .camera
                .is_some()
        );
        let invited = |id, expires_s: i64| OperationKind::Invited {
            id,
            role: Role::Trainee,
            name: None,
            expires_at: ServerTime::from_micros(expires_s * 1_000_000),
            is_single_use: true,
        };
        let open = |state: State| state.invitations.iter().map(|i| i.id).collect::<Vec<_>>();
        assert_eq!(open(apply(&mut board, invited(1, 60))), [1]);
        assert_eq!(open(apply(&mut board, invited(2, 60))), [1, 2]);
        assert_eq!(open(apply(&mut board, invited(3, 0))), [1, 2, 3]);
        let used = OperationKind::InvitationUsed { id: 1 };
        assert_eq!(open(apply(&mut board, used)), [2, 3]);
        assert_eq!(
            open(apply(&mut board, invited(4, 60))),
            [2, 4],
            "3 has expired"
        );
        let revoked = OperationKind::InvitationRevoked { id: 2 };
        assert_eq!(open(apply(&mut board, revoked)), [4]);
        let gone = OperationKind::Left {
            participant: ann,
            reason: palpate_protocol::operation::LeaveReason::Removed,
        };
        assert!(apply(&mut board, gone).participants.is_empty());
    }
}
