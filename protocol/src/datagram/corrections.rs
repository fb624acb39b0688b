//! Node displacements, for comparison and for display. The bytes are in [`super::shape`].

use super::shape::PIECE_NODES;
use crate::ServerTime;

/// Displacements of some nodes of the tissue, in steps of 0.01 mm.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Corrections {
    /// The topology that the node numbers belong to.
    pub topology_version: u32,
    /// The moment that the displacements are for.
    pub view_time: ServerTime,
    /// Node and displacement from its rest position in metres; nodes ascend.
    pub nodes: Vec<(u32, [f32; 3])>,
}

impl Corrections {
    /// Divides a list of any length into pieces for a datagram each. Nodes must ascend.
    pub fn pieces(
        topology_version: u32,
        view_time: ServerTime,
        nodes: &[(u32, [f32; 3])],
    ) -> Vec<Self> {
        let piece = |nodes: &[(u32, [f32; 3])]| Self {
            topology_version,
            view_time,
            nodes: nodes.to_vec(),
        };
        nodes.chunks(PIECE_NODES).map(piece).collect()
    }
}

/// The displacements of the nodes in view, for a client without its own tissue.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Displacements {
    /// Step of the displacements in micrometres, up to [`super::shape::STEP_MAX_UM`]; 50 looks smooth.
    pub step_um: u16,
    /// The topology that the node numbers belong to.
    pub topology_version: u32,
    /// The moment that they are for.
    pub view_time: ServerTime,
    /// Nodes in view whose error exceeds a step at that moment and that did not fit into the rate.
    pub waiting: u32,
    /// Node and displacement from its rest position in metres; nodes ascend.
    pub nodes: Vec<(u32, [f32; 3])>,
}

impl Displacements {
    /// Divides a list of any length into pieces for a datagram each. Nodes must ascend.
    #[must_use]
    pub fn pieces(&self) -> Vec<Self> {
        let piece = |nodes: &[(u32, [f32; 3])]| Self {
            nodes: nodes.to_vec(),
            ..*self
        };
        self.nodes.chunks(PIECE_NODES).map(piece).collect()
    }
}
