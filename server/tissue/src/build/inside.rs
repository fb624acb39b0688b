//! Which region holds a point.
//!
//! One watertight ray per surface, along the axis that its triangles face most: a tall wall seen
//! from the side puts one triangle before each point, seen from above a hundred.

use rayon::prelude::*;

use super::rays::{Hit, Rays, cast_triangle, inside_at};
use crate::{Surface, Vec3};

/// Most columns along one side of a surface's bounding box; more cost more memory than they save time.
const COLUMNS_MAX: f64 = 1024.0;

/// Answers which region holds a point.
#[derive(Debug)]
pub(super) struct PointQuery<'a> {
    surfaces: Vec<Binned<'a>>,
}

/// A surface with its triangles sorted into square columns along one axis.
#[derive(Debug)]
struct Binned<'a> {
    surface: &'a Surface,
    axis: usize,
    low: [f64; 2],
    side: f64,
    count: [usize; 2],
    start: Vec<u32>,
    triangles: Vec<u32>,
}

impl<'a> PointQuery<'a> {
    /// Sorts the triangles of all surfaces into columns.
    pub(super) fn new(surfaces: &[&'a Surface]) -> Self {
        Self {
            surfaces: surfaces.par_iter().map(|s| Binned::new(s)).collect(),
        }
    }

    /// The region at a point, overlaps resolved, or `None` outside all of them.
    pub(super) fn region_at(&self, point: Vec3) -> Option<usize> {
        (0..self.surfaces.len())
            .rev()
            .find(|&r| self.surfaces[r].contains(point))
    }

    /// Whether region `r`'s own surface contains the point, whoever else does.
    pub(super) fn contains(&self, region: usize, point: Vec3) -> bool {
        self.surfaces[region].contains(point)
    }
}

impl<'a> Binned<'a> {
    fn new(surface: &'a Surface) -> Self {
        let axis = facing(surface);
        let across = [(axis + 1) % 3, (axis + 2) % 3];
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        for v in &surface.vertices {
            for a in 0..2 {
                low[a] = low[a].min(v[across[a]]);
                high[a] = high[a].max(v[across[a]]);
            }
        }
        let extent = (high[0] - low[0]).max(high[1] - low[1]);
        let triangle = (surface.area() / surface.triangles.len().max(1) as f64).sqrt();
        let side = triangle
            .max(extent / COLUMNS_MAX)
            .max(f64::MIN_POSITIVE);
        let count =
            [0, 1].map(|a| (((high[a] - low[a]) / side).floor() as usize).saturating_add(1));
        let mut this = Self {
            surface,
            axis,
            low,
            side,
            count,
            start: vec![0; count[0] * count[1] + 1],
            triangles: Vec::new(),
        };
        // Counted first, so that the columns are filled without a list of pairs.
        let mut start = std::mem::take(&mut this.start);
        for t in 0..surface.triangles.len() {
            this.for_columns(t, |column| start[column + 1] += 1);
        }
        for column in 1..start.len() {
            start[column] += start[column - 1];
        }
        let mut next = start.clone();
        let mut triangles = vec![0; start.last().copied().unwrap_or(0) as usize];
        for t in 0..surface.triangles.len() {
            this.for_columns(t, |column| {
                triangles[next[column] as usize] = t as u32;
                next[column] += 1;
            });
        }
        this.start = start;
        this.triangles = triangles;
        this
    }

    fn for_columns(&self, triangle: usize, mut each: impl FnMut(usize)) {
        let corners = self.surface.corners(triangle);
        let range = |side: usize| {
            let axis = (self.axis + 1 + side) % 3;
            let values = corners.map(|p| p[axis]);
            let low = values.iter().copied().fold(f64::INFINITY, f64::min);
            let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            self.column(side, low)..=self.column(side, high)
        };
        for j in range(1) {
            for i in range(0) {
                each(i + self.count[0] * j);
            }
        }
    }

    fn column(&self, side: usize, x: f64) -> usize {
        (((x - self.low[side]) / self.side).floor().max(0.0) as usize).min(self.count[side] - 1)
    }

    fn contains(&self, point: Vec3) -> bool {
        let at = [point[(self.axis + 1) % 3], point[(self.axis + 2) % 3]];
        let column = self.column(0, at[0]) + self.count[0] * self.column(1, at[1]);
        let range = self.start[column] as usize..self.start[column + 1] as usize;
        let rays = Rays {
            axis: self.axis,
            first: at,
            step: 1.0,
            count: [1, 1],
        };
        let mut found: Vec<(u32, Hit)> = Vec::new();
        for &triangle in &self.triangles[range] {
            let corners = self.surface.corners(triangle as usize);
            cast_triangle(&corners, &rays, &mut found);
        }
        inside_at(found.iter().map(|f| f.1), point[self.axis])
    }
}

/// The axis along which the surface shows the largest area.
fn facing(surface: &Surface) -> usize {
    let mut shown = Vec3::zeros();
    for t in 0..surface.triangles.len() {
        let [a, b, c] = surface.corners(t);
        shown += (b - a).cross(&(c - a)).abs();
    }
    // A tie goes to z, the axis of the first rays.
    [1, 0].into_iter().fold(2, |best, axis| {
        if shown[axis] > shown[best] { axis } else { best }
    })
}
