//! Occupancy grid of the space around one surface. A voxel that no triangle reaches into is all inside or all
//! outside, and one ray decides for all of it.

use palpate_tissue::Vec3;

use crate::Surface;

/// Side of a voxel in lattice spacings.
const SIDE: f64 = 2.0;
/// Most voxels; beyond it their sides grow with the surface.
const COUNT_MAX: f64 = 4e6;
/// Most voxels per triangle on the mean. With more, triangles are as large as the surface, and voxels decide
/// nothing.
const SHARE: usize = 32;
/// Margin added to a triangle, in parts of a voxel: far more than the tree rounds its corners by.
const MARGIN: f64 = 1e-3;

/// State of a voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Voxel {
    /// Triangles reach into it.
    Crossed,
    /// All of it lies inside, or all of it outside.
    Within(bool),
}

/// The grid around one surface.
#[derive(Debug, Default)]
pub(super) struct OccupancyGrid {
    /// Corner of the first voxel in m.
    low: Vec3,
    /// One over the side of a voxel, in 1/m.
    per_side: f64,
    count: [usize; 3],
    /// Empty where voxels decide nothing.
    list: Vec<Voxel>,
}

impl OccupancyGrid {
    /// Classifies space around a surface on a lattice of this spacing (m). `is_inside` decides for single
    /// points.
    pub(super) fn new(surface: &Surface, spacing: f64, is_inside: impl Fn(Vec3) -> bool) -> Self {
        let mut grid = Self::default();
        if let Some(bounds) = surface.aabb() {
            let extent = bounds.extent();
            let volume = extent.map(|e| e + SIDE * spacing).product();
            let side = (SIDE * spacing).max((volume / COUNT_MAX).cbrt());
            grid.low = bounds.min - Vec3::repeat(0.5 * side);
            grid.per_side = 1.0 / side;
            grid.count = std::array::from_fn(|a| (extent[a] / side + 1.0).ceil() as usize);
            if grid.cross(surface) {
                grid.fill(is_inside);
            } else {
                grid.list = Vec::new();
            }
        }
        grid
    }

    /// Whether a point is inside the surface, if the state of its voxel is known.
    pub(super) fn contains(&self, point: &Vec3) -> Option<bool> {
        let at = (point - self.low) * self.per_side;
        let at: [f64; 3] = at.into();
        if (0..3).any(|a| at[a] < 0.0 || at[a] >= self.count[a] as f64) {
            // Outside the bounding box of the surface.
            return None;
        }
        match self.list.get(self.index(at.map(|v| v as usize)))? {
            Voxel::Crossed => None,
            Voxel::Within(inside) => Some(*inside),
        }
    }

    fn index(&self, at: [usize; 3]) -> usize {
        at[0] + self.count[0] * (at[1] + self.count[1] * at[2])
    }

    /// Marks the voxels that triangles reach into. Returns whether these are few enough to do so.
    fn cross(&mut self, surface: &Surface) -> bool {
        self.list = vec![Voxel::Within(false); self.count.iter().product()];
        let mut left = SHARE * surface.triangles.len() + self.list.len();
        for t in 0..surface.triangles.len() {
            let [a, b, c] = surface.corners(t).map(|p| (p - self.low) * self.per_side);
            let margin = Vec3::repeat(MARGIN);
            let (low, high) = (a.inf(&b).inf(&c) - margin, a.sup(&b).sup(&c) + margin);
            let low: [usize; 3] = std::array::from_fn(|a| low[a] as usize);
            let high: [usize; 3] =
                std::array::from_fn(|a| (high[a] as usize).min(self.count[a] - 1));
            let row = high[0] + 1 - low[0];
            let rows = (high[1] + 1 - low[1]) * (high[2] + 1 - low[2]);
            if row * rows > left {
                return false;
            }
            left -= row * rows;
            for z in low[2]..=high[2] {
                for y in low[1]..=high[1] {
                    let from = self.index([low[0], y, z]);
                    self.list[from..from + row].fill(Voxel::Crossed);
                }
            }
        }
        true
    }

    /// Classifies the other voxels: a voxel takes the state of a known neighbour.
    fn fill(&mut self, is_inside: impl Fn(Vec3) -> bool) {
        for z in 0..self.count[2] {
            for y in 0..self.count[1] {
                for x in 0..self.count[0] {
                    let at = [x, y, z];
                    let index = self.index(at);
                    if self.list[index] == Voxel::Crossed {
                        continue;
                    }
                    let before = (0..3).filter(|&a| at[a] > 0).find_map(|a| {
                        let mut before = at;
                        before[a] -= 1;
                        match self.list[self.index(before)] {
                            Voxel::Crossed => None,
                            Voxel::Within(inside) => Some(inside),
                        }
                    });
                    let middle = Vec3::from(at.map(|i| i as f64 + 0.5)) / self.per_side;
                    let inside = before.unwrap_or_else(|| is_inside(self.low + middle));
                    self.list[index] = Voxel::Within(inside);
                }
            }
        }
    }
}
