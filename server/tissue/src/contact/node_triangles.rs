//! Triangles of the surface around each node.

use crate::Topology;

/// Triangles around every node, each list in the order of their numbers: 12 bytes per triangle and 4
/// per node.
#[derive(Clone)]
pub(crate) struct NodeTriangles {
    /// Start of each node's triangles, and the end of the last ones.
    starts: Vec<u32>,
    triangles: Vec<u32>,
}

impl NodeTriangles {
    pub(crate) fn new(topology: &Topology) -> Self {
        let all = &topology.boundary().triangles;
        let mut starts = vec![0; topology.node_count() + 1];
        for node in all.iter().flatten() {
            starts[*node as usize + 1] += 1;
        }
        for n in 1..starts.len() {
            starts[n] += starts[n - 1];
        }
        let mut ends = starts.clone();
        let mut triangles = vec![0; 3 * all.len()];
        for (t, nodes) in all.iter().enumerate() {
            for &node in nodes {
                let end = &mut ends[node as usize];
                triangles[*end as usize] = t as u32;
                *end += 1;
            }
        }
        Self { starts, triangles }
    }

    pub(crate) fn of(&self, node: u32) -> &[u32] {
        let n = node as usize;
        &self.triangles[self.starts[n] as usize..self.starts[n + 1] as usize]
    }

    #[cfg(test)]
    pub(super) fn heap_bytes(&self) -> usize {
        (self.starts.capacity() + self.triangles.capacity()) * size_of::<u32>()
    }
}
