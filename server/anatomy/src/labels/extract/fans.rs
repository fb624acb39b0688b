//! Connectivity of the faces of a region around one corner.
//!
//! Where voxels of a region meet in an edge or a corner only, its surface touches itself. Each fan of faces
//! gets its own vertex there, so that the surface's edges and vertices are those of a manifold. At an edge with
//! four faces, the two faces of one voxel are connected.
//!
//! The exception is a region that separates two others there. A layer of one voxel oblique to the voxels shares
//! only an edge with itself, and the separated regions lie on the two other sides. Such an edge is *pinched*.
//! Its two faces towards one side are connected, and the mesh has a vertex for each side ([`sheets`]).
//! Otherwise the layer would have zero thickness there.

use palpate_tissue::Vec3;

/// The fans for each of the 256 ways to fill eight voxels.
pub(super) struct Fans {
    table: Vec<Fan>,
}

/// The fans around one corner.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fan {
    /// Number of fans.
    pub(super) count: u8,
    /// The fan of each face (see [`face`]); 0 also for faces that are not on the boundary.
    pub(super) of_face: [u8; 12],
    /// Bit d: four faces meet in direction d and all belong to one fan.
    pub(super) doubled: u8,
}

/// Bit d: the edge in direction d is pinched, in a block of regions (`outside` is none).
pub(super) fn pinched(block: [u8; 8], outside: u8) -> u8 {
    let is_pinched = |direction: usize| {
        let [a, b, c, d] = around(block, direction);
        let parts = |layer: [u8; 2], sides: [u8; 2]| {
            layer[0] == layer[1]
                && layer[0] != outside
                && sides[0] != sides[1]
                && !sides.contains(&layer[0])
        };
        parts([a, d], [b, c]) || parts([b, c], [a, d])
    };
    (0..6).fold(0, |set, d| set | u8::from(is_pinched(d)) << d)
}

/// The four voxels of a block around its half edge in a direction (axis, positive).
pub(super) fn around(block: [u8; 8], direction: usize) -> [u8; 4] {
    let (axis, side) = (direction / 2, direction % 2);
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    [0, 1, 2, 3].map(|q: usize| block[side << axis | (q & 1) << u | (q >> 1) << v])
}

/// The faces between different regions of a block, in connected sets, as bits (see [`face`]). Without a pinched
/// edge there is one set.
pub(super) fn sheets(block: [u8; 8], pinched: u8) -> Vec<u16> {
    let differs = |f: usize| voxels(f).map(|v| block[v]);
    let is_boundary = |f: &usize| differs(*f)[0] != differs(*f)[1];
    let all: Vec<usize> = (0..12).filter(is_boundary).collect();
    if pinched == 0 {
        return vec![all.iter().fold(0, |set, f| set | 1 << f)];
    }
    let mut root: [usize; 12] = std::array::from_fn(|f| f);
    for direction in 0..6 {
        let meeting: Vec<usize> = faces_in(direction)
            .into_iter()
            .filter(is_boundary)
            .collect();
        let is_pinched = pinched >> direction & 1 == 1;
        for (n, &f) in meeting.iter().enumerate() {
            for &g in &meeting[n + 1..] {
                // At a pinched edge two faces of one side share that side's voxel, and two faces of one voxel
                // of the layer share that voxel. The layer is the region that occurs twice.
                let common = voxels(f).into_iter().find(|v| voxels(g).contains(v));
                let of_side = || common.is_some_and(|v| is_side(block, direction, v));
                if !is_pinched || of_side() {
                    join(&mut root, f, g);
                }
            }
        }
    }
    let mut sheets: Vec<u16> = Vec::new();
    for &first in all.iter().filter(|f| root[**f] == **f) {
        let own = all.iter().filter(|f| root[**f] == first);
        sheets.push(own.fold(0, |set, f| set | 1 << f));
    }
    sheets
}

/// Whether a voxel at a pinched edge is on a side of the layer: its region occurs once.
fn is_side(block: [u8; 8], direction: usize, voxel: usize) -> bool {
    let [a, b, c, d] = around(block, direction);
    let layer = if a == d { a } else { b };
    debug_assert!(a == d || b == c, "no pinched edge");
    block[voxel] != layer
}

/// The mean direction from the corner into the sides that a set of faces bounds at pinched edges.
pub(super) fn aside(block: [u8; 8], faces: u16, pinched: u8) -> Option<Vec3> {
    let mut way = Vec3::zeros();
    for direction in (0..6).filter(|d| pinched >> d & 1 == 1) {
        for f in faces_in(direction)
            .into_iter()
            .filter(|f| faces >> f & 1 == 1)
        {
            for v in voxels(f)
                .into_iter()
                .filter(|v| is_side(block, direction, *v))
            {
                for axis in (0..3).filter(|a| *a != direction / 2) {
                    way[axis] += if v >> axis & 1 == 1 { 1.0 } else { -1.0 };
                }
            }
        }
    }
    way.try_normalize(0.0)
}

/// The directions of the edges in a set of faces.
pub(super) fn runs(faces: u16) -> u8 {
    let meets = |d: usize| faces_in(d).iter().any(|f| faces >> f & 1 == 1);
    (0..6).fold(0, |set, d| set | u8::from(meets(d)) << d)
}

/// The regions on the sides of those faces of a set that meet in a direction.
pub(super) fn regions_along(block: [u8; 8], faces: u16, direction: usize) -> Vec<u8> {
    let own = faces_in(direction)
        .into_iter()
        .filter(|f| faces >> f & 1 == 1);
    let mut regions: Vec<u8> = own.flat_map(voxels).map(|v| block[v]).collect();
    regions.sort_unstable();
    regions.dedup();
    regions
}

/// A face of a set along a direction, in the numbering of the corner at the other end of the edge.
pub(super) fn seen_from_next(faces: u16, direction: usize) -> Option<usize> {
    let own = faces_in(direction)
        .into_iter()
        .find(|f| faces >> f & 1 == 1)?;
    let (axis, along) = (own / 4, direction / 2);
    let bit = if along == (axis + 1) % 3 { 1 } else { 2 };
    Some(4 * axis + ((own % 4) ^ bit))
}

fn join(root: &mut [usize; 12], a: usize, b: usize) {
    let (a, b) = (root[a], root[b]);
    for r in root.iter_mut().filter(|r| **r == a.max(b)) {
        *r = a.min(b);
    }
}

/// Number of the face across `axis` at (`u`, `v`), the sides along the next two axes.
pub(super) fn face(axis: usize, u: usize, v: usize) -> usize {
    4 * axis + u + 2 * v
}

/// The two voxels of a face, the nearer first.
fn voxels(face: usize) -> [usize; 2] {
    let (axis, at) = (face / 4, face % 4);
    let near = (at & 1) << ((axis + 1) % 3) | (at >> 1) << ((axis + 2) % 3);
    [near, near | 1 << axis]
}

/// The four faces that meet in a direction.
fn faces_in(direction: usize) -> [usize; 4] {
    let (along, side) = (direction / 2, direction % 2);
    let (a, b) = ((along + 1) % 3, (along + 2) % 3);
    // Across a, `along` is the second of the next two axes; across b it is the first.
    [
        face(a, 0, side),
        face(a, 1, side),
        face(b, side, 0),
        face(b, side, 1),
    ]
}

impl Fans {
    pub(super) fn new() -> Self {
        Self {
            table: (0..=u8::MAX).map(|set| Fan::new(set, !0, 0)).collect(),
        }
    }

    /// The fans of the set voxels.
    pub(super) fn of(&self, filled: u8) -> &Fan {
        &self.table[usize::from(filled)]
    }
}

impl Fan {
    /// The fans of the set voxels among the given faces, with these directions pinched.
    pub(super) fn new(filled: u8, faces: u16, pinched: u8) -> Self {
        let is_in = |voxel: usize| filled >> voxel & 1 == 1;
        let is_boundary = |f: usize| {
            let [near, far] = voxels(f);
            faces >> f & 1 == 1 && is_in(near) != is_in(far)
        };
        let inside = |f: usize| {
            let [near, far] = voxels(f);
            if is_in(near) { near } else { far }
        };
        let outside = |f: usize| {
            let [near, far] = voxels(f);
            if is_in(near) { far } else { near }
        };
        let mut root: [usize; 12] = std::array::from_fn(|f| f);
        for direction in 0..6 {
            let meeting: Vec<usize> = faces_in(direction)
                .into_iter()
                .filter(|f| is_boundary(*f))
                .collect();
            for (n, &f) in meeting.iter().enumerate() {
                for &g in &meeting[n + 1..] {
                    let common = if pinched >> direction & 1 == 1 {
                        outside(f) == outside(g)
                    } else {
                        inside(f) == inside(g)
                    };
                    if meeting.len() == 2 || common {
                        join(&mut root, f, g);
                    }
                }
            }
        }
        let mut this = Self {
            count: 0,
            of_face: [0; 12],
            doubled: 0,
        };
        for f in (0..12).filter(|f| is_boundary(*f)) {
            if root[f] == f {
                this.of_face[f] = this.count;
                this.count += 1;
            } else {
                this.of_face[f] = this.of_face[root[f]];
            }
        }
        for direction in 0..6 {
            let meeting = faces_in(direction);
            let four = meeting.iter().all(|f| is_boundary(*f));
            let one = meeting.iter().all(|f| root[*f] == root[meeting[0]]);
            this.doubled |= u8::from(four && one) << direction;
        }
        this
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faces_separate_voxels_along_their_axis() {
        for f in 0..12 {
            let [near, far] = voxels(f);
            assert_eq!(near ^ far, 1 << (f / 4));
        }
        for direction in 0..6 {
            for f in faces_in(direction) {
                let along = direction / 2;
                assert_ne!(f / 4, along);
                for v in voxels(f) {
                    assert_eq!(v >> along & 1, direction % 2);
                }
            }
        }
    }

    #[test]
    fn voxels_touching_in_edge_or_corner_have_separate_fans() {
        let fans = Fans::new();
        assert_eq!(fans.of(0).count, 0);
        assert_eq!(fans.of(0b0000_0001).count, 1);
        assert_eq!(fans.of(0b1000_0001).count, 2, "corner");
        assert_eq!(fans.of(0b0000_1001).count, 2, "edge");
        assert_eq!(fans.of(0b0110_1001).count, 4, "checkerboard");
        assert_eq!(fans.of(0b1111_0110).doubled, 1 << 4, "an arch over an edge");
    }
}
