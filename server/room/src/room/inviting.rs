//! Invitations: created, used and revoked.

use palpate_protocol::operation::OperationKind;
use palpate_protocol::request::{self, RequestRefusal};
use palpate_protocol::session::PeerMessage;
use palpate_protocol::{ParticipantId, Role, ServerTime};

use super::Room;
use crate::invitations::Invitation;
use crate::participant::Participant;

impl Room {
    /// Creates an invitation for a role and, if given, a name. Only its author receives the grant.
    pub(super) fn invite(
        &mut self,
        author: ParticipantId,
        (role, name): (Role, Option<String>),
        expires_at: ServerTime,
        is_single_use: bool,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let Some(id) = self.controls.invitations.next_number(now) else {
            let full = "all invitations of the session are open; revoke one";
            return Err(RequestRefusal::OutOfRange(full.to_owned()));
        };
        let grant = (self.config.fresh_grant)(id);
        let invitation = Invitation::new(role, name.clone(), grant, expires_at, is_single_use);
        self.controls.invitations.add(invitation, now);
        let kind = OperationKind::Invited {
            id,
            role,
            name,
            expires_at,
            is_single_use,
        };
        self.append(author, kind, now);
        if let Some(peer) = self.participants.get(&author).and_then(Participant::peer) {
            let secret = request::Invitation { id, grant };
            self.send(peer, PeerMessage::Invitation(secret));
        }
        Ok(())
    }

    /// Revokes an invitation, also for the seats that were taken with it.
    pub(super) fn revoke_invitation(
        &mut self,
        author: ParticipantId,
        id: u32,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let is_changed = self.controls.invitations.revoke(id).ok_or_else(|| {
            RequestRefusal::OutOfRange(format!("there is no open invitation {id}"))
        })?;
        if is_changed {
            for seat in self.participants.values_mut() {
                seat.admission.revoke(id);
            }
            self.append(author, OperationKind::InvitationRevoked { id }, now);
        }
        Ok(())
    }

    /// Logs the use of an invitation by a participant who has joined.
    pub(super) fn use_invitation(&mut self, who: ParticipantId, id: u32, now: ServerTime) {
        if self.controls.invitations.note_join(id) {
            self.append(who, OperationKind::InvitationUsed { id }, now);
        }
    }

    /// An invitation by its number, unless it has given way to newer ones.
    pub fn invitation(&self, id: u32) -> Option<&Invitation> {
        self.controls.invitations.get(id)
    }
}
