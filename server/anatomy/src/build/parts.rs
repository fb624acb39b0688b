//! The closed parts of an input surface.

use crate::surface::Sets;
use crate::{Aabb, Surface};

/// The box around each part of a surface; parts share no vertex.
pub(super) fn parts(surface: &Surface) -> Vec<Aabb> {
    let mut sets = Sets::new(surface.vertices.len());
    for &[a, b, c] in &surface.triangles {
        sets.join(a, b);
        sets.join(b, c);
    }
    let mut slot = vec![usize::MAX; surface.vertices.len()];
    let mut boxes: Vec<Aabb> = Vec::new();
    for &v in surface.triangles.iter().flatten() {
        let at = surface.vertices[v as usize];
        let slot = &mut slot[sets.find(v) as usize];
        if *slot == usize::MAX {
            *slot = boxes.len();
            boxes.push(Aabb { min: at, max: at });
        }
        let own = &mut boxes[*slot];
        own.min = own.min.inf(&at);
        own.max = own.max.sup(&at);
    }
    boxes
}
