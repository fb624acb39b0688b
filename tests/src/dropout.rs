//! Dropouts: intervals of contact with no force or far too little.

use serde::{Deserialize, Serialize};

use crate::force_error::{ForcePoint, norm};

/// A reference force above this is contact, N: smaller forces are within the noise of a device.
pub const CONTACT_MIN_N: f64 = 0.05;

/// Contact is also above this share of the largest reference force. At the edge of a press the force depends on
/// tenths of a millimetre; a difference there counts as rms error, not as dropout.
pub const CONTACT_SHARE: f64 = 0.2;

/// Forces below this share of the reference are too small.
pub const FORCE_SHARE: f64 = 0.8;

/// Shorter intervals are not dropouts, ms.
pub const SHORTEST_MS: f64 = 20.0;

/// The reference is its minimum within this window to both sides, s. While a tool enters or leaves the tissue,
/// a correct session may be two solves of 4 ms early or late.
pub const WINDOW_S: f64 = 8e-3;

/// Dropouts of a force course: intervals longer than [`SHORTEST_MS`] in which the reference is in contact and
/// the force is below [`FORCE_SHARE`] of it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Dropouts {
    pub count: usize,
    pub longest_ms: f64,
    pub total_ms: f64,
    /// Reference force above which an instant is in contact, N.
    pub contact_n: f64,
    pub contact_s: f64,
    /// Begins and ends, seconds of script.
    pub spans_s: Vec<(f64, f64)>,
}

impl Dropouts {
    /// Compares a course with its reference, both in the order of time. `None` if the reference is never in
    /// contact.
    pub fn between(course: &[ForcePoint], reference: &[ForcePoint]) -> Option<Self> {
        let largest = reference
            .iter()
            .map(|p| norm(p.force_n))
            .fold(0.0, f64::max);
        let contact_n = (CONTACT_SHARE * largest).max(CONTACT_MIN_N);
        let mut found = Self {
            contact_n,
            ..Self::default()
        };
        let mut floor = Floor::of(reference);
        let mut began: Option<f64> = None;
        let mut last: Option<(f64, bool)> = None;
        for p in course {
            let expected = floor.at(p.t_s);
            let touches = expected.is_some_and(|n| n > contact_n);
            if let Some((before, true)) = last {
                found.contact_s += p.t_s - before;
            }
            last = Some((p.t_s, touches));
            let is_low = touches && expected.is_some_and(|n| norm(p.force_n) < FORCE_SHARE * n);
            match (is_low, began) {
                (true, None) => began = Some(p.t_s),
                (false, Some(from)) => {
                    found.add(from, p.t_s);
                    began = None;
                }
                _ => {}
            }
        }
        if let (Some(from), Some((end, _))) = (began, last) {
            found.add(from, end);
        }
        (found.contact_s > 0.0).then_some(found)
    }

    fn add(&mut self, from_s: f64, to_s: f64) {
        let ms = (to_s - from_s) * 1e3;
        if ms > SHORTEST_MS + 1e-6 {
            self.count += 1;
            self.longest_ms = self.longest_ms.max(ms);
            self.total_ms += ms;
            self.spans_s.push((from_s, to_s));
        }
    }
}

/// Sliding minimum of a force course, for increasing times.
struct Floor<'a> {
    course: &'a [ForcePoint],
    from: usize,
}

impl<'a> Floor<'a> {
    fn of(course: &'a [ForcePoint]) -> Self {
        Self { course, from: 0 }
    }

    fn at(&mut self, t_s: f64) -> Option<f64> {
        let until = self.course.last()?.t_s;
        while self.course.get(self.from)?.t_s < t_s - WINDOW_S {
            self.from += 1;
        }
        let around = self.course[self.from..].iter();
        let around = around.take_while(|p| p.t_s <= t_s + WINDOW_S);
        let least = around
            .map(|p| norm(p.force_n))
            .fold(f64::INFINITY, f64::min);
        (t_s <= until && least.is_finite()).then_some(least)
    }
}

/// Longest time without a recorded force during a script of `seconds`, ms.
pub fn longest_gap_ms(course: &[ForcePoint], seconds: f64) -> f64 {
    let inside = course.iter().map(|p| p.t_s);
    let mut last = 0.0;
    let mut longest: f64 = 0.0;
    for t_s in inside.take_while(|t| *t < seconds).chain([seconds]) {
        longest = longest.max(t_s - last);
        last = t_s;
    }
    1e3 * longest
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::{Dropouts, longest_gap_ms};
    use crate::force_error::ForcePoint;

    /// A press of two newtons from 0.5 to 1.5 s with ramps of 0.1 s, `late_ms` later, every `every` ms.
    fn press(every: usize, late_ms: f64) -> Vec<ForcePoint> {
        let point = |i: usize| {
            let t_s = i as f64 * 1e-3;
            let at = t_s - late_ms * 1e-3;
            let ramp = ((at - 0.5) / 0.1).min((1.5 - at) / 0.1).clamp(0.0, 1.0);
            ForcePoint {
                t_s,
                force_n: [0.0, 0.0, 2.0 * ramp],
                position_m: [0.0; 3],
            }
        };
        (0..2000).step_by(every).map(point).collect()
    }

    fn with_hole(from_s: f64, to_s: f64, share: f64) -> Vec<ForcePoint> {
        let mut course = press(4, 0.0);
        for p in course
            .iter_mut()
            .filter(|p| (from_s..to_s).contains(&p.t_s))
        {
            p.force_n[2] *= share;
        }
        course
    }

    #[test]
    fn course_equal_to_its_reference_has_no_dropout() {
        let found = Dropouts::between(&press(4, 0.0), &press(1, 0.0)).unwrap();
        assert_eq!((found.count, found.total_ms), (0, 0.0));
        assert!((found.contact_s - 0.93).abs() < 0.05, "{found:?}");
    }

    #[test]
    fn gaps_above_20_ms_are_counted_with_their_lengths() {
        let found = Dropouts::between(&with_hole(1.0, 1.06, 0.0), &press(1, 0.0)).unwrap();
        assert_eq!(found.count, 1);
        assert!((found.longest_ms - 60.0).abs() <= 4.0, "{found:?}");
        assert!((found.spans_s[0].0 - 1.0).abs() <= 4e-3);
        let short = Dropouts::between(&with_hole(1.0, 1.02, 0.0), &press(1, 0.0)).unwrap();
        assert_eq!(short.count, 0);
    }

    #[test]
    fn a_force_of_85_percent_is_an_error_and_no_dropout() {
        let found = Dropouts::between(&with_hole(0.8, 1.2, 0.85), &press(1, 0.0)).unwrap();
        assert_eq!(found.count, 0);
        let found = Dropouts::between(&with_hole(0.8, 1.2, 0.75), &press(1, 0.0)).unwrap();
        assert_eq!(found.count, 1);
    }

    #[test]
    fn force_that_never_returns_is_one_long_dropout() {
        let found = Dropouts::between(&with_hole(0.8, 9.0, 0.0), &press(1, 0.0)).unwrap();
        assert_eq!(found.count, 1);
        assert!((found.longest_ms - 676.0).abs() < 30.0, "{found:?}");
    }

    #[test]
    fn reference_without_contact_gives_no_figures() {
        let mut air = press(1, 0.0);
        for p in &mut air {
            p.force_n = [0.0; 3];
        }
        assert_eq!(Dropouts::between(&press(4, 0.0), &air), None);
        assert_eq!(Dropouts::between(&[], &press(1, 0.0)), None);
    }

    #[test]
    fn recording_gaps_count_over_the_whole_script() {
        assert!((longest_gap_ms(&press(4, 0.0), 2.0) - 4.0).abs() < 1e-9);
        assert!((longest_gap_ms(&press(4, 0.0), 3.0) - 1004.0).abs() < 1e-6);
        let late: Vec<ForcePoint> = press(4, 0.0).split_off(50);
        assert!((longest_gap_ms(&late, 2.0) - 200.0).abs() < 1e-6);
        assert_eq!(longest_gap_ms(&[], 2.0), 2000.0);
    }

    proptest! {
        /// A session that is one or two solves early or late has no dropout on the ramps of a press.
        #[test]
        fn a_small_shift_in_time_makes_no_dropout(late_ms in -8.0..8.0f64) {
            let found = Dropouts::between(&press(4, late_ms), &press(1, 0.0)).unwrap();
            prop_assert_eq!(found.count, 0);
        }
    }
}
