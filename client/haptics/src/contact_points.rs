//! All contact points of the tool, summed to a wrench about the pivot.

use nalgebra::Vector3;
use palpate_device::{Pose, Wrench};
use palpate_protocol::{ClientTime, Span};

use crate::blend::{ActiveContact, Blend};
use crate::motion::Motion;
use crate::proxy::ContactPlanes;
use crate::{CONTACTS_MAX, Friction, FrictionConfig, Grip};

/// Stick-slip state of every contact point, and the last pose of the tool.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ContactPoints {
    frictions: [Friction; CONTACTS_MAX],
    last: Option<Pose>,
}

/// Contact states of the tool: some contact points may stick while others slide.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Grips {
    pub(crate) sticks: bool,
    pub(crate) slips: bool,
}

impl Grips {
    pub(crate) fn any(self) -> bool {
        self.sticks || self.slips
    }
}

impl ContactPoints {
    pub(crate) fn new(config: FrictionConfig) -> Self {
        Self {
            frictions: [Friction::new(config); CONTACTS_MAX],
            last: None,
        }
    }

    /// Resets every contact point to no contact. For broken paths (a bad sample).
    pub(crate) fn reset(&mut self) {
        for friction in &mut self.frictions {
            friction.reset();
        }
        self.last = None;
    }

    pub(crate) fn grips(&self) -> Grips {
        let any = |grip| self.frictions.iter().any(|f| f.grip() == grip);
        Grips {
            sticks: any(Grip::Stick),
            slips: any(Grip::Slip),
        }
    }

    /// One tick, `dt` after the last: the wrench of the tissue on a tool in `motion`, about its pivot, and the contact
    /// planes there.
    pub(crate) fn tick(
        &mut self,
        blend: &Blend,
        now: ClientTime,
        dt: Span,
        motion: &Motion,
    ) -> (Wrench, ContactPlanes) {
        let mut planes = ContactPlanes::NONE;
        let (mut force, mut torque) = (Vector3::zeros(), Vector3::zeros());
        let couple = self.advance_friction(blend, now, dt, motion, |felt, across| {
            let push = felt.contact.normal * felt.normal_force + across;
            force += push;
            torque += felt.lever.cross(&push);
            planes.add(felt);
        });
        let torque = torque + couple;
        (Wrench { force, torque }, planes)
    }

    /// Advances the friction of every contact point; calls `each` with its tangential force. Returns the couple,
    /// N·m.
    fn advance_friction(
        &mut self,
        blend: &Blend,
        now: ClientTime,
        dt: Span,
        motion: &Motion,
        mut each: impl FnMut(&ActiveContact, Vector3<f64>),
    ) -> Vector3<f64> {
        let last = self.last.replace(motion.pose()).unwrap_or(motion.pose());
        let mut is_active = [false; CONTACTS_MAX];
        let couple = blend.for_each_contact(now, motion, |felt| {
            is_active[felt.index] = true;
            let moved = motion.moved_since(&last, &felt.lever);
            let v = motion.velocity_at(&felt.lever);
            let across = self.frictions[felt.index].tick(&felt.contact, &moved, &v, dt);
            each(&felt, across);
        });
        for (friction, is_active) in self.frictions.iter_mut().zip(is_active) {
            if !is_active {
                friction.reset();
            }
        }
        couple
    }
}

#[cfg(test)]
mod tests;
