//! View of a thin subscriber: nothing is computed here; the server sends surface displacements.
//!
//! ```text
//! waiting  displacements, until their time is displayed (jitter buffer): early and late ones
//!          keep their order, and each is displayed at its own time
//! received per node: newest displacement, its time and its topology version
//! shown    displacements of nodes of the own topology; a node doubled by a cut
//!          uses its origin's displacement until its own arrives
//! lag      delay of the displacements behind the common time s: the downlink delay
//! ```
//!
//! Tools are displayed `lag` before s, so that they touch the displayed tissue. A cut is applied on arrival, because
//! later displacements refer to the cut tissue. Pure: no thread, no clock.

use std::collections::VecDeque;

use palpate_protocol::datagram::Displacements;
use palpate_protocol::{ServerTime, Span};
use palpate_tissue::{CutOutcome, Shape, Topology, Vec3};

/// Decay of the lag after a late datagram: 1/256 of the difference per datagram, about 2 s at 120 datagrams per
/// second. It rises at once.
const LAG_FORGETS: i64 = 256;

/// Maximum lag: beyond it tools would appear to stand still.
const LAG_MAX: Span = Span::from_millis(1000);

/// Capacity of the jitter buffer: maximum lag at two datagrams per frame and 60 Hz, doubled. Beyond it the oldest is
/// displayed early.
const WAITING_MAX: usize = 256;

/// Maximum number of copies of a node: one per adjacent cell.
const CORNERS: usize = 8;

/// Counters of a thin view.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ThinCounters {
    /// Received node displacements.
    pub received: u64,
    /// Displacements that arrived after a newer one of the same node.
    pub late: u64,
    /// Node numbers that no topology of this model can have.
    pub unknown: u64,
    /// Nodes queued at the server, as of the newest datagram.
    pub waiting: u32,
    /// Maximum of `waiting`.
    pub waiting_max: u32,
}

#[derive(Debug, Clone, Copy)]
struct Received {
    at: ServerTime,
    topology_version: u32,
    displacement: Vec3,
}

/// The view of a thin subscriber. Calling order: [`receive`](Self::receive) for displacements on arrival,
/// [`follow`](Self::follow) for every cut in log order, [`advance`](Self::advance) to each displayed time.
#[derive(Debug)]
pub struct ThinView {
    topology_version: u32,
    shape: Shape,
    /// Received displacements that are not displayed yet, by time, oldest first.
    waiting: VecDeque<Displacements>,
    /// Newest displacement by node number.
    received: Vec<Option<Received>>,
    /// Maximum number of nodes of the model, however it is cut.
    nodes_max: usize,
    newest: Option<ServerTime>,
    lag: Span,
    counters: ThinCounters,
    /// Versions that returned to fewer nodes, and that number of nodes: displacements of further nodes from before
    /// belong to nodes that are gone. The latest ones.
    returns: VecDeque<(u32, usize)>,
}

/// Returns to fewer cuts that are remembered: displacements from before them arrive within seconds.
const RETURNS_MAX: usize = 16;

impl ThinView {
    /// The undeformed tissue.
    pub fn new(topology: &Topology) -> Self {
        Self {
            topology_version: topology.version(),
            shape: Shape::rest(topology),
            waiting: VecDeque::new(),
            received: Vec::new(),
            nodes_max: CORNERS * topology.cell_count(),
            newest: None,
            lag: Span::ZERO,
            counters: ThinCounters::default(),
            returns: VecDeque::new(),
        }
    }

    /// Receives displacements; `s` is the common time of arrival, if known.
    pub fn receive(&mut self, news: Displacements, s: Option<ServerTime>) {
        if self.newest.is_none_or(|newest| news.view_time >= newest) {
            self.newest = Some(news.view_time);
            self.counters.waiting = news.waiting;
            self.counters.waiting_max = self.counters.waiting_max.max(news.waiting);
        }
        if let Some(s) = s {
            self.note_lag(s - news.view_time);
        }
        let at = self
            .waiting
            .partition_point(|w| w.view_time <= news.view_time);
        self.waiting.insert(at, news);
        if self.waiting.len() > WAITING_MAX {
            self.take_first();
        }
    }

    /// Advances to the next displayed time.
    pub fn advance(&mut self, shown: ServerTime) {
        while self.waiting.front().is_some_and(|w| w.view_time <= shown) {
            self.take_first();
        }
    }

    fn take_first(&mut self) {
        let Some(news) = self.waiting.pop_front() else {
            return;
        };
        for (node, displacement) in &news.nodes {
            let received = Received {
                at: news.view_time,
                topology_version: news.topology_version,
                displacement: Vec3::from(displacement.map(f64::from)),
            };
            self.receive_node(*node as usize, received);
        }
    }

    fn receive_node(&mut self, node: usize, received: Received) {
        if node >= self.nodes_max {
            self.counters.unknown += 1;
            return;
        }
        let is_gone =
            |&(version, nodes): &(u32, usize)| received.topology_version < version && node >= nodes;
        if self.returns.iter().any(is_gone) {
            return;
        }
        self.counters.received += 1;
        if self.received.len() <= node {
            self.received.resize(node + 1, None);
        }
        if self.received[node].is_some_and(|before| before.at > received.at) {
            self.counters.late += 1;
            return;
        }
        self.received[node] = Some(received);
        self.show(node);
    }

    /// Displays the newest displacement of a node, if its topology is not newer than this one. Cuts keep node
    /// numbers, so older displacements stay valid.
    fn show(&mut self, node: usize) {
        let received = self.received.get(node).copied().flatten();
        let received = received.filter(|t| t.topology_version <= self.topology_version);
        if let Some((received, shown)) = received.zip(self.shape.displacement.get_mut(node)) {
            *shown = received.displacement;
        }
    }

    fn note_lag(&mut self, behind: Span) {
        let behind = behind.clamp(Span::ZERO, LAG_MAX);
        let less = Span::from_micros((self.lag - behind).as_micros() / LAG_FORGETS);
        self.lag = behind.max(self.lag - less);
    }

    /// Adopts a cut. Nodes whose rest positions moved keep their displacements until new ones arrive: every displayed
    /// value comes from the server.
    pub fn follow(&mut self, topology: &Topology, outcome: &CutOutcome) {
        self.topology_version = topology.version();
        let shown = &mut self.shape.displacement;
        if outcome.is_return() {
            let nodes = topology.node_count() - outcome.doubled.len();
            shown.truncate(nodes);
            self.received.truncate(nodes);
            if self.returns.len() == RETURNS_MAX {
                self.returns.pop_front();
            }
            self.returns.push_back((topology.version(), nodes));
        }
        for (_, from) in &outcome.doubled {
            shown.push(shown[*from as usize]);
        }
        for node in 0..shown.len() {
            self.show(node);
        }
    }

    /// Adopts the topology of a snapshot. Displacements that came before it are kept: the server sends no node again that
    /// has not moved since.
    pub(crate) fn restore(&mut self, topology: &Topology) {
        self.topology_version = topology.version();
        self.shape = Shape::rest(topology);
        for node in 0..self.shape.displacement.len() {
            self.show(node);
        }
    }

    /// The displayed shape.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Delay behind the common time.
    pub fn lag(&self) -> Span {
        self.lag
    }

    /// The counters.
    pub fn counters(&self) -> ThinCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests;
