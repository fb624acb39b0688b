//! Connected components of the cells after a cut.

use std::collections::BTreeMap;

use crate::cell::NO_CELL;
use crate::{FaceId, Topology};

impl Topology {
    /// Volume in m³ of each connected component of the cells, where one passes from cell to cell
    /// through faces that are not cut; in the order of their first cells. Visits every cell.
    pub fn component_volumes(&self) -> Vec<f64> {
        let mut seen = vec![false; self.cell_count()];
        let mut volumes = Vec::new();
        let mut stack = Vec::new();
        for start in 0..self.cell_count() as u32 {
            if seen[start as usize] {
                continue;
            }
            seen[start as usize] = true;
            stack.push(start);
            let mut volume = 0.0;
            while let Some(cell) = stack.pop() {
                volume += self.volume(cell);
                for face in 0..6 {
                    let next = self.across(FaceId::new(cell, face));
                    if next != NO_CELL && !seen[next as usize] {
                        seen[next as usize] = true;
                        stack.push(next);
                    }
                }
            }
            volumes.push(volume);
        }
        volumes
    }

    /// Number of connected components of the cells. Visits every cell.
    pub fn components(&self) -> usize {
        self.component_volumes().len()
    }

    /// Number of connected components of the cells around some nodes, passing only among these.
    pub(crate) fn components_among(&self, nodes: &[u32]) -> usize {
        let around = |n: &u32| self.node_cells[*n as usize];
        let mut seen: BTreeMap<u32, bool> = nodes
            .iter()
            .flat_map(around)
            .filter(|&c| c != NO_CELL)
            .map(|c| (c, false))
            .collect();
        let cells: Vec<u32> = seen.keys().copied().collect();
        let mut count = 0;
        for start in cells {
            let mut stack = vec![start];
            let mut fresh = false;
            while let Some(cell) = stack.pop() {
                if let Some(visited) = seen.get_mut(&cell)
                    && !*visited
                {
                    *visited = true;
                    fresh = true;
                    stack.extend((0..6).map(|f| self.across(FaceId::new(cell, f))));
                }
            }
            count += usize::from(fresh);
        }
        count
    }
}
