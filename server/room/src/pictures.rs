//! The pictures that thin subscribers are sent: where the surface is, made once for all of them.
//!
//! What of a picture is told to whom, and when, is each [session's](palpate_protocol::session::Picture)
//! business: only that knows what has arrived and what there is room for.

use std::sync::Arc;

use palpate_protocol::{ServerTime, Span};
use palpate_tissue::Topology;

/// Between two pictures at least: 60 a second look smooth, and more would share the same rate.
const PERIOD: Span = Span::from_micros(1_000_000 / 60);

/// How much earlier than that a picture may leave, so that ticks of 60 Hz, which are rounded to
/// microseconds and come a little early or late, are each worth one.
const EARLY: Span = Span::from_millis(4);

/// See the module.
#[derive(Debug, Default)]
pub(crate) struct Pictures {
    /// The nodes in view, and the topology version that they are of.
    nodes: Option<(u32, Arc<[u32]>)>,
    next: ServerTime,
}

impl Pictures {
    /// The nodes of the next picture, ascending, if one is due: those of the outer surface, cuts included.
    pub(crate) fn poll(&mut self, topology: &Topology, now: ServerTime) -> Option<Arc<[u32]>> {
        if now + EARLY < self.next {
            return None;
        }
        // On a raster of its own, unless it was missed: early ones do not add up to more of them.
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
