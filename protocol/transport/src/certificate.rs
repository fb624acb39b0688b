//! Self-signed certificates of short validity for browsers, renewed while the program runs.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use palpate_protocol::CertificateHash;
use rcgen::{CertificateParams, DistinguishedName, DnType, KeyPair};
use rustls::pki_types::PrivatePkcs8KeyDer;
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;

use crate::TransportError;
use crate::config::{certificate_error, provider};
use crate::identity::{SERVER_NAME, hash_of};

/// Browsers accept a certificate by its hash only if it is valid for at most 14 days.
const VALIDITY: Duration = Duration::from_secs(13 * 24 * 3600);

/// Part of the validity that lies in the past, for browsers with slow clocks.
const BACKDATED: Duration = Duration::from_secs(3600);

/// A certificate of this age is replaced, so that a browser that holds its hash has six days to connect.
const AGE_MAX: Duration = Duration::from_secs(7 * 24 * 3600);

/// A self-signed certificate (ECDSA P-256) for some host names, made again every week.
#[derive(Debug)]
pub(crate) struct ShortLived {
    names: Vec<String>,
    current: Mutex<Made>,
}

#[derive(Debug, Clone)]
struct Made {
    key: Arc<CertifiedKey>,
    at: SystemTime,
}

impl ShortLived {
    /// Makes the first one. `names` are host names or IP addresses. Fails if a name has other than ASCII characters.
    pub(crate) fn new(names: Vec<String>) -> Result<Arc<Self>, TransportError> {
        let current = Mutex::new(Made::new(&names, SystemTime::now())?);
        Ok(Arc::new(Self { names, current }))
    }

    /// The hash of the present one.
    pub(crate) fn hash(&self) -> CertificateHash {
        hash_of(&self.key().cert[0])
    }

    /// The certificate to present now.
    pub(crate) fn key(&self) -> Arc<CertifiedKey> {
        self.at(SystemTime::now()).key
    }

    /// The certificate to present at a time.
    fn at(&self, now: SystemTime) -> Made {
        let mut current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        // A clock that was put back also asks for a new one.
        if now
            .duration_since(current.at)
            .is_ok_and(|age| age < AGE_MAX)
        {
            return current.clone();
        }
        match Made::new(&self.names, now) {
            Ok(made) => *current = made,
            Err(error) => tracing::warn!(%error, "the certificate was not renewed"),
        }
        current.clone()
    }
}

impl ResolvesServerCert for ShortLived {
    fn resolve(&self, _hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.key())
    }
}

impl Made {
    fn new(names: &[String], now: SystemTime) -> Result<Self, TransportError> {
        let mut params = CertificateParams::new(names).map_err(certificate_error)?;
        params.distinguished_name = DistinguishedName::new();
        params
            .distinguished_name
            .push(DnType::CommonName, SERVER_NAME);
        let since = now.duration_since(UNIX_EPOCH).map_err(certificate_error)?;
        params.not_before = rcgen::date_time_ymd(1970, 1, 1) + since.saturating_sub(BACKDATED);
        params.not_after = params.not_before + VALIDITY;
        let pair = KeyPair::generate().map_err(certificate_error)?;
        let certificate = params.self_signed(&pair).map_err(certificate_error)?;
        let certificate = certificate.der().clone();
        let key = PrivatePkcs8KeyDer::from(pair.serialize_der()).into();
        let key = CertifiedKey::from_der(vec![certificate], key, &provider())
            .map_err(certificate_error)?;
        Ok(Self {
            key: Arc::new(key),
            at: now,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certificate_is_renewed_after_a_week_and_not_before() {
        let kept = ShortLived::new(vec!["localhost".to_owned()]).unwrap();
        let first = kept.current.lock().unwrap().clone();
        let after = |days: u64| kept.at(first.at + Duration::from_secs(days * 24 * 3600));
        assert_eq!(after(6).key.cert, first.key.cert);
        let renewed = after(7);
        assert_ne!(renewed.key.cert, first.key.cert);
        assert_eq!(after(8).key.cert, renewed.key.cert);
    }
}
