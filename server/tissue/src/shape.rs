//! The deformed shape: one displacement per node.

use crate::equilibrium::laid_out;
use crate::{Topology, Vec3};

/// Displacements from the rest positions of a [`Topology`]. Several shapes of one topology may exist at once:
/// one for haptic rendering, one at the shared time for display.
#[derive(Debug, Clone, PartialEq)]
pub struct Shape {
    /// Displacement of each node in m.
    pub displacement: Vec<Vec3>,
}

impl Shape {
    /// The undeformed shape.
    pub fn rest(topology: &Topology) -> Self {
        Self {
            displacement: laid_out(Vec3::zeros(), topology.node_count()),
        }
    }

    /// Current position of a node in m.
    pub fn position(&self, topology: &Topology, node: u32) -> Vec3 {
        topology.rest(node) + self.displacement[node as usize]
    }

    /// Hash of every bit of the displacements.
    pub fn hash(&self) -> u64 {
        let mut hasher = xxhash_rust::xxh3::Xxh3::new();
        for d in &self.displacement {
            for v in d.iter() {
                hasher.update(&v.to_bits().to_le_bytes());
            }
        }
        hasher.digest()
    }
}
