//! The closed parts of an input surface.

use crate::{Aabb, Surface};

/// The box around each part of a surface; parts share no vertex.
pub(super) fn parts(surface: &Surface) -> Vec<Aabb> {
    let mut parent: Vec<u32> = (0..surface.vertices.len() as u32).collect();
    for t in &surface.triangles {
        let roots = t.map(|v| root(&mut parent, v));
        let least = roots.into_iter().fold(u32::MAX, u32::min);
        for v in roots {
            parent[v as usize] = least;
        }
    }
    let mut slot = vec![usize::MAX; parent.len()];
    let mut boxes: Vec<Aabb> = Vec::new();
    for &v in surface.triangles.iter().flatten() {
        let at = surface.vertices[v as usize];
        let slot = &mut slot[root(&mut parent, v) as usize];
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

/// Root of an entry in a union-find forest, with path halving.
pub(super) fn root(parent: &mut [u32], mut at: u32) -> u32 {
    while parent[at as usize] != at {
        parent[at as usize] = parent[parent[at as usize] as usize];
        at = parent[at as usize];
    }
    at
}
