//! The samples of one tool and the curve through them.

use std::collections::VecDeque;

use super::bank::{Bank, CUTOFFS, Filters, PREDICTORS, Scores};
use super::curvature::CurvatureShare;
use super::kalman::Components;
use crate::timeline::{Method, SAMPLES_MAX, Source, distance, from_unit, unit};
use crate::verlet::{self, FIT_S, Fit, Knot, Vec3, WINDOW_S};
use crate::{Pose, ServerTime, Span, ToolSample};

/// Two samples farther apart than this are not joined by a curve but by a straight line: there was
/// a pause, and an acceleration across it means nothing.
const JOINED_MAX: Span = Span::from_millis(250);

/// The fastest extrapolated rotation beyond the newest sample, rad/s.
const SPIN_MAX: f64 = 20.0;

/// Time beyond the newest sample within which a filter's curve leaves the sample, whose noise it lacks.
const LEAVES_S: f64 = 0.0075;

#[derive(Debug, Clone)]
pub(super) struct Curve {
    method: Method,
    /// Ascending in time, no two of one moment.
    samples: VecDeque<ToolSample>,
    /// The predictors and their errors, for the methods that weight them.
    bank: Option<Box<Bank>>,
    /// Of [`Method::Chosen`] between samples.
    share: CurvatureShare,
}

/// A pose as components, the quaternion with the sign nearer to `like`.
fn components(pose: &Pose, like: Option<&Components>) -> Components {
    let [x, y, z] = pose.position_m;
    let [i, j, k, w] = from_unit(unit(pose.orientation));
    let mut all = Components::from([x, y, z, i, j, k, w]);
    if like.is_some_and(|like| all.rows(3, 4).dot(&like.rows(3, 4)) < 0.0) {
        all.rows_mut(3, 4).neg_mut();
    }
    all
}

/// The weighted mean of poses and velocities. Rotations are near each other, so that the normalised mean of their
/// quaternions serves.
fn mean(predictions: &[(Pose, Vec3); PREDICTORS], weights: &Scores) -> (Pose, Vec3) {
    let (mut place, mut velocity) = ([0.0; 3], [0.0; 3]);
    let like = components(&predictions[0].0, None);
    let mut turn = Components::zeros();
    for ((pose, v), [place_share, turn_share]) in predictions.iter().zip(weights) {
        place = verlet::map2(place, pose.position_m, |sum, x| sum + place_share * x);
        velocity = verlet::map2(velocity, *v, |sum, v| sum + place_share * v);
        turn += components(pose, Some(&like)) * *turn_share;
    }
    let orientation = from_unit(unit([turn[3], turn[4], turn[5], turn[6]]));
    let position_m = place;
    (
        Pose {
            position_m,
            orientation,
        },
        velocity,
    )
}

impl Curve {
    pub(super) fn new(method: Method) -> Self {
        Self {
            method,
            samples: VecDeque::new(),
            bank: None,
            share: CurvatureShare::default(),
        }
    }

    pub(super) fn newest(&self) -> Option<&ToolSample> {
        self.samples.back()
    }

    /// Whether anything changed.
    pub(super) fn insert(&mut self, sample: ToolSample) -> bool {
        let newest = self.newest().map(|s| s.time);
        let i = match newest {
            Some(newest) if newest >= sample.time => {
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
        if newest.is_none_or(|newest| newest < sample.time) {
            self.learn(newest, &sample);
        }
        true
    }

    /// Updates filters and errors with a new newest sample. Late samples improve the curve only.
    fn learn(&mut self, previous: Option<ServerTime>, sample: &ToolSample) {
        let first = match self.method {
            Method::Chosen => 0,
            Method::Kalman => PREDICTORS - CUTOFFS.len(),
            _ => return,
        };
        // Taken out, because the errors are those of this curve.
        let (Some(mut bank), Some(previous)) = (self.bank.take(), previous) else {
            self.bank = Some(Box::new(Bank::new(first, &components(&sample.pose, None))));
            return;
        };
        let pose = components(&sample.pose, Some(&bank.filters[0].on(0.0).0));
        let elapsed = sample.time - previous;
        if elapsed > JOINED_MAX {
            bank.restart(&pose);
        } else {
            bank.update(sample.time, elapsed, &pose, |began, filters| {
                let i = self.samples.partition_point(|s| s.time < began);
                self.predictions(i, filters, sample.time).map(|(p, _)| {
                    let turn = unit(p.orientation).angle_to(&unit(sample.pose.orientation));
                    let way = distance(p.position_m, sample.pose.position_m);
                    [way * way, turn * turn]
                })
            });
        }
        self.bank = Some(bank);
        if self.method == Method::Chosen && self.share.is_due(sample.time) {
            self.learn_share(sample.time);
        }
    }

    /// Leaves out the samples within a window around one of them, and compares it with the curve of the others.
    fn learn_share(&mut self, now: ServerTime) {
        let window = Span::from_secs_f64(WINDOW_S);
        let count = |edge| self.samples.partition_point(|s| s.time <= edge);
        // Each edge is a window before the one after it: the end of the curve's last window is the newest sample.
        let end = count(now - window).checked_sub(1);
        let middle = end.and_then(|end| count(self.samples[end].time - window).checked_sub(1));
        let start = middle.and_then(|middle| self.previous(middle));
        let (Some(start), Some(middle), Some(end)) = (start, middle, end) else {
            return;
        };
        let near = self.samples[end].time - self.samples[start].time <= JOINED_MAX;
        if !near || self.previous(start).is_none() || self.next(end).is_none() {
            return;
        }
        let sample = self.samples[middle];
        let (line, curve) = self.verlet_between(start, end, sample.time, false);
        self.share.learn(now, sample.pose.position_m, line, curve);
    }

    /// Pose, velocity, the sample whose buttons hold, and the source of the pose.
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
        let (pose, velocity) = self.extrapolated(i, t);
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
    fn previous(&self, i: usize) -> Option<usize> {
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
    fn next(&self, i: usize) -> Option<usize> {
        let edge = self.samples[i].time + Span::from_secs_f64(WINDOW_S);
        let last = self.samples.len() - 1;
        let j = self.samples.partition_point(|s| s.time < edge).min(last);
        (j > i && self.samples[j].time - self.samples[i].time <= JOINED_MAX).then_some(j)
    }

    /// The parabola of the samples up to number `i`: those of the last [`FIT_S`], and at least three.
    /// `None` while they reach back by less than [`WINDOW_S`], where an acceleration would be noise.
    fn fit_before(&self, i: usize, origin: ServerTime) -> Option<Fit> {
        let newest = self.samples[i].time;
        let reach = |from: ServerTime, by: f64| {
            let edge = from - Span::from_secs_f64(by);
            self.samples
                .partition_point(|s| s.time <= edge)
                .saturating_sub(1)
        };
        let mut first = reach(newest, FIT_S);
        if first + 2 > i {
            first = reach(self.samples[first].time, WINDOW_S);
        }
        let joined = newest - JOINED_MAX;
        first = first.max(self.samples.partition_point(|s| s.time < joined));
        let spans = newest - self.samples[first].time;
        if spans < Span::from_secs_f64(WINDOW_S) {
            return None;
        }
        let knots = (first..=i).map(|k| self.knot(k, origin));
        verlet::fit(knots, self.knot(i, origin))
    }

    /// The same parabola for the samples from number `i` on.
    fn fit_after(&self, i: usize, origin: ServerTime) -> Option<Fit> {
        let (oldest, last) = (self.samples[i].time, self.samples.len() - 1);
        let reach = |from: ServerTime, by: f64| {
            let edge = from + Span::from_secs_f64(by);
            self.samples.partition_point(|s| s.time < edge).min(last)
        };
        let mut end = reach(oldest, FIT_S);
        if end < i + 2 {
            end = reach(self.samples[end].time, WINDOW_S);
        }
        let joined = oldest + JOINED_MAX;
        end = end.min(self.samples.partition_point(|s| s.time <= joined) - 1);
        let spans = self.samples[end].time - oldest;
        if spans < Span::from_secs_f64(WINDOW_S) {
            return None;
        }
        let knots = (i..=end).map(|k| self.knot(k, origin));
        verlet::fit(knots, self.knot(i, origin))
    }

    /// The velocities at both ends of the gap after number `i`, each from its own side: a difference
    /// across the gap would cut off the curvature within it. An end without further samples has no
    /// curvature.
    fn slopes(&self, i: usize) -> (Vec3, Vec3) {
        let origin = self.samples[i].time;
        let chord = verlet::velocity(self.knot(i, origin), self.knot(i + 1, origin));
        let free = |other: Vec3| verlet::map2(chord, other, |c, o| 1.5 * c - 0.5 * o);
        let before = self.fit_before(i, origin).map(|f| f.v);
        let after = self.fit_after(i + 1, origin).map(|f| f.v);
        match (before, after) {
            (Some(v0), Some(v1)) => (v0, v1),
            (Some(v0), None) => (v0, free(v0)),
            (None, Some(v1)) => (free(v1), v1),
            (None, None) => (chord, chord),
        }
    }

    /// The straight line and Verlet's cubic at `t` between the samples `i` and `j`, from those outside of them; `raw`
    /// without windows.
    fn verlet_between(&self, i: usize, j: usize, t: ServerTime, raw: bool) -> (Vec3, Vec3) {
        let origin = self.samples[i].time;
        let (k0, k1) = (self.knot(i, origin), self.knot(j, origin));
        let at = (t - origin).as_secs_f64();
        let (before, after) = if raw {
            let next = Some(j + 1).filter(|p| *p < self.samples.len());
            (i.checked_sub(1), next)
        } else {
            (self.previous(i), self.next(j))
        };
        let a0 = before.map(|m| verlet::acceleration(self.knot(m, origin), k0, k1));
        let a1 = after.map(|p| verlet::acceleration(k0, k1, self.knot(p, origin)));
        let (a0, a1) = (a0.or(a1).unwrap_or_default(), a1.or(a0).unwrap_or_default());
        let line = verlet::interpolate(k0, k1, [0.0; 3], [0.0; 3], at);
        let (k0, k1) = if raw {
            (k0, k1)
        } else {
            self.quiet_ends((i, k0), (j, k1))
        };
        (line, verlet::interpolate(k0, k1, a0, a1, at))
    }

    /// Both ends of a gap without the noise of their rounding, each from its own side.
    fn quiet_ends(&self, (i, k0): (usize, Knot), (j, k1): (usize, Knot)) -> (Knot, Knot) {
        let origin = self.samples[i].time;
        let quiet = |k: Knot, fit: Option<Fit>| Knot {
            x: fit.map_or(k.x, |f| f.x),
            ..k
        };
        let (before, after) = (self.fit_before(i, origin), self.fit_after(j, origin));
        (quiet(k0, before), quiet(k1, after))
    }

    /// From one window before a sample to one after it.
    fn velocity_at(&self, i: usize) -> Vec3 {
        let origin = self.samples[i].time;
        let (before, after) = (self.previous(i).unwrap_or(i), self.next(i).unwrap_or(i));
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
            Method::Verlet | Method::VerletRaw | Method::Kalman => {
                let raw = method == Method::VerletRaw;
                self.verlet_between(i, i + 1, t, raw).1
            }
            Method::Chosen => {
                let (line, curve) = self.verlet_between(i, i + 1, t, false);
                self.share.blend(line, curve)
            }
            Method::Hermite => {
                let (v0, v1) = self.slopes(i);
                verlet::hermite(k0, k1, v0, v1, at)
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
        // Half a turn between two samples has no shortest path: keep the first.
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

    fn extrapolated(&self, i: usize, t: ServerTime) -> (Pose, Vec3) {
        match &self.bank {
            Some(bank) => {
                let weights = bank.weights(t - self.samples[i].time);
                mean(&self.predictions(i, &bank.filters, t), &weights)
            }
            None => self.extrapolated_by(self.method, i, t),
        }
    }

    /// Pose and velocity at `t` by each predictor from the samples up to number `i` and the filters of its time.
    fn predictions(
        &self,
        i: usize,
        filters: &Filters,
        t: ServerTime,
    ) -> [(Pose, Vec3); PREDICTORS] {
        const STATELESS: [Method; PREDICTORS - CUTOFFS.len()] =
            [Method::Hold, Method::Linear, Method::Verlet];
        let newest = &self.samples[i];
        let s = (t - newest.time).as_secs_f64();
        let shown = components(&newest.pose, Some(&filters[0].on(0.0).0));
        let left = (1.0 - s / LEAVES_S).max(0.0);
        std::array::from_fn(|k| {
            if let Some(method) = STATELESS.get(k) {
                return self.extrapolated_by(*method, i, t);
            }
            let filter = &filters[k - STATELESS.len()];
            let (ahead, velocity) = filter.on(s);
            let all = ahead + (shown - filter.on(0.0).0) * left;
            let [x, y, z, i, j, k, w] = all.into();
            let orientation = from_unit(unit([i, j, k, w]));
            let position_m = [x, y, z];
            (
                Pose {
                    position_m,
                    orientation,
                },
                velocity,
            )
        })
    }

    fn extrapolated_by(&self, method: Method, i: usize, t: ServerTime) -> (Pose, Vec3) {
        let newest = &self.samples[i];
        let Some(m) = self.previous(i).filter(|_| method != Method::Hold) else {
            return (newest.pose, [0.0; 3]);
        };
        let (km, k1) = (self.knot(m, newest.time), self.knot(i, newest.time));
        let s = (t - newest.time).as_secs_f64();
        let (position_m, velocity) = self.extrapolate(method, i, (km, k1), s);
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

    /// Position and velocity `s` seconds beyond number `i`, the newest; `km` is one window before `k1`, its own knot.
    fn extrapolate(
        &self,
        method: Method,
        i: usize,
        (km, k1): (Knot, Knot),
        s: f64,
    ) -> (Vec3, Vec3) {
        let straight = (
            verlet::extrapolate(km, k1, [0.0; 3], s),
            verlet::velocity(km, k1),
        );
        let newest = self.samples[i].time;
        match method {
            Method::Hold => (k1.x, [0.0; 3]),
            Method::Verlet | Method::Kalman | Method::Chosen => {
                self.fit_before(i, newest).map_or(straight, |f| f.on(s))
            }
            Method::VerletRaw if i >= 2 => {
                let (k0, km) = (self.knot(i - 2, newest), self.knot(i - 1, newest));
                let a = verlet::acceleration(k0, km, k1);
                let v = verlet::velocity(km, k1);
                let v = verlet::map2(v, a, |v, a| v + a * (s - 0.5 * km.t));
                (verlet::extrapolate(km, k1, a, s), v)
            }
            Method::Linear | Method::VerletRaw => straight,
            Method::Hermite => {
                let before = self.previous(i).and_then(|m| self.fit_before(m, newest));
                let (Some(v0), Some(v1)) = (before, self.fit_before(i, newest)) else {
                    return straight;
                };
                verlet::end_of_cubic((km, v0.v), (k1, v1.v)).on(s)
            }
        }
    }
}
