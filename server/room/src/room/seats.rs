//! Seats: admission, retention after a lost connection, and resumption.

use std::sync::Arc;

use palpate_protocol::handshake::{
    Hello, RefusalReason, Refused, Resume, RosterEntry, SEAT_RETENTION, Subscription, Welcome,
};
use palpate_protocol::name::Appearance;
use palpate_protocol::operation::{CompensationSettings, LeaveReason, Operation, OperationKind};
use palpate_protocol::permission::Permission;
use palpate_protocol::session::{CloseReason, PeerMessage};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{OperationId, ParticipantId, ProtocolError, Role, ServerTime};

use super::Room;
use crate::PeerKey;
use crate::cut_budget::CutBudget;
use crate::joins::RoleClass;
use crate::limits::Limit;
use crate::participant::{Participant, Presence};

impl Room {
    pub(super) fn handle_hello(&mut self, peer: PeerKey, hello: Hello, now: ServerTime) {
        self.remove_expired_seats(now);
        let result = match hello.resume {
            Some(resume) if self.is_resumed(&hello, &resume) => self
                .check_resumption(&hello, &resume, now)
                .map(|()| self.resume_seat(peer, &hello, &resume, now)),
            _ => self
                .admit(&hello, now)
                .map(|invitation| self.seat(peer, hello, invitation, now)),
        };
        if let Err(reason) = result {
            self.refused += 1;
            self.limits.count(match reason {
                RefusalReason::Full { .. } => Limit::Full,
                RefusalReason::Busy => Limit::Busy,
                _ => Limit::JoinRefused,
            });
            let sentence = self.sentence(&reason, now);
            self.send(peer, PeerMessage::Refused(Refused { reason, sentence }));
        }
    }

    /// Whether a hello with a seat resumes it. If the seat of a role without a tool has been given away, its client joins
    /// again: it has nothing to lose but the seat.
    fn is_resumed(&self, hello: &Hello, resume: &Resume) -> bool {
        hello.role.has_tool() || self.participants.contains_key(&resume.participant)
    }

    /// The text of a refusal. For a name with a kept seat it includes the remaining time.
    fn sentence(&self, reason: &RefusalReason, now: ServerTime) -> String {
        let RefusalReason::NameTaken { name } = reason else {
            return reason.to_string();
        };
        let mut seats = self.participants.values();
        let until = seats
            .find(|p| p.name == *name)
            .and_then(Participant::kept_until);
        until.map_or_else(
            || reason.to_string(),
            |until| {
                let seconds = (until - now).as_secs_f64().max(0.0).ceil();
                format!(
                    "the name \"{name}\" is kept for another {seconds:.0} s for a participant who lost the connection; \
                     choose another name, or join again after that"
                )
            },
        )
    }

    /// Admits a newcomer, or refuses it. Kept seats of participants who hardly took part give way. Returns the
    /// invitation; `None` for the join link of the role.
    fn admit(&mut self, hello: &Hello, now: ServerTime) -> Result<Option<u32>, RefusalReason> {
        let role = hello.role;
        let invitation = self.check_grant(hello, now)?;
        // An instructor who lost the seat must be able to open the session again.
        if self.controls.is_locked && !role.may(Permission::Control) {
            return Err(RefusalReason::Locked);
        }
        if let Some(name) = self.controls.banned_like(&hello.name) {
            return Err(RefusalReason::Banned { name });
        }
        if role.has_tool() && !hello.tool.as_ref().is_some_and(ToolDescription::is_valid) {
            return Err(RefusalReason::BadTool { role });
        }
        if hello.subscription == Subscription::Thin && !role.may(Permission::WatchThin) {
            return Err(RefusalReason::ThinTool { role });
        }
        let mut leaving = self.freed_by_name(hello, now)?;
        self.free_seats(role, &mut leaving, now)?;
        if !self.log.takes_seat() || !self.joins.take(RoleClass::of(role), now) {
            return Err(RefusalReason::Busy);
        }
        for who in leaving {
            self.limits.count(Limit::SeatReused);
            self.remove_seat(who, LeaveReason::Silent, now);
        }
        Ok(invitation)
    }

    /// The kept seats that give way to a name.
    fn freed_by_name(
        &self,
        hello: &Hello,
        now: ServerTime,
    ) -> Result<Vec<ParticipantId>, RefusalReason> {
        let wanted = Appearance::of(&hello.name);
        let alike = self
            .participants
            .values()
            .filter(|p| p.appearance.is_like(&wanted));
        let mut leaving = Vec::new();
        for other in alike {
            if !other.gives_way(now) {
                // A kept seat keeps its name.
                let name = other.name.clone();
                return Err(RefusalReason::NameTaken { name });
            }
            leaving.push(other.id);
        }
        Ok(leaving)
    }

    /// Adds the kept seats that give way to a role, the longest disconnected first, until one seat is free for it.
    fn free_seats(
        &self,
        role: Role,
        leaving: &mut Vec<ParticipantId>,
        now: ServerTime,
    ) -> Result<(), RefusalReason> {
        for (classes, seats) in self.config.limits_of(RoleClass::of(role)) {
            let taken = |leaving: &[ParticipantId]| -> Vec<&Participant> {
                let sharing = self.participants.values().filter(|p| {
                    classes.contains(&RoleClass::of(p.role)) && !leaving.contains(&p.id)
                });
                sharing.collect()
            };
            loop {
                let taken = taken(leaving);
                if taken.len() < usize::from(seats) {
                    break;
                }
                let yielding = taken.into_iter().filter(|p| p.gives_way(now));
                let Some(next) = yielding.min_by_key(|p| p.kept_until()) else {
                    return Err(RefusalReason::Full { role, seats });
                };
                leaving.push(next.id);
            }
        }
        Ok(())
    }

    /// Whether a client may resume a seat. A wrong token and an expired seat get the same refusal, so that guessing
    /// reveals nothing.
    fn check_resumption(
        &mut self,
        hello: &Hello,
        resume: &Resume,
        now: ServerTime,
    ) -> Result<(), RefusalReason> {
        let is_granted = self.is_granted(hello);
        let seat = self.participants.get_mut(&resume.participant);
        let theirs = seat.filter(|seat| {
            seat.token.matches(&resume.token)
                && seat.name == hello.name
                && seat.role == hello.role
                && seat.subscription == hello.subscription
        });
        let Some(seat) = theirs else {
            self.check_grant(hello, now)?;
            return Err(RefusalReason::NoSuchSeat);
        };
        if !is_granted {
            seat.admission.resumes(hello)?;
        }
        if self.log.takes_seat() && seat.resumptions.take(1.0, now - ServerTime::ZERO) {
            Ok(())
        } else {
            Err(RefusalReason::Busy)
        }
    }

    /// The invitation that admits a newcomer; `None` for the join link of its role.
    fn check_grant(&self, hello: &Hello, now: ServerTime) -> Result<Option<u32>, RefusalReason> {
        if self.is_granted(hello) {
            return Ok(None);
        }
        self.controls.invitations.admit(hello, now).map(Some)
    }

    /// Whether the grant is that of the join link of the role.
    fn is_granted(&self, hello: &Hello) -> bool {
        let mut grants = self.config.grants.iter();
        grants.any(|(role, grant)| *role == hello.role && grant.matches(&hello.grant))
    }

    /// A number that no seat has and no operation of the log names. There are fewer of those than numbers.
    fn fresh_number(&mut self) -> ParticipantId {
        loop {
            let id = ParticipantId(self.next_participant);
            self.next_participant = self.next_participant.wrapping_add(1).max(1);
            if !self.participants.contains_key(&id) && !self.log.names(id) {
                return id;
            }
        }
    }

    fn seat(&mut self, peer: PeerKey, hello: Hello, invitation: Option<u32>, now: ServerTime) {
        let id = self.fresh_number();
        let token = (self.config.fresh_token)(id);
        // No trainee who left takes space from an instructor.
        let inherited = if hello.role == Role::Instructor {
            0
        } else {
            self.departed_log
        };
        let cuts = CutBudget::new(inherited, now);
        let cap = self.config.cap();
        let mut participant = Participant::new(peer, token, id, hello, cap, cuts, now);
        participant.admission.invitation = invitation;
        participant.begin_frozen(self.controls.frozen_from);
        let RosterEntry {
            name, role, tool, ..
        } = participant.roster_entry();
        let first = OperationId(0);
        let welcome = self.welcome(&participant, self.config.compensation, first, now);
        self.send_welcome(peer, welcome);
        self.participants.insert(id, participant);
        self.joined += 1;
        self.by_peer.insert(peer, id);
        let kind = OperationKind::Joined {
            participant: id,
            name,
            role,
            tool,
        };
        self.append(id, kind, now);
        if let Some(invitation) = invitation {
            self.use_invitation(id, invitation, now);
        }
        self.start_if_due(now);
    }

    /// Resumes a seat with its number, role and tool, and sends the missing part of the log.
    fn resume_seat(&mut self, peer: PeerKey, hello: &Hello, resume: &Resume, now: ServerTime) {
        let id = resume.participant;
        let first = self.continues_at(resume);
        let Some(seat) = self.participants.get_mut(&id) else {
            return;
        };
        seat.requests.next_connection();
        let before = std::mem::replace(&mut seat.presence, Presence::Connected(peer));
        seat.activate(now);
        if let Presence::Connected(old) = before {
            // The old connection is dead but was not detected as lost. The tool therefore stays in use at the server
            // and all clients, with its samples and delay estimate. The later end of the old connection is ignored.
            self.by_peer.remove(&old);
            self.group.remove(id);
            let sentence = "the seat was resumed over another connection".to_owned();
            self.send(old, PeerMessage::Goodbye(sentence));
        }
        // A client that continues its log does not replay changes of the delay, so it starts with the current one.
        let mut compensation = self.config.compensation;
        if first > OperationId(0) {
            let in_force = self.schedule.delay_at(now).as_micros();
            compensation.initial_delay_us = u32::try_from(in_force).unwrap_or(0);
        }
        if let Some(seat) = self.participants.get(&id) {
            let welcome = self.welcome(seat, compensation, first, now);
            self.send_welcome(peer, welcome);
        }
        self.by_peer.insert(peer, id);
        self.append(id, OperationKind::Reconnected { participant: id }, now);
        if first == OperationId(0) {
            self.update_tool(id, hello, now);
        }
    }

    /// A restarted client may hold another tool than before.
    fn update_tool(&mut self, id: ParticipantId, hello: &Hello, now: ServerTime) {
        let Some(seat) = self.participants.get_mut(&id) else {
            return;
        };
        let offered = hello
            .tool
            .filter(|tool| seat.role.has_tool() && tool.is_valid());
        if let Some(tool) = offered
            && seat.tool != Some(tool)
        {
            seat.tool = Some(tool);
            let kind = OperationKind::ToolChanged {
                participant: id,
                tool,
            };
            self.append(id, kind, now);
        }
    }

    /// The first operation that a resuming client lacks; 0 if its log differs from the server's.
    fn continues_at(&self, resume: &Resume) -> OperationId {
        let next = resume.next_operation;
        let state = self.log.state_before(next).unwrap_or(self.beginning);
        let is_ours = next <= self.log.next()
            && next >= self.log.complete_from()
            && state == (resume.topology_version, resume.topology_hash);
        if is_ours { next } else { OperationId(0) }
    }

    fn welcome(
        &self,
        seat: &Participant,
        compensation: CompensationSettings,
        first_operation: OperationId,
        now: ServerTime,
    ) -> Welcome {
        let is_newcomer = first_operation == OperationId(0);
        let snapshot = self.log.snapshot().filter(|_| is_newcomer);
        let last = self.log_from(first_operation).last().map(|o| o.id.next());
        Welcome {
            participant: seat.id,
            epoch: self.config.epoch,
            role: seat.role,
            server_time: now,
            model: self.config.model,
            roster: self
                .participants
                .values()
                .map(Participant::roster_entry)
                .collect(),
            topology_version: self.version(),
            topology_hash: self.hash(),
            first_operation,
            snapshot: snapshot.map(|(info, _)| info),
            operations_so_far: last.unwrap_or(first_operation).0,
            compensation,
            tick_hz: self.config.tick_hz,
            session_started_at: self.started_at,
            // Equal in every welcome, so that a lost welcome does not lose the seat.
            resume_token: seat.token,
        }
    }

    fn send_welcome(&mut self, peer: PeerKey, welcome: Welcome) {
        let first = welcome.first_operation;
        self.send(peer, PeerMessage::Welcome(Box::new(welcome)));
        if first == OperationId(0) {
            let pieces = self.log.snapshot().map(|(_, pieces)| pieces.to_vec());
            for piece in pieces.into_iter().flatten() {
                self.send(peer, PeerMessage::Snapshot(piece));
            }
        }
        for operation in self.log_from(first) {
            self.send(peer, PeerMessage::Operation(operation));
        }
    }

    /// The operations that a client with the log up to this number lacks. A newcomer receives the snapshot before them.
    fn log_from(&self, first: OperationId) -> Vec<Arc<Operation>> {
        if first == OperationId(0) {
            self.log.for_newcomer()
        } else {
            self.log.since(first).to_vec()
        }
    }

    /// Handles the end of a connection. After a lost connection the seat is kept for a while.
    pub(super) fn handle_leave(
        &mut self,
        who: ParticipantId,
        reason: &CloseReason,
        now: ServerTime,
    ) {
        match reason {
            CloseReason::Left => self.remove_seat(who, LeaveReason::Left, now),
            // The client received too slowly; its own messages were valid.
            CloseReason::Violation(
                ProtocolError::Backlog { .. } | ProtocolError::Stalled { .. },
            ) => self.remove_seat(who, LeaveReason::TooSlow, now),
            CloseReason::Violation(_) => self.remove_seat(who, LeaveReason::Violation, now),
            CloseReason::Refused(_) | CloseReason::Goodbye(_) => {
                self.remove_seat(who, LeaveReason::Removed, now);
            }
            CloseReason::Silent(_)
            | CloseReason::HandshakeTimeout
            | CloseReason::ConnectionLost(_) => self.keep_seat(who, now),
        }
    }

    fn keep_seat(&mut self, who: ParticipantId, now: ServerTime) {
        let Some(seat) = self.participants.get_mut(&who) else {
            return;
        };
        let until = now + SEAT_RETENTION;
        if let Presence::Connected(peer) =
            std::mem::replace(&mut seat.presence, Presence::Disconnected { until })
        {
            self.by_peer.remove(&peer);
        }
        seat.disconnect(now);
        self.fan_out.remove(who);
        self.group.remove(who);
        self.append(who, OperationKind::Disconnected { participant: who }, now);
    }

    pub(super) fn remove_seat(&mut self, who: ParticipantId, reason: LeaveReason, now: ServerTime) {
        let Some(gone) = self.participants.remove(&who) else {
            return;
        };
        if let Presence::Connected(peer) = gone.presence {
            self.by_peer.remove(&peer);
        }
        self.fan_out.remove(who);
        self.group.remove(who);
        self.cut_queue.remove(who);
        self.departed_log += gone.cuts.own_log();
        let kind = OperationKind::Left {
            participant: who,
            reason,
        };
        self.append(who, kind, now);
    }

    /// Gives up the kept seats whose time is over.
    pub(super) fn remove_expired_seats(&mut self, now: ServerTime) {
        let over: Vec<ParticipantId> = self
            .participants
            .values()
            .filter(|p| p.is_expired(now))
            .map(|p| p.id)
            .collect();
        for who in over {
            self.remove_seat(who, LeaveReason::Silent, now);
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::TopologyHash;
    use palpate_protocol::operation::CompensationMode;

    use super::*;
    use crate::tests::config;

    #[test]
    fn numbers_of_seats_and_of_the_log_are_not_given_again() {
        let config = config(8, 1, CompensationMode::None);
        let mut room = Room::new(TopologyHash(0), config, ServerTime::ZERO);
        room.next_participant = u16::MAX;
        assert_eq!(room.fresh_number(), ParticipantId(u16::MAX));
        assert_eq!(room.fresh_number(), ParticipantId(1), "0 is the server");
        let reason = LeaveReason::Left;
        let participant = ParticipantId(2);
        let kind = OperationKind::Left {
            participant,
            reason,
        };
        room.append(participant, kind, ServerTime::ZERO);
        assert_eq!(room.fresh_number(), ParticipantId(3));
    }
}
