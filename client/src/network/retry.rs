//! Attempts to join and to fetch the model that are repeated while the server is busy or not reached.

use std::hash::{BuildHasher as _, RandomState};
use std::time::Duration;

use palpate_protocol::Span;
use palpate_site::{BUSY_WAIT_FIRST, Backoff, Retry};
use palpate_transport::TransportError;

use crate::ClientError;
use crate::realtime::monotonic_now;

/// Receives every failed attempt that is repeated.
pub(crate) type RetryReport = Box<dyn FnMut(&Retry) + Send>;

/// A series of attempts.
pub(super) struct Retries<'a> {
    backoff: Backoff,
    attempts: u32,
    report: &'a mut RetryReport,
}

impl<'a> Retries<'a> {
    /// A series that begins now. No attempt begins after `patience`.
    pub(super) fn new(patience: Span, report: &'a mut RetryReport) -> Self {
        Self {
            backoff: Backoff::new(BUSY_WAIT_FIRST, patience, monotonic_now(), random_seed()),
            attempts: 1,
            report,
        }
    }

    /// Waits before the next attempt. Returns the error if later attempts would fail as well, or if the patience is
    /// over.
    pub(super) async fn wait_after(&mut self, error: ClientError) -> Result<(), ClientError> {
        if !may_pass(&error) {
            return Err(error);
        }
        let Some(wait) = self.backoff.wait(monotonic_now()) else {
            return Err(error);
        };
        self.attempts += 1;
        let (is_busy, cause) = match error {
            ClientError::Refused(refused) => (true, refused.sentence),
            other => (false, other.to_string()),
        };
        (self.report)(&Retry {
            is_busy,
            cause,
            wait,
            attempt: self.attempts,
        });
        tokio::time::sleep(Duration::from_micros(wait.as_micros().unsigned_abs())).await;
        Ok(())
    }
}

/// Whether a later attempt may succeed.
fn may_pass(error: &ClientError) -> bool {
    match error {
        ClientError::Refused(refused) => refused.reason.is_temporary(),
        ClientError::LostWhileJoining(_)
        | ClientError::Transport(TransportError::Lost { .. } | TransportError::NoAnswer { .. }) => {
            true
        }
        _ => false,
    }
}

/// A seed that differs between clients: the standard library draws the keys of its hash maps at random.
pub(super) fn random_seed() -> u64 {
    RandomState::new().hash_one(())
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, SocketAddr};

    use palpate_protocol::handshake::{RefusalReason, Refused};
    use palpate_protocol::session::CloseReason;
    use palpate_protocol::{CertificateHash, Role};

    use super::*;

    #[test]
    fn only_load_and_silence_are_waited_for() {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 4433));
        let detail = "refused".to_owned();
        let refused = |reason| ClientError::Refused(Refused::because(reason));
        for error in [
            refused(RefusalReason::Full {
                role: Role::Trainee,
                seats: 8,
            }),
            ClientError::LostWhileJoining(CloseReason::HandshakeTimeout),
            TransportError::NoAnswer { address }.into(),
            TransportError::Lost { address, detail }.into(),
        ] {
            assert!(may_pass(&error), "{error}");
        }
        let name = "ann".to_owned();
        let (expected, found) = (CertificateHash([0; 32]), CertificateHash([1; 32]));
        for error in [
            refused(RefusalReason::Closing),
            refused(RefusalReason::NameTaken { name }),
            refused(RefusalReason::NoSuchSeat),
            ClientError::Goodbye("the host ended it".to_owned()),
            TransportError::NotPalpate { address }.into(),
            TransportError::WrongCertificate {
                address,
                expected,
                found,
            }
            .into(),
        ] {
            assert!(!may_pass(&error), "{error}");
        }
    }
}
