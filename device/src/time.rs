//! The clock of a device.

/// A moment on the clock that drives one device, in microseconds from an origin of its own.
///
/// A device on the loop's clock ([`ClockOwner::Ours`](crate::ClockOwner::Ours)) gets this time with every call; it
/// must not run backwards.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct DeviceTime(i64);

impl DeviceTime {
    /// The origin of this clock.
    pub const ZERO: Self = Self(0);

    /// The point `us` microseconds after the origin.
    pub const fn from_micros(us: i64) -> Self {
        Self(us)
    }

    /// The point `s` seconds after the origin, rounded to the microsecond.
    pub fn from_secs_f64(s: f64) -> Self {
        Self((s * 1e6).round() as i64)
    }

    /// Microseconds since the origin.
    pub const fn as_micros(self) -> i64 {
        self.0
    }

    /// Seconds since the origin.
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-6
    }

    /// Microseconds from `earlier` to this moment; negative when `earlier` is later.
    pub const fn micros_since(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }

    /// The moment `us` microseconds later.
    #[must_use]
    pub const fn plus_micros(self, us: i64) -> Self {
        Self(self.0.saturating_add(us))
    }
}

#[cfg(test)]
mod tests {
    use super::DeviceTime;

    #[test]
    fn differences_are_signed_and_do_not_wrap() {
        let a = DeviceTime::from_secs_f64(1.5);
        assert_eq!(a.as_micros(), 1_500_000);
        assert_eq!(DeviceTime::ZERO.micros_since(a), -1_500_000);
        assert_eq!(
            DeviceTime::from_micros(i64::MAX).plus_micros(1).as_micros(),
            i64::MAX
        );
    }
}
