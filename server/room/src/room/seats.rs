//! Seats: admission, retention after a lost connection, and resumption.

use palpate_protocol::handshake::{
    Hello, RefusalReason, Refused, Resume, SEAT_RETENTION, Subscription, Welcome,
};
use palpate_protocol::operation::{CompensationSettings, LeaveReason, OperationKind};
use palpate_protocol::session::{CloseReason, PeerMessage};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{OperationId, ParticipantId, ProtocolError, ServerTime};

use super::Room;
use crate::PeerKey;
use crate::config::SEATS_MAX;
use crate::participant::{Participant, Presence};

/// Maximum resumptions of a seat. Each adds two operations to the log, which every new client receives. A connection
/// that breaks once a minute lasts for more than an hour and a half.
const RESUMES_MAX: u16 = 100;

impl Room {
    pub(super) fn handle_hello(&mut self, peer: PeerKey, hello: Hello, now: ServerTime) {
        let result = match hello.resume {
            Some(resume) => self
                .check_resumption(&hello, &resume, now)
                .map(|()| self.resume_seat(peer, &hello, &resume, now)),
            None => self.admit(&hello).map(|()| self.seat(peer, hello, now)),
        };
        if let Err(reason) = result {
            self.refused += 1;
            let sentence = self.sentence(&reason, now);
            self.send(peer, PeerMessage::Refused(Refused { reason, sentence }));
        }
    }

    /// The text of a refusal. For a name with a kept seat it includes the remaining time.
    fn sentence(&self, reason: &RefusalReason, now: ServerTime) -> String {
        let RefusalReason::NameTaken { name } = reason else {
            return reason.to_string();
        };
        let mut seats = self.participants.values();
        let until = seats
            .find(|p| p.name == *name)
            .and_then(|p| match p.presence {
                Presence::Disconnected { until } => Some(until),
                Presence::Connected(_) => None,
            });
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

    fn admit(&self, hello: &Hello) -> Result<(), RefusalReason> {
        let role = hello.role;
        let seats = self.config.seats.min(SEATS_MAX);
        if !self.is_granted(hello) {
            Err(RefusalReason::BadGrant { role })
        } else if !self.log.takes_seat() {
            Err(RefusalReason::LogFull)
        } else if self.participants.len() >= usize::from(seats) || self.next_participant == u16::MAX
        {
            Err(RefusalReason::Full { seats })
        } else if self.participants.values().any(|p| p.name == hello.name) {
            // A kept seat keeps its name.
            Err(RefusalReason::NameTaken {
                name: hello.name.clone(),
            })
        } else if role.has_tool() && !hello.tool.as_ref().is_some_and(ToolDescription::is_valid) {
            Err(RefusalReason::BadTool { role })
        } else if role.has_tool() && hello.subscription == Subscription::Thin {
            Err(RefusalReason::ThinTool { role })
        } else {
            Ok(())
        }
    }

    /// Whether a client may resume a seat. A wrong token and an expired seat get the same refusal, so that guessing
    /// reveals nothing.
    fn check_resumption(
        &self,
        hello: &Hello,
        resume: &Resume,
        now: ServerTime,
    ) -> Result<(), RefusalReason> {
        if !self.is_granted(hello) {
            return Err(RefusalReason::BadGrant { role: hello.role });
        }
        let seat = self.participants.get(&resume.participant);
        let is_theirs = seat.is_some_and(|seat| {
            seat.token.matches(&resume.token)
                && seat.name == hello.name
                && seat.role == hello.role
                && seat.subscription == hello.subscription
                && seat.resumed < RESUMES_MAX
                && !seat.is_expired(now)
        });
        if is_theirs && !self.log.takes_seat() {
            Err(RefusalReason::LogFull)
        } else if is_theirs {
            Ok(())
        } else {
            Err(RefusalReason::NoSuchSeat)
        }
    }

    fn is_granted(&self, hello: &Hello) -> bool {
        let mut grants = self.config.grants.iter();
        grants.any(|(role, grant)| *role == hello.role && grant.matches(&hello.grant))
    }

    fn seat(&mut self, peer: PeerKey, hello: Hello, now: ServerTime) {
        let id = ParticipantId(self.next_participant);
        self.next_participant += 1;
        let tool = hello.tool.filter(|_| hello.role.has_tool());
        let token = (self.config.fresh_token)(id);
        let name = hello.name.clone();
        let cap = self.config.cap();
        let mut participant = Participant::new(peer, token, id, name, hello.role, tool, cap);
        participant.subscription = hello.subscription;
        let first = OperationId(0);
        let welcome = self.welcome(&participant, self.config.compensation, first, now);
        self.send_welcome(peer, welcome);
        self.participants.insert(id, participant);
        self.by_peer.insert(peer, id);
        let kind = OperationKind::Joined {
            participant: id,
            name: hello.name,
            role: hello.role,
            tool,
        };
        self.append(id, kind, now);
        self.start_if_due(now);
    }

    /// Resumes a seat with its number, role and tool, and sends the missing part of the log.
    fn resume_seat(&mut self, peer: PeerKey, hello: &Hello, resume: &Resume, now: ServerTime) {
        let id = resume.participant;
        let first = self.continues_at(resume);
        let Some(seat) = self.participants.get_mut(&id) else {
            return;
        };
        seat.resumed += 1;
        seat.requests.next_connection();
        let before = std::mem::replace(&mut seat.presence, Presence::Connected(peer));
        if !seat.demotion.is_demoted() && seat.is_inactive() {
            seat.activate(now);
        }
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
        let last = resume
            .next_operation
            .0
            .checked_sub(1)
            .and_then(|last| self.log.get(usize::try_from(last).ok()?));
        let is_ours = last.is_some_and(|last| {
            last.topology_version_after == resume.topology_version
                && last.hash_after == resume.topology_hash
        });
        if is_ours {
            resume.next_operation
        } else {
            OperationId(0)
        }
    }

    fn welcome(
        &self,
        seat: &Participant,
        compensation: CompensationSettings,
        first_operation: OperationId,
        now: ServerTime,
    ) -> Welcome {
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
            operations_so_far: self.log.len() as u64,
            compensation,
            tick_hz: self.config.tick_hz,
            session_started_at: self.started_at,
            // Equal in every welcome, so that a lost welcome does not lose the seat.
            resume_token: seat.token,
        }
    }

    fn send_welcome(&mut self, peer: PeerKey, welcome: Welcome) {
        let first = usize::try_from(welcome.first_operation.0).unwrap_or(usize::MAX);
        self.send(peer, PeerMessage::Welcome(Box::new(welcome)));
        let missing = self.log.since(first).to_vec();
        for operation in missing {
            self.send(peer, PeerMessage::Operation(operation));
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

    fn remove_seat(&mut self, who: ParticipantId, reason: LeaveReason, now: ServerTime) {
        let Some(gone) = self.participants.remove(&who) else {
            return;
        };
        if let Presence::Connected(peer) = gone.presence {
            self.by_peer.remove(&peer);
        }
        self.fan_out.remove(who);
        self.group.remove(who);
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
