//! Spatial index of cells, so that a cut visits only its neighbourhood.
//!
//! Cells are stored by the bucket of their centre in the model as built. Cuts move nodes by less than
//! [`super::DRIFT_MAX`] spacings in total, so the buckets never change; searches are widened by that bound.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use crate::cell::NO_CELL;
use crate::{FaceId, Model, Topology, Vec3};

/// Side of a bucket in spacings: 64 cells in each.
pub(crate) const BUCKET: f64 = 4.0;

/// Number of a bucket along each axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Key([i32; 3]);

impl Key {
    pub(crate) fn of(p: &Vec3, side: f64) -> Self {
        Self(std::array::from_fn(|a| (p[a] / side).floor() as i32))
    }
}

/// All buckets within `reach` spacings of a triangle (and some more), sorted.
pub(crate) fn keys_of_triangle(points: &[Vec3; 3], spacing: f64, reach: f64) -> Vec<Key> {
    let [a, b, c] = points;
    // Steps of half a bucket; a point of the triangle is then within one step of a sample.
    let step = BUCKET * spacing / 2.0;
    let count = |edge: Vec3| (edge.norm() / step).ceil().max(1.0) as usize;
    let (across, along) = (count(b - a), count(c - a));
    let around = Vec3::repeat((reach + BUCKET / 2.0) * spacing);
    let side = BUCKET * spacing;
    let mut keys = Vec::new();
    let mut tidy_at = 1 << 16;
    for i in 0..=across {
        for j in (0..=along).take_while(|j| i * along + j * across <= across * along) {
            let p = a + (b - a) * (i as f64 / across as f64) + (c - a) * (j as f64 / along as f64);
            let (low, high) = (Key::of(&(p - around), side), Key::of(&(p + around), side));
            for x in low.0[0]..=high.0[0] {
                for y in low.0[1]..=high.0[1] {
                    keys.extend((low.0[2]..=high.0[2]).map(|z| Key([x, y, z])));
                }
            }
        }
        if keys.len() > tidy_at {
            keys.sort_unstable();
            keys.dedup();
            tidy_at = tidy_at.max(2 * keys.len());
        }
    }
    keys.sort_unstable();
    keys.dedup();
    keys
}

/// The cells of a model by bucket.
#[derive(Debug)]
pub(crate) struct CellIndex {
    side: f64,
    entries: Vec<(Key, u32)>,
}

impl CellIndex {
    fn new(model: &Model) -> Self {
        let side = BUCKET * model.spacing_m;
        let mut entries: Vec<(Key, u32)> = (0..model.cells.len())
            .map(|cell| (Key::of(&centre(&model.corners_of(cell)), side), cell as u32))
            .collect();
        entries.sort_unstable();
        Self { side, entries }
    }

    /// The cells in a bucket.
    pub(crate) fn cells(&self, key: Key) -> impl Iterator<Item = u32> + '_ {
        let start = self.entries.partition_point(|e| e.0 < key);
        self.entries[start..]
            .iter()
            .take_while(move |e| e.0 == key)
            .map(|e| e.1)
    }

    /// The cells in the 27 buckets around a point.
    pub(crate) fn cells_near(&self, p: &Vec3) -> impl Iterator<Item = u32> + '_ {
        let Key([x, y, z]) = Key::of(p, self.side);
        (0..27).flat_map(move |i| {
            let near = |v: i32, step: i32| v.saturating_add(step - 1);
            self.cells(Key([near(x, i % 3), near(y, i / 3 % 3), near(z, i / 9)]))
        })
    }
}

/// Mean of a cell's corners.
pub(crate) fn centre(corners: &[Vec3; 8]) -> Vec3 {
    corners.iter().sum::<Vec3>() / 8.0
}

/// Derived data that make cuts cheap; not part of the state.
#[derive(Debug, Clone, Default)]
pub(crate) struct CutIndex {
    cells: OnceLock<Arc<CellIndex>>,
    /// Position in the boundary of each face laid open by a cut.
    pub(crate) opened: BTreeMap<FaceId, u32>,
}

impl Topology {
    /// The cell index; built at first use and shared by all later copies.
    pub(crate) fn cell_index(&self) -> Arc<CellIndex> {
        let build = || Arc::new(CellIndex::new(&self.model));
        Arc::clone(self.cut_index.cells.get_or_init(build))
    }

    /// Positions in the boundary of the exposed faces at a node.
    pub(crate) fn exposed_faces(&self, node: u32) -> impl Iterator<Item = usize> + '_ {
        let cells = self.cells_around(node).into_iter().enumerate();
        let faces = cells.filter(|c| c.1 != NO_CELL).flat_map(|(slot, cell)| {
            (0..3).map(move |axis| FaceId::new(cell, 2 * axis + (slot >> axis & 1)))
        });
        let exposed = faces.filter(|&face| self.across(face) == NO_CELL);
        exposed.filter_map(|face| self.boundary_position(face))
    }

    pub(crate) fn boundary_position(&self, face: FaceId) -> Option<usize> {
        if let Some(&position) = self.cut_index.opened.get(&face) {
            return Some(position as usize);
        }
        // Those of the model as built are in order.
        let built = self.boundary().faces.len() - self.cut_index.opened.len();
        self.boundary().faces[..built].binary_search(&face).ok()
    }

    /// Centre of a cell at rest.
    pub(crate) fn centre(&self, cell: u32) -> Vec3 {
        centre(&self.corners(cell).map(|n| self.rest(n)))
    }
}
