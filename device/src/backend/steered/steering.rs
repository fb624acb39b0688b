//! Rate control: how far the hand deflects says how fast the tool moves.
//!
//! ```text
//! m  = 0                               where |d| <= z            d: deflection, z: dead zone
//! m  = ((min(|d|, 1) - z)/(1 - z))^p   elsewhere                 p: exponent
//! u  = m s d/|d|                                                 s: speed at full deflection
//! u  clamped to -(x - min)/(4 T) .. (max - x)/(4 T), axis by axis
//! v' = (u - v)/T                                                 T: time constant
//! x' = v
//! ```
//!
//! The dead zone is one of the whole vector, so it turns no direction. Between two steps u is constant and the rest is
//! solved exactly. Velocity is continuous, whatever the deflection does, and so position has no corner.
//!
//! Beside a wall with the room r before it, v/r = q obeys q' <= (q - 1/(2 T))² as long as u <= r/(4 T): it comes close to 1/(2 T)
//! from below and never passes it. So the tool comes to rest at the wall by itself, without a jump of velocity; the
//! clamp of the position behind it is there for rounding.

use nalgebra::{UnitQuaternion, Vector3};
use thiserror::Error;

use crate::{DeviceTime, Faults, Pose, Workspace};

/// The longest pause between two readings that is steered through, µs. Nobody watched the tool in a longer one, so it
/// stays where it was and begins from rest, and the sample carries [`Faults::TIME_JUMP`].
pub const PAUSE_MAX_US: i64 = 100_000;

/// The longest step, µs. Walls are looked for once per step.
const STEP_MAX_US: i64 = 1000;

/// How deflections become speeds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateControl {
    /// The part of the full deflection in which nothing moves, 0 to 0.9.
    pub dead_zone: f64,
    /// The exponent of the curve from there to full deflection, 1 (a line) to 4 (fine around the middle).
    pub exponent: f64,
    /// Speed at full deflection, m/s, up to 1.
    pub speed_m_per_s: f64,
    /// Angular speed at full deflection, rad/s, up to 10.
    pub turn_rad_per_s: f64,
    /// Time constant with which velocity follows, s, 0.01 to 0.5. The tool lags by as much.
    pub follow_s: f64,
}

impl Default for RateControl {
    /// A tool for tissue: 80 mm/s and a third of a turn per second at the most, half a tenth of a second behind.
    fn default() -> Self {
        Self {
            dead_zone: 0.08,
            exponent: 1.5,
            speed_m_per_s: 0.08,
            turn_rad_per_s: 2.0,
            follow_s: 0.05,
        }
    }
}

/// A number of [`RateControl`] that can not be.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[error("{what} of the rate control is {found}, and must be a number from {least} to {most}")]
pub struct BadRate {
    /// Which.
    pub what: &'static str,
    /// What it is.
    pub found: f64,
    /// The smallest it may be.
    pub least: f64,
    /// The largest it may be.
    pub most: f64,
}

impl RateControl {
    /// Whether all of it can be.
    pub fn check(&self) -> Result<(), BadRate> {
        for (what, found, least, most) in [
            ("dead_zone", self.dead_zone, 0.0, 0.9),
            ("exponent", self.exponent, 1.0, 4.0),
            ("speed_m_per_s", self.speed_m_per_s, 1e-3, 1.0),
            ("turn_rad_per_s", self.turn_rad_per_s, 1e-2, 10.0),
            ("follow_s", self.follow_s, 0.01, 0.5),
        ] {
            if !(least..=most).contains(&found) {
                return Err(BadRate {
                    what,
                    found,
                    least,
                    most,
                });
            }
        }
        Ok(())
    }

    /// The deflection `d` behind dead zone and curve: between 0 and 1 long, and nothing for what is no number.
    pub fn shape(&self, d: &Vector3<f64>) -> Vector3<f64> {
        let n = d.norm();
        if !(n > self.dead_zone && n.is_finite()) {
            return Vector3::zeros();
        }
        let beyond = (n.min(1.0) - self.dead_zone) / (1.0 - self.dead_zone);
        d * (beyond.powf(self.exponent) / n)
    }
}

/// A tool that is steered through a workspace.
#[derive(Debug, Clone)]
pub struct Steering {
    rate: RateControl,
    workspace: Workspace,
    pose: Pose,
    velocity: Vector3<f64>,
    angular_velocity: Vector3<f64>,
    now: Option<DeviceTime>,
}

impl Steering {
    /// A tool at rest at `start`, or at the place of the workspace that is nearest to it.
    pub fn new(rate: RateControl, workspace: Workspace, start: Pose) -> Result<Self, BadRate> {
        rate.check()?;
        let within = start.position.sup(&workspace.min).inf(&workspace.max);
        Ok(Self {
            rate,
            workspace,
            pose: Pose {
                position: within,
                ..start
            },
            velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
            now: None,
        })
    }

    /// Where the tool is.
    pub fn pose(&self) -> &Pose {
        &self.pose
    }

    /// Its velocity, m/s.
    pub fn velocity(&self) -> Vector3<f64> {
        self.velocity
    }

    /// Its angular velocity, rad/s, in the frame of the scene.
    pub fn angular_velocity(&self) -> Vector3<f64> {
        self.angular_velocity
    }

    /// Stops the tool where it is at `now`.
    pub fn halt(&mut self, now: DeviceTime) {
        self.now = Some(now);
        self.velocity = Vector3::zeros();
        self.angular_velocity = Vector3::zeros();
    }

    /// Lets the tool move until `now`, deflected by `push` and `twist` all the time.
    pub fn advance(
        &mut self,
        now: DeviceTime,
        push: &Vector3<f64>,
        twist: &Vector3<f64>,
    ) -> Faults {
        let passed = now.micros_since(self.now.unwrap_or(now));
        if passed > PAUSE_MAX_US {
            self.halt(now);
            return Faults::TIME_JUMP;
        }
        self.now = Some(now);
        let move_at = self.rate.shape(push) * self.rate.speed_m_per_s;
        let turn_at = self.rate.shape(twist) * self.rate.turn_rad_per_s;
        let steps = (passed + STEP_MAX_US - 1).max(0) / STEP_MAX_US;
        for _ in 0..steps {
            self.step(passed as f64 * 1e-6 / steps as f64, &move_at, &turn_at);
        }
        Faults::NONE
    }

    fn step(&mut self, h: f64, move_at: &Vector3<f64>, turn_at: &Vector3<f64>) {
        let t = self.rate.follow_s;
        let left = (-h / t).exp();
        let Workspace { min, max } = self.workspace;
        let x = &mut self.pose.position;
        for i in 0..3 {
            let u = move_at[i].clamp((min[i] - x[i]) / (4.0 * t), (max[i] - x[i]) / (4.0 * t));
            let ahead = self.velocity[i] - u;
            let to = x[i] + u * h + ahead * t * (1.0 - left);
            self.velocity[i] = u + ahead * left;
            x[i] = to.clamp(min[i], max[i]);
            if x[i] != to {
                self.velocity[i] = 0.0;
            }
        }
        let ahead = self.angular_velocity - turn_at;
        let turned = turn_at * h + ahead * (t * (1.0 - left));
        self.angular_velocity = turn_at + ahead * left;
        let turned = UnitQuaternion::from_scaled_axis(turned) * self.pose.orientation;
        // Ten million products of unit quaternions are not one.
        self.pose.orientation = UnitQuaternion::new_normalize(turned.into_inner());
    }
}
