//! The address of a page, as a host prints it.

use serde_json::{Value, json};

/// Host and port of a page, and the words of its fragment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PageAddress {
    host: String,
    role: Option<String>,
    grant: String,
}

impl PageAddress {
    /// Reads `http://HOST:PORT/#role=ROLE&grant=GRANT`; the role is missing at a local client.
    pub(crate) fn parse(url: &str) -> Option<Self> {
        let (host, fragment) = url.strip_prefix("http://")?.split_once("/#")?;
        let word = |key: &str| {
            let mut words = fragment.split('&').filter_map(|w| w.split_once('='));
            words.find(|(k, _)| *k == key).map(|(_, v)| v.to_owned())
        };
        Some(Self {
            host: host.to_owned(),
            role: word("role"),
            grant: word("grant")?,
        })
    }

    /// The address of the WebSocket.
    pub(super) fn session(&self) -> String {
        format!("ws://{}/session", self.host)
    }

    /// The first message of a page.
    pub(crate) fn hello(&self, name: &str, tool: Option<&Value>) -> Value {
        json!({
            "type": "hello", "version": 1, "name": name, "role": self.role, "grant": self.grant,
            "tool": tool, "seat": null,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::PageAddress;

    #[test]
    fn address_of_server_and_client_are_read() {
        let server =
            PageAddress::parse("http://127.0.0.1:4480/#role=spectator&grant=0a1b").unwrap();
        assert_eq!(server.session(), "ws://127.0.0.1:4480/session");
        let hello = server.hello("ann", None);
        assert_eq!(
            (&hello["role"], &hello["grant"]),
            (&"spectator".into(), &"0a1b".into())
        );
        let client = PageAddress::parse("http://127.0.0.1:4481/#grant=0a1b").unwrap();
        assert!(client.hello("", None)["role"].is_null());
        for bad in [
            "",
            "http://127.0.0.1:4480/",
            "http://127.0.0.1/#role=spectator",
        ] {
            assert_eq!(PageAddress::parse(bad), None, "{bad}");
        }
    }
}
