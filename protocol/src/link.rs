//! The join link: the only input that a participant needs.
//!
//! ```text
//! palpate://HOST:PORT/ROLE?cert=SHA256-HEX&grant=TOKEN-HEX
//! ```
//!
//! The link carries the hash of the server's certificate, so that no other host can pose as the server,
//! and the secret that allows the role. Any holder of the link can take the seat.

use std::fmt;
use std::str::FromStr;

use data_encoding::HEXLOWER_PERMISSIVE;
use serde::{Deserialize, Serialize};
use subtle::ConstantTimeEq as _;

use crate::Role;

/// The scheme of a join link.
pub const SCHEME: &str = "palpate://";

/// Bytes of a grant: too many to guess.
pub const GRANT_BYTES: usize = 16;

/// SHA-256 of a server certificate in DER.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct CertificateHash(pub [u8; 32]);

impl fmt::Display for CertificateHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&HEXLOWER_PERMISSIVE.encode(&self.0))
    }
}

/// A secret that allows one role in one session. Its bytes come from the shell, at random.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Grant(pub [u8; GRANT_BYTES]);

impl Grant {
    /// The grant for a link, in hexadecimal.
    pub fn token(&self) -> String {
        HEXLOWER_PERMISSIVE.encode(&self.0)
    }

    /// Compares in constant time, independent of the first difference.
    pub fn matches(&self, other: &Self) -> bool {
        self.0.ct_eq(&other.0).into()
    }
}

/// Bytes of a resume token: too many to guess.
pub const TOKEN_BYTES: usize = 16;

/// A secret that resumes one seat of one session after its connection was lost. The shell supplies
/// random bytes.
#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResumeToken(pub [u8; TOKEN_BYTES]);

impl ResumeToken {
    /// Compares in constant time, independent of the first difference.
    pub fn matches(&self, other: &Self) -> bool {
        self.0.ct_eq(&other.0).into()
    }
}

impl fmt::Debug for ResumeToken {
    /// Prints a placeholder, not the secret, because logs are shared.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ResumeToken(..)")
    }
}

impl fmt::Debug for Grant {
    /// Prints a placeholder, not the secret, because logs are shared.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Grant(..)")
    }
}

/// The server's address, the role, and the hash that authenticates the server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JoinLink {
    /// Host name or address; an IPv6 address without its brackets.
    pub host: String,
    /// UDP port.
    pub port: u16,
    /// The role that the link is for.
    pub role: Role,
    /// The expected hash of the server's certificate.
    pub certificate: CertificateHash,
    /// The secret that allows the role.
    pub grant: Grant,
}

impl fmt::Display for JoinLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (open, close) = if self.host.contains(':') {
            ("[", "]")
        } else {
            ("", "")
        };
        write!(
            f,
            "{SCHEME}{open}{}{close}:{}/{}?cert={}&grant={}",
            self.host,
            self.port,
            self.role,
            self.certificate,
            self.grant.token()
        )
    }
}

/// The errors of a join link.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LinkError {
    /// Not a palpate link.
    #[error(
        "a join link begins with \"{SCHEME}\", and this one with \"{found}\"; copy the whole link that the server printed, and put it in quotes, because it has a '&'"
    )]
    Scheme {
        /// Its first characters.
        found: String,
    },
    /// The host or its port is missing or wrong.
    #[error(
        "the join link has no HOST:PORT between \"{SCHEME}\" and the role: \"{found}\"; for example {SCHEME}192.168.1.20:4433/trainee?..."
    )]
    Host {
        /// The text found.
        found: String,
    },
    /// The role is missing or unknown.
    #[error(
        "the join link names the role \"{found}\"; the roles are instructor, trainee, spectator and recorder"
    )]
    Role {
        /// The text found.
        found: String,
    },
    /// A part after the question mark is missing.
    #[error(
        "the join link has no \"{key}=\"; was it cut off at the '&'? put the whole link in quotes"
    )]
    Missing {
        /// Its key.
        key: &'static str,
    },
    /// A part after the question mark is wrong.
    #[error(
        "\"{key}=\" in the join link must have {digits} hexadecimal digits, it has {found} characters; copy the whole link that the server printed"
    )]
    Value {
        /// Its key.
        key: &'static str,
        /// How many digits it must have.
        digits: usize,
        /// How many characters it has.
        found: usize,
    },
    /// An unknown key.
    #[error("the join link has an unknown part \"{found}\"; only cert and grant are allowed")]
    Unknown {
        /// The key found.
        found: String,
    },
}

/// The first characters of a part, without values: errors are logged, and a value may be the secret.
fn excerpt(s: &str) -> String {
    let is_key = |c: &char| !"?=&".contains(*c);
    s.chars().take_while(is_key).take(40).collect()
}

fn hex<const N: usize>(key: &'static str, value: &str) -> Result<[u8; N], LinkError> {
    HEXLOWER_PERMISSIVE
        .decode(value.as_bytes())
        .ok()
        .and_then(|bytes| bytes.try_into().ok())
        .ok_or_else(|| LinkError::Value {
            key,
            digits: 2 * N,
            found: value.chars().count(),
        })
}

fn host_and_port(authority: &str) -> Option<(String, u16)> {
    let (host, port) = authority.rsplit_once(':')?;
    let port = port.parse().ok().filter(|p| *p != 0)?;
    let host = match host.strip_prefix('[') {
        Some(rest) => rest.strip_suffix(']')?,
        None if host.contains(':') => return None,
        None => host,
    };
    let allowed = |c: char| c.is_ascii_alphanumeric() || "-._:%".contains(c);
    (!host.is_empty() && host.len() <= 253 && host.chars().all(allowed))
        .then(|| (host.to_owned(), port))
}

impl FromStr for JoinLink {
    type Err = LinkError;

    fn from_str(s: &str) -> Result<Self, LinkError> {
        let s = s.trim();
        let rest = s
            .strip_prefix(SCHEME)
            .ok_or_else(|| LinkError::Scheme { found: excerpt(s) })?;
        let (place, query) = rest.split_once('?').unwrap_or((rest, ""));
        let (authority, role) = place.split_once('/').unwrap_or((place, ""));
        let (host, port) = host_and_port(authority).ok_or_else(|| LinkError::Host {
            found: excerpt(authority),
        })?;
        let role = role.parse().map_err(|_| LinkError::Role {
            found: excerpt(role),
        })?;
        let (mut certificate, mut grant) = (None, None);
        for part in query.split('&').filter(|p| !p.is_empty()) {
            match part.split_once('=') {
                Some(("cert", v)) => certificate = Some(CertificateHash(hex("cert", v)?)),
                Some(("grant", v)) => grant = Some(Grant(hex("grant", v)?)),
                _ => {
                    return Err(LinkError::Unknown {
                        found: excerpt(part),
                    });
                }
            }
        }
        Ok(Self {
            host,
            port,
            role,
            certificate: certificate.ok_or(LinkError::Missing { key: "cert" })?,
            grant: grant.ok_or(LinkError::Missing { key: "grant" })?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn link(host: &str) -> JoinLink {
        JoinLink {
            host: host.to_owned(),
            port: 4433,
            role: Role::Trainee,
            certificate: CertificateHash([0xa5; 32]),
            grant: Grant([7; 16]),
        }
    }

    #[test]
    fn a_link_reads_back_as_written() {
        for host in ["127.0.0.1", "::1", "host-1.example.org"] {
            let l = link(host);
            assert_eq!(l.to_string().parse(), Ok(l));
        }
    }

    #[test]
    fn each_wrong_part_is_named() {
        let good = link("h").to_string();
        let err = |s: &str| s.parse::<JoinLink>().unwrap_err().to_string();
        assert!(err("http://h").contains("palpate://"));
        assert!(err(&good.replace(":4433", "")).contains("HOST:PORT"));
        assert!(err(&good.replace("trainee", "surgeon")).contains("\"surgeon\""));
        assert!(err(good.split_once('&').unwrap().0).contains("grant"));
        assert!(err(&good.replace("a5a5", "zz")).contains("64 hexadecimal"));
        assert!(err(&format!("{good}&x=1")).contains("\"x\""));
    }

    #[test]
    fn no_error_shows_a_secret() {
        let secret = "5ec7".repeat(8);
        let good = link("h").to_string();
        let (start, _) = good.rsplit_once('=').unwrap();
        let wrong = [
            format!("{start}={secret}x"),
            format!("{start}={}z", &secret[..31]),
            good.replace("grant=", &format!("grnt={secret}&grant=")),
            format!("grant={secret}"),
            format!("palpate://grant={secret}"),
            format!("palpate://h:1/trainee&grant={secret}"),
        ];
        for text in wrong {
            let error = text.parse::<JoinLink>().unwrap_err().to_string();
            assert!(!error.contains("5ec7"), "{text}: {error}");
        }
    }

    #[test]
    fn a_grant_is_not_shown_in_debug_output() {
        assert!(!format!("{:?}", link("h")).contains('7'));
    }

    proptest! {
        #[test]
        fn no_text_makes_the_parser_panic(s in "(palpate://)?.{0,80}") {
            let _ = s.parse::<JoinLink>();
        }
    }
}
