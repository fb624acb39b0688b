//! A server's identity: a self-signed certificate, known by its hash in the join link.

use std::sync::{Arc, Mutex, PoisonError};

use palpate_protocol::CertificateHash;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, WebPkiSupportedAlgorithms, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, ServerName, UnixTime};
use rustls::{CertificateError, DigitallySignedStruct, Error, SignatureScheme};
use sha2::{Digest, Sha256};

use crate::{TransportError, config};

/// The name in the certificate. It proves nothing: clients check the hash.
pub(crate) const SERVER_NAME: &str = "palpate";

/// A self-signed certificate (ECDSA P-256) and its key.
pub struct ServerIdentity {
    certificate: CertificateDer<'static>,
    key: Vec<u8>,
}

impl ServerIdentity {
    /// A new one, from the system's random numbers.
    pub fn generate() -> Result<Self, TransportError> {
        let made = rcgen::generate_simple_self_signed([SERVER_NAME.to_owned()])
            .map_err(|e| TransportError::Certificate(e.to_string()))?;
        Ok(Self {
            certificate: made.cert.der().clone(),
            key: made.signing_key.serialize_der(),
        })
    }

    /// A stored identity: certificate and PKCS #8 key, both DER. Links stay valid over a restart. Refuses a certificate
    /// and a key that do not belong together.
    pub fn from_der(certificate: Vec<u8>, key: Vec<u8>) -> Result<Self, TransportError> {
        let identity = Self {
            certificate: CertificateDer::from(certificate),
            key,
        };
        config::server(&identity, None)?;
        Ok(identity)
    }

    /// Certificate and key in DER, to be kept in a safe place.
    pub fn to_der(&self) -> (Vec<u8>, Vec<u8>) {
        (self.certificate.to_vec(), self.key.clone())
    }

    /// For the join link.
    pub fn certificate_hash(&self) -> CertificateHash {
        hash_of(&self.certificate)
    }

    pub(crate) fn certificate(&self) -> CertificateDer<'static> {
        self.certificate.clone()
    }

    pub(crate) fn key(&self) -> PrivateKeyDer<'static> {
        PrivatePkcs8KeyDer::from(self.key.clone()).into()
    }
}

pub(crate) fn hash_of(certificate: &CertificateDer<'_>) -> CertificateHash {
    CertificateHash(Sha256::digest(certificate).into())
}

/// Accepts exactly one certificate, by its hash, and the signatures made with its key. Names and
/// dates in the certificate do not matter.
#[derive(Debug)]
pub(crate) struct Pinned {
    expected: CertificateHash,
    algorithms: WebPkiSupportedAlgorithms,
    /// The hash of another certificate that was shown.
    other: Mutex<Option<CertificateHash>>,
}

impl Pinned {
    pub(crate) fn new(expected: CertificateHash, provider: &CryptoProvider) -> Arc<Self> {
        let algorithms = provider.signature_verification_algorithms;
        Arc::new(Self {
            expected,
            algorithms,
            other: Mutex::new(None),
        })
    }

    pub(crate) fn other(&self) -> Option<CertificateHash> {
        *self.other.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServerCertVerifier for Pinned {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let found = hash_of(end_entity);
        if found == self.expected {
            return Ok(ServerCertVerified::assertion());
        }
        *self.other.lock().unwrap_or_else(PoisonError::into_inner) = Some(found);
        Err(Error::InvalidCertificate(
            CertificateError::ApplicationVerificationFailure,
        ))
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(Error::General("only TLS 1.3 is spoken here".to_owned()))
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, cert, dss, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stored_identity_is_reused_and_a_mixed_one_is_rejected() {
        let identity = ServerIdentity::generate().unwrap();
        let (certificate, key) = identity.to_der();
        let kept = ServerIdentity::from_der(certificate.clone(), key.clone()).unwrap();
        assert_eq!(kept.certificate_hash(), identity.certificate_hash());
        let (_, other) = ServerIdentity::generate().unwrap().to_der();
        assert!(ServerIdentity::from_der(certificate.clone(), other).is_err());
        assert!(ServerIdentity::from_der(certificate, key[1..].to_vec()).is_err());
        assert!(ServerIdentity::from_der(Vec::new(), key).is_err());
    }
}
