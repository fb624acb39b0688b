//! The samples of one tool and the curve through them.

use std::collections::VecDeque;

use crate::timeline::{Method, SAMPLES_MAX, Source, from_unit, unit};
use crate::verlet::{self, Knot, Vec3, WINDOW_S};
use crate::{Pose, ServerTime, Span, ToolSample};

/// Two samples farther apart than this are not joined by a curve but by a straight line: there was
/// a pause, and an acceleration across it means nothing.
const JOINED_MAX: Span = Span::from_millis(250);

/// A rotation is not carried on beyond the newest sample faster than this, rad/s.
const SPIN_MAX: f64 = 20.0;

#[derive(Debug, Clone)]
pub(super) struct Curve {
    method: Method,
    /// Ascending in time, no two of one moment.
    samples: VecDeque<ToolSample>,
}

impl Curve {
    pub(super) fn new(method: Method) -> Self {
        Self {
            method,
            samples: VecDeque::new(),
        }
    }

    pub(super) fn newest(&self) -> Option<&ToolSample> {
        self.samples.back()
    }

    /// Whether anything changed.
    pub(super) fn insert(&mut self, sample: ToolSample) -> bool {
        let i = match self.samples.back() {
            Some(last) if last.time >= sample.time => {
                self.samples.partition_point(|s| s.time < sample.time)
            }
            _ => self.samples.len(),
        };
        if self.samples.get(i).is_some_and(|s| s.time == sample.time) {
            return false;
        }
        if self.samples.len() == SAMPLES_MAX {
            if i == 0 {
                return false;
            }
            self.samples.pop_front();
            self.samples.insert(i - 1, sample);
        } else {
            self.samples.insert(i, sample);
        }
        true
    }

    /// Pose, velocity, the sample whose buttons hold, and where it comes from.
    pub(super) fn at(&self, t: ServerTime) -> Option<(Pose, Vec3, ToolSample, Source)> {
        let after = self.samples.partition_point(|s| s.time <= t);
        let i = after.checked_sub(1)?;
        let here = self.samples[i];
        if here.time == t {
            return Some((here.pose, self.velocity_at(i), here, Source::Exact));
        }
        if after < self.samples.len() {
            let (pose, velocity) = self.between(i, t);
            return Some((pose, velocity, here, Source::Interpolated));
        }
        let (pose, velocity) = self.beyond(i, t);
        Some((pose, velocity, here, Source::Extrapolated))
    }

    /// A sample in seconds relative to another moment, so that large times lose no digits.
    fn knot(&self, i: usize, origin: ServerTime) -> Knot {
        let s = &self.samples[i];
        Knot {
            t: (s.time - origin).as_secs_f64(),
            x: s.pose.position_m,
        }
    }

    /// The sample one window before number `i`, or the oldest within reach.
    fn behind(&self, i: usize) -> Option<usize> {
        let edge = self.samples[i].time - Span::from_secs_f64(WINDOW_S);
        let j = self
            .samples
            .partition_point(|s| s.time <= edge)
            .checked_sub(1);
        let j = j.or_else(|| i.checked_sub(1).map(|_| 0))?;
        let near = self.samples[i].time - self.samples[j].time <= JOINED_MAX;
        if near {
            Some(j)
        } else {
            (i > j + 1).then(|| i - 1)
        }
    }

    /// The sample one window after number `i`, or the newest within reach.
    fn ahead(&self, i: usize) -> Option<usize> {
        let edge = self.samples[i].time + Span::from_secs_f64(WINDOW_S);
        let last = self.samples.len() - 1;
        let j = self.samples.partition_point(|s| s.time < edge).min(last);
        (j > i && self.samples[j].time - self.samples[i].time <= JOINED_MAX).then_some(j)
    }

    /// From one window before a sample to one after it.
    fn velocity_at(&self, i: usize) -> Vec3 {
        let origin = self.samples[i].time;
        let (before, after) = (self.behind(i).unwrap_or(i), self.ahead(i).unwrap_or(i));
        if before == after {
            return [0.0; 3];
        }
        verlet::velocity(self.knot(before, origin), self.knot(after, origin))
    }

    fn between(&self, i: usize, t: ServerTime) -> (Pose, Vec3) {
        let (s0, s1) = (&self.samples[i], &self.samples[i + 1]);
        let (k0, k1) = (self.knot(i, s0.time), self.knot(i + 1, s0.time));
        let at = (t - s0.time).as_secs_f64();
        let joined = s1.time - s0.time <= JOINED_MAX;
        let method = if joined { self.method } else { Method::Linear };
        let position_m = match method {
            Method::Verlet => {
                let a0 = self
                    .behind(i)
                    .map(|m| verlet::acceleration(self.knot(m, s0.time), k0, k1));
                let a1 = self
                    .ahead(i + 1)
                    .map(|p| verlet::acceleration(k0, k1, self.knot(p, s0.time)));
                let (a0, a1) = (a0.or(a1).unwrap_or_default(), a1.or(a0).unwrap_or_default());
                verlet::interpolate(k0, k1, a0, a1, at)
            }
            Method::Hermite => {
                verlet::hermite(k0, k1, self.velocity_at(i), self.velocity_at(i + 1), at)
            }
            Method::Linear => verlet::interpolate(k0, k1, [0.0; 3], [0.0; 3], at),
            Method::Hold => s0.pose.position_m,
        };
        let u = if method == Method::Hold {
            0.0
        } else {
            at / k1.t
        };
        let (q0, q1) = (unit(s0.pose.orientation), unit(s1.pose.orientation));
        // Half a turn between two samples has no shortest way: keep the first.
        let turn = q0.try_slerp(&q1, u, 1e-9).unwrap_or(q0);
        let (v0, v1) = (self.velocity_at(i), self.velocity_at(i + 1));
        let velocity = verlet::map2(v0, v1, |a, b| (1.0 - u) * a + u * b);
        (
            Pose {
                position_m,
                orientation: from_unit(turn),
            },
            velocity,
        )
    }

    fn beyond(&self, i: usize, t: ServerTime) -> (Pose, Vec3) {
        let newest = &self.samples[i];
        let Some(m) = self.behind(i).filter(|_| self.method != Method::Hold) else {
            return (newest.pose, [0.0; 3]);
        };
        let (km, k1) = (self.knot(m, newest.time), self.knot(i, newest.time));
        let s = (t - newest.time).as_secs_f64();
        let a = match (self.method, self.behind(m)) {
            (Method::Verlet, Some(o)) => verlet::acceleration(self.knot(o, newest.time), km, k1),
            _ => [0.0; 3],
        };
        let position_m = verlet::extrapolate(km, k1, a, s);
        let speed = verlet::velocity(km, k1);
        let velocity = verlet::map2(speed, a, |v, a| v + a * (s - 0.5 * km.t));
        let (qm, q1) = (
            unit(self.samples[m].pose.orientation),
            unit(newest.pose.orientation),
        );
        let h = -km.t;
        let spin = (q1 * qm.inverse()).scaled_axis() / h.max(1e-6);
        let spin = spin.cap_magnitude(SPIN_MAX);
        let turn = nalgebra::UnitQuaternion::from_scaled_axis(spin * s) * q1;
        (
            Pose {
                position_m,
                orientation: from_unit(turn),
            },
            velocity,
        )
    }
}
