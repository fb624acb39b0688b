//! Smooth motion of the tool towards the pointer's target.
//!
//! Pointers send 60 to 1000 events a second, with jumps. First the *lead* r moves to the goal in a straight line,
//! at most at speed V; the tool x follows it as a critically damped second-order system:
//!
//! ```text
//! |r'| <= V
//! x'' = w² (r - x) - 2 w x'            w = 60 /s
//! ```
//!
//! In one step r is a line, and then e = x - r + 2 r'/w obeys e'' + 2 w e' + w² e = 0, which is solved exactly:
//! e(t) = (e0 + (e0' + w e0) t) exp(-w t).
//!
//! - x is r weighted with w² t exp(-w t), which is positive and has the integral 1. The tool therefore stays in
//!   every box of the lead, is no faster than V, and does not overshoot.
//! - Position and velocity are continuous for any input.
//! - Behind a steady pointer the tool lags by 2/w = 33 ms.
//! - A pointer of 60 Hz causes a velocity ripple whose first harmonic is 2 w²/(w² + W²) = 5 % (W = 2 pi 60 /s);
//!   with the other harmonics the velocity is between 7 % less and 5 % more than the pointer's.
//!
//! Rotations are followed in the same way, as the rotation vector from the lead's orientation to the tool's. This
//! is exact about one axis; about several the error is of second order in the angle between the two, at most 2 V/w.

use nalgebra::{UnitQuaternion, Vector3};

use crate::Pose;

/// Rate of the follower (w), 1/s.
pub const RATE_PER_S: f64 = 60.0;

/// A tool in motion to its goal.
#[derive(Debug, Clone)]
pub struct Follower {
    /// Maximum speed (V), m/s.
    speed: f64,
    /// Maximum angular speed, rad/s.
    turn: f64,
    lead: Pose,
    pose: Pose,
    velocity: Vector3<f64>,
    angular_velocity: Vector3<f64>,
}

impl Follower {
    /// A tool at rest, no faster than `speed_m_per_s` and `turn_rad_per_s`.
    pub fn new(start: Pose, speed_m_per_s: f64, turn_rad_per_s: f64) -> Self {
        Self {
            speed: speed_m_per_s,
            turn: turn_rad_per_s,
            lead: start,
            pose: start,
            velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
        }
    }

    /// Pose of the tool.
    pub fn pose(&self) -> &Pose {
        &self.pose
    }

    /// The lead.
    pub fn lead(&self) -> &Pose {
        &self.lead
    }

    /// Its velocity, m/s.
    pub fn velocity(&self) -> Vector3<f64> {
        self.velocity
    }

    /// Its angular velocity, rad/s, in the frame of the scene.
    pub fn angular_velocity(&self) -> Vector3<f64> {
        self.angular_velocity
    }

    /// Stops it at its present pose.
    pub fn halt(&mut self) {
        self.lead = self.pose;
        self.velocity = Vector3::zeros();
        self.angular_velocity = Vector3::zeros();
    }

    /// Advances towards `goal` by `h` seconds.
    pub fn step(&mut self, goal: &Pose, h: f64) {
        if h <= 0.0 {
            return;
        }
        let moved = limited(goal.position - self.lead.position, self.speed * h);
        let away = self.pose.position - self.lead.position;
        let (away, velocity) = followed(away, self.velocity, moved / h, h);
        self.lead.position += moved;
        self.pose.position = self.lead.position + away;
        self.velocity = velocity;

        let to_goal = goal.orientation * self.lead.orientation.inverse();
        let turned = limited(to_goal.scaled_axis(), self.turn * h);
        let away = (self.pose.orientation * self.lead.orientation.inverse()).scaled_axis();
        let (away, velocity) = followed(away, self.angular_velocity, turned / h, h);
        self.lead.orientation =
            normal(UnitQuaternion::from_scaled_axis(turned) * self.lead.orientation);
        self.pose.orientation =
            normal(UnitQuaternion::from_scaled_axis(away) * self.lead.orientation);
        self.angular_velocity = velocity;
    }
}

/// `v`, shortened to at most `most`.
fn limited(v: Vector3<f64>, most: f64) -> Vector3<f64> {
    let n = v.norm();
    if n > most { v * (most / n) } else { v }
}

/// x - r and x' after `h` seconds with the lead at velocity `lead`.
fn followed(
    away: Vector3<f64>,
    velocity: Vector3<f64>,
    lead: Vector3<f64>,
    h: f64,
) -> (Vector3<f64>, Vector3<f64>) {
    let late = lead * (2.0 / RATE_PER_S);
    let e = away + late;
    let slope = velocity - lead;
    let both = slope + e * RATE_PER_S;
    let left = (-RATE_PER_S * h).exp();
    let away = (e + both * h) * left - late;
    let velocity = (slope - both * (RATE_PER_S * h)) * left + lead;
    (away, velocity)
}

/// Normalises: products of many unit quaternions drift.
fn normal(q: UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::new_normalize(q.into_inner())
}
