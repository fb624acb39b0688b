//! What a host prints: first where it listens, last how it went.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::SocketAddr;

use palpate_transport::DriverStats;
use palpate_transport::threads::CpuUsage;
use serde::{Deserialize, Serialize};

use crate::ServerError;
use crate::say::say;

/// The first object of `host --json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Listening {
    /// Where.
    pub listening: SocketAddr,
    /// What is served.
    pub model: ListeningModel,
    /// A join link per role.
    pub links: BTreeMap<String, String>,
}

/// The model that is served.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ListeningModel {
    /// Number of nodes.
    pub nodes: usize,
    /// Its hash, hexadecimal.
    pub hash: String,
    /// What a client downloads, in bytes.
    pub bytes: u64,
}

/// The last object of `host --json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct HostSummary {
    /// Ticks done.
    pub ticks: u64,
    /// How long they took.
    pub tick_ms: TickTimes,
    /// How long after their moments they began.
    pub late_ms: TickTimes,
    /// Ticks that found the tissue still at the last one.
    #[serde(default)]
    pub ticks_skipped: u64,
    /// How long cuts took to prepare, beside the ticks.
    #[serde(default)]
    pub cut_ms: TickTimes,
    /// Mean use of the processor over the session, by thread class.
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
    /// The artificial delay at the end, in ms.
    pub compensation_ms: f64,
    /// Datagrams that found their queue full.
    pub datagrams_skipped: u64,
    /// How often somebody became a spectator because of their network.
    pub demotions: u64,
    /// What came and was not taken.
    pub refused: Refused,
    /// Length of the session in s.
    pub seconds: f64,
    /// Why it ended.
    pub ended: String,
}

/// What came from all peers and was not taken, by reason; their sessions went on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// Who was not let in: without a grant, a seat, or a name of their own.
    pub joins: u64,
    /// Requests that came a second time over a new connection.
    pub repetitions: u64,
    /// Datagrams beyond the most that one peer may send.
    pub over_rate: u64,
    /// Datagrams that are none.
    pub malformed: u64,
    /// Datagrams of an earlier or unknown life of the session.
    pub other_epoch: u64,
    /// Datagrams of somebody else's connection, or of a kind that a server does not take.
    pub misdirected: u64,
    /// Datagrams that were seen before.
    pub duplicate: u64,
    /// Datagrams that came too late.
    pub old: u64,
    /// Datagrams before their sender was let in.
    pub early: u64,
    /// Datagrams that tell differences from what did not arrive.
    pub no_baseline: u64,
    /// Acknowledgements of what was never sent.
    pub false_acknowledgement: u64,
}

impl Refused {
    /// Adds what one peer's connection counted.
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

/// Says where the session can be joined.
pub(super) fn announce(json: bool, listening: &Listening) -> Result<(), ServerError> {
    if json {
        return say(&serde_json::json!(listening).to_string());
    }
    let mut text = format!(
        "listening on {} with a model of {} nodes ({:.1} MB); end with Ctrl-C",
        listening.listening,
        listening.model.nodes,
        listening.model.bytes as f64 / 1e6
    );
    for (role, link) in &listening.links {
        // Writing to a string can not fail.
        let _ = write!(text, "\n{role:>11}  {link}");
    }
    say(&text)
}

/// Says how it went.
pub(super) fn finish(json: bool, s: &HostSummary) -> Result<(), ServerError> {
    if json {
        return say(&serde_json::json!(s).to_string());
    }
    say(&format!(
        "{} after {:.1} s: {} participants, {} operations with {} cuts; {} ticks of \
         {:.1} ms (p99 {:.1}, period {:.1}); topology {} (version {}), {} piece(s); {}",
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
