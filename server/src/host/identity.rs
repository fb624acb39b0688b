//! The identity of a host: its certificate with the key, and the secrets in its join links.
//!
//! Both are kept in one private file, so that a host that is started again is the same host and its links stay valid. Two
//! hosts may use one identity at the same time, at different ports.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind, Read as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use palpate_protocol::{Grant, Role};
use palpate_transport::ServerIdentity;
use palpate_transport::state::{check_private, make_private_folder, state_folder, write_private};
use serde::{Deserialize, Serialize};

use crate::ServerError;

/// The format of the file.
const FORMAT: &str = "palpate-identity/1";

/// The name of the file in its folder.
const FILE: &str = "identity.json";

/// Maximum size of the file in bytes. A larger file is not from this program.
const BYTES_MAX: u64 = 64 * 1024;

/// Location of the host's identity, unless it is in the user's state folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum IdentitySource {
    /// The one in this folder.
    Folder(PathBuf),
    /// A temporary identity that is not stored.
    New,
}

impl FromStr for IdentitySource {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "" => Err("name a folder, or new".to_owned()),
            "new" => Ok(Self::New),
            folder => Ok(Self::Folder(folder.into())),
        }
    }
}

/// The identity of a host with the secret of each role. It has no `Debug`, to keep secrets out of logs.
pub(super) struct Identity {
    pub(super) server: ServerIdentity,
    pub(super) grants: Vec<(Role, Grant)>,
}

/// The content of the file; bytes in hexadecimal.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    format: String,
    certificate: String,
    key: String,
    /// Secrets by name of the role.
    grants: BTreeMap<String, String>,
}

impl Identity {
    /// Loads an identity, or creates a missing one. `new_links` replaces the secrets of the links.
    pub(super) fn obtain(
        place: Option<&IdentitySource>,
        new_links: bool,
    ) -> Result<Self, ServerError> {
        let folder = match place {
            Some(IdentitySource::New) => return Self::generate(),
            Some(IdentitySource::Folder(folder)) => folder.clone(),
            None => state_folder()
                .ok_or_else(|| {
                    ServerError::CommandLine(
                        "there is no folder to keep the host's identity in: neither XDG_STATE_HOME nor HOME names one; \
                         give --identity DIR, or --identity new for links that end with this host"
                            .to_owned(),
                    )
                })?
                .join("host"),
        };
        let path = folder.join(FILE);
        let failed = |source| ServerError::Identity {
            path: path.clone(),
            why: io_reason(&source),
        };
        make_private_folder(&folder).map_err(failed)?;
        let mut identity = if let Some(identity) = Self::load(&path)? {
            identity
        } else {
            let identity = Self::generate()?;
            match write_private(&path, &identity.to_file(), false) {
                Ok(()) => return Ok(identity),
                // Another host created the file first.
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                    Self::load(&path)?.ok_or_else(|| failed(ErrorKind::NotFound.into()))?
                }
                Err(error) => return Err(failed(error)),
            }
        };
        if new_links {
            identity.grants = new_grants();
            write_private(&path, &identity.to_file(), true).map_err(failed)?;
        }
        Ok(identity)
    }

    fn generate() -> Result<Self, ServerError> {
        Ok(Self {
            server: ServerIdentity::generate()?,
            grants: new_grants(),
        })
    }

    /// The identity in a file; `None` where there is none.
    fn load(path: &Path) -> Result<Option<Self>, ServerError> {
        let failed = |why: String| ServerError::Identity {
            path: path.to_owned(),
            why,
        };
        let text = match read(path) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(failed(io_reason(&error))),
        };
        let damaged = |why: &str| {
            failed(format!(
                "it is damaged ({why}); remove it for a new identity, with new links"
            ))
        };
        // The error holds only the position, because the text around it may be the key.
        let kept: Kept = serde_json::from_str(&text)
            .map_err(|e| damaged(&format!("line {}, column {}", e.line(), e.column())))?;
        if kept.format != FORMAT {
            return Err(damaged("another format"));
        }
        let bytes = |what: &str, text: &str| {
            data_encoding::HEXLOWER
                .decode(text.as_bytes())
                .map_err(|_| damaged(&format!("no hexadecimal digits in \"{what}\"")))
        };
        let certificate = bytes("certificate", &kept.certificate)?;
        let server = ServerIdentity::from_der(certificate, bytes("key", &kept.key)?)
            .map_err(|e| damaged(&e.to_string()))?;
        let grant = |&role: &Role| {
            let text = kept.grants.get(role.word()).map_or("", String::as_str);
            let grant = bytes(role.word(), text)?.try_into();
            Ok((role, Grant(grant.map_err(|_| damaged(role.word()))?)))
        };
        let grants: Result<Vec<_>, ServerError> = Role::ALL.iter().map(grant).collect();
        Ok(Some(Self {
            server,
            grants: grants?,
        }))
    }

    fn to_file(&self) -> Vec<u8> {
        let hex = |bytes: &[u8]| data_encoding::HEXLOWER.encode(bytes);
        let (certificate, key) = self.server.to_der();
        let grants = self.grants.iter();
        let kept = Kept {
            format: FORMAT.to_owned(),
            certificate: hex(&certificate),
            key: hex(&key),
            grants: grants
                .map(|(role, grant)| (role.word().to_owned(), hex(&grant.0)))
                .collect(),
        };
        serde_json::to_vec_pretty(&kept).expect("an identity is plain data")
    }
}

fn new_grants() -> Vec<(Role, Grant)> {
    let grant = |&role: &Role| (role, Grant(rand::random()));
    Role::ALL.iter().map(grant).collect()
}

fn read(path: &Path) -> io::Result<String> {
    let file = File::open(path)?;
    check_private(&file)?;
    let mut text = String::new();
    file.take(BYTES_MAX).read_to_string(&mut text)?;
    Ok(text)
}

fn io_reason(error: &io::Error) -> String {
    format!(
        "{error}; give another folder with --identity DIR, or --identity new for links that end with this host"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The secrets and the certificate hash in the links.
    fn links(identity: &Identity) -> ([u8; 32], Vec<[u8; 16]>) {
        let grants = identity.grants.iter().map(|(_, grant)| grant.0).collect();
        (identity.server.certificate_hash().0, grants)
    }

    fn at(folder: &Path) -> IdentitySource {
        IdentitySource::Folder(folder.to_owned())
    }

    #[test]
    fn links_survive_a_restart_until_they_are_renewed() {
        let dir = tempfile::tempdir().unwrap();
        let place = at(&dir.path().join("a/b"));
        let first = links(&Identity::obtain(Some(&place), false).unwrap());
        assert_eq!(
            links(&Identity::obtain(Some(&place), false).unwrap()),
            first
        );
        let renewed = links(&Identity::obtain(Some(&place), true).unwrap());
        assert_eq!(renewed.0, first.0, "the host is the same");
        assert!(renewed.1.iter().all(|grant| !first.1.contains(grant)));
        assert_eq!(
            links(&Identity::obtain(Some(&place), false).unwrap()),
            renewed
        );
        let throwaway = links(&Identity::obtain(Some(&IdentitySource::New), false).unwrap());
        assert_ne!(throwaway.0, first.0);
    }

    #[test]
    fn concurrently_started_hosts_share_one_identity() {
        let dir = tempfile::tempdir().unwrap();
        let place = at(dir.path());
        let hosts: Vec<_> = std::thread::scope(|scope| {
            let start = || scope.spawn(|| links(&Identity::obtain(Some(&place), false).unwrap()));
            let started: Vec<_> = (0..4).map(|_| start()).collect();
            started.into_iter().map(|h| h.join().unwrap()).collect()
        });
        assert!(hosts.iter().all(|host| *host == hosts[0]));
    }

    #[test]
    fn damaged_identity_is_reported_without_its_secrets() {
        let dir = tempfile::tempdir().unwrap();
        let place = at(dir.path());
        Identity::obtain(Some(&place), false).unwrap();
        let path = dir.path().join(FILE);
        let text = std::fs::read_to_string(&path).unwrap();
        let key = text.split('"').nth(11).unwrap().to_owned();
        for wrong in [
            String::new(),
            text[..text.len() / 2].to_owned(),
            text.replace("identity/1", "identity/9"),
            text.replace(&key, &key[2..]),
            text.replace("trainee", "intern"),
        ] {
            write_private(&path, wrong.as_bytes(), true).unwrap();
            let said = Identity::obtain(Some(&place), false)
                .err()
                .unwrap()
                .to_string();
            assert!(said.contains(FILE) && said.contains("damaged"), "{said}");
            assert!(!said.contains(&key[..40]), "{said}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn key_readable_by_other_users_is_rejected() {
        use std::os::unix::fs::PermissionsExt as _;
        let dir = tempfile::tempdir().unwrap();
        let place = at(dir.path());
        Identity::obtain(Some(&place), false).unwrap();
        let path = dir.path().join(FILE);
        let mode = std::fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        let said = Identity::obtain(Some(&place), false)
            .err()
            .unwrap()
            .to_string();
        assert!(said.contains("chmod 600"), "{said}");
    }
}
