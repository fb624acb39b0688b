//! Errors of the methods that reconstruct missing samples (Lin 2007, table 7.1). Only the table's caption
//! is known, so hands, gap lengths and sample rates are our choice.
//!
//! Without a given motion there are three hands, all with the same motion: a continuous one as of a haptic
//! device, one recorded by a tracker of 100 Hz with 0.3 mm of noise, and one recorded by a master device of
//! 30 Hz. A recording is compared with itself, noise included. Streams with a higher rate than the
//! recording contain samples of a curve through it, and a shorter gap than its period contains nothing else. Both are
//! marked as finer.
//!
//! Gaps are stratified over the motion, one at a random time of each stratum, which avoids aliasing with
//! periods of the motion. All samples before a gap are known, quantised as on the wire, because methods learn their
//! errors. Interpolation also has 60 ms of samples after the gap, from the first whole period at or beyond the gap's
//! end. The timeline is compared with the true motion every half millisecond of the gap.
//!
//! The orientation error is the angle of the rotation on SO(3) between shown and true orientation. Between
//! samples all methods but hold use slerp; beyond them the latest angular velocity, or the Kalman filters.
//!
//! The force is that of a tool in tissue of uniform stiffness k. Its surface is a plane through the
//! motion's mean, normal to the axis of largest motion: F = k max(0, depth). The percentage is the rms
//! error of F relative to the rms of the true F, so k cancels.

use std::sync::Arc;

use palpate_protocol::datagram::POSITION_STEP_M;
use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{Pose, ServerTime, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use serde_json::{Value, json};

use super::samples::{HISTORY_US, Sampled, angle_deg, distance, method_line, methods};
use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::chart::{Chart, Line, Panel};
use crate::hand::{Hand, HandParameters, Random, Sensor};

const GAPS_MS: [i64; 6] = [5, 10, 20, 33, 50, 100];
const RATES_HZ: [u32; 4] = [100, 250, 500, 1000];
const GAPS: usize = 300;
const STEP_US: i64 = 500;
const METHODS: usize = Method::ALL.len();

/// Length of the recordings of sensors, s.
const RECORDED_S: f64 = 120.0;

/// Maximum evaluated length of a motion, µs.
const LONGEST_US: i64 = 300_000_000;

type NamedHand = (&'static str, Arc<dyn Hand>);

#[derive(Debug, Clone, Copy)]
struct Row {
    hand: &'static str,
    /// Whether stream or gap is finer than the recording.
    finer: bool,
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

    /// Whether the stream has a higher rate than a recording, or the gap contains none of its samples. Intervals
    /// of a recording vary by a tenth.
    fn is_finer_than(&self, recording_hz: f64) -> bool {
        let intervals = self.gap_ms as f64 * 1e-3 * recording_hz;
        // The sample at the end of a gap is known for interpolation.
        let inside = intervals > if self.interpolation { 1.1 } else { 0.9 };
        f64::from(self.rate_hz) > 1.1 * recording_hz || !inside
    }

    fn json(&self) -> Value {
        json!({
            "hand": self.hand, "kind": self.kind(), "method": self.method.name(), "rate_hz": self.rate_hz,
            "finer": self.finer, "gap_ms": self.gap_ms,
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

/// Error of a pose: distance (m), angle (degrees), and force behind a wall.
#[derive(Debug, Clone, Copy)]
struct PoseError {
    distance: f64,
    angle: f64,
    force: f64,
    true_force: f64,
}

impl PoseError {
    fn of(shown: &Pose, truth: &Pose, overall: &Overall) -> Self {
        let true_force = overall.depth(truth.position_m);
        Self {
            distance: distance(shown.position_m, truth.position_m),
            angle: angle_deg(shown.orientation, truth.orientation),
            force: overall.depth(shown.position_m) - true_force,
            true_force,
        }
    }
}

impl Sum {
    fn add(&mut self, error: &PoseError) {
        self.turn_squares += error.angle.powi(2);
        self.squares += error.distance.powi(2);
        self.max = self.max.max(error.distance);
        self.force_squares += error.force.powi(2);
        self.true_force_squares += error.true_force.powi(2);
        self.n += 1;
    }

    /// The row of this sum, with the keys of `row`.
    fn row(&self, row: Row) -> Row {
        let share = self.force_squares / self.true_force_squares.max(f64::MIN_POSITIVE);
        Row {
            rms_mm: 1e3 * (self.squares / self.n.max(1) as f64).sqrt(),
            max_mm: 1e3 * self.max,
            rms_deg: (self.turn_squares / self.n.max(1) as f64).sqrt(),
            force_percent: 100.0 * share.sqrt(),
            n: self.n,
            ..row
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

/// The given motion, or the built-in hands.
fn hands(bench: &Bench<'_>) -> Result<Vec<NamedHand>, String> {
    match &bench.inputs.motion {
        Some(_) => Ok(vec![("motion", bench.hand())]),
        None => built_in(bench.seed()),
    }
}

fn built_in(seed: u64) -> Result<Vec<NamedHand>, String> {
    let hand = Random::new(HandParameters::default(), seed);
    let recorded = |rate_hz, noise_m| -> Result<Arc<dyn Hand>, String> {
        Ok(Arc::new(
            Sensor { rate_hz, noise_m }.record(&hand, RECORDED_S, seed)?,
        ))
    };
    let (tracker, master) = (recorded(100.0, 3e-4)?, recorded(30.0, 0.0)?);
    Ok(vec![
        ("haptic", Arc::new(hand)),
        ("tracker", tracker),
        ("master", master),
    ])
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let seed = bench.seed();
    let hands = hands(bench)?;
    let n = hands.len() as f64;
    let (mut listed, mut charts, mut speeds) = (Vec::new(), Vec::new(), Vec::new());
    let mut table = by_gap(&[]);
    for (k, (name, hand)) in hands.iter().enumerate() {
        let mut report = |share| (bench.progress)("gaps", (k as f64 + share) / n);
        let (rows, overall) = rows(name, &**hand, seed, GAPS, &mut report)?;
        speeds.push(json!({
            "hand": name, "rate_hz": hand.rate_hz(), "speed_rms_mm_s": 1e3 * overall.speed_rms_m_s,
        }));
        let file = match k {
            0 => "table-7-1".to_owned(),
            _ => format!("table-7-1-{name}"),
        };
        charts.push((file, chart(name, &rows)));
        table.rows.extend(by_gap(&rows).rows);
        listed.extend(rows.iter().map(Row::json));
    }
    Ok(Outcome {
        caption: format!(
            "Errors of reconstructed samples against the motion. The stream is quantised as on the wire, \
             positions to {} mm. Each method covers the whole gap; a session holds the pose after 50 ms. \
             rms_deg is the orientation error. The force error is that of a spring behind a plane through \
             the motion's mean, in percent of the rms force. The charts have logarithmic scales.{}",
            1e3 * POSITION_STEP_M,
            warning(&hands)
        ),
        figures: json!({ "experiment": "table-7-1", "seed": seed, "hands": speeds, "rows": &listed }),
        charts,
        tables: vec![
            ("table-7-1-by-gap".to_owned(), table),
            ("table-7-1".to_owned(), Table::of_objects(&listed, COLUMNS)),
        ],
        ..Outcome::default()
    })
}

/// The recordings that have finer rows.
fn warning(hands: &[NamedHand]) -> String {
    let finest = f64::from(RATES_HZ[RATES_HZ.len() - 1]);
    let coarse = (hands.iter()).filter_map(|(name, hand)| {
        let rate_hz = hand.rate_hz().filter(|rate| *rate < finest)?;
        Some(format!(
            " Warning: \"{name}\" was recorded at {rate_hz:.0} Hz. Figures of a higher rate or a shorter gap, \
             marked *, use a curve through its samples and say little about such a device."
        ))
    });
    coarse.collect()
}

const COLUMNS: &[Column] = &[
    ("hand", "hand", 1.0),
    ("kind", "kind", 1.0),
    ("method", "method", 1.0),
    ("rate_hz", "rate_hz", 1.0),
    ("finer", "finer", 1.0),
    ("gap_ms", "gap_ms", 1.0),
    ("rms_mm", "rms_mm", 1.0),
    ("max_mm", "max_mm", 1.0),
    ("rms_deg", "rms_deg", 1.0),
    ("force_percent", "force_percent", 1.0),
    ("n", "n", 1.0),
];

/// The table for a reader: rms in mm, with one column per gap length.
fn by_gap(rows: &[Row]) -> Table {
    let mut table = Table::new("hand,rms_mm,rate_hz,method");
    table
        .head
        .extend(GAPS_MS.map(|gap_ms| format!("{gap_ms} ms")));
    for row in rows {
        let mark = if row.finer { "*" } else { "" };
        let key = [
            row.hand.to_owned(),
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
        table.rows[at].push(format!("{:.4}{mark}", row.rms_mm));
    }
    table
}

fn rows(
    name: &'static str,
    hand: &dyn Hand,
    seed: u64,
    gaps: usize,
    report: &mut dyn FnMut(f64),
) -> Result<(Vec<Row>, Overall), String> {
    let mut rows = Vec::new();
    let overall = Overall::of(&Sampled::new(hand, RATES_HZ[0])?)?;
    for (i, rate_hz) in RATES_HZ.into_iter().enumerate() {
        let sampled = Sampled::new(hand, rate_hz)?;
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut report = |share: f64| report((i as f64 + share) / RATES_HZ.len() as f64);
        let sums = sums(&sampled, overall, gaps, &mut rng, &mut report)?;
        for (gap_ms, sums) in GAPS_MS.into_iter().zip(sums) {
            for (sums, interpolation) in sums.iter().zip([false, true]) {
                let filled = |(sum, _): &(&Sum, Method)| sum.n > 0;
                for (sum, method) in sums.iter().zip(Method::ALL).filter(filled) {
                    let row = Row {
                        hand: name,
                        finer: false,
                        interpolation,
                        method,
                        rate_hz,
                        gap_ms,
                        rms_mm: 0.0,
                        max_mm: 0.0,
                        rms_deg: 0.0,
                        force_percent: 0.0,
                        n: 0,
                    };
                    let finer = hand.rate_hz().is_some_and(|rate| row.is_finer_than(rate));
                    rows.push(sum.row(Row { finer, ..row }));
                }
            }
        }
    }
    rows.sort_by_key(|r| r.interpolation);
    Ok((rows, overall))
}

/// Errors by gap, kind and method. Methods that differ beyond samples only have no interpolation.
fn sums(
    sampled: &Sampled<'_>,
    overall: Overall,
    gaps: usize,
    rng: &mut Pcg64,
    report: &mut dyn FnMut(f64),
) -> Result<[[[Sum; METHODS]; 2]; GAPS_MS.len()], String> {
    // The next sample follows a whole number of periods after the last.
    let period_us = sampled.period_us;
    let missing = GAPS_MS.map(|gap_ms| (gap_ms * 1000 + period_us - 1) / period_us * period_us);
    let longest_us = missing[missing.len() - 1];
    let (first, last) = sampled.gap_range(longest_us + HISTORY_US)?;
    let share = (last.min(LONGEST_US) - first) as f64 / gaps as f64;
    let mut sums = [[[Sum::default(); METHODS]; 2]; GAPS_MS.len()];
    let mut timelines = Method::ALL.map(|m| Timeline::new(m, Span::from_micros(longest_us)));
    let mut known_us = -period_us;
    for k in 0..gaps {
        report(k as f64 / gaps as f64);
        let random = first + ((k as f64 + rng.random_range(0.0..1.0)) * share) as i64;
        let began = random / period_us * period_us;
        let steps = || (STEP_US..=longest_us).step_by(STEP_US as usize);
        let truth: Vec<Pose> = steps().map(|t| sampled.true_pose(began + t)).collect();
        let known = sampled.samples(known_us + period_us, began)?;
        known_us = began;
        for (m, (method, timeline)) in Method::ALL.into_iter().zip(&mut timelines).enumerate() {
            for sample in &known {
                timeline.insert(*sample);
            }
            for (truth, t) in truth.iter().zip(steps()) {
                let at = ServerTime::from_micros(began + t);
                let Some(pose) = timeline.uncorrected_pose(at) else {
                    continue;
                };
                let error = PoseError::of(&pose, truth, &overall);
                for (sums, gap_ms) in sums.iter_mut().zip(GAPS_MS) {
                    if t <= gap_ms * 1000 {
                        sums[0][m].add(&error);
                    }
                }
            }
            if methods(true).all(|other| other != method) {
                continue;
            }
            for (sums, missing_us) in sums.iter_mut().zip(missing) {
                let mut timeline = timeline.clone();
                let next = began + missing_us;
                sampled.fill(&mut timeline, next, next + HISTORY_US)?;
                for (truth, t) in truth.iter().zip(steps()).filter(|(_, t)| *t < missing_us) {
                    let at = ServerTime::from_micros(began + t);
                    if let Some(pose) = timeline.uncorrected_pose(at) {
                        sums[1][m].add(&PoseError::of(&pose, truth, &overall));
                    }
                }
            }
        }
    }
    Ok(sums)
}

fn chart(name: &str, rows: &[Row]) -> Chart {
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
    let title = format!("Missing samples of \"{name}\": distance to the motion");
    Chart::new(title, "gap length (ms)", panels.collect())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use palpate_device::backend::replay::Motion;

    use super::*;
    use crate::hand::{HandParameters, Random};

    fn table(hand: &dyn Hand, seed: u64, gaps: usize) -> Vec<Row> {
        rows("hand", hand, seed, gaps, &mut |_| ()).unwrap().0
    }

    /// The row of the same key by another method.
    fn by(rows: &[Row], like: &Row, method: Method) -> Row {
        let same = |r: &&Row| {
            r.interpolation == like.interpolation
                && (r.rate_hz, r.gap_ms, r.method) == (like.rate_hz, like.gap_ms, method)
        };
        *rows.iter().find(same).unwrap()
    }

    #[test]
    fn windowed_verlet_interpolates_more_accurately_than_lines_for_any_seed() {
        for seed in 1..=4 {
            let rows = table(&Random::new(HandParameters::default(), seed), seed, 30);
            for row in rows
                .iter()
                .filter(|r| r.method == Method::Verlet && r.interpolation)
            {
                let linear = by(&rows, row, Method::Linear).rms_mm;
                let hold = by(&rows, row, Method::Hold).rms_mm;
                assert!(
                    row.rms_mm < linear && linear < hold,
                    "{row:?}: {linear} {hold}"
                );
            }
        }
    }

    #[test]
    fn chosen_is_within_5_percent_of_the_best_method_on_each_built_in_hand() {
        let mut worse = Vec::new();
        for (name, hand) in built_in(1).unwrap() {
            let rows = table(&*hand, 1, 100);
            for row in rows.iter().filter(|r| r.method == Method::Chosen) {
                let of = |method| by(&rows, row, method);
                let others = methods(row.interpolation).filter(|method| {
                    let family = [Method::Hold, Method::Linear, Method::Verlet, Method::Kalman];
                    family.contains(method)
                });
                let family: Vec<Row> = others.map(of).collect();
                let ratio = |part: fn(&Row) -> f64| {
                    part(row) / family.iter().map(part).fold(f64::MAX, f64::min)
                };
                let (place, turn) = (ratio(|r| r.rms_mm), ratio(|r| r.rms_deg));
                let linear = row.rms_mm / of(Method::Linear).rms_mm;
                // Between the samples of a recording there is no truth that the curvature could be learned from.
                let is_best = place <= 1.05 || row.interpolation && row.finer;
                if !is_best || turn > 1.05 || linear > 1.02 {
                    let key = (name, row.rate_hz, row.gap_ms);
                    worse.push(format!("{key:?}: {place:.3} {turn:.3}, linear {linear:.3}"));
                }
            }
        }
        assert!(worse.is_empty(), "{worse:#?}");
    }

    #[test]
    fn rows_finer_than_a_recording_are_marked() {
        let hands = built_in(1).unwrap();
        let clear = |k: usize, interpolation: bool| -> BTreeSet<(u32, i64)> {
            let rows = table(&*hands[k].1, 1, 2).into_iter();
            let clear = rows.filter(|r| !r.finer && r.interpolation == interpolation);
            clear.map(|r| (r.rate_hz, r.gap_ms)).collect()
        };
        assert_eq!(clear(0, true).len(), RATES_HZ.len() * GAPS_MS.len());
        assert_eq!(
            clear(1, true),
            [20, 33, 50, 100].map(|gap| (100, gap)).into()
        );
        assert_eq!(
            clear(1, false),
            [10, 20, 33, 50, 100].map(|gap| (100, gap)).into()
        );
        assert!(clear(2, true).is_empty());
        let said = warning(&hands);
        assert!(
            !said.contains("haptic") && said.contains("\"tracker\" was recorded at 100 Hz"),
            "{said}"
        );
    }

    #[test]
    fn extrapolated_orientations_are_more_accurate_than_held_ones() {
        let rows = table(&Random::new(HandParameters::default(), 1), 1, 50);
        for row in rows.iter().filter(|r| r.method == Method::Verlet) {
            let held = by(&rows, row, Method::Hold);
            assert!(row.rms_deg < 0.5 * held.rms_deg, "{row:?} {held:?}");
        }
    }

    #[test]
    fn table_by_gap_has_one_row_per_method_and_one_cell_per_gap() {
        let rows = table(&Random::new(HandParameters::default(), 1), 1, 5);
        let table = by_gap(&rows);
        assert_eq!(table.rows.len(), RATES_HZ.len() * (2 * METHODS - 1));
        assert!(table.rows.iter().all(|row| row.len() == 4 + GAPS_MS.len()));
    }

    #[test]
    fn too_short_motion_is_rejected_with_its_length() {
        let text = "time_s,x_m,y_m,z_m\n0,0,0,0\n0.05,0,0,0\n0.1,0,0,0\n";
        let hand = Motion::from_table(text).unwrap();
        let said = rows("hand", &hand, 1, 10, &mut |_| ()).unwrap_err();
        assert!(said.contains("the motion lasts 0.100 s"), "{said}");
    }
}
