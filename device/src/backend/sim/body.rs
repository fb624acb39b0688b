//! The hand's body: a mass on a spring and a damper whose other end follows the script.
//!
//! With x, v the tip's position and velocity, p, w those of the script (tremor included), F our
//! force on the tool, m, k, c the hand's mass, stiffness and damping:
//!
//! ```text
//! m dv/dt = k (p − x) + c (w − v) + F,    dx/dt = v
//! v ← v + h (k (p − x) + c (w − v) + F) / m,    x ← x + h v      (semi-implicit Euler)
//! ```
//!
//! h is fixed and its points are multiples of h on the device's clock, so that the times of reading do not change
//! the motion. It is stable while h² k / m + h c / m < 2; the bounds of a script's `[hand]` keep a wide margin.

use nalgebra::Vector3;

use super::tremor::Tremor;
use super::{CATCH_UP_MAX_US, ScriptStart};
use crate::{DeviceTime, Faults, Script};

/// The sub-step h, µs: four per tick of the haptic loop, so that the hand is smooth against it.
const SUB_STEP_US: i64 = 250;

#[derive(Debug)]
pub(super) struct Body {
    script: Script,
    tremor: Tremor,
    /// The last integration point; `None` until the first reading.
    integrated_to: Option<DeviceTime>,
    position: Vector3<f64>,
    velocity: Vector3<f64>,
}

impl Body {
    pub(super) fn new(script: Script) -> Self {
        let position = script.waypoints()[0].position;
        let tremor = Tremor::new(&script.hand());
        Self {
            script,
            tremor,
            integrated_to: None,
            position,
            velocity: Vector3::zeros(),
        }
    }

    pub(super) fn script(&self) -> &Script {
        &self.script
    }

    /// Integrates to the last point before `now`; `now` must not run backwards.
    pub(super) fn advance(
        &mut self,
        now: DeviceTime,
        start: &ScriptStart,
        force: Vector3<f64>,
    ) -> Faults {
        let Some(mut at) = self.integrated_to else {
            self.put_on_script(now, start);
            return Faults::NONE;
        };
        if now.micros_since(at) > CATCH_UP_MAX_US {
            self.put_on_script(now, start);
            return Faults::TIME_JUMP;
        }
        let hand = self.script.hand();
        let h = SUB_STEP_US as f64 * 1e-6;
        while now.micros_since(at) >= SUB_STEP_US {
            at = at.plus_micros(SUB_STEP_US);
            let (p, w) = self.target(at, start);
            let pull = hand.stiffness_n_per_m * (p - self.position)
                + hand.damping_ns_per_m * (w - self.velocity);
            self.velocity += (pull + force) * (h / hand.mass_kg);
            self.position += self.velocity * h;
        }
        self.integrated_to = Some(at);
        Faults::NONE
    }

    /// Position of the tip at `now`, extrapolated from the last integration point at its velocity.
    pub(super) fn position_at(&self, now: DeviceTime) -> Vector3<f64> {
        let rest_us = self.integrated_to.map_or(0, |at| now.micros_since(at));
        self.position + self.velocity * (rest_us as f64 * 1e-6)
    }

    pub(super) fn velocity(&self) -> Vector3<f64> {
        self.velocity
    }

    fn put_on_script(&mut self, now: DeviceTime, start: &ScriptStart) {
        let at = now.plus_micros(-now.as_micros().rem_euclid(SUB_STEP_US));
        let script = self.script.pose(start.script_s(at));
        self.position = script.pose.position;
        self.velocity = script.velocity;
        self.integrated_to = Some(at);
    }

    /// Position and velocity of the script's end of the spring.
    fn target(&self, at: DeviceTime, start: &ScriptStart) -> (Vector3<f64>, Vector3<f64>) {
        let script = self.script.pose(start.script_s(at));
        let (shake, rate) = self.tremor.at(at.as_secs_f64());
        (script.pose.position + shake, script.velocity + rate)
    }
}
