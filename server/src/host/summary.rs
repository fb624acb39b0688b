//! What a host prints: first where it listens, last how it went.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

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
    /// Length of the session in s.
    pub seconds: f64,
    /// Why it ended.
    pub ended: String,
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
#[allow(clippy::print_stdout)]
pub(super) fn announce(json: bool, listening: &Listening) {
    if json {
        println!("{}", serde_json::json!(listening));
    } else {
        println!(
            "listening on {} with a model of {} nodes ({:.1} MB); end with Ctrl-C",
            listening.listening,
            listening.model.nodes,
            listening.model.bytes as f64 / 1e6
        );
        for (role, link) in &listening.links {
            println!("{role:>11}  {link}");
        }
    }
    // Who started us waits for this line.
    let _ = std::io::stdout().flush();
}

/// Says how it went.
#[allow(clippy::print_stdout)]
pub(super) fn finish(json: bool, s: &HostSummary) {
    if json {
        println!("{}", serde_json::json!(s));
    } else {
        println!(
            "{} after {:.1} s: {} participants, {} operations with {} cuts; {} ticks of \
             {:.1} ms (p99 {:.1}, period {:.1}); topology {} (version {}), {} piece(s)",
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
            s.components
        );
    }
    let _ = std::io::stdout().flush();
}
