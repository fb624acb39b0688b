//! Points in time, one type per clock, so that the compiler keeps the clocks apart.
//!
//! All of them count microseconds from their own origin. This crate never reads a clock: the shells do,
//! and pass the time as an argument.

use std::ops::{Add, AddAssign, Neg, Sub, SubAssign};

use serde::{Deserialize, Serialize};

/// A signed length of time in microseconds; the unit of every delay, offset and period here.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
)]
pub struct Span(i64);

impl Span {
    /// The zero span.
    pub const ZERO: Self = Self(0);

    /// A span of `us` microseconds.
    pub const fn from_micros(us: i64) -> Self {
        Self(us)
    }

    /// A span of `ms` milliseconds.
    pub const fn from_millis(ms: i64) -> Self {
        Self(ms * 1000)
    }

    /// A span of `s` seconds, rounded to the microsecond. NaN becomes zero; a value too large for 64
    /// bits becomes the largest span.
    pub fn from_secs_f64(s: f64) -> Self {
        Self((s * 1e6).round() as i64)
    }

    /// The span in whole microseconds.
    pub const fn as_micros(self) -> i64 {
        self.0
    }

    /// The span in milliseconds.
    pub fn as_millis_f64(self) -> f64 {
        self.0 as f64 * 1e-3
    }

    /// The span in seconds.
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-6
    }

    /// The same span without its sign.
    #[must_use]
    pub const fn abs(self) -> Self {
        Self(self.0.saturating_abs())
    }
}

impl Add for Span {
    type Output = Self;
    fn add(self, rhs: Self) -> Self {
        Self(self.0.saturating_add(rhs.0))
    }
}

impl AddAssign for Span {
    fn add_assign(&mut self, rhs: Self) {
        *self = *self + rhs;
    }
}

impl Sub for Span {
    type Output = Self;
    fn sub(self, rhs: Self) -> Self {
        Self(self.0.saturating_sub(rhs.0))
    }
}

impl SubAssign for Span {
    fn sub_assign(&mut self, rhs: Self) {
        *self = *self - rhs;
    }
}

impl Neg for Span {
    type Output = Self;
    fn neg(self) -> Self {
        Self(self.0.saturating_neg())
    }
}

macro_rules! clock_time {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
        )]
        pub struct $name(i64);

        impl $name {
            /// The origin of this clock.
            pub const ZERO: Self = Self(0);

            /// The point `us` microseconds after the origin.
            pub const fn from_micros(us: i64) -> Self {
                Self(us)
            }

            /// Microseconds since the origin.
            pub const fn as_micros(self) -> i64 {
                self.0
            }

            /// Seconds since the origin.
            pub fn as_secs_f64(self) -> f64 {
                self.0 as f64 * 1e-6
            }
        }

        impl Add<Span> for $name {
            type Output = Self;
            fn add(self, rhs: Span) -> Self {
                Self(self.0.saturating_add(rhs.as_micros()))
            }
        }

        impl Sub<Span> for $name {
            type Output = Self;
            fn sub(self, rhs: Span) -> Self {
                Self(self.0.saturating_sub(rhs.as_micros()))
            }
        }

        impl Sub for $name {
            type Output = Span;
            fn sub(self, rhs: Self) -> Span {
                Span::from_micros(self.0.saturating_sub(rhs.0))
            }
        }
    };
}

clock_time! {
    /// A moment on the server's clock, the shared time of a session. Samples, operations and their
    /// release carry it.
    ServerTime
}

clock_time! {
    /// A moment on one client's own monotonic clock. It never leaves that client, except echoed
    /// back in clock probes.
    ClientTime
}
