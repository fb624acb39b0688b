//! The closed parts of an input surface.

use crate::surface::Sets;
use crate::{Aabb, Surface};

/// The closed parts of a surface; parts share no vertex.
pub(super) struct ClosedParts {
    /// The box around each part.
    pub(super) boxes: Vec<Aabb>,
    /// The part of each triangle.
    pub(super) of_triangle: Vec<u32>,
}

impl ClosedParts {
    pub(super) fn of(surface: &Surface) -> Self {
        let mut sets = Sets::new(surface.vertices.len());
        for &[a, b, c] in &surface.triangles {
            sets.join(a, b);
            sets.join(b, c);
        }
        let mut slot = vec![u32::MAX; surface.vertices.len()];
        let mut boxes: Vec<Aabb> = Vec::new();
        let mut part = |triangle: &[u32; 3]| {
            let slot = &mut slot[sets.find(triangle[0]) as usize];
            for at in triangle.map(|v| surface.vertices[v as usize]) {
                if *slot == u32::MAX {
                    *slot = boxes.len() as u32;
                    boxes.push(Aabb { min: at, max: at });
                }
                let own = &mut boxes[*slot as usize];
                own.min = own.min.inf(&at);
                own.max = own.max.sup(&at);
            }
            *slot
        };
        let of_triangle = surface.triangles.iter().map(&mut part).collect();
        Self { boxes, of_triangle }
    }
}
