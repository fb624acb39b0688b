//! The address of `--view`, as servers and clients read it.

use std::net::{Ipv4Addr, SocketAddr};

/// Address of a server's page unless one is given: this machine only.
pub const SERVER_VIEW: &str = "127.0.0.1:4480";

/// The same of a client, beside a server on this machine.
pub const CLIENT_VIEW: &str = "127.0.0.1:4481";

/// `--view` has an invalid value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "invalid address {0:?} of --view; give ADDRESS:PORT or a port alone (this machine only), such as {SERVER_VIEW} or \
     4480"
)]
pub struct ViewAddressError(String);

/// Reads an address and a port, or a port alone: of this machine only, so that serving others is a decision.
pub fn parse_view(text: &str) -> Result<SocketAddr, ViewAddressError> {
    match text.strip_prefix(':').unwrap_or(text).parse() {
        Ok(port) => Ok(SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port)),
        Err(_) => text.parse().map_err(|_| ViewAddressError(text.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_alone_serves_this_machine_only() {
        for (text, address) in [
            (CLIENT_VIEW, "127.0.0.1:4481"),
            ("5000", "127.0.0.1:5000"),
            (":5000", "127.0.0.1:5000"),
            ("0", "127.0.0.1:0"),
            ("0.0.0.0:1", "0.0.0.0:1"),
            ("[::1]:9", "[::1]:9"),
        ] {
            assert_eq!(parse_view(text), Ok(address.parse().unwrap()), "{text}");
        }
    }

    #[test]
    fn invalid_address_is_named_with_the_remedy() {
        for text in ["", ":", "70000", "127.0.0.1", "here:1", "::1"] {
            let error = parse_view(text).unwrap_err().to_string();
            assert!(error.contains(&format!("{text:?}")), "{error}");
            assert!(error.contains("ADDRESS:PORT"), "{error}");
        }
    }
}
