//! Real numbers as small integers.
//!
//! Rotations use the smallest-three encoding: one component of a unit quaternion (x, y, z, w) is
//! omitted. q and -q are the same rotation, so that its sign is made positive; the other components
//! become integers. The largest component is omitted, unless the rotation before omitted another that is
//! still above [`KEPT_COMPONENT`]: differences need the same omitted component.

use crate::{Pose, ProtocolError, ServerTime, ToolSample};

/// Step of a position in metres: an eighth of the tremor of a steady hand. With 0.02 mm the error of 10
/// ms of extrapolation would be 0.024 mm (rms) instead of 0.018.
pub const POSITION_STEP_M: f64 = 1.25e-5;

/// The largest coordinate in metres. Both sides reject larger ones.
pub const POSITION_MAX_M: f64 = 20.0;

/// Step of the time of a sample in microseconds: a quick hand, 0.4 m/s, moves by a position step in it.
/// The wake-up latency of threads is usually below it, and costs no bits.
pub const TIME_STEP_US: i64 = 50;

/// Step of a force in newtons.
pub(super) const FORCE_STEP_N: f64 = 0.01;

/// Step of a component of a quaternion. With an omitted component of 0.4 or more the error of the angle
/// is at most 2 · √3/2 · step / 0.4 = 8.7e-4 rad = 0.05°: at the end of an edge of 20 mm, as much as a
/// step of position.
const COMPONENT_STEP: f64 = 2e-4;

/// The smallest magnitude of an omitted component that is not the largest.
const KEPT_COMPONENT: f64 = 0.4;

/// The largest component in steps: 1, a little rounded up.
pub(super) const COMPONENT_MAX: i32 = 5000;

/// The largest coordinate in steps.
pub(super) const POSITION_MAX: i32 = 1_600_000;

/// A rotation in integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct QuantisedRotation {
    /// The index of the omitted component, 0 to 3.
    pub(super) omitted: u8,
    /// The other components in order, in steps.
    pub(super) parts: [i32; 3],
}

/// A sample in integers, identical to the bit at both ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Point {
    /// Server time in steps.
    pub(super) time: i64,
    /// Position in steps.
    pub(super) position: [i32; 3],
    /// Orientation.
    pub(super) turn: QuantisedRotation,
    /// Buttons.
    pub(super) buttons: u8,
    /// Force in steps.
    pub(super) force: Option<[i32; 3]>,
}

impl Point {
    /// Rounds a sample; `near` is the rotation that its difference refers to.
    pub(super) fn of(
        sample: &ToolSample,
        near: Option<QuantisedRotation>,
    ) -> Result<Self, ProtocolError> {
        let mut position = [0; 3];
        for (q, x) in position.iter_mut().zip(sample.pose.position_m) {
            *q = coordinate(x)?;
        }
        Ok(Self {
            time: time(sample.time),
            position,
            turn: QuantisedRotation::of(sample.pose.orientation, near)?,
            buttons: sample.buttons,
            force: sample
                .force_n
                .map(|f| f.map(|x| i32::from(saturating_i16(x, FORCE_STEP_N)))),
        })
    }

    /// Checks that a sender may send it.
    pub(super) fn check(&self) -> Result<(), ProtocolError> {
        if let Some(x) = self.position.iter().find(|x| x.abs() > POSITION_MAX) {
            let x_m = f64::from(*x) * POSITION_STEP_M;
            return Err(out_of_range("a position", x_m, POSITION_MAX_M));
        }
        if let Some(c) = self.turn.parts.iter().find(|c| c.abs() > COMPONENT_MAX) {
            let c = f64::from(*c) * COMPONENT_STEP;
            return Err(out_of_range("a part of an orientation", c, 1.0));
        }
        let force_max = i32::from(i16::MAX) + 1;
        if let Some(f) = self.force.iter().flatten().find(|f| f.abs() > force_max) {
            let limit = f64::from(force_max) * FORCE_STEP_N;
            return Err(out_of_range("a force", f64::from(*f) * FORCE_STEP_N, limit));
        }
        Ok(())
    }

    /// The sample.
    pub(super) fn sample(&self) -> ToolSample {
        ToolSample {
            time: time_back(self.time),
            pose: Pose {
                position_m: self.position.map(|x| f64::from(x) * POSITION_STEP_M),
                orientation: self.turn.quaternion(),
            },
            buttons: self.buttons,
            force_n: self.force.map(|f| f.map(|x| f64::from(x) * FORCE_STEP_N)),
        }
    }
}

/// The sample as the other side decodes it: time, position, rotation and force rounded to their steps.
/// The steps of a rotation are those of the first sample in a track; later ones may omit another
/// component of the quaternion, with the same bound.
///
/// # Errors
///
/// An invalid or too distant position or rotation can not be sent.
pub fn as_sent(sample: &ToolSample) -> Result<ToolSample, ProtocolError> {
    Ok(Point::of(sample, None)?.sample())
}

/// A time in steps.
pub(super) fn time(t: ServerTime) -> i64 {
    t.as_micros()
        .saturating_add(TIME_STEP_US / 2)
        .div_euclid(TIME_STEP_US)
}

/// The time at a number of steps.
pub(super) fn time_back(steps: i64) -> ServerTime {
    ServerTime::from_micros(steps.saturating_mul(TIME_STEP_US))
}

fn coordinate(x_m: f64) -> Result<i32, ProtocolError> {
    if !x_m.is_finite() || x_m.abs() > POSITION_MAX_M {
        return Err(out_of_range("a position", x_m, POSITION_MAX_M));
    }
    Ok((x_m / POSITION_STEP_M).round() as i32)
}

fn out_of_range(what: &'static str, value: f64, limit: f64) -> ProtocolError {
    ProtocolError::OutOfRange {
        what,
        detail: format!("{value}, the limit is ±{limit}"),
    }
}

/// A value in 16 bits at a step, clamped to the range; NaN becomes zero.
pub(super) fn saturating_i16(value: f64, step: f64) -> i16 {
    (value / step).round() as i16
}

impl QuantisedRotation {
    /// Rounds a unit quaternion (x, y, z, w); an error where its length is not 1.
    fn of(q: [f64; 4], near: Option<Self>) -> Result<Self, ProtocolError> {
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
        let omitted = near
            .map(|n| usize::from(n.omitted))
            .filter(|i| q[*i].abs() >= KEPT_COMPONENT * norm)
            .unwrap_or(largest);
        let scale = q[omitted].signum() / (norm * COMPONENT_STEP);
        let mut others = (0..4).filter(|i| *i != omitted);
        let parts = [(); 3].map(|()| others.next().map_or(0, |i| (q[i] * scale).round() as i32));
        Ok(Self {
            omitted: omitted as u8,
            parts,
        })
    }

    /// The unit quaternion (x, y, z, w).
    fn quaternion(self) -> [f64; 4] {
        let omitted = usize::from(self.omitted);
        let mut q = [0.0; 4];
        let mut rest = 1.0;
        for (part, i) in self.parts.iter().zip((0..4).filter(|i| *i != omitted)) {
            q[i] = f64::from(*part) * COMPONENT_STEP;
            rest -= q[i] * q[i];
        }
        q[omitted] = rest.max(0.0).sqrt();
        let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
        q.map(|c| c / norm)
    }
}
