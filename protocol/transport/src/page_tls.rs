//! TLS of the page that a browser loads: with the operator's certificate, or with a self-signed one.

use std::io;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::ServerCertVerifier as _;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{CertificateError, Error, InconsistentKeys, RootCertStore, ServerConfig};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use crate::TransportError;
use crate::certificate::ShortLived;
use crate::config::{certificate_error, provider};
use crate::identity::SERVER_NAME;

/// The page is served by HTTP/1.1, because WebSockets need it.
const ALPN_PAGE: &[u8] = b"http/1.1";

const SECONDS_PER_DAY: u64 = 24 * 3600;

/// A certificate for the page can not be used.
#[derive(Debug, thiserror::Error)]
pub enum PageTlsError {
    /// A file can not be read.
    #[error("{option} {path} can not be read: {source}; give the path of a PEM file")]
    Read {
        /// The option that names it.
        option: &'static str,
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// A file has no certificate or no private key.
    #[error(
        "{option} {path} has no {lacking} in PEM format ({why}); give the file that contains \"-----BEGIN {mark}-----\""
    )]
    Lacking {
        /// The option that names it.
        option: &'static str,
        /// The file.
        path: PathBuf,
        /// Certificate or private key.
        lacking: &'static str,
        /// The words after BEGIN.
        mark: &'static str,
        /// The error of the reader.
        why: String,
    },
    /// Certificate and key do not belong together.
    #[error(
        "the key of --key {key} does not match the certificate of --certificate {certificate}; give the key that this \
         certificate was issued for"
    )]
    Mismatch {
        /// File of the certificate.
        certificate: PathBuf,
        /// File of the key.
        key: PathBuf,
    },
    /// The validity of the certificate is over.
    #[error(
        "--certificate {path} expired {days} day(s) ago; browsers reject it; renew it, or leave --certificate and --key \
         out to use a self-signed one"
    )]
    Expired {
        /// File of the certificate.
        path: PathBuf,
        /// Days since its end.
        days: u64,
    },
    /// The validity of the certificate has not begun.
    #[error("--certificate {path} is not valid yet, by the clock of this machine; check the clock")]
    NotYetValid {
        /// File of the certificate.
        path: PathBuf,
    },
    /// Certificate or key are of an unknown kind.
    #[error(
        "--certificate {certificate} and --key {key} can not be used: {why}; give an RSA, ECDSA or Ed25519 key and its \
         certificate"
    )]
    Unusable {
        /// File of the certificate.
        certificate: PathBuf,
        /// File of the key.
        key: PathBuf,
        /// The cause.
        why: String,
    },
}

/// Presents one certificate and speaks TLS 1.3 on accepted connections.
#[derive(Clone)]
pub struct PageTls {
    acceptor: TlsAcceptor,
    is_self_signed: bool,
}

/// An encrypted connection of a browser.
#[derive(Debug)]
pub struct PageStream(Box<TlsStream<TcpStream>>);

impl PageTls {
    /// With a certificate chain and its private key, both PEM files. The certificate must be valid now.
    pub fn from_files(certificate: &Path, key: &Path) -> Result<Self, PageTlsError> {
        let chain = read_pem(
            ("--certificate", certificate),
            ("certificate", "CERTIFICATE"),
            |pem| CertificateDer::pem_slice_iter(pem).collect::<Result<Vec<_>, _>>(),
        )?;
        let lacking = || PageTlsError::Lacking {
            option: "--certificate",
            path: certificate.to_owned(),
            lacking: "certificate",
            mark: "CERTIFICATE",
            why: "no such section".to_owned(),
        };
        let end_entity = chain.first().ok_or_else(lacking)?.clone();
        let private = read_pem(
            ("--key", key),
            ("private key", "PRIVATE KEY"),
            PrivateKeyDer::from_pem_slice,
        )?;
        let unusable = |why: String| PageTlsError::Unusable {
            certificate: certificate.to_owned(),
            key: key.to_owned(),
            why,
        };
        let intermediates = &chain[1..];
        check_validity(&end_entity, intermediates, UnixTime::now(), certificate)?;
        let certified =
            CertifiedKey::from_der(chain.clone(), private, &provider()).map_err(|e| match e {
                Error::InconsistentKeys(InconsistentKeys::KeyMismatch) => PageTlsError::Mismatch {
                    certificate: certificate.to_owned(),
                    key: key.to_owned(),
                },
                other => unusable(other.to_string()),
            })?;
        let presented = Arc::new(Fixed(Arc::new(certified)));
        Self::new(presented, false).map_err(|e| unusable(e.to_string()))
    }

    /// With a self-signed certificate for host names or IP addresses, valid for 13 days and made again every week.
    pub fn self_signed(names: Vec<String>) -> Result<Self, TransportError> {
        Self::new(ShortLived::new(names)?, true)
    }

    fn new(
        certificate: Arc<dyn ResolvesServerCert>,
        is_self_signed: bool,
    ) -> Result<Self, TransportError> {
        let mut tls = ServerConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(certificate_error)?
            .with_no_client_auth()
            .with_cert_resolver(certificate);
        tls.alpn_protocols = vec![ALPN_PAGE.to_vec()];
        Ok(Self {
            acceptor: TlsAcceptor::from(Arc::new(tls)),
            is_self_signed,
        })
    }

    /// Whether browsers will warn about the certificate.
    pub fn is_self_signed(&self) -> bool {
        self.is_self_signed
    }

    /// Completes the handshake of a connection. It has no time limit of its own.
    pub async fn accept(&self, stream: TcpStream) -> io::Result<PageStream> {
        let stream = self.acceptor.accept(stream).await?;
        Ok(PageStream(Box::new(stream)))
    }
}

/// The same certificate for every browser.
#[derive(Debug)]
struct Fixed(Arc<CertifiedKey>);

impl ResolvesServerCert for Fixed {
    fn resolve(&self, _hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(Arc::clone(&self.0))
    }
}

fn read_pem<T, E: std::fmt::Display>(
    (option, path): (&'static str, &Path),
    (lacking, mark): (&'static str, &'static str),
    parse: impl FnOnce(&[u8]) -> Result<T, E>,
) -> Result<T, PageTlsError> {
    let bytes = std::fs::read(path).map_err(|source| PageTlsError::Read {
        option,
        path: path.to_owned(),
        source,
    })?;
    parse(&bytes).map_err(|e| PageTlsError::Lacking {
        option,
        path: path.to_owned(),
        lacking,
        mark,
        why: e.to_string(),
    })
}

/// Rejects a certificate outside of its validity. Whether a browser trusts its issuer is unknown here, so the certificate
/// stands for its own issuer: the verifier checks the validity before the path.
fn check_validity(
    certificate: &CertificateDer<'_>,
    intermediates: &[CertificateDer<'_>],
    now: UnixTime,
    path: &Path,
) -> Result<(), PageTlsError> {
    let mut roots = RootCertStore::empty();
    let name = ServerName::try_from(SERVER_NAME);
    // A certificate that can not be read is reported with the key.
    let (Ok(()), Ok(name)) = (roots.add(certificate.clone().into_owned()), name) else {
        return Ok(());
    };
    let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider()).build();
    let Ok(verifier) = verifier else {
        return Ok(());
    };
    let found = verifier.verify_server_cert(certificate, intermediates, &name, &[], now);
    match found {
        Err(Error::InvalidCertificate(CertificateError::ExpiredContext { time, not_after })) => {
            Err(PageTlsError::Expired {
                path: path.to_owned(),
                days: time.as_secs().saturating_sub(not_after.as_secs()) / SECONDS_PER_DAY,
            })
        }
        Err(Error::InvalidCertificate(CertificateError::NotValidYetContext { .. })) => {
            Err(PageTlsError::NotYetValid {
                path: path.to_owned(),
            })
        }
        _ => Ok(()),
    }
}

impl AsyncRead for PageStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut *self.0).poll_read(context, buffer)
    }
}

impl AsyncWrite for PageStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut *self.0).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut *self.0).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut *self.0).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests;
