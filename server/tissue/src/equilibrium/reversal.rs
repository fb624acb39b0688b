//! The way back from a change of a hierarchy: the former values of all that it set.
//!
//! A cut only appends items and sets some of the known ones, so removing the appended ones and setting the others again
//! gives the former hierarchy with its numbers.

use rayon::prelude::*;

use super::construction::Construction;
use super::fine_level::own_stiffness;
use super::hierarchy::{Hierarchy, Level, parts_over_bricks, parts_over_children};
use super::hierarchy_change::{HierarchyChange, LevelChange};
use super::quad::overlaid;
use super::sizes::Sizes;
use crate::Topology;
use crate::contact::SurfaceChange;

/// See the module.
#[derive(Clone)]
pub(super) struct Reversal {
    /// Former values, but for those that follow from the topology.
    change: HierarchyChange,
    /// Former cells of elements of level 1.
    cells: Vec<(u32, Vec<u32>)>,
    /// Nodes whose rest position, springs or mass changed.
    touched: Vec<u32>,
}

impl Reversal {
    /// The way from this hierarchy to itself.
    pub(super) fn none(hierarchy: &Hierarchy) -> Self {
        Self::new(hierarchy, &[], false)
    }

    /// An empty way back to this hierarchy from a cut that is about to change it: the nodes that it touches, and whether it
    /// may separate components.
    pub(super) fn new(hierarchy: &Hierarchy, touched: &[u32], separates: bool) -> Self {
        let keeps = hierarchy.sizes();
        let known = |node: &u32| (*node as usize) < keeps.nodes;
        Self {
            cells: Vec::new(),
            touched: touched.iter().copied().filter(known).collect(),
            change: HierarchyChange {
                separates,
                levels: keeps
                    .levels
                    .iter()
                    .map(|_| LevelChange::default())
                    .collect(),
                keeps,
                ..HierarchyChange::default()
            },
        }
    }

    fn keeps(&self) -> &Sizes {
        &self.change.keeps
    }

    /// Notes the cells of an element.
    pub(super) fn note_cells(&mut self, construction: &Construction, element: u32) {
        if (element as usize) < self.keeps().levels[0].elements {
            let cells = construction.cells.row(element).to_vec();
            self.cells.push((element, cells));
        }
    }

    /// Notes the bricks and forms that a change will set.
    pub(super) fn note_bricks(&mut self, hierarchy: &Hierarchy, change: &HierarchyChange) {
        let former = &mut self.change;
        let Sizes {
            nodes,
            bricks,
            forms,
            ..
        } = former.keeps;
        let known = |&(id, ..): &&(u32, _, u32)| (*id as usize) < bricks;
        let brick = |&(id, ..): &(u32, _, u32)| {
            let b = id as usize;
            (id, hierarchy.bricks[b], hierarchy.element_of[b])
        };
        former.bricks = change.bricks.iter().filter(known).map(brick).collect();
        let numbers = change.forms.iter().map(|f| f.0);
        let numbers = numbers.filter(|&f| (f as usize) < forms);
        former.forms = numbers
            .map(|f| (f, hierarchy.forms[f as usize].clone()))
            .collect();
        let numbers = change.shared.iter().map(|f| f.0);
        let numbers = numbers.filter(|&f| (f as usize) < forms);
        former.shared = numbers.map(|f| (f, hierarchy.shared[f as usize])).collect();
        former.around = rows_of(&hierarchy.around, &change.around, nodes);
    }

    /// Notes the items of a level that a change will set, but for the bounds.
    pub(super) fn note_level(&mut self, hierarchy: &Hierarchy, l: usize, change: &LevelChange) {
        let level = &hierarchy.levels[l];
        let sizes = &self.change.keeps.levels[l];
        let former = &mut self.change.levels[l];
        let known = |&id: &u32| (id as usize) < sizes.elements;
        let elements = change.corners.iter().map(|e| e.0).filter(known);
        former.corners = elements.map(|e| (e, level.corners[e as usize])).collect();
        let elements = change.matrix.iter().map(|e| e.0).filter(known);
        former.matrix = elements.map(|e| (e, level.matrix[e as usize])).collect();
        let numbers = change.matrices.iter().map(|m| m.0);
        let numbers = numbers.filter(|&m| (m as usize) < sizes.matrices);
        former.matrices = numbers
            .map(|m| (m, level.matrices[m as usize].clone()))
            .collect();
        former.children = rows_of(&level.children, &change.children, sizes.elements);
        former.around = rows_of(&level.around, &change.around, sizes.points);
        let prolongation = match l.checked_sub(1) {
            Some(below) => &hierarchy.levels[below].prolongation,
            None => &hierarchy.prolongation,
        };
        let points = change.entries.keys();
        let points = points.filter(|&&p| (p as usize) < prolongation.len());
        former.entries = points.map(|&p| (p, prolongation.entry(p))).collect();
    }

    /// Notes the bound of a point that a change will set.
    pub(super) fn note_bound(&mut self, level: &Level, l: usize, point: u32) {
        if (point as usize) < self.keeps().levels[l].points {
            let bound = level.bound[point as usize];
            self.change.levels[l].bounds.push((point, bound));
        }
    }

    /// This way back and then another, to a still earlier hierarchy.
    pub(super) fn then(self, earlier: Self) -> Self {
        let keeps = earlier.change.keeps.clone();
        let mut touched = self.touched;
        touched.extend_from_slice(&earlier.touched);
        touched.sort_unstable();
        touched.dedup();
        touched.retain(|n| (*n as usize) < keeps.nodes);
        let mut cells = overlaid(self.cells, earlier.cells);
        cells.retain(|e| (e.0 as usize) < keeps.levels[0].elements);
        Self {
            change: self.change.then(earlier.change),
            cells,
            touched,
        }
    }
}

/// The rows with these numbers, below `count`.
fn rows_of(
    table: &super::hierarchy::Table,
    changed: &[(u32, Vec<u32>)],
    count: usize,
) -> Vec<(u32, Vec<u32>)> {
    let known = changed.iter().filter(|row| (row.0 as usize) < count);
    known
        .map(|row| (row.0, table.row(row.0).to_vec()))
        .collect()
}

impl HierarchyChange {
    /// This change and a later one.
    pub(super) fn then(mut self, later: Self) -> Self {
        self.drop_beyond(&later.keeps);
        let bricks = |list: Vec<(u32, _, u32)>| -> Vec<(u32, _)> {
            list.into_iter().map(|(id, b, e)| (id, (b, e))).collect()
        };
        let all = overlaid(bricks(self.bricks), bricks(later.bricks));
        let levels = self.levels.into_iter().zip(later.levels);
        Self {
            bricks: all.into_iter().map(|(id, (b, e))| (id, b, e)).collect(),
            forms: overlaid(self.forms, later.forms),
            shared: overlaid(self.shared, later.shared),
            around: overlaid(self.around, later.around),
            own: overlaid(self.own, later.own),
            levels: levels.map(|(level, later)| level.then(later)).collect(),
            surface: self.surface.then(later.surface),
            separates: self.separates || later.separates,
            keeps: self.keeps,
            stays: self.stays.min(later.stays),
            outcomes: [self.outcomes, later.outcomes].concat(),
            weights: None,
        }
    }

    /// Drops the items that a later change removes.
    fn drop_beyond(&mut self, keeps: &Sizes) {
        self.bricks.retain(|b| (b.0 as usize) < keeps.bricks);
        drop_from(&mut self.forms, &mut self.keeps.forms, keeps.forms);
        self.shared.retain(|f| (f.0 as usize) < keeps.forms);
        drop_from(&mut self.around, &mut self.keeps.nodes, keeps.nodes);
        self.own.retain(|n| (n.0 as usize) < keeps.nodes);
        self.keeps.bricks = self.keeps.bricks.min(keeps.bricks);
        let mut finer = keeps.nodes;
        let own = self.keeps.levels.iter_mut().zip(&keeps.levels);
        for (level, (own, keeps)) in self.levels.iter_mut().zip(own) {
            level.entries.retain(|p, _| (*p as usize) < finer);
            finer = keeps.points;
            drop_from(&mut level.matrices, &mut own.matrices, keeps.matrices);
            drop_from(&mut level.around, &mut own.points, keeps.points);
            level.bounds.retain(|p| (p.0 as usize) < keeps.points);
            level.matrix.retain(|e| (e.0 as usize) < keeps.elements);
            level.children.retain(|e| (e.0 as usize) < keeps.elements);
            drop_from(&mut level.corners, &mut own.elements, keeps.elements);
        }
    }
}

/// Drops the items from `count` on, and lowers the size to it.
fn drop_from<T>(items: &mut Vec<(u32, T)>, size: &mut usize, count: usize) {
    items.retain(|item| (item.0 as usize) < count);
    *size = count.min(*size);
}

impl LevelChange {
    fn then(mut self, mut later: Self) -> Self {
        self.entries.append(&mut later.entries);
        Self {
            corners: overlaid(self.corners, later.corners),
            new: [&self.new[..], &later.new].concat(),
            children: overlaid(self.children, later.children),
            matrix: overlaid(self.matrix, later.matrix),
            matrices: overlaid(self.matrices, later.matrices),
            origins: [&self.origins[..], &later.origins].concat(),
            around: overlaid(self.around, later.around),
            bounds: overlaid(self.bounds, later.bounds),
            entries: self.entries,
        }
    }
}

impl Hierarchy {
    /// Goes a way back to the hierarchy of `topology`. Returns the change, for other hierarchies.
    pub(super) fn go_back(
        &mut self,
        construction: &mut Construction,
        topology: &Topology,
        way: Reversal,
    ) -> HierarchyChange {
        let Reversal {
            mut change,
            cells,
            touched,
        } = way;
        let kinds = &mut construction.kinds;
        let former = change.bricks.iter().map(|b| b.0);
        for brick in former.chain(change.keeps.bricks as u32..self.bricks.len() as u32) {
            kinds.release_form(self.bricks[brick as usize].form);
        }
        for (l, (level, keeps)) in change.levels.iter().zip(&change.keeps.levels).enumerate() {
            let matrix = &self.levels[l].matrix;
            let former = level.matrix.iter().map(|e| e.0);
            for element in former.chain(keeps.elements as u32..matrix.len() as u32) {
                kinds.levels[l].release(matrix[element as usize]);
            }
        }
        self.apply(&change);
        kinds.restore_forms(change.keeps.forms, &change.forms);
        for (_, brick, _) in &change.bricks {
            kinds.take_form_back(brick.form);
        }
        for (l, (level, keeps)) in change.levels.iter().zip(&change.keeps.levels).enumerate() {
            kinds.levels[l].restore(keeps.matrices, &level.matrices);
            for &(element, matrix) in &level.matrix {
                let children = self.levels[l].children.row(element);
                let parts = if l == 0 {
                    let bricks = children.iter().map(|&b| &self.bricks[b as usize]);
                    parts_over_bricks(topology, bricks)
                } else {
                    parts_over_children(&self.levels[l - 1], children)
                };
                kinds.levels[l].take_back(matrix, &parts);
            }
            construction.places[l].truncate(keeps.elements);
        }
        construction.cells.truncate(change.keeps.levels[0].elements);
        for (element, cells) in &cells {
            construction.set_cells(*element, cells);
        }
        let own = |&node: &u32| (node, own_stiffness(topology, node));
        change.own = touched.par_iter().map(own).collect();
        change.surface = SurfaceChange::of(topology, &touched);
        change.stays = change.keeps.nodes;
        change
    }
}
