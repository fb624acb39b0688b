//! Events of a tick and their counters.

/// Events of one tick, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Events(u16);

impl Events {
    /// No event.
    pub const NONE: Self = Self(0);
    /// The force was clamped to the device's limit.
    pub const SATURATED: Self = Self(1);
    /// The change of force was limited.
    pub const SLEWED: Self = Self(1 << 1);
    /// The contact model is old and its force fades.
    pub const STALE: Self = Self(1 << 2);
    /// The tool is outside the contact model's radius.
    pub const LEFT_RADIUS: Self = Self(1 << 3);
    /// The sample held a non-finite number; the force fades.
    pub const BAD_SAMPLE: Self = Self(1 << 4);
    /// The contact model was not usable and was rejected.
    pub const BAD_MODEL: Self = Self(1 << 5);
    /// The last active contact point lost contact in this tick.
    pub const RELEASED: Self = Self(1 << 6);
    /// A contact point sticks to the tissue.
    pub const STICK: Self = Self(1 << 7);
    /// A contact point slides over the tissue. Others may stick in the same tick.
    pub const SLIP: Self = Self(1 << 8);
    /// The device reports a fault; the force fades.
    pub const FAULTED: Self = Self(1 << 9);
    /// The link is lost and the force fades.
    pub const LINK_LOST: Self = Self(1 << 10);
    /// The soft start is in progress.
    pub const SOFT_START: Self = Self(1 << 11);
    /// The passivity controller reduced the force.
    pub const PASSIVATED: Self = Self(1 << 12);
    /// The torque was clamped to the device's limit.
    pub const TORQUE_SATURATED: Self = Self(1 << 13);
    /// The change of torque was limited.
    pub const TORQUE_SLEWED: Self = Self(1 << 14);

    /// The bits.
    pub const fn bits(self) -> u16 {
        self.0
    }

    /// Whether all events of `other` are set.
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Sets `other` when `it_happened`.
    pub(crate) fn set(&mut self, other: Self, it_happened: bool) {
        if it_happened {
            self.0 |= other.0;
        }
    }
}

/// Number of ticks with each event, and the extremes of a run.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Counters {
    /// All ticks.
    pub ticks: u64,
    /// Ticks in contact.
    pub in_contact: u64,
    /// [`Events::SATURATED`].
    pub saturated: u64,
    /// [`Events::SLEWED`].
    pub slewed: u64,
    /// [`Events::STALE`].
    pub stale: u64,
    /// [`Events::LEFT_RADIUS`].
    pub left_radius: u64,
    /// [`Events::BAD_SAMPLE`].
    pub bad_samples: u64,
    /// [`Events::BAD_MODEL`].
    pub bad_models: u64,
    /// [`Events::RELEASED`].
    pub released: u64,
    /// [`Events::STICK`].
    pub stick: u64,
    /// [`Events::SLIP`].
    pub slip: u64,
    /// [`Events::FAULTED`].
    pub faulted: u64,
    /// [`Events::LINK_LOST`].
    pub link_lost: u64,
    /// [`Events::PASSIVATED`].
    pub passivated: u64,
    /// [`Events::TORQUE_SATURATED`].
    pub torque_saturated: u64,
    /// [`Events::TORQUE_SLEWED`].
    pub torque_slewed: u64,
    /// Largest change of force between two ticks, N.
    pub max_delta_force_n: f64,
    /// Largest force, N.
    pub max_force_n: f64,
    /// Largest change of torque between two ticks, N·m.
    pub max_delta_torque_nm: f64,
    /// Largest torque, N·m.
    pub max_torque_nm: f64,
    /// Minimum of the energy that the hand has put in since the start, J; see
    /// the energy observer.
    pub min_energy_j: f64,
}

impl Counters {
    pub(crate) fn count(&mut self, events: Events) {
        self.ticks += 1;
        for (event, counter) in [
            (Events::SATURATED, &mut self.saturated),
            (Events::SLEWED, &mut self.slewed),
            (Events::STALE, &mut self.stale),
            (Events::LEFT_RADIUS, &mut self.left_radius),
            (Events::BAD_SAMPLE, &mut self.bad_samples),
            (Events::BAD_MODEL, &mut self.bad_models),
            (Events::RELEASED, &mut self.released),
            (Events::STICK, &mut self.stick),
            (Events::SLIP, &mut self.slip),
            (Events::FAULTED, &mut self.faulted),
            (Events::LINK_LOST, &mut self.link_lost),
            (Events::PASSIVATED, &mut self.passivated),
            (Events::TORQUE_SATURATED, &mut self.torque_saturated),
            (Events::TORQUE_SLEWED, &mut self.torque_slewed),
        ] {
            *counter += u64::from(events.contains(event));
        }
        self.in_contact +=
            u64::from(events.contains(Events::STICK) || events.contains(Events::SLIP));
    }
}

#[cfg(test)]
mod tests {
    use super::{Counters, Events};

    #[test]
    fn every_event_is_counted_where_it_belongs() {
        let mut c = Counters::default();
        let mut e = Events::NONE;
        e.set(Events::STALE, true);
        e.set(Events::SLIP, true);
        e.set(Events::SLEWED, false);
        c.count(e);
        c.count(Events::NONE);
        assert_eq!(
            (c.ticks, c.stale, c.slip, c.in_contact, c.slewed),
            (2, 1, 1, 1, 0)
        );
    }
}
