//! The check of a page's origin: a foreign site may not use the browser of a participant.

use std::net::IpAddr;

use axum::http::HeaderMap;
use axum::http::header::{HOST, ORIGIN};

/// Whether the request comes from a page of this host: its `Origin` is the address that it was sent to, and that is an
/// address, `localhost` or the public name `name`. Any other name may be one of a foreign site that was made to lead
/// here (DNS rebinding). Programs without a browser send no `Origin`; they have no user whom a foreign site could misuse.
pub(crate) fn is_own(headers: &HeaderMap, name: Option<&str>) -> bool {
    let Some(origin) = headers.get(ORIGIN) else {
        return true;
    };
    let host = headers.get(HOST).and_then(|h| h.to_str().ok());
    let origin = origin.to_str().ok().and_then(authority);
    host.zip(origin)
        .is_some_and(|(host, of)| of.eq_ignore_ascii_case(host) && is_known(host, name))
}

/// The same of a WebTransport request, which goes to another port of the host: the origin has the host's name and the
/// port of the page.
pub(crate) fn is_own_page(
    origin: Option<&str>,
    host: &str,
    page_port: u16,
    name: Option<&str>,
) -> bool {
    let Some(origin) = origin else {
        return true;
    };
    let Some(of) = authority(origin) else {
        return false;
    };
    let default = if origin.starts_with("https") { 443 } else { 80 };
    let (of, port) = match of.rsplit_once(':') {
        // The colons of an IPv6 address are in brackets.
        Some((of, port)) if !port.ends_with(']') => (of, port.parse().ok()),
        _ => (of, Some(default)),
    };
    port == Some(page_port) && of.eq_ignore_ascii_case(host) && is_known(host, name)
}

/// Host and port of the origin of a page.
fn authority(origin: &str) -> Option<&str> {
    let (scheme, of) = origin.split_once("://")?;
    matches!(scheme, "http" | "https").then_some(of)
}

fn is_known(host: &str, name: Option<&str>) -> bool {
    let without_port = host.rsplit_once(':').map_or(host, |(before, port)| {
        let is_port = port.bytes().all(|b| b.is_ascii_digit());
        if is_port { before } else { host }
    });
    let bare = without_port.trim_start_matches('[').trim_end_matches(']');
    bare.parse::<IpAddr>().is_ok()
        || bare.eq_ignore_ascii_case("localhost")
        || name.is_some_and(|name| bare.eq_ignore_ascii_case(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(host: &str, origin: Option<&str>) -> bool {
        let mut headers = HeaderMap::new();
        headers.insert(HOST, host.parse().unwrap());
        if let Some(origin) = origin {
            headers.insert(ORIGIN, origin.parse().unwrap());
        }
        is_own(&headers, Some("operating.example.org"))
    }

    #[test]
    fn foreign_origins_are_refused() {
        let here = "127.0.0.1:4480";
        let check = |origin: Option<&str>| {
            let is_own_page = is_own_page(origin, "127.0.0.1", 4480, None);
            assert_eq!(is_own_page, check(here, origin), "{origin:?}");
            is_own_page
        };
        assert!(
            check(Some("http://127.0.0.1:4480"))
                && check(Some("https://127.0.0.1:4480"))
                && check(None)
        );
        for foreign in [
            "http://127.0.0.1",
            "http://127.0.0.1:4481",
            "http://evil.example",
            "http://evil.example:4480",
            "null",
            "file://127.0.0.1:4480",
        ] {
            assert!(!check(Some(foreign)), "{foreign}");
        }
    }

    #[test]
    fn names_that_lead_here_are_refused_unless_they_are_public() {
        for host in [
            "localhost:4480",
            "LOCALHOST",
            "192.168.1.20:80",
            "[::1]:4480",
            "[::1]",
            "operating.example.org:443",
        ] {
            assert!(check(host, Some(&format!("https://{host}"))), "{host}");
        }
        assert!(!is_own_page(
            Some("http://evil.example:4480"),
            "evil.example",
            4480,
            None
        ));
        for host in [
            "evil.example:4480",
            "evil.example",
            "localhost.evil.example:1",
        ] {
            assert!(!check(host, Some(&format!("http://{host}"))), "{host}");
        }
    }

    #[test]
    fn origins_without_a_port_have_the_port_of_their_scheme() {
        for (origin, host, port, is_own) in [
            ("https://sim.example", "sim.example", 443, true),
            ("http://sim.example", "SIM.example", 80, true),
            ("https://sim.example", "sim.example", 80, false),
            ("http://[::1]", "[::1]", 80, true),
            ("http://[::1]:4480", "[::1]", 4480, true),
            ("http://[::1]", "[::1]", 1, false),
        ] {
            let found = is_own_page(Some(origin), host, port, Some("sim.example"));
            assert_eq!(found, is_own, "{origin}");
        }
    }
}
