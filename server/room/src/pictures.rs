//! Surface displacements for thin subscribers, computed once for all of them.
//!
//! Each [session](palpate_protocol::session::Picture) selects the nodes that it sends, because it knows
//! acknowledgements and byte budget.

use std::sync::Arc;

use palpate_protocol::{ServerTime, Span};
use palpate_tissue::Topology;

/// Minimum time between two pictures: 60 per second look smooth, and more would share the same bit rate.
const PERIOD: Span = Span::from_micros(1_000_000 / 60);

/// Tolerance for early pictures: each tick of 60 Hz, with rounding and jitter, yields one picture.
const EARLY: Span = Span::from_millis(4);

/// See the module.
#[derive(Debug, Default)]
pub(crate) struct Pictures {
    /// The surface nodes and their topology version.
    nodes: Option<(u32, Arc<[u32]>)>,
    next: ServerTime,
}

impl Pictures {
    /// The nodes of the next picture, ascending, if one is due: the outer surface, including cut faces.
    pub(crate) fn poll(&mut self, topology: &Topology, now: ServerTime) -> Option<Arc<[u32]>> {
        if now + EARLY < self.next {
            return None;
        }
        // The due times form a fixed raster, so early pictures do not raise the rate. A missed picture restarts it.
        self.next = (self.next + PERIOD).max(now + PERIOD - EARLY);
        let version = topology.version();
        if self.nodes.as_ref().is_none_or(|(v, _)| *v != version) {
            self.nodes = Some((version, nodes_in_view(topology)));
        }
        let (_, nodes) = self.nodes.as_ref()?;
        Some(Arc::clone(nodes))
    }
}

fn nodes_in_view(topology: &Topology) -> Arc<[u32]> {
    let triangles = &topology.boundary().triangles;
    let mut nodes: Vec<u32> = triangles.iter().flatten().copied().collect();
    nodes.sort_unstable();
    nodes.dedup();
    nodes.into()
}
