//! Errors of the methods that reconstruct missing samples (Lin 2007, table 7.1). Only the table's caption
//! is known, so gap lengths and sample rates are our choice.
//!
//! Gaps are stratified over the motion, one at a random time of each stratum, which avoids aliasing with
//! periods of the motion. Before a gap, 60 ms of samples are known, quantised as on the wire. Interpolation
//! also has 60 ms of samples after the gap, from the first whole period at or beyond the gap's end. The
//! timeline is compared with the true motion every half millisecond of the gap.
//!
//! The orientation error is the angle of the rotation on SO(3) between shown and true orientation. All
//! methods but hold use slerp between samples and the latest angular velocity beyond them.
//!
//! The force is that of a tool in tissue of uniform stiffness k. Its surface is a plane through the
//! motion's mean, normal to the axis of largest motion: F = k max(0, depth). The percentage is the rms
//! error of F relative to the rms of the true F, so k cancels.

use palpate_protocol::datagram::POSITION_STEP_M;
use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{Pose, ServerTime, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use serde_json::{Value, json};

use super::samples::{HISTORY_US, Sampled, angle_deg, distance, method_line};
use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::chart::{Chart, Line, Panel};
use crate::hand::Hand;

const GAPS_MS: [i64; 6] = [5, 10, 20, 33, 50, 100];
const RATES_HZ: [u32; 4] = [100, 250, 500, 1000];
const GAPS: usize = 300;
const STEP_US: i64 = 500;

/// Maximum evaluated length of a motion, µs.
const LONGEST_US: i64 = 300_000_000;

#[derive(Debug, Clone, Copy)]
struct Row {
    interpolation: bool,
    method: Method,
    rate_hz: u32,
    gap_ms: i64,
    rms_mm: f64,
    max_mm: f64,
    rms_deg: f64,
    force_percent: f64,
    n: usize,
}

impl Row {
    fn kind(&self) -> &'static str {
        if self.interpolation {
            "interpolation"
        } else {
            "extrapolation"
        }
    }

    fn json(&self) -> Value {
        json!({
            "kind": self.kind(), "method": self.method.name(), "rate_hz": self.rate_hz, "gap_ms": self.gap_ms,
            "rms_mm": self.rms_mm, "max_mm": self.max_mm, "rms_deg": self.rms_deg,
            "force_percent": self.force_percent, "n": self.n,
        })
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    squares: f64,
    max: f64,
    /// Sum of squared angles, degrees squared.
    turn_squares: f64,
    force_squares: f64,
    true_force_squares: f64,
    n: usize,
}

impl Sum {
    /// Adds an error; `wall` returns the depth of a position, m.
    fn add(&mut self, shown: &Pose, truth: &Pose, wall: impl Fn([f64; 3]) -> f64) {
        self.turn_squares += angle_deg(shown.orientation, truth.orientation).powi(2);
        let (shown, truth) = (shown.position_m, truth.position_m);
        let error = distance(shown, truth);
        self.squares += error * error;
        self.max = self.max.max(error);
        self.force_squares += (wall(shown) - wall(truth)).powi(2);
        self.true_force_squares += wall(truth).powi(2);
        self.n += 1;
    }

    fn row(&self, interpolation: bool, method: Method, rate_hz: u32, gap_ms: i64) -> Row {
        let share = self.force_squares / self.true_force_squares.max(f64::MIN_POSITIVE);
        Row {
            interpolation,
            method,
            rate_hz,
            gap_ms,
            rms_mm: 1e3 * (self.squares / self.n.max(1) as f64).sqrt(),
            max_mm: 1e3 * self.max,
            rms_deg: (self.turn_squares / self.n.max(1) as f64).sqrt(),
            force_percent: 100.0 * share.sqrt(),
            n: self.n,
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Overall {
    axis: usize,
    surface_m: f64,
    speed_rms_m_s: f64,
}

impl Overall {
    fn of(sampled: &Sampled<'_>) -> Result<Self, String> {
        const AT_US: i64 = 7_310;
        let (first, last) = sampled.gap_range(0)?;
        let positions: Vec<[f64; 3]> = (first..=last.min(LONGEST_US))
            .step_by(AT_US as usize)
            .map(|t| sampled.true_pose(t).position_m)
            .collect();
        let n = positions.len() as f64;
        let mean = |axis: usize| positions.iter().map(|p| p[axis]).sum::<f64>() / n;
        let spread = |axis: usize| {
            let mean = mean(axis);
            positions
                .iter()
                .map(|p| (p[axis] - mean).powi(2))
                .sum::<f64>()
        };
        let axis = (0..3)
            .max_by(|a, b| spread(*a).total_cmp(&spread(*b)))
            .unwrap_or(0);
        let way = |p: &[[f64; 3]]| distance(p[0], p[1]).powi(2);
        let squares = positions.windows(2).map(way).sum::<f64>() / (n - 1.0).max(1.0);
        Ok(Self {
            axis,
            surface_m: mean(axis),
            speed_rms_m_s: squares.sqrt() / (AT_US as f64 * 1e-6),
        })
    }

    fn depth(&self, at: [f64; 3]) -> f64 {
        (self.surface_m - at[self.axis]).max(0.0)
    }
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let hand = bench.hand();
    let seed = bench.seed();
    let mut report = |share| (bench.progress)("gaps", share);
    let (rows, overall) = rows(&*hand, seed, GAPS, &mut report)?;
    let listed: Vec<Value> = rows.iter().map(Row::json).collect();
    Ok(Outcome {
        caption: format!(
            "Errors of reconstructed samples against the true motion. The stream is quantised as on the \
             wire, positions to {} mm. Each method covers the whole gap; a session holds the pose after 50 \
             ms. rms_deg is the orientation error. The force error is that of a spring behind a plane \
             through the motion's mean, in percent of the rms force. The charts have logarithmic scales.",
            1e3 * POSITION_STEP_M
        ),
        figures: json!({
            "experiment": "table-7-1", "seed": seed, "speed_rms_mm_s": 1e3 * overall.speed_rms_m_s, "rows": &listed,
        }),
        charts: vec![("table-7-1".to_owned(), chart(&rows))],
        tables: vec![
            ("table-7-1-by-gap".to_owned(), by_gap(&rows)),
            ("table-7-1".to_owned(), Table::of_objects(&listed, COLUMNS)),
        ],
        ..Outcome::default()
    })
}

const COLUMNS: &[Column] = &[
    ("kind", "kind", 1.0),
    ("method", "method", 1.0),
    ("rate_hz", "rate_hz", 1.0),
    ("gap_ms", "gap_ms", 1.0),
    ("rms_mm", "rms_mm", 1.0),
    ("max_mm", "max_mm", 1.0),
    ("rms_deg", "rms_deg", 1.0),
    ("force_percent", "force_percent", 1.0),
    ("n", "n", 1.0),
];

/// The table for a reader: rms in mm, with one column per gap length.
fn by_gap(rows: &[Row]) -> Table {
    let mut table = Table::new("rms_mm,rate_hz,method");
    table
        .head
        .extend(GAPS_MS.map(|gap_ms| format!("{gap_ms} ms")));
    for row in rows {
        let key = [
            row.kind().to_owned(),
            row.rate_hz.to_string(),
            row.method.name().to_owned(),
        ];
        // Rows of one method differ in the gap length; the order of the gaps is preserved.
        let known = table.rows.iter().position(|cells| cells.starts_with(&key));
        let at = known.unwrap_or_else(|| {
            table.rows.push(key.into());
            table.rows.len() - 1
        });
        table.rows[at].push(format!("{:.4}", row.rms_mm));
    }
    table
}

fn rows(
    hand: &dyn Hand,
    seed: u64,
    gaps: usize,
    report: &mut dyn FnMut(f64),
) -> Result<(Vec<Row>, Overall), String> {
    let mut rows = Vec::new();
    let overall = Overall::of(&Sampled::new(hand, RATES_HZ[0])?)?;
    let total = (RATES_HZ.len() * GAPS_MS.len()) as f64;
    for (i, rate_hz) in RATES_HZ.into_iter().enumerate() {
        let sampled = Sampled::new(hand, rate_hz)?;
        for (k, gap_ms) in GAPS_MS.into_iter().enumerate() {
            report((i * GAPS_MS.len() + k) as f64 / total);
            let mut rng = Pcg64::seed_from_u64(seed);
            let sums = sums(&sampled, overall, gap_ms, gaps, &mut rng)?;
            for (s, interpolation) in sums.iter().zip([false, true]) {
                for (sum, method) in s.iter().zip(Method::ALL) {
                    rows.push(sum.row(interpolation, method, rate_hz, gap_ms));
                }
            }
        }
    }
    rows.sort_by_key(|r| r.interpolation);
    Ok((rows, overall))
}

fn sums(
    sampled: &Sampled<'_>,
    overall: Overall,
    gap_ms: i64,
    gaps: usize,
    rng: &mut Pcg64,
) -> Result<[[Sum; 5]; 2], String> {
    let gap_us = gap_ms * 1000;
    // The next sample follows a whole number of periods after the last.
    let missing_us = (gap_us + sampled.period_us - 1) / sampled.period_us * sampled.period_us;
    let (first, last) = sampled.gap_range(missing_us + HISTORY_US)?;
    let share = (last.min(LONGEST_US) - first) as f64 / gaps as f64;
    let mut sums = [[Sum::default(); 5]; 2];
    for k in 0..gaps {
        let began = first + ((k as f64 + rng.random_range(0.0..1.0)) * share) as i64;
        let truth: Vec<Pose> = (STEP_US..=missing_us)
            .step_by(STEP_US as usize)
            .map(|t| sampled.true_pose(began + t))
            .collect();
        for (m, method) in Method::ALL.into_iter().enumerate() {
            let mut timeline = Timeline::new(method, Span::from_micros(missing_us));
            sampled.fill(&mut timeline, began - HISTORY_US, began)?;
            let mut beyond = timeline.clone();
            sampled.fill(
                &mut timeline,
                began + missing_us,
                began + missing_us + HISTORY_US,
            )?;
            for (truth, t) in truth.iter().zip((STEP_US..).step_by(STEP_US as usize)) {
                let at = ServerTime::from_micros(began + t);
                let mut add = |kind: usize, timeline: &mut Timeline| {
                    if let Some(shown) = timeline.at(at) {
                        sums[kind][m].add(&shown.pose, truth, |p| overall.depth(p));
                    }
                };
                if t <= gap_us {
                    add(0, &mut beyond);
                }
                if t < missing_us {
                    add(1, &mut timeline);
                }
            }
        }
    }
    Ok(sums)
}

fn chart(rows: &[Row]) -> Chart {
    let panel = |interpolation: bool, rate_hz: u32| {
        let lines = Method::ALL.into_iter().map(|method| {
            let points = (rows.iter())
                .filter(|r| r.interpolation == interpolation && r.rate_hz == rate_hz)
                .filter(|r| r.method == method)
                .map(|r| (r.gap_ms as f64, r.rms_mm));
            method_line(method, points)
        });
        let mut lines: Vec<Line> = lines.collect();
        lines.sort_by_key(Line::is_dashed);
        let kind = ["Extrapolation", "Interpolation"][usize::from(interpolation)];
        // Errors range from micrometres to millimetres.
        Panel::new(
            format!("{kind} at {rate_hz} Hz"),
            "rms distance (mm)",
            lines,
        )
        .logarithmic()
    };
    let kinds = [false, true].into_iter();
    let panels = kinds.flat_map(|kind| [RATES_HZ[0], RATES_HZ[3]].map(|rate| panel(kind, rate)));
    let title = "Missing samples: distance to the true motion";
    Chart::new(title, "gap length (ms)", panels.collect())
}

#[cfg(test)]
mod tests {
    use palpate_device::backend::replay::Motion;

    use super::*;
    use crate::hand::{HandParameters, Random};

    fn table(hand: &dyn Hand, seed: u64, gaps: usize) -> Vec<Row> {
        rows(hand, seed, gaps, &mut |_| ()).unwrap().0
    }

    fn beats(rows: &[Row], interpolation: bool, up_to_ms: i64) {
        let of = |like: &Row, method: Method| {
            let same = |r: &&Row| {
                r.interpolation == like.interpolation
                    && (r.rate_hz, r.gap_ms, r.method) == (like.rate_hz, like.gap_ms, method)
            };
            rows.iter().find(same).unwrap().rms_mm
        };
        let verlet = |r: &&Row| {
            r.method == Method::Verlet && r.interpolation == interpolation && r.gap_ms <= up_to_ms
        };
        for row in rows.iter().filter(verlet) {
            let (linear, hold) = (of(row, Method::Linear), of(row, Method::Hold));
            assert!(
                row.n > 0 && row.rms_mm < linear && linear < hold,
                "{row:?}: {linear} {hold}"
            );
        }
    }

    #[test]
    fn verlet_is_more_accurate_than_linear_for_any_seed() {
        for seed in 1..=4 {
            let rows = table(&Random::new(HandParameters::default(), seed), seed, 100);
            beats(&rows, false, 50);
            beats(&rows, true, 100);
            let row = |r: &&Row| {
                (r.interpolation, r.method, r.rate_hz, r.gap_ms)
                    == (false, Method::Verlet, 1000, 10)
            };
            let found = rows.iter().find(row).unwrap();
            assert!(found.rms_mm <= 0.02, "{found:?}");
        }
    }

    #[test]
    fn extrapolated_orientations_are_more_accurate_than_held_ones() {
        let rows = table(&Random::new(HandParameters::default(), 1), 1, 50);
        for row in rows.iter().filter(|r| r.method == Method::Verlet) {
            let held = (rows.iter())
                .find(|r| {
                    r.method == Method::Hold
                        && (r.interpolation, r.rate_hz, r.gap_ms)
                            == (row.interpolation, row.rate_hz, row.gap_ms)
                })
                .unwrap();
            assert!(row.rms_deg < 0.5 * held.rms_deg, "{row:?} {held:?}");
        }
    }

    #[test]
    fn table_by_gap_has_one_row_per_method_and_one_cell_per_gap() {
        let rows = table(&Random::new(HandParameters::default(), 1), 1, 5);
        let table = by_gap(&rows);
        assert_eq!(table.rows.len(), 2 * RATES_HZ.len() * Method::ALL.len());
        assert!(table.rows.iter().all(|row| row.len() == 3 + GAPS_MS.len()));
    }

    #[test]
    fn too_short_motion_is_rejected_with_its_length() {
        let text = "time_s,x_m,y_m,z_m\n0,0,0,0\n0.05,0,0,0\n0.1,0,0,0\n";
        let hand = Motion::from_table(text).unwrap();
        let said = rows(&hand, 1, 10, &mut |_| ()).unwrap_err();
        assert!(said.contains("the motion lasts 0.100 s"), "{said}");
    }
}
