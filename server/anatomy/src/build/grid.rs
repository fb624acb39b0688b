//! The lattice that the model is cut from: where its planes stand and how many there are.

use palpate_tissue::Vec3;

use crate::Surface;

/// A grid of cubic cells of side `spacing` that covers the input with a margin of one cell.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grid {
    /// Position of grid point (0, 0, 0) in m.
    pub(super) origin: Vec3,
    /// Side Δd of a cell in m.
    pub(super) spacing: f64,
    /// Number of cells along each axis.
    pub(super) cells: [usize; 3],
}

impl Grid {
    /// The grid around `surfaces`, centred on their common bounding box, so that opposite flat ends
    /// lie equally far from the lattice planes.
    pub(super) fn around(surfaces: &[&Surface], spacing: f64) -> Self {
        let mut low = Vec3::repeat(f64::INFINITY);
        let mut high = Vec3::repeat(f64::NEG_INFINITY);
        for vertex in surfaces.iter().flat_map(|s| &s.vertices) {
            low = low.inf(vertex);
            high = high.sup(vertex);
        }
        let extent = high - low;
        let inner: [usize; 3] =
            std::array::from_fn(|a| ((extent[a] / spacing).ceil() as usize).max(1));
        let cells = inner.map(|n| n + 2);
        let middle = (low + high) / 2.0;
        let origin = Vec3::from_fn(|a, _| middle[a] - cells[a] as f64 * spacing / 2.0);
        Self {
            origin,
            spacing,
            cells,
        }
    }

    /// Position of a grid point in m.
    pub(super) fn point(&self, at: [i32; 3]) -> Vec3 {
        self.origin + Vec3::from(at.map(f64::from)) * self.spacing
    }

    /// Middle of the grid in m.
    pub(super) fn middle(&self) -> Vec3 {
        self.origin + self.extent() / 2.0
    }

    /// Lengths of the sides in m.
    pub(super) fn extent(&self) -> Vec3 {
        Vec3::from(self.cells.map(|n| n as f64)) * self.spacing
    }

    /// Number of grid points along each axis.
    pub(super) fn points(&self) -> [usize; 3] {
        self.cells.map(|n| n + 1)
    }

    /// The cell that contains a point, or the nearest one.
    pub(super) fn cell_at(&self, at: &Vec3) -> [usize; 3] {
        let cell = (at - self.origin) / self.spacing;
        std::array::from_fn(|a| (cell[a].max(0.0) as usize).min(self.cells[a] - 1))
    }

    /// Index of a cell, x fastest.
    pub(super) fn cell_index(&self, at: [usize; 3]) -> usize {
        at[0] + self.cells[0] * (at[1] + self.cells[1] * at[2])
    }

    pub(super) fn cell_count(&self) -> usize {
        self.cells.iter().product()
    }
}
