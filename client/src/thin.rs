//! The tissue as a thin subscriber shows it: nothing is computed here, the server says where its surface is.
//!
//! ```text
//! waiting  what arrived, until its moment is shown: so pictures that came early or late follow each other as
//!          they were, and what is not lost is shown at the moment that it is of
//! told     by node: the newest of it, its moment and its topology
//! shown    what was told, of nodes that the own topology has; a node that a cut has doubled is shown where
//!          the one is that it came from, until it is told of itself
//! lag      how far the pictures are behind the common moment s: the way from the server to here
//! ```
//!
//! Tools are shown `lag` before s, so that they touch the tissue that is shown with them. A cut is applied
//! when it arrives: the pictures that follow it are of the cut tissue. Pure: no thread, no clock.

use std::collections::VecDeque;

use palpate_protocol::datagram::Displacements;
use palpate_protocol::{ServerTime, Span};
use palpate_tissue::{CutOutcome, Shape, Topology, Vec3};

/// How fast the lag comes down again after a late picture: by 1/256 of the difference per piece, some
/// 2 s at 120 pieces a second. It goes up at once.
const LAG_FORGETS: i64 = 256;

/// A lag beyond this is not waited for: the tools would be shown as if they stood still.
const LAG_MAX: Span = Span::from_millis(1000);

/// Pieces of pictures that wait for their moment: the longest lag of them, two a frame at 60 Hz, and as
/// many again. Beyond, the oldest is shown early.
const WAITING_MAX: usize = 256;

/// A node has at most as many doubles as cells around it.
const CORNERS: usize = 8;

/// What a thin view counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ThinCounters {
    /// Nodes told, each time counted.
    pub told: u64,
    /// Nodes that were told late, after something newer of them.
    pub late: u64,
    /// Nodes that no topology of this model can have.
    pub unknown: u64,
    /// Nodes that wait at the server for room, as of the newest picture.
    pub waiting: u32,
    /// The most that ever waited.
    pub waiting_max: u32,
}

#[derive(Debug, Clone, Copy)]
struct Told {
    at: ServerTime,
    topology_version: u32,
    displacement: Vec3,
}

/// What is shown.
///
/// Calling order: [`tell`](Self::tell) as displacements come, [`follow`](Self::follow) every cut in the
/// order of the log, [`advance`](Self::advance) to each moment that is shown.
#[derive(Debug)]
pub struct ThinView {
    topology_version: u32,
    shape: Shape,
    /// What arrived and is not shown yet, by its moment, oldest first.
    waiting: VecDeque<Displacements>,
    /// By node number, as far as anything was told.
    told: Vec<Option<Told>>,
    /// Nodes that the model can have at most, however it is cut.
    nodes_max: usize,
    newest: Option<ServerTime>,
    lag: Span,
    counters: ThinCounters,
}

impl ThinView {
    /// The undeformed tissue.
    pub fn new(topology: &Topology) -> Self {
        Self {
            topology_version: topology.version(),
            shape: Shape::rest(topology),
            waiting: VecDeque::new(),
            told: Vec::new(),
            nodes_max: CORNERS * topology.cell_count(),
            newest: None,
            lag: Span::ZERO,
            counters: ThinCounters::default(),
        }
    }

    /// What the server says; `s` is the common moment when it arrived, if that is known.
    pub fn tell(&mut self, news: Displacements, s: Option<ServerTime>) {
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

    /// Comes to the moment that is shown next.
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
            let told = Told {
                at: news.view_time,
                topology_version: news.topology_version,
                displacement: Vec3::from(displacement.map(f64::from)),
            };
            self.tell_node(*node as usize, told);
        }
    }

    fn tell_node(&mut self, node: usize, told: Told) {
        if node >= self.nodes_max {
            self.counters.unknown += 1;
            return;
        }
        self.counters.told += 1;
        if self.told.len() <= node {
            self.told.resize(node + 1, None);
        }
        if self.told[node].is_some_and(|before| before.at > told.at) {
            self.counters.late += 1;
            return;
        }
        self.told[node] = Some(told);
        self.show(node);
    }

    /// Shows what was told of a node, if it is of this topology or of one before: numbers stay what they
    /// are, so what was said before a cut is true after it.
    fn show(&mut self, node: usize) {
        let told = self.told.get(node).copied().flatten();
        let told = told.filter(|t| t.topology_version <= self.topology_version);
        if let Some((told, shown)) = told.zip(self.shape.displacement.get_mut(node)) {
            *shown = told.displacement;
        }
    }

    fn note_lag(&mut self, behind: Span) {
        let behind = behind.clamp(Span::ZERO, LAG_MAX);
        let less = Span::from_micros((self.lag - behind).as_micros() / LAG_FORGETS);
        self.lag = behind.max(self.lag - less);
    }

    /// Takes a cut over. Where rest positions moved, the displacements of before stay until others are
    /// told: what is shown of a node is always something that the server said.
    pub fn follow(&mut self, topology: &Topology, outcome: &CutOutcome) {
        self.topology_version = topology.version();
        let shown = &mut self.shape.displacement;
        for (_, from) in &outcome.doubled {
            shown.push(shown[*from as usize]);
        }
        for node in 0..shown.len() {
            self.show(node);
        }
    }

    /// The shape that is shown.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// How far it is behind the common moment.
    pub fn lag(&self) -> Span {
        self.lag
    }

    /// What was counted.
    pub fn counters(&self) -> ThinCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests;
