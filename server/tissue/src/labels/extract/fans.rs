//! Around one corner: which faces of a region hang together.
//!
//! Where voxels of a region meet in an edge or a corner only, its surface touches itself there. Each
//! fan of faces gets a vertex of its own at that place, so that the surface's edges and vertices are
//! those of a manifold. At an edge with four faces, the two that belong to one voxel hang together.

/// The fans for each of the 256 ways to fill eight voxels.
pub(super) struct Fans {
    table: Vec<Fan>,
}

/// The fans around one corner.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fan {
    /// How many there are.
    pub(super) count: u8,
    /// The fan of each face (see [`face`]); faces that are no boundary have 0 too.
    pub(super) of_face: [u8; 12],
    /// Bit d: four faces meet in direction d and all belong to one fan.
    pub(super) doubled: u8,
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
            table: (0..=u8::MAX).map(Fan::new).collect(),
        }
    }

    /// The fans of the set voxels.
    pub(super) fn of(&self, filled: u8) -> &Fan {
        &self.table[usize::from(filled)]
    }
}

impl Fan {
    fn new(filled: u8) -> Self {
        let is_in = |voxel: usize| filled >> voxel & 1 == 1;
        let is_boundary = |f: usize| {
            let [near, far] = voxels(f);
            is_in(near) != is_in(far)
        };
        let inside = |f: usize| {
            let [near, far] = voxels(f);
            if is_in(near) { near } else { far }
        };
        let mut root: [usize; 12] = std::array::from_fn(|f| f);
        let join = |root: &mut [usize; 12], a: usize, b: usize| {
            let (a, b) = (root[a], root[b]);
            for r in root.iter_mut().filter(|r| **r == a.max(b)) {
                *r = a.min(b);
            }
        };
        for direction in 0..6 {
            let meeting: Vec<usize> = faces_in(direction)
                .into_iter()
                .filter(|f| is_boundary(*f))
                .collect();
            for (n, &f) in meeting.iter().enumerate() {
                for &g in &meeting[n + 1..] {
                    if meeting.len() == 2 || inside(f) == inside(g) {
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
    fn a_face_lies_between_voxels_that_differ_along_its_axis() {
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
    fn voxels_that_meet_in_an_edge_or_a_corner_have_fans_of_their_own() {
        let fans = Fans::new();
        assert_eq!(fans.of(0).count, 0);
        assert_eq!(fans.of(0b0000_0001).count, 1);
        assert_eq!(fans.of(0b1000_0001).count, 2, "corner");
        assert_eq!(fans.of(0b0000_1001).count, 2, "edge");
        assert_eq!(fans.of(0b0110_1001).count, 4, "checkerboard");
        assert_eq!(fans.of(0b1111_0110).doubled, 1 << 4, "an arch over an edge");
    }
}
