//! Vectors in four lanes of f32, for forces and corrections.
//!
//! A correction needs few digits, so the coarse levels run in single precision; the sum of the
//! corrections does not.

/// Three numbers and a lane that stays zero.
pub(crate) type Quad = [f32; 4];

pub(crate) const ZERO: Quad = [0.0; 4];

/// `a + w b`, all four lanes at once: single lanes written and then read as a vector would have to wait for
/// each other.
#[inline(always)]
pub(crate) fn plus(a: &Quad, w: f32, b: &Quad) -> Quad {
    [
        a[0] + w * b[0],
        a[1] + w * b[1],
        a[2] + w * b[2],
        a[3] + w * b[3],
    ]
}

/// So many of a value, in memory that is there. What `vec!` makes of zeros is handed out page by page when it is
/// first written to, and a hand's first touch of a place took a third longer for it.
pub(super) fn laid_out<T: Clone>(value: T, len: usize) -> Vec<T> {
    let mut values = Vec::with_capacity(len);
    values.resize(len, value);
    values
}

/// Makes room for so many values, in memory that is there, and for a quarter more, so that it need not be done again
/// for a few.
pub(super) fn make_room<T: Clone>(values: &mut Vec<T>, filler: T, len: usize) {
    if values.capacity() < len {
        let mut roomy = laid_out(filler, len + len / 4);
        roomy.clear();
        roomy.append(values);
        *values = roomy;
    }
}
