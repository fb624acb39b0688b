//! `palpate-server host`: serves one session until it is interrupted.
//!
//! Threads: a small tokio runtime does the I/O of all peers, the thread that called `host` owns the room, and two
//! threads own the tissue. Messages of peers reach the room through one bounded inbox. Its outputs leave through
//! bounded queues that never block it.

mod announcements;
mod identity;
mod options;
mod serve;
mod summary;
mod tissue;
mod tokens;

use std::io::Write as _;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;

use palpate_protocol::{Epoch, Grant, JoinLink, ModelHash, ModelInfo, ResumeToken, Role};
use palpate_room::RoomConfig;
use palpate_transport::ModelSource;

pub(crate) use options::HostOptions;
pub use options::TICK_HZ;
pub use serve::solver_limit;
pub use summary::{HostSummary, Listening, ListeningModel, Refused, TickTimes};
use tokens::SeatTokens;

use crate::{ServerError, load};
use identity::{Identity, IdentitySource};

/// Hosts a session until it is interrupted or its duration is over.
pub(crate) fn host(options: &HostOptions) -> Result<(), ServerError> {
    let compensation = options.check()?;
    progress(&format!("preparing the model {}", options.model));
    let loaded = load::load(&options.model)?;
    let Identity { server, grants } =
        Identity::obtain(options.identity.as_ref(), options.new_links)?;
    progress("opening the session");
    let info = ModelInfo {
        hash: ModelHash(xxhash_rust::xxh3::xxh3_64(&loaded.bytes)),
        bytes: loaded.bytes.len() as u64,
    };
    let bytes: Arc<[u8]> = loaded.bytes.into();
    let tokens = SeatTokens::default();
    let models: ModelSource = {
        let tokens = tokens.clone();
        Arc::new(move |participant, token, hash| {
            let has_seat = tokens.has(participant, &token);
            (has_seat && hash == info.hash).then(|| Arc::clone(&bytes))
        })
    };
    let config = RoomConfig {
        epoch: Epoch(rand::random()),
        model: info,
        grants: grants.clone(),
        seats: options.seats,
        spectators: options.spectators(),
        tick_hz: options.tick_hz,
        compensation,
        fresh_token: |_| ResumeToken(rand::random()),
        start_when_tools: options.start_when,
    };
    let nodes = loaded.model.nodes.len();
    let announce = |address: SocketAddr| {
        let link = |role: Role| {
            let grant = grants.iter().find(|(r, _)| *r == role).map(|(_, g)| *g);
            JoinLink {
                host: public_host(options, address),
                port: address.port(),
                role,
                certificate: server.certificate_hash(),
                grant: grant.unwrap_or(Grant([0; 16])),
            }
            .to_string()
        };
        summary::announce(
            options.json,
            &Listening {
                listening: address,
                model: ListeningModel {
                    nodes,
                    hash: info.hash.to_string(),
                    bytes: info.bytes,
                },
                links: Role::ALL
                    .iter()
                    .map(|&r| (r.word().to_owned(), link(r)))
                    .collect(),
            },
        )
    };
    let models = (models, tokens);
    let summary = serve::serve(options, &server, models, loaded.model, config, &announce)?;
    summary::finish(options.json, &summary)
}

/// Prints a stage of the preparation to standard error, apart from results.
fn progress(stage: &str) {
    // A closed standard error is ignored.
    let _ = writeln!(std::io::stderr(), "{stage} ...");
}

/// Host name for join links: option `--public`, the address it listens on, or the address of the default route.
fn public_host(options: &HostOptions, address: SocketAddr) -> String {
    if let Some(host) = &options.public {
        return host.clone();
    }
    if !address.ip().is_unspecified() {
        return address.ip().to_string();
    }
    // Connecting a UDP socket only selects the interface and sends nothing. The address is reserved for documentation
    // (RFC 5737).
    let chosen = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))
        .and_then(|s| {
            s.connect((Ipv4Addr::new(192, 0, 2, 1), 9))
                .and_then(|()| s.local_addr())
        })
        .map(|a| a.ip());
    chosen
        .unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST))
        .to_string()
}
