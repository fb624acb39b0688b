//! Rate control: the deflection sets the velocity of the tool.
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
//! The dead zone applies to the norm of the vector, so directions are kept. Between two steps u is constant and the
//! rest is solved exactly. Velocity is continuous for any deflection, and so position has no corner.
//!
//! At a distance r from a wall, v/r = q obeys q' <= (q - 1/(2 T))² as long as u <= r/(4 T): it approaches 1/(2 T)
//! from below. The tool therefore comes to rest at the wall without a jump of velocity; the clamp of the position
//! is only for rounding.

use nalgebra::{UnitQuaternion, Vector3};

use crate::error::check_ranges;
use crate::{DeviceTime, Faults, OpenError, Pose, Workspace};

/// Maximum pause between two readings that is integrated, µs. After a longer one the tool keeps its pose, at rest,
/// and the sample carries [`Faults::TIME_JUMP`].
pub const PAUSE_MAX_US: i64 = 100_000;

/// Maximum step, µs. Walls are checked once per step.
const STEP_MAX_US: i64 = 1000;

/// Map from deflection to speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateControl {
    /// Dead zone as a fraction of the full deflection, 0 to 0.9.
    pub dead_zone: f64,
    /// The exponent of the curve from there to full deflection, 1 (a line) to 4 (fine around the middle).
    pub exponent: f64,
    /// Speed at full deflection, m/s, up to 1.
    pub speed_m_per_s: f64,
    /// Angular speed at full deflection, rad/s, up to 10.
    pub turn_rad_per_s: f64,
    /// Time constant of the velocity, s, 0.01 to 0.5. The tool lags by the same time.
    pub follow_s: f64,
}

impl Default for RateControl {
    /// A tool for tissue: 80 mm/s and a third of a turn per second at full deflection, with a lag of half a tenth
    /// of a second.
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

impl RateControl {
    /// Checks the range of every number.
    pub fn check(&self) -> Result<(), OpenError> {
        let numbers = [
            ("dead_zone", self.dead_zone, 0.0..=0.9),
            ("exponent", self.exponent, 1.0..=4.0),
            ("speed_m_per_s", self.speed_m_per_s, 1e-3..=1.0),
            ("turn_rad_per_s", self.turn_rad_per_s, 1e-2..=10.0),
            ("follow_s", self.follow_s, 0.01..=0.5),
        ];
        check_ranges("the rate control", numbers)
    }

    /// The deflection `d` after dead zone and curve: a norm of 0 to 1, and zero for NaN.
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
    /// A tool at rest at `start`, clamped to the workspace.
    pub fn new(rate: RateControl, workspace: Workspace, start: Pose) -> Result<Self, OpenError> {
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

    /// Pose of the tool.
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

    /// Stops the tool at `now`, at its present pose.
    pub fn halt(&mut self, now: DeviceTime) {
        self.now = Some(now);
        self.velocity = Vector3::zeros();
        self.angular_velocity = Vector3::zeros();
    }

    /// Integrates the tool until `now` with the constant deflection `push` and `twist`.
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
        // Normalises: ten million products of unit quaternions drift.
        self.pose.orientation = UnitQuaternion::new_normalize(turned.into_inner());
    }
}
