//! Numbers of the items of a hierarchy.

use super::hierarchy::{Hierarchy, Level};
use super::quad::trim;

/// Numbers of items of a level.
#[derive(Clone, Default)]
pub(super) struct LevelSizes {
    pub(super) elements: usize,
    pub(super) points: usize,
    pub(super) matrices: usize,
}

/// Numbers of items of a hierarchy.
#[derive(Clone, Default)]
pub(super) struct Sizes {
    pub(super) nodes: usize,
    pub(super) bricks: usize,
    pub(super) forms: usize,
    pub(super) levels: Vec<LevelSizes>,
}

impl Hierarchy {
    /// Numbers of its items.
    pub(super) fn sizes(&self) -> Sizes {
        let of_level = |level: &Level| LevelSizes {
            elements: level.corners.len(),
            points: level.points(),
            matrices: level.matrices.len(),
        };
        Sizes {
            nodes: self.prolongation.len(),
            bricks: self.bricks.len(),
            forms: self.forms.len(),
            levels: self.levels.iter().map(of_level).collect(),
        }
    }

    /// Removes the items from these sizes on.
    pub(super) fn truncate(&mut self, keeps: &Sizes) {
        let gone = keeps.nodes as u32..self.prolongation.len() as u32;
        for node in gone {
            if let Some(element) = self.prolongation.element_of(node as usize) {
                let mut row = self.nodes_of.row(element).to_vec();
                row.retain(|n| *n != node);
                self.nodes_of.set(element, &row);
            }
        }
        trim(&mut self.bricks, keeps.bricks);
        trim(&mut self.element_of, keeps.bricks);
        trim(&mut self.forms, keeps.forms);
        trim(&mut self.shared, keeps.forms);
        self.around.truncate(keeps.nodes);
        self.nodes_of.truncate(keeps.levels[0].elements);
        self.prolongation
            .truncate(keeps.nodes, keeps.levels[0].elements);
        for (l, (level, keeps_here)) in self.levels.iter_mut().zip(&keeps.levels).enumerate() {
            trim(&mut level.corners, keeps_here.elements);
            trim(&mut level.matrix, keeps_here.elements);
            trim(&mut level.matrices, keeps_here.matrices);
            level.children.truncate(keeps_here.elements);
            trim(&mut level.parent, keeps_here.elements);
            trim(&mut level.octant, keeps_here.elements);
            level.around.truncate(keeps_here.points);
            trim(&mut level.bound, keeps_here.points);
            let above = keeps.levels.get(l + 1).map_or(0, |above| above.elements);
            level.prolongation.truncate(keeps_here.points, above);
        }
    }
}
