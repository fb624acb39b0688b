//! Laws of the page's certificates, and of connections with them.

use std::fs;

use palpate_protocol::CertificateHash;
use rcgen::{CertificateParams, CertifiedKey as MadeKey, KeyPair};
use rustls::ClientConfig;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio_rustls::TlsConnector;

use super::*;
use crate::config;
use crate::identity::hash_of;

/// A folder for the files of one test.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("palpate-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn file(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.join(name);
        fs::write(&path, text).unwrap();
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A certificate that is valid in these years.
fn made(years: std::ops::Range<i32>) -> MadeKey<KeyPair> {
    let mut params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
    params.not_before = rcgen::date_time_ymd(years.start, 1, 1);
    params.not_after = rcgen::date_time_ymd(years.end, 1, 1);
    let signing_key = KeyPair::generate().unwrap();
    let cert = params.self_signed(&signing_key).unwrap();
    MadeKey { cert, signing_key }
}

fn pem(mark: &str, der: &[u8]) -> String {
    let text = data_encoding::BASE64.encode(der);
    format!("-----BEGIN {mark}-----\n{text}\n-----END {mark}-----\n")
}

fn certificate_pem(made: &MadeKey<KeyPair>) -> String {
    pem("CERTIFICATE", made.cert.der())
}

fn key_pem(made: &MadeKey<KeyPair>) -> String {
    pem("PRIVATE KEY", &made.signing_key.serialize_der())
}

fn refused(certificate: &Path, key: &Path) -> String {
    PageTls::from_files(certificate, key)
        .err()
        .unwrap()
        .to_string()
}

#[test]
fn unusable_files_are_named_with_cause_and_remedy() {
    let folder = Folder::new("page-tls");
    let good = made(2020..2100);
    let certificate = folder.file("good.pem", &certificate_pem(&good));
    let key = folder.file("key.pem", &key_pem(&good));
    assert!(PageTls::from_files(&certificate, &key).is_ok());

    let missing = folder.0.join("missing.pem");
    let text = refused(&missing, &key);
    assert!(
        text.contains("--certificate") && text.contains("missing.pem"),
        "{text}"
    );
    let text = refused(&certificate, &missing);
    assert!(
        text.contains("--key") && text.contains("missing.pem"),
        "{text}"
    );

    let other = key_pem(&made(2020..2100));
    let text = refused(&certificate, &folder.file("other.pem", &other));
    assert!(text.contains("other.pem does not match"), "{text}");

    let expired = made(2020..2021);
    let old = folder.file("old.pem", &certificate_pem(&expired));
    let old_key = folder.file("old-key.pem", &key_pem(&expired));
    let text = refused(&old, &old_key);
    assert!(
        text.contains("old.pem expired") && text.contains("renew"),
        "{text}"
    );

    let early = made(2099..2100);
    let path = folder.file("early.pem", &certificate_pem(&early));
    let early_key = folder.file("early-key.pem", &key_pem(&early));
    let text = refused(&path, &early_key);
    assert!(text.contains("not valid yet"), "{text}");

    let text = refused(&key, &key);
    assert!(text.contains("-----BEGIN CERTIFICATE-----"), "{text}");
    let text = refused(&certificate, &certificate);
    assert!(text.contains("-----BEGIN PRIVATE KEY-----"), "{text}");
}

/// Sends a word over TLS to a client that accepts only the certificate with this hash.
async fn greet(tls: PageTls, pinned: CertificateHash) -> io::Result<String> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let address = listener.local_addr()?;
    let serving = tokio::spawn(async move {
        let (stream, _) = listener.accept().await?;
        let mut stream = tls.accept(stream).await?;
        stream.write_all(b"hello").await?;
        stream.shutdown().await
    });
    let client = ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(config::pinned(pinned))
        .with_no_client_auth();
    let stream = TcpStream::connect(address).await?;
    let name = ServerName::try_from("localhost").unwrap();
    let mut stream = TlsConnector::from(Arc::new(client))
        .connect(name, stream)
        .await?;
    let mut text = String::new();
    stream.read_to_string(&mut text).await?;
    serving.await.unwrap()?;
    Ok(text)
}

#[tokio::test]
async fn client_that_pins_the_certificate_is_served_and_another_certificate_is_rejected() {
    let folder = Folder::new("page-tls-pinned");
    let good = made(2020..2100);
    let tls = PageTls::from_files(
        &folder.file("good.pem", &certificate_pem(&good)),
        &folder.file("key.pem", &key_pem(&good)),
    )
    .unwrap();
    let hash = hash_of(good.cert.der());
    assert_eq!(greet(tls.clone(), hash).await.unwrap(), "hello");
    let other = PageTls::self_signed(vec!["localhost".to_owned()]).unwrap();
    assert!(other.is_self_signed() && !tls.is_self_signed());
    greet(other, hash).await.unwrap_err();
}
