//! The files of the page, built into the program.

use std::io::Write as _;
use std::sync::LazyLock;

use axum::body::Bytes;
use axum::http::header::{
    ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST,
    REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use flate2::Compression;
use flate2::write::GzEncoder;

/// The page loads nothing from elsewhere and runs no inline code. It may connect to its host alone.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; connect-src 'self'";

struct Asset {
    path: &'static str,
    kind: &'static str,
    bytes: &'static [u8],
    /// The same, compressed on first use.
    packed: LazyLock<Bytes, Box<dyn FnOnce() -> Bytes + Send>>,
}

impl Asset {
    fn new(path: &'static str, kind: &'static str, bytes: &'static [u8]) -> Self {
        Self {
            path,
            kind,
            bytes,
            packed: LazyLock::new(Box::new(|| pack(bytes))),
        }
    }
}

fn pack(bytes: &[u8]) -> Bytes {
    let mut packed = GzEncoder::new(Vec::new(), Compression::best());
    // Writing to memory does not fail.
    let _ = packed.write_all(bytes);
    packed.finish().unwrap_or_default().into()
}

macro_rules! asset {
    ($path:literal, $kind:literal) => {
        Asset::new(
            concat!("/", $path),
            $kind,
            include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/page/dist/", $path)),
        )
    };
}

static ASSETS: LazyLock<[Asset; 5]> = LazyLock::new(|| {
    [
        asset!("index.html", "text/html; charset=utf-8"),
        asset!("page.js", "text/javascript; charset=utf-8"),
        asset!("worker.js", "text/javascript; charset=utf-8"),
        asset!("index.css", "text/css; charset=utf-8"),
        asset!("icon.svg", "image/svg+xml"),
    ]
});

/// The policy for a request. `port` is the one for WebTransport at the host of the request.
fn policy(headers: &HeaderMap, port: Option<u16>) -> String {
    let host = headers.get(HOST).and_then(|h| h.to_str().ok());
    // A policy has no way to write an IPv6 address; such a page uses a WebSocket.
    let is_name = |host: &&str| {
        let is_part = |c: u8| c.is_ascii_alphanumeric() || c == b'-' || c == b'.';
        !host.is_empty() && host.bytes().all(is_part)
    };
    let host = host
        .map(|host| host.rsplit_once(':').map_or(host, |(name, _)| name))
        .filter(is_name);
    match host.zip(port) {
        Some((host, port)) => format!("{POLICY} https://{host}:{port}"),
        None => POLICY.to_owned(),
    }
}

/// Serves a file of the page. `port` is the one for WebTransport.
pub(crate) fn serve(uri: &Uri, headers: &HeaderMap, port: Option<u16>) -> Response {
    let path = if uri.path() == "/" {
        "/index.html"
    } else {
        uri.path()
    };
    let Some(asset) = ASSETS.iter().find(|a| a.path == path) else {
        return (StatusCode::NOT_FOUND, "no such file\n").into_response();
    };
    let policy = [(CONTENT_SECURITY_POLICY, policy(headers, port))];
    let common = [
        (CONTENT_TYPE, asset.kind),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        // The page belongs to the program that serves it.
        (CACHE_CONTROL, "no-cache"),
    ];
    let accepted = headers.get(ACCEPT_ENCODING).and_then(|h| h.to_str().ok());
    if accepted.is_some_and(|a| a.contains("gzip")) {
        return (
            policy,
            common,
            [(CONTENT_ENCODING, "gzip")],
            asset.packed.clone(),
        )
            .into_response();
    }
    (policy, common, asset.bytes).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn policy_allows_the_endpoint_at_the_host_of_the_request_and_nothing_else() {
        let of = |host: &str, port| {
            let mut headers = HeaderMap::new();
            headers.insert(HOST, host.parse().unwrap());
            policy(&headers, port)
        };
        assert!(
            of("sim.example:4480", Some(4433))
                .ends_with("connect-src 'self' https://sim.example:4433")
        );
        assert!(of("127.0.0.1", Some(4433)).ends_with("'self' https://127.0.0.1:4433"));
        assert!(of("sim.example:4480", None).ends_with("connect-src 'self'"));
        for host in ["[::1]:4480", "a;script-src *", "a b:1", ":1"] {
            assert!(
                of(host, Some(4433)).ends_with("connect-src 'self'"),
                "{host}"
            );
        }
    }
}
