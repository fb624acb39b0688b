//! The instructor's controls: from the request over its checks to the log.

use palpate_protocol::control::{Annotation, Control};
use palpate_protocol::operation::{CompensationMode, HeldTool, LeaveReason, OperationKind};
use palpate_protocol::permission::Permission;
use palpate_protocol::request::RequestRefusal;
use palpate_protocol::session::PeerMessage;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    EMULATED_DELAY_MAX_MS, EMULATED_LOSS_MAX_PERMILLE, Emulation, ParticipantId, RequestId,
    ServerTime, Span,
};

use super::Room;
use crate::authority::RequestedChange;
use crate::config::SEATS_MAX;
use crate::control_state::ANNOTATIONS_MAX;
use crate::participant::Participant;

impl Room {
    /// Changes a participant's tool.
    pub(super) fn set_tool(
        &mut self,
        who: ParticipantId,
        tool: ToolDescription,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let seat = self.participants.get_mut(&who);
        let Some(seat) = seat.filter(|seat| seat.role.may(Permission::HoldTool)) else {
            return Err(RequestRefusal::NotAllowed);
        };
        // The tool that presses in the held tissue stays.
        if self.controls.frozen_from.is_some() {
            return Err(RequestRefusal::Frozen);
        }
        if !self.log.takes_seat() || !seat.change_tool(tool, now) {
            return Err(RequestRefusal::TooMany);
        }
        let kind = OperationKind::ToolChanged {
            participant: who,
            tool,
        };
        self.append(who, kind, now);
        Ok(())
    }

    /// Applies a control, or refuses it. A control that changes nothing adds no operation.
    pub(super) fn control(
        &mut self,
        author: ParticipantId,
        request: RequestId,
        control: Control,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let requester = self.participants.get(&author);
        if !requester.is_some_and(|p| p.role.may(Permission::Control)) {
            return Err(RequestRefusal::NotAllowed);
        }
        let operations = match control {
            Control::HandOver { .. } => self.participants.len(),
            _ => 1,
        };
        if !self.log.takes_control() || !self.controls.take(operations, now) {
            return Err(RequestRefusal::TooMany);
        }
        match control {
            Control::Mute {
                participant,
                is_muted,
            } => {
                self.tool_holder(participant)?;
                self.mute(author, participant, is_muted, now);
            }
            Control::HandOver { participant } => {
                self.tool_holder(participant)?;
                for who in self.tool_holders() {
                    self.mute(author, who, who != participant, now);
                }
            }
            Control::Freeze { is_frozen } => self.freeze(author, is_frozen, now),
            Control::Reset => self.order_return(author, request, RequestedChange::Reset)?,
            Control::Undo => self.order_return(author, request, RequestedChange::Undo)?,
            Control::Redo => self.order_return(author, request, RequestedChange::Redo)?,
            Control::ForceLimit {
                participant,
                newtons,
            } => self.limit_force(author, participant, newtons, now)?,
            Control::Kick { participant } => self.kick(author, participant, now)?,
            Control::Ban { participant } => self.ban(author, participant, now)?,
            Control::Lock { is_locked } => {
                if std::mem::replace(&mut self.controls.is_locked, is_locked) != is_locked {
                    self.log_access(author, now);
                }
            }
            Control::Capacity { seats, spectators } => {
                self.set_capacity(author, seats, spectators, now)?;
            }
            Control::Compensation { mode } => self.set_compensation(author, mode, now),
            Control::Annotate(annotation) => self.annotate(author, annotation, now)?,
            Control::RemoveAnnotation { id } => {
                if !self.controls.annotations.remove(&id) {
                    return Err(unknown_annotation(id));
                }
                self.append(author, OperationKind::AnnotationRemoved { id }, now);
            }
            Control::ShowCamera(view) => {
                self.append(author, OperationKind::CameraShown(view), now);
            }
            Control::Invite {
                role,
                name,
                lifetime_s,
                is_single_use,
            } => {
                let expires_at = now + Span::from_millis(1000 * i64::from(lifetime_s));
                self.invite(author, (role, name), expires_at, is_single_use, now)?;
            }
            Control::RevokeInvitation { id } => self.revoke_invitation(author, id, now)?,
            Control::Emulate {
                participant,
                emulation,
            } => self.emulate(author, participant, emulation, now)?,
        }
        Ok(())
    }

    fn seat_mut(&mut self, who: ParticipantId) -> Result<&mut Participant, RequestRefusal> {
        (self.participants.get_mut(&who)).ok_or(RequestRefusal::UnknownParticipant)
    }

    /// Checks that a participant has a tool.
    fn tool_holder(&mut self, who: ParticipantId) -> Result<(), RequestRefusal> {
        let seat = self.seat_mut(who)?;
        if seat.role.may(Permission::HoldTool) {
            return Ok(());
        }
        let (name, role) = (&seat.name, seat.role);
        Err(RequestRefusal::OutOfRange(format!(
            "{name} is a {role} and has no tool"
        )))
    }

    fn tool_holders(&self) -> Vec<ParticipantId> {
        let holders = self.participants.values();
        let holders = holders.filter(|p| p.role.may(Permission::HoldTool));
        holders.map(|p| p.id).collect()
    }

    fn mute(&mut self, author: ParticipantId, who: ParticipantId, is_muted: bool, now: ServerTime) {
        let Some(seat) = self.participants.get_mut(&who) else {
            return;
        };
        if std::mem::replace(&mut seat.is_muted, is_muted) == is_muted {
            return;
        }
        if is_muted {
            seat.deactivate(now);
            self.fan_out.remove(who);
        } else {
            seat.activate(now);
        }
        let kind = OperationKind::Muted {
            participant: who,
            is_muted,
        };
        self.append(author, kind, now);
    }

    fn freeze(&mut self, author: ParticipantId, is_frozen: bool, now: ServerTime) {
        if self.controls.frozen_from.is_some() == is_frozen {
            return;
        }
        self.controls.frozen_from = is_frozen.then_some(now);
        let mut held = Vec::new();
        for seat in self.participants.values_mut() {
            if !is_frozen {
                seat.release(now);
            } else if let Some(shown) = seat.freeze(now) {
                held.push(HeldTool {
                    participant: seat.id,
                    pose: shown.pose,
                    buttons: shown.buttons,
                });
            }
        }
        self.append(author, OperationKind::Frozen { is_frozen, held }, now);
    }

    fn limit_force(
        &mut self,
        author: ParticipantId,
        participant: ParticipantId,
        newtons: Option<f64>,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        self.tool_holder(participant)?;
        let seat = self.seat_mut(participant)?;
        if std::mem::replace(&mut seat.force_limit, newtons) != newtons {
            let kind = OperationKind::ForceLimit {
                participant,
                newtons,
            };
            self.append(author, kind, now);
        }
        Ok(())
    }

    /// Changes the emulated network of a participant. The shell delays and drops; the log shows it to all participants.
    fn emulate(
        &mut self,
        author: ParticipantId,
        participant: ParticipantId,
        emulation: Emulation,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let seat = self.seat_mut(participant)?;
        if !emulation.is_valid() {
            return Err(RequestRefusal::OutOfRange(format!(
                "a network with {} ms of delay and {} % of loss is not emulated; choose at most \
                 {EMULATED_DELAY_MAX_MS} ms and {} %",
                emulation.delay_ms,
                f64::from(emulation.loss_permille) / 10.0,
                EMULATED_LOSS_MAX_PERMILLE / 10
            )));
        }
        if std::mem::replace(&mut seat.emulation, emulation) != emulation {
            let kind = OperationKind::Emulated {
                participant,
                emulation,
            };
            self.append(author, kind, now);
        }
        Ok(())
    }

    /// Removes a participant, whose connection ends with a sentence.
    fn kick(
        &mut self,
        author: ParticipantId,
        who: ParticipantId,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let peer = self.removable(author, who)?.peer();
        self.remove_seat(who, LeaveReason::Removed, now);
        if let Some(peer) = peer {
            let sentence = "the instructor has removed you from the session".to_owned();
            self.send(peer, PeerMessage::Goodbye(sentence));
        }
        Ok(())
    }

    fn ban(
        &mut self,
        author: ParticipantId,
        who: ParticipantId,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let seat = self.removable(author, who)?;
        let (name, appearance) = (seat.name.clone(), seat.appearance.clone());
        if !self.controls.ban(&name, appearance) {
            let full = "too many names are banned; lock the session instead";
            return Err(RequestRefusal::OutOfRange(full.to_owned()));
        }
        self.kick(author, who, now)
    }

    fn removable(
        &mut self,
        author: ParticipantId,
        who: ParticipantId,
    ) -> Result<&mut Participant, RequestRefusal> {
        if author == who {
            let own = "you can not remove yourself; leave the session instead";
            return Err(RequestRefusal::OutOfRange(own.to_owned()));
        }
        self.seat_mut(who)
    }

    fn set_capacity(
        &mut self,
        author: ParticipantId,
        seats: u16,
        spectators: u16,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        if !(1..=SEATS_MAX).contains(&seats) || spectators > seats {
            return Err(RequestRefusal::OutOfRange(format!(
                "{seats} seats with {spectators} for spectators are not possible; offer 1 to {SEATS_MAX} seats, and at \
                 most as many for spectators"
            )));
        }
        let before = (self.config.seats, self.config.spectators);
        if before != (seats, spectators) {
            (self.config.seats, self.config.spectators) = (seats, spectators);
            self.log_access(author, now);
        }
        Ok(())
    }

    fn log_access(&mut self, author: ParticipantId, now: ServerTime) {
        let kind = OperationKind::Access {
            is_locked: self.controls.is_locked,
            seats: self.config.seats.min(SEATS_MAX),
            spectators: self.config.spectators,
        };
        self.append(author, kind, now);
    }

    /// Changes the rule for the playout delay. A rule without a cap restores demoted participants.
    fn set_compensation(&mut self, author: ParticipantId, mode: CompensationMode, now: ServerTime) {
        if std::mem::replace(&mut self.config.compensation.mode, mode) == mode {
            return;
        }
        self.group.set_mode(mode);
        self.append(author, OperationKind::CompensationMode { mode }, now);
        let cap = self.config.cap();
        let has_cap = matches!(mode, CompensationMode::Adaptive { .. });
        let mut restored = Vec::new();
        for seat in self.participants.values_mut() {
            seat.demotion.set_cap(cap);
            seat.delay.set_cap(cap);
            if !has_cap && seat.demotion.end() {
                restored.push(seat.id);
            }
        }
        for who in restored {
            self.restore(who, now);
        }
    }

    fn annotate(
        &mut self,
        author: ParticipantId,
        mut annotation: Annotation,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let numbers = &self.controls.annotations;
        if annotation.id == 0 {
            if numbers.len() >= ANNOTATIONS_MAX {
                return Err(RequestRefusal::OutOfRange(format!(
                    "there are {ANNOTATIONS_MAX} annotations already; remove one"
                )));
            }
            annotation.id = self.controls.fresh_annotation();
            self.controls.annotations.insert(annotation.id);
        } else if !numbers.contains(&annotation.id) {
            return Err(unknown_annotation(annotation.id));
        }
        self.append(author, OperationKind::Annotated(annotation), now);
        Ok(())
    }
}

fn unknown_annotation(id: u32) -> RequestRefusal {
    RequestRefusal::OutOfRange(format!("there is no annotation {id}"))
}
