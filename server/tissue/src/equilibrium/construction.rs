//! Data of a hierarchy that only its changes need, derived from it.

use std::collections::BTreeSet;

use super::brick::{Brick, CORNER};
use super::coarsen::place;
use super::hierarchy::{Hierarchy, Table, parts_over_bricks, parts_over_children, place_of};
use super::kinds::Kinds;
use super::quad::{ROOM, move_to_room, reserve, trim};
use crate::Topology;
use crate::cell::NO_CELL;

/// Places of the elements of one level.
#[derive(Clone, Default)]
pub(super) struct Places {
    /// Lattice coordinates of each element, in units of its own side.
    pub(super) of: Vec<[i32; 3]>,
    sorted: BTreeSet<([i32; 3], u32)>,
}

impl Places {
    fn new(mut of: Vec<[i32; 3]>) -> Self {
        reserve(&mut of);
        let sorted = of.iter().copied().zip(0..).collect();
        Self { of, sorted }
    }

    /// Adds an element.
    pub(super) fn push(&mut self, at: [i32; 3]) {
        self.sorted.insert((at, self.of.len() as u32));
        self.of.push(at);
    }

    /// Removes the elements from `count` on.
    pub(super) fn truncate(&mut self, count: usize) {
        for (&at, element) in self.of[count..].iter().zip(count as u32..) {
            self.sorted.remove(&(at, element));
        }
        trim(&mut self.of, count);
        move_to_room(&mut self.of, count + count / ROOM);
    }

    /// The elements at a place, ascending.
    pub(super) fn at(&self, at: [i32; 3]) -> impl Iterator<Item = u32> + '_ {
        self.sorted.range((at, 0)..=(at, u32::MAX)).map(|e| e.1)
    }
}

/// See the module.
#[derive(Clone)]
pub(super) struct Construction {
    pub(super) kinds: Kinds,
    /// Cells of each element of level 1, ascending.
    pub(super) cells: Table,
    /// Element of level 1 of each cell.
    pub(super) element_of: Vec<u32>,
    /// Places of the elements of each level.
    pub(super) places: Vec<Places>,
}

impl Construction {
    pub(super) fn of(topology: &Topology, hierarchy: &Hierarchy) -> Self {
        let bricks_of = |e: u32| {
            let children = hierarchy.levels[0].children.row(e).iter();
            children.map(|&brick| &hierarchy.bricks[brick as usize])
        };
        let first = 0..hierarchy.levels[0].corners.len() as u32;
        let cells: Vec<Vec<u32>> = first
            .clone()
            .map(|e| {
                let cells = bricks_of(e).flat_map(|brick| cells_of(topology, brick));
                cells.collect::<BTreeSet<u32>>().into_iter().collect()
            })
            .collect();
        let mut kinds = Kinds::of_bricks(&hierarchy.forms, &hierarchy.bricks);
        let mut at: Vec<[i32; 3]> = cells
            .iter()
            .map(|cells| place(place_of(topology, cells[0])))
            .collect();
        let mut places = Vec::new();
        let mut parts: Vec<_> = first
            .map(|e| parts_over_bricks(topology, bricks_of(e)))
            .collect();
        for (l, level) in hierarchy.levels.iter().enumerate() {
            kinds.add_level(&level.matrices, &level.matrix, &parts);
            parts = Vec::new();
            let mut above = Vec::new();
            if let Some(next) = hierarchy.levels.get(l + 1) {
                for e in 0..next.corners.len() as u32 {
                    let children = next.children.row(e);
                    parts.push(parts_over_children(level, children));
                    above.push(place(at[children[0] as usize]));
                }
            }
            places.push(Places::new(std::mem::replace(&mut at, above)));
        }
        let pairs = cells.iter().zip(0..);
        let pairs = pairs.flat_map(|(cells, e)| cells.iter().map(move |&c| (e, c)));
        let mut element_of = vec![0; topology.cell_count()];
        for (e, cell) in pairs.clone() {
            element_of[cell as usize] = e;
        }
        let mut cells = Table::new(cells.len(), pairs);
        cells.reserve();
        Self {
            kinds,
            cells,
            element_of,
            places,
        }
    }

    /// Sets the cells of an element of level 1, which may be new.
    pub(super) fn set_cells(&mut self, element: u32, cells: &[u32]) {
        self.cells.set(element, cells);
        for &cell in cells {
            self.element_of[cell as usize] = element;
        }
    }
}

/// The cells of a topology all of whose corners are those of a brick at some position.
fn cells_of<'a>(topology: &'a Topology, brick: &'a Brick) -> impl Iterator<Item = u32> + 'a {
    CORNER.iter().filter_map(|entries| {
        let is_present = entries.iter().all(|&i| brick.present >> i & 1 == 1);
        let nodes = entries.map(|i| brick.nodes[i]);
        let cell = topology.cells_around(nodes[0])[0];
        (is_present && cell != NO_CELL && topology.corners(cell) == nodes).then_some(cell)
    })
}
