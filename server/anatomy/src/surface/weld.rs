//! Welding: triangle corners with equal coordinates become one vertex.

use std::collections::HashMap;

use palpate_tissue::Vec3;

use super::Surface;

/// Collects triangles corner by corner into a surface with welded vertices.
///
/// Corners are the same vertex when their coordinates are equal as numbers (so -0 is 0). Vertices are numbered
/// by first occurrence, independently of the hash map.
pub(super) struct Welder {
    unit_m: f64,
    index: HashMap<[u32; 3], u32>,
    surface: Surface,
}

impl Welder {
    /// A welder for coordinates in units of `unit_m` metres.
    pub(super) fn new(unit_m: f64) -> Self {
        Self {
            unit_m,
            index: HashMap::new(),
            surface: Surface::default(),
        }
    }

    /// Adds a triangle.
    pub(super) fn triangle(&mut self, corners: [[f32; 3]; 3]) {
        let corners = corners.map(|c| self.vertex(c));
        self.surface.triangles.push(corners);
    }

    /// Number of triangles so far.
    pub(super) fn triangles(&self) -> usize {
        self.surface.triangles.len()
    }

    pub(super) fn finish(self) -> Surface {
        self.surface
    }

    fn vertex(&mut self, c: [f32; 3]) -> u32 {
        // Adding zero turns -0 into +0 and leaves every other number as it is.
        let c = c.map(|x| x + 0.0);
        let vertices = &mut self.surface.vertices;
        *self.index.entry(c.map(f32::to_bits)).or_insert_with(|| {
            let [x, y, z] = c.map(|x| f64::from(x) * self.unit_m);
            vertices.push(Vec3::new(x, y, z));
            (vertices.len() - 1) as u32
        })
    }
}
