//! Output of a host: address and links at the start, statistics at the end.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::SocketAddr;

use palpate_room::{Limit, LimitCounters};
use palpate_transport::DriverStats;
use palpate_transport::threads::CpuUsage;
use serde::{Deserialize, Serialize};

use crate::ServerError;
use crate::output::print_result;

/// The first object of `host --json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Listening {
    /// Address and port.
    pub listening: SocketAddr,
    /// The model of the session.
    pub model: ListeningModel,
    /// A join link per role.
    pub links: BTreeMap<String, String>,
    /// Address of the page per role, if the session has one.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub pages: BTreeMap<String, String>,
    /// Whether browsers will warn about the certificate of the page.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_page_self_signed: bool,
}

/// The model that is served.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ListeningModel {
    /// Number of nodes.
    pub nodes: usize,
    /// Its hash, hexadecimal.
    pub hash: String,
    /// Download size in bytes.
    pub bytes: u64,
}

/// The last object of `host --json`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct HostSummary {
    /// Solved ticks.
    pub ticks: u64,
    /// Duration of a tick.
    pub tick_ms: TickTimes,
    /// Delay of the start of a tick behind its due time.
    pub late_ms: TickTimes,
    /// Ticks skipped because the tissue was busy.
    #[serde(default)]
    pub ticks_skipped: u64,
    /// Preparation time of a cut, beside the ticks.
    #[serde(default)]
    pub cut_ms: TickTimes,
    /// Mean CPU use of the session by thread class.
    #[serde(default)]
    pub cpu: CpuUsage,
    /// Time between two ticks in ms.
    pub tick_period_ms: f64,
    /// Operations in the log.
    pub operations: usize,
    /// Cuts among them.
    pub cuts: u64,
    /// Version of the topology.
    pub topology_version: u32,
    /// Hash of the topology, hexadecimal.
    pub topology_hash: String,
    /// Connected pieces of the tissue.
    pub components: usize,
    /// Whether every edge of the boundary belongs to exactly two triangles.
    pub boundary_closed: bool,
    /// Participants over the whole session.
    pub participants: u64,
    /// The playout delay at the end, in ms.
    pub compensation_ms: f64,
    /// Datagrams that found their queue full.
    pub datagrams_skipped: u64,
    /// Demotions to spectator because of the network.
    pub demotions: u64,
    /// Refused joins and rejected datagrams.
    pub refused: Refused,
    /// How often each limit of the room took effect, by name; omitted where it never did.
    #[serde(default)]
    pub limits: BTreeMap<String, u64>,
    /// Length of the session in s.
    pub seconds: f64,
    /// Whether the session file has every cut; `None` without one.
    #[serde(default)]
    pub are_cuts_kept: Option<bool>,
    /// Reason for the end.
    pub ended: String,
}

/// Refused joins, repeated requests and rejected datagrams of all peers, by reason. Rejections do not end a session.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// Refused joins: wrong grant, no free seat, or duplicate name.
    pub joins: u64,
    /// Requests repeated over a new connection.
    pub repetitions: u64,
    /// Datagrams above the rate limit of a peer.
    pub over_rate: u64,
    /// Malformed datagrams.
    pub malformed: u64,
    /// Datagrams of another session epoch.
    pub other_epoch: u64,
    /// Datagrams of another connection, or of a kind that servers do not accept.
    pub misdirected: u64,
    /// Duplicate datagrams.
    pub duplicate: u64,
    /// Datagrams that arrived too late.
    pub old: u64,
    /// Datagrams received before their sender was admitted.
    pub early: u64,
    /// Datagrams whose baseline did not arrive.
    pub no_baseline: u64,
    /// Acknowledgements of datagrams that were never sent.
    pub false_acknowledgement: u64,
}

impl Refused {
    /// Adds the counters of one peer's connection.
    pub(super) fn add(&mut self, stats: &DriverStats) {
        let noise = stats.link.noise;
        self.over_rate += stats.path.refused_datagrams;
        self.malformed += noise.malformed;
        self.other_epoch += noise.other_epoch;
        self.misdirected += noise.misdirected;
        self.duplicate += noise.duplicate;
        self.old += noise.old;
        self.early += noise.early;
        self.no_baseline += noise.no_baseline;
        self.false_acknowledgement += noise.false_acknowledgement;
    }
}

/// Percentiles over the ticks of a session, ms.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub struct TickTimes {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Longest.
    pub max: f64,
}

/// The counters of the limits that took effect, by name.
pub(super) fn limits(counters: &LimitCounters) -> BTreeMap<String, u64> {
    let counts = Limit::ALL.map(|limit| (limit.word().to_owned(), counters.of(limit)));
    counts.into_iter().filter(|(_, n)| *n > 0).collect()
}

/// Printed below the page's URLs.
const SELF_SIGNED: &str = "browsers will warn about the self-signed certificate of this page; avoid it with \
    --certificate and --key of a certificate for the page's host name";

/// Prints address and join links.
pub(super) fn announce(json: bool, listening: &Listening) -> Result<(), ServerError> {
    if json {
        return print_result(&serde_json::json!(listening).to_string());
    }
    let mut text = format!(
        "listening on {} with a model of {} nodes ({:.1} MB); end with Ctrl-C",
        listening.listening,
        listening.model.nodes,
        listening.model.bytes as f64 / 1e6
    );
    // Writing to a string can not fail.
    for (role, link) in &listening.links {
        let _ = write!(text, "\n{role:>11}  {link}");
    }
    if !listening.pages.is_empty() {
        text.push_str("\nin a browser:");
    }
    for (role, page) in &listening.pages {
        let _ = write!(text, "\n{role:>11}  {page}");
    }
    if listening.is_page_self_signed {
        let _ = write!(text, "\n{SELF_SIGNED}");
    }
    print_result(&text)
}

/// Prints the statistics of the session.
pub(super) fn finish(json: bool, s: &HostSummary) -> Result<(), ServerError> {
    if json {
        return print_result(&serde_json::json!(s).to_string());
    }
    let limits: Vec<String> = s.limits.iter().map(|(l, n)| format!("{l} {n}")).collect();
    let limits = if limits.is_empty() {
        String::new()
    } else {
        format!("; limits: {}", limits.join(", "))
    };
    print_result(&format!(
        "{} after {:.1} s: {} participants, {} operations with {} cuts; {} ticks of \
         {:.1} ms (p99 {:.1}, period {:.1}); topology {} (version {}), {} piece(s); {}{limits}",
        s.ended,
        s.seconds,
        s.participants,
        s.operations,
        s.cuts,
        s.ticks,
        s.tick_ms.p50,
        s.tick_ms.p99,
        s.tick_period_ms,
        s.topology_hash,
        s.topology_version,
        s.components,
        s.cpu
    ))
}
