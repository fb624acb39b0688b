//! Vectors in four lanes of f32, for forces and corrections.
//!
//! Corrections need few digits, so the coarse levels run in single precision; accumulated totals are in f64.

use crate::Vec3;

/// Three numbers and a lane that stays zero.
pub(crate) type Quad = [f32; 4];

pub(crate) const ZERO: Quad = [0.0; 4];

/// Squared length.
#[inline(always)]
pub(super) fn square(v: &Quad) -> f32 {
    v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
}

/// Work of a force in N along a displacement in m, in N m.
#[inline(always)]
pub(crate) fn work(force: &Quad, by: &Vec3) -> f64 {
    (0..3).map(|a| f64::from(force[a]) * by[a]).sum()
}

/// `a + w b` in all four lanes at once. Scalar lane writes followed by a vector read would stall on store forwarding.
#[inline(always)]
pub(crate) fn plus(a: &Quad, w: f32, b: &Quad) -> Quad {
    [
        a[0] + w * b[0],
        a[1] + w * b[1],
        a[2] + w * b[2],
        a[3] + w * b[3],
    ]
}

/// Further items that vectors have room for, as a fraction of their length: the nodes and elements that cuts add. A vector
/// that grows beyond is copied, which takes milliseconds on the hand's thread.
pub(super) const ROOM: usize = 4;

/// Part of the usual memory by which a vector may exceed it after an undo.
pub(crate) const SLACK: usize = 32;

/// Makes room for the items that cuts will add.
pub(crate) fn reserve<T>(values: &mut Vec<T>) {
    let room = values.len() / ROOM;
    if values.capacity() - values.len() < room {
        values.reserve_exact(room);
    }
}

/// The items of both lists, sorted by their numbers; a later item replaces an earlier one.
pub(crate) fn overlaid<T>(earlier: Vec<(u32, T)>, mut later: Vec<(u32, T)>) -> Vec<(u32, T)> {
    later.extend(earlier);
    later.sort_by_key(|item| item.0);
    later.dedup_by_key(|item| item.0);
    later
}

/// Removes the items from `len` on, and returns memory that exceeds the usual room. It copies the vector only if cuts had made
/// it grow beyond that room.
pub(crate) fn trim<T>(values: &mut Vec<T>, len: usize) {
    if len >= values.len() {
        return;
    }
    values.truncate(len);
    let usual = values.len() + values.len() / ROOM;
    if values.capacity() > usual + usual / SLACK {
        move_to_room(values, usual);
    }
}

/// Moves a vector to memory for this many items if it has more. Memory that is made smaller in place stays where the
/// vector had grown to, behind all that cuts allocated, and keeps the allocator from returning it.
pub(crate) fn move_to_room<T>(values: &mut Vec<T>, capacity: usize) {
    if values.capacity() > capacity {
        let mut moved = Vec::with_capacity(capacity);
        moved.append(values);
        *values = moved;
    }
}

/// A vector of `len` copies in committed memory. `vec!` of zeros commits pages at the first write, which made the first
/// touch of a tool a third slower.
pub(crate) fn laid_out<T: Clone>(value: T, len: usize) -> Vec<T> {
    let mut values = Vec::with_capacity(len + len / ROOM);
    values.resize(len, value);
    values
}
