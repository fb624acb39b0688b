//! Real numbers as small integers.
//!
//! Rotations by the smallest three: of a unit quaternion (x, y, z, w) the component of largest
//! magnitude is left out; q and -q are the same rotation, so its sign is made positive; each of the
//! others lies in ±1/√2 and becomes a 15-bit integer. 2 + 3·15 bits = 47. The error of a component
//! is at most 1/√2 / 16383 / 2 = 2.2e-5, of the angle below 0.01°.

use crate::ProtocolError;

/// Step of a position in metres: 0.01 mm, a tenth of the tremor of a steady hand.
pub const POSITION_STEP_M: f64 = 1e-5;

/// The largest coordinate in metres. What is farther away is refused on both sides.
pub const POSITION_MAX_M: f64 = 20.0;

/// Step of a force in newtons.
pub(super) const FORCE_STEP_N: f64 = 0.01;

const HALF: f64 = 16_383.0;

/// A coordinate as 24 bits around the middle.
pub(super) fn position(x_m: f64) -> Result<u32, ProtocolError> {
    if !x_m.is_finite() || x_m.abs() > POSITION_MAX_M {
        return Err(out_of_range("a position", x_m, POSITION_MAX_M));
    }
    Ok(((x_m / POSITION_STEP_M).round() as i32 + (1 << 23)) as u32)
}

/// The coordinate in metres.
pub(super) fn position_back(q: u32) -> Result<f64, ProtocolError> {
    let x_m = f64::from(q as i32 - (1 << 23)) * POSITION_STEP_M;
    if x_m.abs() > POSITION_MAX_M + POSITION_STEP_M {
        return Err(out_of_range("a position", x_m, POSITION_MAX_M));
    }
    Ok(x_m)
}

fn out_of_range(what: &'static str, value: f64, limit: f64) -> ProtocolError {
    ProtocolError::OutOfRange {
        what,
        detail: format!("{value}, the limit is ±{limit}"),
    }
}

/// A value in 16 bits at a step; beyond the range it becomes the end of the range, and
/// not-a-number becomes zero.
pub(super) fn saturating_i16(value: f64, step: f64) -> i16 {
    (value / step).round() as i16
}

/// A unit quaternion (x, y, z, w) in 47 bits; an error where it is none.
pub(super) fn rotation(q: [f64; 4]) -> Result<u64, ProtocolError> {
    let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    if !(0.5..2.0).contains(&norm) {
        return Err(ProtocolError::OutOfRange {
            what: "an orientation",
            detail: format!("a quaternion of length {norm}, not 1"),
        });
    }
    let largest = (0..4).fold(
        0,
        |best, i| if q[i].abs() > q[best].abs() { i } else { best },
    );
    let scale = q[largest].signum() / norm * HALF * std::f64::consts::SQRT_2;
    let others = (0..4).filter(|i| *i != largest);
    Ok(others.fold(largest as u64, |bits, i| {
        let v = (q[i] * scale).round().clamp(-HALF, HALF) + HALF;
        (bits << 15) | v as u64
    }))
}

/// The unit quaternion (x, y, z, w).
pub(super) fn rotation_back(bits: u64) -> [f64; 4] {
    let largest = (bits >> 45 & 3) as usize;
    let mut q = [0.0; 4];
    let mut rest = 1.0;
    for (slot, i) in (0..4).filter(|i| *i != largest).enumerate() {
        let v = (bits >> (15 * (2 - slot)) & 0x7fff) as f64;
        q[i] = (v - HALF) / (HALF * std::f64::consts::SQRT_2);
        rest -= q[i] * q[i];
    }
    q[largest] = rest.max(0.0).sqrt();
    let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    q.map(|c| c / norm)
}
