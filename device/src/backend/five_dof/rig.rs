//! Simulated boards, motors and links of a 5-DOF device, and the hand that holds it.
//!
//! With q the six angles, I the inertias of the axes, m the hand's mass, `J_P` the pivot's Jacobian, c(q) the square of
//! the ends' distance less that of the probe:
//!
//! ```text
//! M q'' = τ - b q' + J_Lᵀ h_L + J_Rᵀ h_R - m J_Pᵀ (dJ_P/dt) q' + Gᵀ λ      M = diag(I) + m J_Pᵀ J_P,  G = ∂c/∂q
//! ```
//!
//! h are the hand's forces on the two ends: a spring and a damper to the script at the pivot, and another pair that
//! turns the probe. Projection of rates and angles after each sub-step keeps the probe's length without drift.
//! Inertias, friction and the hand's grip are assumed, not measured.

use nalgebra::{SMatrix, SVector, Vector3};

use super::arm::Angles;
use super::device::Config;
use super::linkage::Linkage;
use super::port::{Port, PortFault, Six};
use super::signals::{Drive, Encoder};
use super::statics::end_forces;
use crate::backend::sim::{ScriptStart, Tremor};
use crate::{Buttons, DeviceTime, OpenError, Script, Wrench};

/// The sub-step, µs.
const SUB_STEP_US: i64 = 250;
/// Maximum pause between two calls that is integrated, µs; after a longer one the hand is placed on its script.
const CATCH_UP_MAX_US: i64 = 1_000_000;
/// Iterations of the length projection after a sub-step.
const PROJECTIONS: usize = 2;

type Vector6 = SVector<f64, 6>;
type Matrix6 = SMatrix<f64, 6, 6>;
type Matrix36 = SMatrix<f64, 3, 6>;

/// Assumed parameters of the simulated device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigConfig {
    /// Inertia of motor and link about each axis of an arm, kg·m².
    pub inertia_kg_m2: [f64; 3],
    /// Friction of each axis, N·m·s/rad.
    pub friction_nms: f64,
    /// Stiffness with which the hand turns the probe, N·m/rad.
    pub grip_nm: f64,
    /// Its damping, N·m·s/rad.
    pub grip_nms: f64,
}

impl Default for RigConfig {
    /// Links of 100 g and small motors: 60 g to move at the probe, on top of the hand.
    fn default() -> Self {
        Self {
            inertia_kg_m2: [1e-3; 3],
            friction_nms: 2e-3,
            grip_nm: 0.5,
            grip_nms: 0.01,
        }
    }
}

/// The simulated boards.
#[derive(Debug)]
pub struct Rig {
    linkage: Linkage,
    encoder: Encoder,
    drive: Drive,
    config: RigConfig,
    script: Script,
    tremor: Tremor,
    start: ScriptStart,
    angles: Vector6,
    rates: Vector6,
    /// Torques that the motors hold now, N·m.
    pub(super) torque_nm: Vector6,
    /// Offset of the counters from the encoders' true count.
    pub(super) offset: Six,
    pub(super) homed: bool,
    integrated_to: Option<DeviceTime>,
}

impl Rig {
    /// A device of these parts, held by the hand of a script in the device's own frame. It is calibrated.
    pub fn new(
        device: &Config,
        config: RigConfig,
        script: Script,
        start: ScriptStart,
    ) -> Result<Self, OpenError> {
        let mut rig = Self {
            linkage: device.linkage,
            encoder: device.encoder,
            drive: device.drive,
            config,
            tremor: Tremor::new(&script.hand()),
            script,
            start,
            angles: Vector6::zeros(),
            rates: Vector6::zeros(),
            torque_nm: Vector6::zeros(),
            offset: [0; 6],
            homed: true,
            integrated_to: None,
        };
        let begins = rig.script.pose(0.0).pose;
        let axis = begins.orientation * Vector3::y_axis();
        rig.angles = joined(&rig.linkage.angles(&begins.position, &axis)?);
        Ok(rig)
    }

    pub(super) fn true_counts(&self) -> Six {
        std::array::from_fn(|j| self.encoder.count(self.angles[j]))
    }

    /// Integrates until `now`.
    fn advance(&mut self, now: DeviceTime) {
        let Some(mut at) = self.integrated_to else {
            self.integrated_to = Some(now.plus_micros(-now.as_micros().rem_euclid(SUB_STEP_US)));
            return;
        };
        if now.micros_since(at) > CATCH_UP_MAX_US {
            self.jump(now);
            return;
        }
        while now.micros_since(at) >= SUB_STEP_US {
            at = at.plus_micros(SUB_STEP_US);
            self.step(at, SUB_STEP_US as f64 * 1e-6);
        }
        self.integrated_to = Some(at);
    }

    /// Places everything on the script.
    fn jump(&mut self, now: DeviceTime) {
        let target = self.script.pose(self.start.script_s(now)).pose;
        let axis = target.orientation * Vector3::y_axis();
        if let Ok(angles) = self.linkage.angles(&target.position, &axis) {
            self.angles = joined(&angles);
        }
        self.rates = Vector6::zeros();
        self.integrated_to = Some(now.plus_micros(-now.as_micros().rem_euclid(SUB_STEP_US)));
    }

    /// One sub-step of `h` s that ends at `at`.
    fn step(&mut self, at: DeviceTime, h: f64) {
        let angles = split(&self.angles);
        let forces = self.hand(at, &angles);
        let mut load = self.torque_nm - self.rates * self.config.friction_nms;
        for a in 0..2 {
            let by_hand = self.linkage.arms[a].jacobian(&angles[a]).tr_mul(&forces[a]);
            for k in 0..3 {
                load[3 * a + k] += by_hand[k];
            }
        }
        let mass = self.script.hand().mass_kg;
        let j = pivot_jacobian(&self.linkage, &self.angles);
        // Centripetal force of the hand's mass: the term with (dJ/dt) q'.
        let later = pivot_jacobian(&self.linkage, &(self.angles + self.rates * h));
        load -= j.tr_mul(&((later - j) * self.rates)) * (mass / h);
        let mut inertia = j.tr_mul(&j) * mass;
        for k in 0..6 {
            inertia[(k, k)] += self.config.inertia_kg_m2[k % 3];
        }
        // The inertia matrix is positive definite in every posture.
        let Some(inverse) = inertia.try_inverse() else {
            return;
        };
        self.rates += inverse * load * h;
        self.keep_length(&inverse, h);
    }

    /// Projects the rates onto constant probe length, moves, and corrects the remaining error.
    fn keep_length(&mut self, inverse: &Matrix6, h: f64) {
        let (g, _) = self.length(&self.angles);
        let along = inverse * g;
        self.rates -= along * (g.dot(&self.rates) / g.dot(&along));
        self.angles += self.rates * h;
        for _ in 0..PROJECTIONS {
            let (g, wrong) = self.length(&self.angles);
            let along = inverse * g;
            self.angles -= along * (wrong / g.dot(&along));
        }
    }

    /// G, and the error of the squared distance between the ends, m².
    fn length(&self, q: &Vector6) -> (Vector6, f64) {
        let angles = split(q);
        let [left, right] = self.linkage.ends(&angles);
        let across = left - right;
        let of = |a: usize| self.linkage.arms[a].jacobian(&angles[a]).tr_mul(&across);
        let g = joined(&[of(0) * 2.0, of(1) * -2.0]);
        let probe = self.linkage.probe_m;
        (g, across.norm_squared() - probe * probe)
    }

    /// The hand's forces on the two ends, N.
    fn hand(&self, at: DeviceTime, angles: &[Angles; 2]) -> [Vector3<f64>; 2] {
        let target = self.script.pose(self.start.script_s(at));
        let (shake, rate) = self.tremor.at(at.as_secs_f64());
        let probe = self.linkage.probe(angles);
        let (velocity, turning) = self.linkage.velocity(angles, &split(&self.rates));
        let hand = self.script.hand();
        let force = (target.pose.position + shake - probe.pivot) * hand.stiffness_n_per_m
            + (target.velocity + rate - velocity) * hand.damping_ns_per_m;
        let axis = target.pose.orientation * Vector3::y();
        let torque = probe.axis.cross(&axis) * self.config.grip_nm
            + (target.angular_velocity - turning) * self.config.grip_nms;
        end_forces(&probe, &Wrench { force, torque })
    }
}

/// Jacobian of the pivot for all six angles.
fn pivot_jacobian(linkage: &Linkage, q: &Vector6) -> Matrix36 {
    let angles = split(q);
    let mut j = Matrix36::zeros();
    for a in 0..2 {
        let of = linkage.arms[a].jacobian(&angles[a]) * 0.5;
        j.fixed_columns_mut::<3>(3 * a).copy_from(&of);
    }
    j
}

fn split(q: &Vector6) -> [Vector3<f64>; 2] {
    [0, 3].map(|from| q.fixed_rows::<3>(from).into_owned())
}

fn joined(of: &[Vector3<f64>; 2]) -> Vector6 {
    Vector6::from_fn(|j, _| of[j / 3][j % 3])
}

impl Port for Rig {
    fn counts(&mut self, now: DeviceTime) -> Result<Six, PortFault> {
        self.advance(now);
        let counts = self.true_counts();
        Ok(std::array::from_fn(|j| counts[j] + self.offset[j]))
    }

    fn command(&mut self, now: DeviceTime, codes: Six) -> Result<(), PortFault> {
        self.advance(now);
        self.torque_nm = Vector6::from_fn(|j, _| self.drive.torque(codes[j]));
        Ok(())
    }

    fn buttons(&mut self, now: DeviceTime) -> Buttons {
        if self.script.pose(self.start.script_s(now)).button {
            Buttons::PRIMARY
        } else {
            Buttons::NONE
        }
    }

    fn is_homed(&self) -> bool {
        self.homed
    }

    fn set_counts(&mut self, counts: Six) -> Result<(), PortFault> {
        let true_counts = self.true_counts();
        self.offset = std::array::from_fn(|j| counts[j] - true_counts[j]);
        self.homed = true;
        Ok(())
    }

    fn close(&mut self) {
        self.torque_nm = Vector6::zeros();
    }
}
