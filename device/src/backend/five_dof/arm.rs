//! One arm: three motors and two links, from the angles to where it ends and back (equations 4.1 to 4.6).
//!
//! The frame: x points away from the base, y to the left arm, z up; the origin is in the middle between the arms'
//! first axes. With s = +1 for the left arm and -1 for the right one:
//!
//! ```text
//! r   = L1 sin θ2 + L2 cos θ3
//! P_s = ( r cos θ1,  r sin θ1 + s L0,  -L1 cos θ2 - L2 sin θ3 )
//! ```
//!
//! θ1 turns the arm's plane about the vertical, θ2 is that of the upper link against hanging down, θ3 that of the
//! lower link below the horizon. Both are measured against the base, not against each other.

use nalgebra::{Matrix3, Vector3};

/// Left or right, as seen by the user.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// At y > 0.
    Left,
    /// At y < 0.
    Right,
}

impl Side {
    /// Both, in the order of the motors.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];

    const fn sign(self) -> f64 {
        match self {
            Self::Left => 1.0,
            Self::Right => -1.0,
        }
    }
}

/// θ1, θ2 and θ3 of an arm, rad.
pub type Angles = Vector3<f64>;

/// One arm of the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arm {
    /// On which side it hangs.
    pub side: Side,
    /// L0: from the middle of the base to the arm's first axis, m.
    pub offset_m: f64,
    /// L1: the upper link, m.
    pub upper_m: f64,
    /// L2: the lower link, m.
    pub lower_m: f64,
}

impl Arm {
    /// r: reach from its first axis, m; negative where it has folded through it.
    pub fn reach(&self, angles: &Angles) -> f64 {
        self.upper_m * angles.y.sin() + self.lower_m * angles.z.cos()
    }

    /// Position of its end, m (4.5, 4.6).
    pub fn end(&self, angles: &Angles) -> Vector3<f64> {
        let r = self.reach(angles);
        Vector3::new(
            r * angles.x.cos(),
            r * angles.x.sin() + self.side.sign() * self.offset_m,
            -self.upper_m * angles.y.cos() - self.lower_m * angles.z.sin(),
        )
    }

    /// How its end moves with its angles, m/rad; columns are ∂P/∂θ1, ∂P/∂θ2, ∂P/∂θ3 (4.12).
    pub fn jacobian(&self, angles: &Angles) -> Matrix3<f64> {
        let r = self.reach(angles);
        let (s1, c1) = angles.x.sin_cos();
        let (s2, c2) = angles.y.sin_cos();
        let (s3, c3) = angles.z.sin_cos();
        let (upper, lower) = (self.upper_m, self.lower_m);
        Matrix3::from_columns(&[
            Vector3::new(-r * s1, r * c1, 0.0),
            Vector3::new(upper * c2 * c1, upper * c2 * s1, upper * s2),
            Vector3::new(-lower * s3 * c1, -lower * s3 * s1, -lower * c3),
        ])
    }

    /// The Jacobian's determinant, m³: `r L1 L2 cos(θ2 + θ3)`. It is zero in singular postures: with the end on the
    /// first axis, or with the links in line.
    pub fn determinant(&self, angles: &Angles) -> f64 {
        self.reach(angles) * self.upper_m * self.lower_m * (angles.y + angles.z).cos()
    }

    /// Distance from a singular posture: the determinant's magnitude relative to its bound `L1 L2 (L1 + L2)`.
    pub fn manipulability(&self, angles: &Angles) -> f64 {
        let most = (self.upper_m + self.lower_m) * self.upper_m * self.lower_m;
        self.determinant(angles).abs() / most
    }

    /// Inverse kinematics: the angles that put its end at `end` (m), with the end in front of its first axis and
    /// the lower link bent upwards, cos(θ2 + θ3) >= 0. Angles are within a half turn of zero. `None` out of reach,
    /// or on the first axis, where θ1 is undefined.
    pub fn angles(&self, end: &Vector3<f64>) -> Option<Angles> {
        let (x, y) = (end.x, end.y - self.side.sign() * self.offset_m);
        let (r, z) = (x.hypot(y), end.z);
        let (upper, lower) = (self.upper_m, self.lower_m);
        // In the arm's plane with (r, z): the upper link along (sin θ2, -cos θ2), the lower one along
        // (cos θ3, -sin θ3). Their scalar product is sin(θ2 + θ3), their cross product cos(θ2 + θ3).
        let sine = (r * r + z * z - upper * upper - lower * lower) / (2.0 * upper * lower);
        let cosine = ((1.0 - sine) * (1.0 + sine)).sqrt();
        if !cosine.is_finite() || r == 0.0 {
            return None;
        }
        // The angle between the upper link and the line to the end.
        let ahead = (lower * cosine).atan2(upper + lower * sine);
        let upper_at = z.atan2(r) - ahead;
        let second = wrap(upper_at + std::f64::consts::FRAC_PI_2);
        let third = wrap(sine.atan2(cosine) - second);
        Some(Vector3::new(y.atan2(x), second, third))
    }
}

/// The same angle within a half turn of zero.
fn wrap(angle: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    angle - turn * (angle / turn).round()
}
