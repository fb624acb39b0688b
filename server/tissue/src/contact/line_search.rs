//! Line search with contacts.
//!
//! Tissue resists deformation nearly linearly; a contact pushes from `λ/κ` before touch on, many times stiffer, and never pulls. So
//! the step length along a correction does not follow from the forces at its two ends: where a tool leaves or meets the
//! tissue, that estimate was a tenth of the right value. Contact forces are cheap, so they are evaluated at every trial
//! step length.

use super::core::Core;
use super::tie::Tie;
use crate::Vec3;

/// Maximum rounds of the root search: the bracket halves at least every other round.
const ROUNDS: usize = 24;
/// Width of the bracket at which the search ends.
const NARROW: f64 = 1e-3;
/// Distance from the middle of a ball, in radii, within which an approaching sample must not pass it.
const CORE: f64 = 0.5;

/// Contact samples on a line of shapes `u + s by`.
pub(crate) struct LineSearch {
    /// Each with the core point that it [pierces](Row::pierces), if any.
    rows: Vec<(Row, Option<Vec3>)>,
    /// Cores of the tools; only their shape is used.
    cores: Vec<Core>,
    ties: Vec<TieRow>,
}

/// A tie to an inserted needle, on the line.
pub(crate) struct TieRow {
    pub(super) tie: Tie,
    /// Distance from the target at s = 0, and its derivative by s, in m.
    pub(super) from: f64,
    pub(super) by: f64,
}

impl TieRow {
    /// Work of its force per s, at s, in N m.
    fn work(&self, s: f64) -> f64 {
        self.tie.force(self.from + self.by * s).0 * self.by
    }
}

pub(crate) struct Row {
    /// Position relative to the middle of the tool's core at s = 0, and its derivative by s, in m.
    pub(crate) from: Vec3,
    pub(crate) by: Vec3,
    pub(crate) radius: f64,
    pub(crate) stiffness: f64,
    /// Index of the tool.
    pub(crate) tool: u32,
}

/// The core point nearest to the position `v`, both relative to the middle of the core.
#[inline]
fn nearest(core: &Core, v: &Vec3) -> Vec3 {
    let [s, t] = core.nearest(&(core.mid + v));
    core.a * s + core.b * t
}

impl Row {
    /// The core point whose ball the line passes too close to the centre. Beyond it the contact force would push the
    /// sample out on the far side: a retreating tool pulled tissue through itself with ten newtons.
    fn pierces(&self, core: &Core) -> Option<Vec3> {
        let centre = if core.is_point() {
            Vec3::zeros()
        } else {
            nearest(core, &self.from)
        };
        let from = self.from - centre;
        let towards = -from.dot(&self.by);
        let square = self.by.norm_squared();
        let core = CORE * self.radius;
        let near = || (from + self.by * (towards / square)).norm_squared() < core * core;
        (towards > 0.0 && near()).then_some(centre)
    }

    /// Whether the sample may touch the tool for any s within these bounds.
    fn meets(&self, core: &Core, [low, high]: [f64; 2]) -> bool {
        let square = self.by.norm_squared();
        let nearest = -self.from.dot(&self.by) / square;
        // NaN where the sample does not move: then every s is nearest.
        let nearest = nearest.max(low).min(high);
        let v = self.from + self.by * nearest;
        // A margin for rounding.
        let reach = self.radius + core.half_diagonal();
        v.norm_squared() < 1.001 * reach * reach
    }
}

/// Work of one contact's force per s, at s, in N m.
fn work((row, pierces): &(Row, Option<Vec3>), core: &Core, s: f64) -> f64 {
    let v = row.from + row.by * s;
    if let Some(centre) = pierces {
        let v = v - centre;
        let core = CORE * row.radius;
        if v.dot(&row.by) > 0.0 || v.norm_squared() < core * core {
            // A wall across the line, as deep as the ball from here on.
            return -row.stiffness * (row.radius * row.by.norm() + v.dot(&row.by));
        }
    }
    let v = if core.is_point() {
        v
    } else {
        v - nearest(core, &v)
    };
    let square = v.norm_squared();
    if square >= row.radius * row.radius || square == 0.0 {
        return 0.0;
    }
    let distance = square.sqrt();
    row.stiffness * (row.radius - distance) / distance * v.dot(&row.by)
}

impl LineSearch {
    pub(crate) fn new(rows: Vec<Row>, cores: Vec<Core>) -> Self {
        let row = |row: Row| {
            let pierces = row.pierces(&cores[row.tool as usize]);
            (row, pierces)
        };
        Self {
            rows: rows.into_iter().map(row).collect(),
            cores,
            ties: Vec::new(),
        }
    }

    /// The same with ties.
    pub(super) fn with_ties(self, ties: Vec<TieRow>) -> Self {
        Self { ties, ..self }
    }

    fn work_of_ties(&self, s: f64) -> f64 {
        self.ties.iter().map(|tie| tie.work(s)).sum()
    }

    /// Lets samples pass the middle of a tool.
    pub(crate) fn ignore_cores(&mut self) {
        for (_, pierces) in &mut self.rows {
            *pierces = None;
        }
    }

    fn core(&self, row: &Row) -> &Core {
        &self.cores[row.tool as usize]
    }

    /// Work of all contact forces per s, at s, in N m.
    pub(crate) fn work(&self, s: f64) -> f64 {
        self.rows
            .iter()
            .map(|row| work(row, self.core(&row.0), s))
            .sum::<f64>()
            + self.work_of_ties(s)
    }

    /// The s within bounds at which the total work vanishes: the minimum of the energy on the line. All other work is
    /// `here` at 0, `there` at 1, and linear between.
    pub(crate) fn zero_work(&self, [here, there]: [f64; 2], bounds: [f64; 2]) -> f64 {
        // Half of the samples in reach of a tool do not touch it anywhere on the line.
        let meets = |(row, pierces): &&(Row, Option<Vec3>)| {
            pierces.is_some() || row.meets(self.core(row), bounds)
        };
        let rows: Vec<_> = self.rows.iter().filter(meets).collect();
        let contacts = |s: f64| {
            rows.iter()
                .map(|row| work(row, self.core(&row.0), s))
                .sum::<f64>()
                + self.work_of_ties(s)
        };
        let work = |s: f64| here + s * (there - here) + contacts(s);
        let [mut low, mut high] = bounds;
        let (mut left, mut right) = (work(low), work(high));
        if left <= 0.0 {
            return low;
        }
        if right >= 0.0 {
            return high;
        }
        for round in 0..ROUNDS {
            if high - low < NARROW {
                break;
            }
            // The chord solves the linear part at once, the midpoint passes the onset of contact.
            let s = if round % 2 == 0 {
                low + (high - low) * left / (left - right)
            } else {
                0.5 * (low + high)
            };
            let w = work(s);
            if w > 0.0 {
                (low, left) = (s, w);
            } else {
                (high, right) = (s, w);
            }
        }
        low + (high - low) * left / (left - right)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Form, Tool};
    use super::*;
    use proptest::prelude::*;

    fn ball(from: f64, stiffness: f64) -> Row {
        Row {
            from: Vec3::new(0.0, 0.0, from),
            by: Vec3::new(0.0, 0.0, 1e-3),
            radius: 8e-3,
            stiffness,
            tool: 0,
        }
    }

    fn along(rows: Vec<Row>) -> LineSearch {
        let core = Core::of(&Tool::ball(0, Vec3::zeros(), 8e-3));
        LineSearch::new(rows, vec![core])
    }

    #[test]
    fn line_search_without_contacts_finds_the_zero_of_the_line() {
        let none = along(Vec::new());
        assert!((none.zero_work([1.0, -1.0], [0.0, 2.0]) - 0.5).abs() < 1e-3);
        assert_eq!(none.zero_work([1.0, 0.9], [0.0, 2.0]), 2.0);
        assert_eq!(none.zero_work([-1.0, -2.0], [0.2, 2.0]), 0.2);
    }

    #[test]
    fn returning_tissue_stops_at_the_tool() {
        // The tool has retreated by 0.8 mm, and is forty times as stiff as this returning tissue.
        let away = along(vec![ball(-8.8e-3, 4000.0)]);
        let s = away.zero_work([1e-4, 0.0], [0.0, 2.0]);
        assert!((0.8..0.83).contains(&s), "{s}");
    }

    #[test]
    fn samples_do_not_pass_through_a_tool() {
        // A sample that moves to 30 mm beyond the near side of a ball of 16 mm.
        let away = along(vec![ball(-8.8e-3, 4000.0)]);
        let s = away.zero_work([1e-4, 1e-4], [0.0, 30.0]);
        assert!((0.8..0.9).contains(&s), "{s}");
        // A sample that slides along the ball moves on.
        let mut beside = ball(-8.8e-3, 40.0);
        beside.from.x = 7.9e-3;
        let s = along(vec![beside]).zero_work([1e-2, 1e-2], [0.0, 30.0]);
        assert_eq!(s, 30.0);
    }

    proptest! {
        /// Samples excluded by [`Row::meets`] do no work between the bounds.
        #[test]
        fn samples_out_of_reach_do_no_work(
            from in prop::array::uniform3(-12e-3..12e-3f64), by in prop::array::uniform3(-10e-3..10e-3f64),
            low in -2.0..1.0f64, wide in 0.0..4.0f64, still in any::<bool>(),
            long in 0.0..0.02f64, broad in 0.0..0.02f64,
        ) {
            let row = Row {
                from: from.into(),
                by: if still { Vec3::zeros() } else { by.into() },
                ..ball(0.0, 400.0)
            };
            let bounds = [low, low + wide];
            let form = Form::rectangle(Vec3::zeros(), [Vec3::x() * long, Vec3::y() * broad]);
            let core = Core::of(&Tool { form, ..Tool::ball(0, Vec3::zeros(), 8e-3) });
            let meets = row.meets(&core, bounds) || row.pierces(&core).is_some();
            let row = (row, None);
            for k in 0..=200 {
                let s = low + wide * f64::from(k) / 200.0;
                prop_assert!(meets || work(&row, &core, s) == 0.0, "work at {}", s);
            }
        }

        #[test]
        fn work_vanishes_at_the_zero_work_step(
            from in -10e-3..-6e-3f64, stiffness in 10.0..1e4f64, here in 1e-6..1e-3f64, falls in 0.0..1e-3f64
        ) {
            let along = along(vec![ball(from, stiffness)]);
            let s = along.zero_work([here, here - falls], [-1.0, 2.0]);
            let work = |s: f64| here - s * falls + along.work(s);
            prop_assert!((-1.0..=2.0).contains(&s));
            if s > -1.0 && s < 2.0 {
                prop_assert!(work(s - 2e-3) >= 0.0 && work(s + 2e-3) <= 0.0, "{s} {}", work(s));
            }
        }
    }
}
