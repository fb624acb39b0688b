//! Force error of a session against the reference without a network.

use palpate_client::recording::HapticPoint;
use serde::{Deserialize, Serialize};

/// Contact: either force is above this, N.
const CONTACT_N: f64 = 0.05;

/// A force over the time of a script.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ForcePoint {
    /// Seconds of script.
    pub t_s: f64,
    pub force_n: [f64; 3],
    pub position_m: [f64; 3],
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ForceError {
    /// Root mean square of `|F - F_ref|` over that of `|F_ref|`, both over the contact, percent.
    pub rms_percent: f64,
    /// Largest `|F - F_ref|`, N.
    pub max_n: f64,
    /// Root mean square of the distance of the two tools over the contact, mm.
    pub position_rms_mm: f64,
    pub contact_s: f64,
}

/// A recording over the time of its script.
pub fn over_script(points: &[HapticPoint], started_us: i64) -> Vec<ForcePoint> {
    points
        .iter()
        .map(|p| ForcePoint {
            t_s: (p.t_us - started_us) as f64 * 1e-6,
            force_n: p.force_n,
            position_m: p.position_m,
        })
        .filter(|p| p.t_s >= 0.0)
        .collect()
}

/// Points of a course in contact on either side, with those of its reference; both in the order of time.
fn touching(course: &[ForcePoint], reference: &[ForcePoint]) -> Vec<(ForcePoint, ForcePoint)> {
    let mut index = 0;
    let mut both = |p: &ForcePoint| {
        let r = at(reference, &mut index, p.t_s)?;
        let touches = norm(p.force_n).max(norm(r.force_n)) > CONTACT_N;
        touches.then_some((*p, r))
    };
    course.iter().filter_map(&mut both).collect()
}

/// Seconds of script, `|F - F_ref|` and `|F_ref|` over the contact, N.
pub fn difference(course: &[ForcePoint], reference: &[ForcePoint]) -> Vec<(f64, f64, f64)> {
    let pair = |(p, r): (ForcePoint, ForcePoint)| {
        let off = norm(minus(p.force_n, r.force_n));
        (p.t_s, off, norm(r.force_n))
    };
    touching(course, reference).into_iter().map(pair).collect()
}

impl ForceError {
    /// Compares a course with its reference, both in the order of time. `None` without contact.
    pub fn between(course: &[ForcePoint], reference: &[ForcePoint]) -> Option<Self> {
        let (mut error, mut size, mut apart) = (0.0, 0.0, 0.0);
        let mut max_n = 0.0_f64;
        let pairs = touching(course, reference);
        for (p, r) in &pairs {
            let e = norm(minus(p.force_n, r.force_n));
            error += e * e;
            size += norm(r.force_n).powi(2);
            apart += norm(minus(p.position_m, r.position_m)).powi(2);
            max_n = max_n.max(e);
        }
        let count = pairs.len();
        let span = course.last()?.t_s - course.first()?.t_s;
        let step = span / (course.len().max(2) - 1) as f64;
        (size > 0.0).then(|| Self {
            rms_percent: 100.0 * (error / size).sqrt(),
            max_n,
            position_rms_mm: 1e3 * (apart / count as f64).sqrt(),
            contact_s: count as f64 * step,
        })
    }
}

/// The point of a course at `t_s`, interpolated; `None` outside it.
fn at(course: &[ForcePoint], index: &mut usize, t_s: f64) -> Option<ForcePoint> {
    while course.get(*index + 1).is_some_and(|p| p.t_s <= t_s) {
        *index += 1;
    }
    let (p, q) = (course.get(*index)?, course.get(*index + 1)?);
    if t_s < p.t_s {
        return None;
    }
    let share = (t_s - p.t_s) / (q.t_s - p.t_s);
    let mix = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|i| a[i] + share * (b[i] - a[i]));
    Some(ForcePoint {
        t_s,
        force_n: mix(p.force_n, q.force_n),
        position_m: mix(p.position_m, q.position_m),
    })
}

pub fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

pub fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

#[cfg(test)]
mod tests {
    use super::{ForceError, ForcePoint};

    fn course(every: usize, factor: f64) -> Vec<ForcePoint> {
        (0..2000)
            .step_by(every)
            .map(|i| {
                let t_s = f64::from(i) * 1e-3;
                ForcePoint {
                    t_s,
                    force_n: [0.0, 0.0, factor * (3.0 * t_s).sin().max(0.0)],
                    position_m: [0.0; 3],
                }
            })
            .collect()
    }

    #[test]
    fn the_same_force_at_another_rate_has_no_error() {
        let e = ForceError::between(&course(4, 2.0), &course(1, 2.0)).unwrap();
        assert!(e.rms_percent < 0.1, "{e:?}");
        assert!((e.contact_s - 1.0).abs() < 0.1, "{e:?}");
    }

    #[test]
    fn five_percent_more_force_is_five_percent_of_error() {
        let e = ForceError::between(&course(4, 2.1), &course(1, 2.0)).unwrap();
        assert!((e.rms_percent - 5.0).abs() < 0.1, "{e:?}");
    }

    #[test]
    fn course_without_contact_gives_no_figures() {
        assert_eq!(ForceError::between(&course(4, 0.0), &course(1, 0.0)), None);
    }
}
