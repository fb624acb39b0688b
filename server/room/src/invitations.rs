//! The invitations of a session: who may join with a grant that an instructor created, and until when.

use std::collections::BTreeMap;

use palpate_protocol::handshake::{Hello, RefusalReason};
use palpate_protocol::{Grant, Role, ServerTime};

/// Invitations in the table; a spent one (used, revoked or expired) gives way to a new one.
const INVITATIONS_MAX: usize = 64;

/// An invitation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Invitation {
    /// The role that it allows.
    pub role: Role,
    /// The only name that may use it; `None` for any name.
    pub name: Option<String>,
    grant: Grant,
    expires_at: ServerTime,
    is_single_use: bool,
    end: Option<End>,
}

/// The reason why an invitation ended before its expiry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    Used,
    Revoked,
}

impl Invitation {
    /// An unused invitation.
    pub(crate) fn new(
        role: Role,
        name: Option<String>,
        grant: Grant,
        expires_at: ServerTime,
        is_single_use: bool,
    ) -> Self {
        Self {
            role,
            name,
            grant,
            expires_at,
            is_single_use,
            end: None,
        }
    }

    fn is_open(&self, now: ServerTime) -> bool {
        self.end.is_none() && now < self.expires_at
    }

    /// Whether it admits a newcomer with its grant.
    fn admits(&self, hello: &Hello, now: ServerTime) -> Result<(), RefusalReason> {
        let role = hello.role;
        match self.end {
            _ if self.role != role => Err(RefusalReason::BadGrant { role }),
            Some(End::Revoked) => Err(RefusalReason::InvitationRevoked),
            Some(End::Used) => Err(RefusalReason::InvitationUsed),
            None if now >= self.expires_at => Err(RefusalReason::InvitationExpired),
            None => match &self.name {
                Some(name) if *name != hello.name => {
                    Err(RefusalReason::InvitationName { name: name.clone() })
                }
                _ => Ok(()),
            },
        }
    }
}

/// All invitations by their number, which counts up from 1.
#[derive(Debug, Default)]
pub(crate) struct Invitations {
    table: BTreeMap<u32, Invitation>,
    last: u32,
}

impl Invitations {
    /// The number of the next invitation; `None` if the table is full of open ones.
    pub(crate) fn next_number(&self, now: ServerTime) -> Option<u32> {
        let has_room = self.table.len() < INVITATIONS_MAX || self.spent(now).is_some();
        has_room.then_some(self.last + 1)
    }

    /// Adds an invitation with the [next number](Self::next_number). The oldest spent one gives way in a full table; its
    /// grant is then unknown, and refused as such.
    pub(crate) fn add(&mut self, invitation: Invitation, now: ServerTime) {
        if self.table.len() >= INVITATIONS_MAX
            && let Some(spent) = self.spent(now)
        {
            self.table.remove(&spent);
        }
        self.last += 1;
        self.table.insert(self.last, invitation);
    }

    /// The oldest spent invitation.
    fn spent(&self, now: ServerTime) -> Option<u32> {
        let mut all = self.table.iter();
        all.find(|(_, invitation)| !invitation.is_open(now))
            .map(|(id, _)| *id)
    }

    /// An invitation that is in the table.
    pub(crate) fn get(&self, id: u32) -> Option<&Invitation> {
        self.table.get(&id)
    }

    /// The number of the invitation that admits a newcomer.
    pub(crate) fn admit(&self, hello: &Hello, now: ServerTime) -> Result<u32, RefusalReason> {
        let mut all = self.table.iter();
        let (id, invitation) = all
            .find(|(_, invitation)| invitation.grant.matches(&hello.grant))
            .ok_or(RefusalReason::BadGrant { role: hello.role })?;
        invitation.admits(hello, now).map(|()| *id)
    }

    /// Notes a join. Returns whether it has used the invitation up.
    pub(crate) fn note_join(&mut self, id: u32) -> bool {
        let single = self.table.get_mut(&id).filter(|i| i.is_single_use);
        single.is_some_and(|invitation| invitation.end.replace(End::Used).is_none())
    }

    /// Revokes an invitation. Returns whether that changes it; `None` for an unknown one.
    pub(crate) fn revoke(&mut self, id: u32) -> Option<bool> {
        let invitation = self.table.get_mut(&id)?;
        Some(invitation.end.replace(End::Revoked) != Some(End::Revoked))
    }
}
