//! Vectors in four lanes of f32, for forces and corrections.
//!
//! A correction needs few digits, so the coarse levels run in single precision; the sum of the
//! corrections does not.

/// Three numbers and a lane that stays zero.
pub(crate) type Quad = [f32; 4];

pub(crate) const ZERO: Quad = [0.0; 4];
