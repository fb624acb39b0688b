//! The right by which a participant has its seat.

use palpate_protocol::Grant;
use palpate_protocol::handshake::{Hello, RefusalReason};

/// The grant of a participant. It is kept with the seat, so that the seat can be resumed after the invitation expired
/// or gave way to newer ones.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Admission {
    /// The number of the invitation; `None` for the join link of the role.
    pub(crate) invitation: Option<u32>,
    grant: Grant,
    is_revoked: bool,
}

impl Admission {
    /// The admission with a valid grant, that of the role.
    pub(crate) fn new(grant: Grant) -> Self {
        Self {
            invitation: None,
            grant,
            is_revoked: false,
        }
    }

    /// Ends the right to resume the seat, if it was taken with this invitation.
    pub(crate) fn revoke(&mut self, invitation: u32) {
        self.is_revoked |= self.invitation == Some(invitation);
    }

    /// Whether the seat may be resumed with a grant that is not that of the role.
    pub(crate) fn resumes(&self, hello: &Hello) -> Result<(), RefusalReason> {
        if !self.grant.matches(&hello.grant) {
            Err(RefusalReason::BadGrant { role: hello.role })
        } else if self.is_revoked {
            Err(RefusalReason::InvitationRevoked)
        } else {
            Ok(())
        }
    }
}
