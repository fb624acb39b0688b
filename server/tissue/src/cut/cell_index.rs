//! Spatial index of cells, so that a cut visits only its neighbourhood.
//!
//! Cells are stored by the bucket of their centre in the model as built. Cuts move nodes by less than
//! [`super::DRIFT_MAX`] spacings in total, so the buckets never change; searches are widened by that bound.

use std::cmp::Ordering;
use std::sync::{Arc, OnceLock};

use super::ribbon::Ribbon;
use crate::cell::NO_CELL;
use crate::pages::Pages;
use crate::{FaceId, Model, Topology, Vec3};

/// Side of a bucket in spacings: 64 cells in each.
const BUCKET: f64 = 4.0;

/// Number of a bucket along each axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Key([i32; 3]);

impl Key {
    fn of(p: &Vec3, side: f64) -> Self {
        Self(std::array::from_fn(|a| (p[a] / side).floor() as i32))
    }

    /// All buckets of a box, from its lowest to its highest.
    fn to(self, high: Self) -> impl Iterator<Item = Self> {
        let [x, y, z] = [0, 1, 2].map(|a| self.0[a]..=high.0[a]);
        x.flat_map(move |x| {
            let z = z.clone();
            y.clone()
                .flat_map(move |y| z.clone().map(move |z| Self([x, y, z])))
        })
    }

    /// The middle of the bucket.
    fn middle(self, side: f64) -> Vec3 {
        Vec3::from(self.0.map(|v| (f64::from(v) + 0.5) * side))
    }
}

/// A cell in its bucket.
#[derive(Debug)]
struct Entry {
    key: Key,
    cell: u32,
    /// Its centre as built.
    centre: [f32; 3],
}

/// The cells of a model by bucket.
#[derive(Debug)]
pub(crate) struct CellIndex {
    side: f64,
    entries: Vec<Entry>,
}

impl CellIndex {
    fn new(model: &Model) -> Self {
        let side = BUCKET * model.spacing_m;
        let entry = |cell: usize| {
            let centre = centre(&model.corners_of(cell));
            Entry {
                key: Key::of(&centre, side),
                cell: cell as u32,
                centre: [0, 1, 2].map(|a| centre[a] as f32),
            }
        };
        let mut entries: Vec<Entry> = (0..model.cells.len()).map(entry).collect();
        entries.sort_unstable_by_key(|e| (e.key, e.cell));
        Self { side, entries }
    }

    fn bucket(&self, key: Key) -> impl Iterator<Item = &Entry> {
        let start = self.entries.partition_point(|e| e.key < key);
        self.entries[start..]
            .iter()
            .take_while(move |e| e.key == key)
    }

    /// The cells whose centre, as built, may be nearer to a surface than a distance; all that are.
    pub(crate) fn cells_around(&self, ribbon: &Ribbon, distance: f64) -> Vec<u32> {
        let mut keys = Vec::new();
        for (bounds, triangles) in ribbon.parts() {
            let around = Vec3::repeat(distance);
            let low = Key::of(&(bounds.low - around), self.side);
            let high = Key::of(&(bounds.high + around), self.side);
            // A bucket is within half its diagonal of its centre.
            let reach = distance + 0.5 * f64::sqrt(3.0) * self.side;
            let all = low.to(high).filter(|key| {
                let middle = key.middle(self.side);
                triangles.iter().any(|t| t.height(&middle).abs() < reach)
            });
            keys.extend(all);
        }
        keys.sort_unstable();
        keys.dedup();
        let cells = keys.into_iter().flat_map(|key| self.bucket(key));
        let is_near = |e: &&Entry| ribbon.may_reach(&Vec3::from(e.centre.map(f64::from)), distance);
        cells.filter(is_near).map(|e| e.cell).collect()
    }

    /// The cells in the 27 buckets around a point.
    pub(crate) fn cells_near(&self, p: &Vec3) -> impl Iterator<Item = u32> + '_ {
        let Key([x, y, z]) = Key::of(p, self.side);
        (0..27).flat_map(move |i| {
            let near = |v: i32, step: i32| v.saturating_add(step - 1);
            let key = Key([near(x, i % 3), near(y, i / 3 % 3), near(z, i / 9)]);
            self.bucket(key).map(|e| e.cell)
        })
    }
}

/// Mean of a cell's corners.
pub(crate) fn centre(corners: &[Vec3; 8]) -> Vec3 {
    corners.iter().sum::<Vec3>() / 8.0
}

/// Derived data that make cuts cheap; not part of the state.
#[derive(Debug, Clone)]
pub(crate) struct CutIndex {
    cells: OnceLock<Arc<CellIndex>>,
    /// Position in the boundary of each face of a cell laid open by a cut, or [`CLOSED`].
    positions: Pages<[u32; 6]>,
    /// Number of faces laid open by cuts.
    pub(crate) opened: usize,
}

const CLOSED: u32 = u32::MAX;

impl CutIndex {
    /// No cuts.
    pub(crate) fn new(cells: usize) -> Self {
        Self {
            cells: OnceLock::new(),
            positions: Pages::filled([CLOSED; 6], cells),
            opened: 0,
        }
    }

    /// Adds a face laid open by a cut. Returns whether it is new.
    pub(crate) fn open(&mut self, face: FaceId, position: u32) -> bool {
        let known = &mut self.positions[face.cell() as usize][face.face()];
        let is_new = std::mem::replace(known, position) == CLOSED;
        self.opened += usize::from(is_new);
        is_new
    }
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
        let position = self.cut_index.positions[face.cell() as usize][face.face()];
        if position != CLOSED {
            return Some(position as usize);
        }
        // Those of the model as built are in order.
        let faces = &self.exposed.faces;
        let (mut low, mut high) = (0, faces.len() - self.cut_index.opened);
        while low < high {
            let middle = low.midpoint(high);
            match faces[middle].cmp(&face) {
                Ordering::Less => low = middle + 1,
                Ordering::Equal => return Some(middle),
                Ordering::Greater => high = middle,
            }
        }
        None
    }

    /// Centre of a cell at rest.
    pub(crate) fn centre(&self, cell: u32) -> Vec3 {
        centre(&self.corners(cell).map(|n| self.rest(n)))
    }
}
