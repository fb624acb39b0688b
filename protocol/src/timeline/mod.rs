//! One tool over time, as other sites display it at the moment τ = now - D.
//!
//! ```text
//! a sample at τ        -> use it
//! both neighbours      -> INTERPOLATE
//! only past, gap <= G  -> EXTRAPOLATE                       G = 50 ms
//! else                 -> SLOW DOWN and HOLD; after 0.5 s the contact fades (`silence`)
//! a late packet        -> insert it; blend the correction linearly over 30-100 ms
//! ```
//!
//! A correction lasts at most 100 ms whatever its size, so that all sites agree again soon after a stall. A picture
//! limits its steps itself: [`Shown::returns`].
//!
//! Between samples, positions by the formulas of [`crate::verlet`] and rotations by slerp. Beyond the newest
//! sample, several predictors weighted by their errors so far ([`Method::Chosen`]), because the best depends
//! on the noise of the device, the agility of the hand and the span.

mod bank;
mod curvature;
mod curve;
mod kalman;
mod silence;

use nalgebra::{Quaternion, UnitQuaternion};

use crate::verlet::{Vec3, map2};
use crate::{Pose, ServerTime, Span, ToolSample};
use curve::Curve;

pub use silence::{PRESSES_UNTIL, RELEASED_FROM, SLOWING, SLOWING_MAX_M};

/// The gap limit G unless another is given.
pub const GAP_LIMIT: Span = Span::from_millis(50);

/// A correction is blended over this time when it is small ...
pub const BLEND_MIN: Span = Span::from_millis(30);

/// ... and over this time when it is 10 mm or more, or when contact returns in full.
pub const BLEND_MAX: Span = Span::from_millis(100);

/// Time after a hold in which all sites agree again: the correction, and the tissue that follows it.
pub const RETURN: Span = Span::from_millis(200);

/// Samples kept per tool: two seconds at 1 kHz, more than the longest delay. The oldest go first.
pub const SAMPLES_MAX: usize = 2048;

/// The method for missing samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Method {
    /// Beyond the newest sample the mean of hold, linear, windowed Verlet and four Kalman filters, weighted
    /// by their measured errors over such a span in this stream. Between samples windowed Verlet with the share of
    /// its curvature that errs least in this stream.
    #[default]
    Chosen,
    /// The same of the Kalman filters alone.
    Kalman,
    /// Verlet's rule with accelerations from a window of samples.
    Verlet,
    /// Verlet's rule with the second difference from sample to sample, which multiplies their noise.
    VerletRaw,
    /// The cubic with the velocities of both ends, which come from a window on each side. Beyond the
    /// samples: its velocity and fading acceleration at the end of the last window. Between samples it
    /// is more accurate than Verlet for gaps above 20 to 30 ms.
    Hermite,
    /// Linear interpolation and extrapolation.
    Linear,
    /// Holds the last sample.
    Hold,
}

impl Method {
    /// All of them, the plainest first.
    pub const ALL: [Self; 7] = [
        Self::Hold,
        Self::Linear,
        Self::VerletRaw,
        Self::Verlet,
        Self::Hermite,
        Self::Kalman,
        Self::Chosen,
    ];

    /// Its name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Hold => "hold",
            Self::Linear => "linear",
            Self::VerletRaw => "verlet",
            Self::Verlet => "verlet-windowed",
            Self::Hermite => "hermite",
            Self::Kalman => "kalman",
            Self::Chosen => "chosen",
        }
    }
}

/// The source of the displayed pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// A sample of this very moment.
    Exact,
    /// Between two samples.
    Interpolated,
    /// Beyond the newest sample, by at most the gap limit.
    Extrapolated,
    /// Farther beyond the newest sample: the tool slows down and is held.
    Held,
}

/// A tool at a moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shown {
    /// Its pose.
    pub pose: Pose,
    /// Its velocity, m/s.
    pub velocity_m_s: [f64; 3],
    /// Its buttons.
    pub buttons: u8,
    /// The source of the pose.
    pub source: Source,
    /// Share of its contact force: 1 up to [`PRESSES_UNTIL`] beyond the newest sample, 0 from [`RELEASED_FROM`] on.
    pub strength: f64,
    /// Whether it returns from a held pose: up to [`RETURN`] after the hold.
    pub returns: bool,
}

/// The difference between the displayed and the newly known pose, fading to zero.
#[derive(Debug, Clone, Copy)]
struct Correction {
    began: ServerTime,
    lasts: Span,
    position_m: Vec3,
    rotation: UnitQuaternion<f64>,
    strength: f64,
}

#[derive(Debug, Clone, Copy)]
struct LastShown {
    at: ServerTime,
    shown: Shown,
    /// The same from the samples of that time, without corrections.
    raw: Shown,
}

/// One tool over time. [`insert`](Self::insert) samples in order of arrival, late and duplicate ones
/// too; query [`at`](Self::at) for any moment. Corrections are blended along the queried moments, so
/// that one timeline serves one view, which queries ascending times.
#[derive(Debug, Clone)]
pub struct Timeline {
    curve: Curve,
    gap_limit: Span,
    changed: bool,
    correction: Option<Correction>,
    /// Last time shown of the latest hold that a sample has ended.
    held_until: Option<ServerTime>,
    last: Option<LastShown>,
}

impl Default for Timeline {
    fn default() -> Self {
        Self::new(Method::default(), GAP_LIMIT)
    }
}

impl Timeline {
    /// An empty timeline that extrapolates at most `gap_limit` beyond the newest sample.
    pub fn new(method: Method, gap_limit: Span) -> Self {
        Self {
            curve: Curve::new(method),
            gap_limit: gap_limit.abs(),
            changed: false,
            correction: None,
            held_until: None,
            last: None,
        }
    }

    /// Adds a sample in its place. A second sample of the same time is ignored.
    pub fn insert(&mut self, sample: ToolSample) {
        self.changed |= self.curve.insert(sample);
    }

    /// The moment of the newest sample.
    pub fn newest(&self) -> Option<ServerTime> {
        self.curve.newest().map(|s| s.time)
    }

    /// The tool at a moment; `None` before the first sample.
    pub fn at(&mut self, t: ServerTime) -> Option<Shown> {
        if std::mem::take(&mut self.changed) {
            self.note_correction(t);
        }
        let raw = self.raw(t)?;
        let mut shown = raw;
        if let Some(correction) = self.correction {
            let elapsed = (t - correction.began).as_secs_f64() / correction.lasts.as_secs_f64();
            let weight = (1.0 - elapsed).clamp(0.0, 1.0);
            shown.pose.position_m = map2(raw.pose.position_m, correction.position_m, |x, c| {
                x + c * weight
            });
            let turn = UnitQuaternion::identity().slerp(&correction.rotation, weight);
            shown.pose.orientation = from_unit(turn * unit(raw.pose.orientation));
            shown.strength = (raw.strength + correction.strength * weight).clamp(0.0, 1.0);
            if weight == 0.0 {
                self.correction = None;
            }
        }
        let began = |until: ServerTime| (Span::ZERO..RETURN).contains(&(t - until));
        shown.returns = self.held_until.is_some_and(began);
        self.last = Some(LastShown { at: t, shown, raw });
        Some(shown)
    }

    /// The pose from the samples alone, without the correction in progress; `None` before the first
    /// sample.
    pub fn uncorrected_pose(&self, t: ServerTime) -> Option<Pose> {
        self.raw(t).map(|shown| shown.pose)
    }

    /// The pose from the samples, without corrections.
    fn raw(&self, t: ServerTime) -> Option<Shown> {
        let newest = self.curve.newest()?;
        let limit = newest.time + self.gap_limit;
        let since = t - limit;
        let strength = silence::strength(t - newest.time);
        if since <= Span::ZERO {
            let (pose, velocity_m_s, sample, source) = self.curve.at(t)?;
            return Some(Shown {
                pose,
                velocity_m_s,
                buttons: sample.buttons,
                source,
                strength,
                returns: false,
            });
        }
        let (at_limit, velocity, sample, _) = self.curve.at(limit)?;
        let slowing = silence::slowing(since, distance(velocity, [0.0; 3]));
        let position_m = map2(at_limit.position_m, velocity, |x, v| {
            x + v * slowing.distance_s
        });
        // The rotation slows down in the same way, along the prediction.
        let turned = limit + Span::from_secs_f64(silence::slowing(since, 0.0).distance_s);
        let (at_turned, ..) = self.curve.at(turned)?;
        Some(Shown {
            pose: Pose {
                position_m,
                orientation: at_turned.orientation,
            },
            velocity_m_s: velocity.map(|v| v * slowing.velocity),
            buttons: sample.buttons,
            source: Source::Held,
            strength,
            returns: false,
        })
    }

    /// New samples may change the pose at the moment last shown: the difference is then blended away
    /// from there on.
    fn note_correction(&mut self, t: ServerTime) {
        const MOVED_M: f64 = 1e-6;
        let Some(last) = self.last else { return };
        let Some(now_known) = self.raw(last.at) else {
            return;
        };
        let moved = distance(now_known.pose.position_m, last.raw.pose.position_m);
        let turned = unit(now_known.pose.orientation).angle_to(&unit(last.raw.pose.orientation));
        let regained = now_known.strength - last.raw.strength;
        if moved < MOVED_M && turned < 1e-4 && regained <= 0.0 {
            return;
        }
        if t < last.at {
            self.correction = None;
            return;
        }
        let shown = if last.shown.strength > 0.0 {
            last.shown.pose
        } else {
            // The tool did not press: it appears at its pose, and its contact grows.
            now_known.pose
        };
        let faded = (now_known.strength - last.shown.strength).max(0.0);
        let position_m = map2(shown.position_m, now_known.pose.position_m, |s, k| s - k);
        let rotation = unit(shown.orientation) * unit(now_known.pose.orientation).inverse();
        let share = (distance(position_m, [0.0; 3]) / 0.010).max(faded).min(1.0);
        let extra = (BLEND_MAX - BLEND_MIN).as_secs_f64() * share;
        let lasts = BLEND_MIN + Span::from_secs_f64(extra);
        if last.shown.source == Source::Held {
            self.held_until = Some(last.at);
        }
        self.correction = Some(Correction {
            began: last.at,
            lasts,
            position_m,
            rotation,
            strength: -faded,
        });
    }
}

fn distance(a: Vec3, b: Vec3) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).powi(2))
        .sum::<f64>()
        .sqrt()
}

/// A rotation from its components; invalid ones become the identity.
fn unit([x, y, z, w]: [f64; 4]) -> UnitQuaternion<f64> {
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6).unwrap_or_default()
}

fn from_unit(q: UnitQuaternion<f64>) -> [f64; 4] {
    [q.i, q.j, q.k, q.w]
}

#[cfg(test)]
mod tests;
