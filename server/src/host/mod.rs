//! `palpate-server host`: serves one session until it is interrupted.
//!
//! Threads: a small tokio runtime does the I/O of all peers, the thread that called `host` owns the room, and two
//! threads own the tissue. Messages of peers reach the room through one bounded inbox. Its outputs leave through
//! bounded queues that never block it.

mod announcements;
mod emulated_page;
mod identity;
mod links;
mod options;
mod page_site;
mod pages;
mod serve;
mod session_file;
mod session_view;
mod steered_tool;
mod summary;
mod tissue;
mod tokens;

use std::io::Write as _;
use std::net::SocketAddr;
use std::sync::Arc;

use palpate_protocol::{Epoch, Grant, ModelHash, ModelInfo, ResumeToken, Role};
use palpate_room::RoomConfig;
use palpate_transport::ModelSource;
use palpate_view::PageAddress;

pub(crate) use options::HostOptions;
pub use options::TICK_HZ;
pub use serve::solver_limit;
pub use summary::{HostSummary, Listening, ListeningModel, Refused, TickTimes};
use tokens::SeatTokens;

use crate::{ServerError, load};
use identity::{Identity, IdentitySource};
use links::Links;
use page_site::PageSite;

/// Hosts a session until it is interrupted or its duration is over.
pub(crate) fn host(options: &HostOptions) -> Result<(), ServerError> {
    let compensation = options.check()?;
    let site = PageSite::of(options)?;
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
        fresh_grant: |_| Grant(rand::random()),
        start_when_tools: options.start_when,
    };
    let nodes = loaded.model.nodes.len();
    let announce = |address: SocketAddr, links: &Links, page: Option<PageAddress>| {
        let grant = |role: Role| {
            let grant = grants.iter().find(|(r, _)| *r == role).map(|(_, g)| *g);
            grant.unwrap_or(Grant([0; 16]))
        };
        let link = |role: Role| links.link(role, grant(role));
        let page_of = |role: Role| page.map(|page| links.page(page, role, grant(role), None));
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
                    .map(|&r| (r.word().to_owned(), link(r).to_string()))
                    .collect(),
                pages: BROWSER_ROLES
                    .iter()
                    .filter_map(|&r| Some((r.word().to_owned(), page_of(r)?)))
                    .collect(),
                is_page_self_signed: site.as_ref().is_some_and(PageSite::is_self_signed),
            },
        )
    };
    let models = (models, tokens);
    let at = (&server, site.as_ref());
    let summary = serve::serve(options, at, models, loaded.model, config, &announce)?;
    summary::finish(options.json, &summary)?;
    if summary.are_cuts_kept == Some(false) {
        return Err(ServerError::Option(
            "the last cuts are not in the session file; see the errors above".to_owned(),
        ));
    }
    Ok(())
}

/// The roles that a browser can take; recording takes a program.
const BROWSER_ROLES: [Role; 3] = [Role::Instructor, Role::Trainee, Role::Spectator];

/// Prints a stage of the preparation to standard error, apart from results.
fn progress(stage: &str) {
    // A closed standard error is ignored.
    let _ = writeln!(std::io::stderr(), "{stage} ...");
}
