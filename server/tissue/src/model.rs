//! The model as it was built: immutable, the content of a model file, shared by every participant.

use crate::{Cell, Material, Vec3};

/// Index of a region in [`Model::regions`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RegionId(pub u16);

impl RegionId {
    /// Position in [`Model::regions`].
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// A part of the model that is filled with one material.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Its name in the scene.
    pub name: String,
    /// Its material.
    pub material: Material,
    /// A pinned region does not move.
    pub pinned: bool,
    /// Unit vector along its fibres; zero when its material is isotropic. See [`Model::resolve_fibres`].
    pub fibre: [f64; 3],
}

/// A heterogeneous lattice of hexahedral cells at rest (Lin 2007, section 3.3).
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Lattice spacing Δd in m.
    pub spacing_m: f64,
    /// Acceleration of gravity in m/s² along the axes of the model; zeros without gravity.
    pub gravity: [f64; 3],
    /// Regions in scene order: a later one overrides an earlier one where they overlap.
    pub regions: Vec<Region>,
    /// Rest position of each node in m.
    pub nodes: Vec<Vec3>,
    /// Lattice coordinates of each node: its grid point before snapping.
    pub lattice: Vec<[i32; 3]>,
    /// The cells; their corners index `nodes`.
    pub cells: Vec<Cell>,
}

impl Model {
    /// The material of a cell.
    pub fn material_of(&self, cell: usize) -> &Material {
        &self.regions[self.cells[cell].region.index()].material
    }

    /// Rest positions of a cell's corners.
    pub fn corners_of(&self, cell: usize) -> [Vec3; 8] {
        self.cells[cell].corners.map(|n| self.nodes[n as usize])
    }
}
