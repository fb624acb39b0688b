//! Two people press, cut and let go of the same tissue over a network: how far apart are the shapes
//! that they see, and how far is what they feel from the same without a network?
//!
//! Whole sessions are [rehearsed](crate::rehearsal) in virtual time, one per seed, over several
//! networks. The disagreement counts every node that is displaced by more than 0.05 mm on either
//! side, every 10 ms; the force error is compared with [one table](mod@crate::reference).

use std::sync::Arc;

use palpate_device::Script;
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_tissue::{Material, Model, Topology, block};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::{Bench, Outcome, panel};
use crate::bench::on_threads;
use crate::chart::{BLUE, Chart, GREEN, GREY, Line, ORANGE};
use crate::disagreement::{CoursePoint, Disagreement, each_node};
use crate::force_error::{ForcePoint, difference, over_script};
use crate::network::{Jitter, Link, Profile};
use crate::place::Place;
use crate::reference;
use crate::rehearsal::{BytesPerSecond, Rehearsal, Rehearsed};
use crate::scripts::Scripts;

/// Sessions per network when nothing is said: each takes one to two seconds.
const SEEDS: u64 = 20;

/// Length of a session's scripts, s.
const SECONDS: f64 = 6.0;

/// Views per second, as a server's that is told nothing else.
const TICK_HZ: u32 = 60;

/// The most that the artificial delay may be: at 400 ms of round trip to the server an event of one
/// participant is 400 ms old when it reaches the other.
const CAP_US: u32 = 700_000;

/// Width of a bucket of distances, mm, and how many there are: to 20 mm.
const BUCKET_MM: f64 = 5e-4;
const BUCKETS: usize = 40_000;

/// What is asked of views: 95 of 100 distances below this, mm ...
const SHAPE_P95_MM: f64 = 0.1;
/// ... and of forces, as a share.
const FORCE_RMS: f64 = 0.05;

/// Distances, counted by size.
#[derive(Debug, Clone)]
struct Distances {
    counts: Vec<u64>,
    max: f64,
}

impl Default for Distances {
    fn default() -> Self {
        Self {
            counts: vec![0; BUCKETS],
            max: 0.0,
        }
    }
}

impl Distances {
    fn add(&mut self, mm: f64) {
        let bucket = ((mm / BUCKET_MM) as usize).min(BUCKETS - 1);
        self.counts[bucket] += 1;
        self.max = self.max.max(mm);
    }

    fn join(mut self, other: &Self) -> Self {
        for (a, b) in self.counts.iter_mut().zip(&other.counts) {
            *a += b;
        }
        self.max = self.max.max(other.max);
        self
    }

    /// The upper edge of the bucket in which the share `q` is reached.
    fn quantile(&self, q: f64) -> f64 {
        let all: u64 = self.counts.iter().sum();
        let rank = (q * all as f64).ceil().max(1.0) as u64;
        let mut seen = 0;
        let bucket = self.counts.iter().position(|c| {
            seen += c;
            seen >= rank
        });
        bucket.map_or(0.0, |b| ((b + 1) as f64 * BUCKET_MM).min(self.max))
    }
}

/// What the sessions over one network gave.
#[derive(Debug, Clone, Default)]
struct Tally {
    sessions: u64,
    apart: Distances,
    /// `|F - F_ref|²` and `|F_ref|²` over the contact, summed, N².
    off: f64,
    size: f64,
    /// `|F - F_ref|` over the contact, N.
    errors: Vec<f32>,
    equal: u64,
    bytes: BytesPerSecond,
    troubles: Vec<String>,
    /// Of the first seed.
    course: Vec<CoursePoint>,
}

impl Tally {
    fn of(rehearsed: &Rehearsed, truth: &[Vec<ForcePoint>; 2], seed: u64) -> Self {
        let mut tally = Self {
            sessions: 1,
            equal: u64::from(rehearsed.hashes_equal()),
            bytes: rehearsed.bytes_per_s,
            troubles: rehearsed.troubles.clone(),
            ..Self::default()
        };
        if let [a, b] = rehearsed.recordings.as_slice() {
            each_node(a, b, |mm| tally.apart.add(f64::from(mm)));
        }
        if seed == 0 {
            let all: Vec<_> = rehearsed.recordings.iter().collect();
            tally.course = Disagreement::between(&all).course;
        }
        for (recording, course) in rehearsed.recordings.iter().zip(truth) {
            let Some(began) = recording.script_started_us else {
                continue;
            };
            for (off, size) in difference(&over_script(&recording.haptic, began), course) {
                tally.off += off * off;
                tally.size += size * size;
                tally.errors.push(off as f32);
            }
        }
        tally
    }

    fn join(mut self, mut other: Self) -> Self {
        self.apart = self.apart.join(&other.apart);
        self.errors.append(&mut other.errors);
        self.troubles.append(&mut other.troubles);
        Self {
            sessions: self.sessions + other.sessions,
            off: self.off + other.off,
            size: self.size + other.size,
            equal: self.equal + other.equal,
            bytes: BytesPerSecond {
                up: self.bytes.up + other.bytes.up,
                down: self.bytes.down + other.bytes.down,
            },
            course: if self.course.is_empty() {
                other.course
            } else {
                self.course
            },
            ..self
        }
    }

    fn force_rms(&self) -> f64 {
        (self.off / self.size).sqrt()
    }

    /// The error that 95 of 100 moments of contact stay below, over the rms of the force.
    fn force_p95(&mut self) -> f64 {
        if self.errors.is_empty() {
            return f64::NAN;
        }
        let at = (self.errors.len() - 1) * 95 / 100;
        let p95 = *self.errors.select_nth_unstable_by(at, f32::total_cmp).1;
        f64::from(p95) / (self.size / self.errors.len() as f64).sqrt()
    }

    fn row(&mut self, profile: &Profile) -> Value {
        let n = self.sessions.max(1) as f64;
        let (p50, p95) = (self.apart.quantile(0.5), self.apart.quantile(0.95));
        let equal = self.equal == self.sessions;
        let (rms, force_p95) = (self.force_rms(), self.force_p95());
        json!({
            "profile": profile.name,
            "seeds": self.sessions,
            "shape_disagreement_mm": { "p50": p50, "p95": p95, "max": self.apart.max },
            "force_error_rms": rms,
            "force_error_p95": force_p95,
            "hashes_equal": equal,
            "bytes_per_s": { "up": self.bytes.up / n, "down": self.bytes.down / n },
            "troubles": self.troubles,
            "ok": p95 <= SHAPE_P95_MM && rms <= FORCE_RMS && equal && self.troubles.is_empty(),
        })
    }
}

/// A network with this round trip to the server, 5 % loss and 20 ms of jitter, but for one without delay.
fn far(round_trip_ms: f64) -> Profile {
    let one_way = round_trip_ms / 2.0;
    let link = Link {
        delay_ms: one_way,
        jitter: Jitter::Uniform {
            reach_ms: one_way.min(20.0),
        },
        reorder: true,
        loss: 0.05,
        ..Link::default()
    };
    Profile::both(&format!("{round_trip_ms:.0} ms round trip, 5 % loss"), link)
}

fn networks() -> Vec<Profile> {
    [200.0, 0.0, 50.0, 100.0, 300.0, 400.0].map(far).into()
}

pub(super) fn soft_block() -> Model {
    let material = Material {
        name: "soft".into(),
        young_pa: 1e4,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "a block for experiments".into(),
        ..Material::default()
    };
    block([18, 18, 6], 5e-3, &material, 1)
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = bench
        .model
        .clone()
        .unwrap_or_else(|| Arc::new(soft_block()));
    let place = Place::find(&Topology::new(Arc::clone(&model))).map_err(|e| e.to_string())?;
    let scripts = Scripts::for_place(&place, SECONDS).map_err(|e| e.to_string())?;
    let scripts = [&scripts.holder, &scripts.cutter];
    (bench.progress)("one table", 0.0);
    let truth = reference::run(&model, scripts, |_| true).map_err(|e| e.to_string())?;
    let networks = bench.profile.clone().map_or_else(networks, |p| vec![p]);
    let seeds = bench.seeds.unwrap_or(SEEDS);
    let (mut rows, mut lines, mut table) = (Vec::new(), Vec::new(), String::from(HEADER));
    for (k, profile) in networks.iter().enumerate() {
        (bench.progress)(&profile.name, k as f64 / networks.len() as f64);
        let all = std::thread::available_parallelism().map_or(1, usize::from);
        let one = |seed: u64| session(&model, &scripts, profile, bench.seed, seed, &truth.courses);
        let tally = on_threads(all, || {
            (0..seeds)
                .into_par_iter()
                .map(one)
                .try_reduce(Tally::default, |a, b| Ok(a.join(b)))
        })?;
        let mut tally: Tally = tally?;
        let row = tally.row(profile);
        table.push_str(&csv(&row));
        if let Some(colour) = [BLUE, ORANGE, GREEN, GREY].get(k) {
            lines.push(course(&profile.name, colour, &tally.course));
        }
        rows.push(row);
    }
    let chart = Chart {
        title: "Two people press, cut and let go: how far apart are their views".to_owned(),
        x_label: "time (s)".to_owned(),
        panels: vec![panel(
            "95th percentile of tools and nodes, seed 0 of each network",
            "distance (mm)",
            lines,
        )],
        marks: Vec::new(),
    };
    let mut figures = rows.first().cloned().unwrap_or_default();
    figures["experiment"] = json!("replicas");
    figures["nodes"] = json!(model.nodes.len());
    figures["networks"] = json!(rows);
    Ok(Outcome {
        caption: "Two trainees press, cut and press again, in virtual time over emulated networks: distance of the \
                  shapes that they see at the same instant, and of what they feel from the same on one table."
            .to_owned(),
        figures,
        charts: vec![("replicas".to_owned(), chart)],
        tables: vec![("replicas".to_owned(), table)],
    })
}

fn session(
    model: &Arc<Model>,
    scripts: &[&Script; 2],
    profile: &Profile,
    base: u64,
    seed: u64,
    truth: &[Vec<ForcePoint>; 2],
) -> Result<Tally, String> {
    let rehearsal = Rehearsal {
        model,
        scripts,
        motion_only: false,
        onlookers: 0,
        profile,
        seed: base.wrapping_mul(1_000_003).wrapping_add(seed),
        compensation: CompensationSettings {
            mode: CompensationMode::Adaptive { cap_us: CAP_US },
            initial_delay_us: 100_000,
        },
        tick_hz: TICK_HZ,
    };
    Ok(Tally::of(&rehearsal.run(|_| true)?, truth, seed))
}

const HEADER: &str = "network,sessions,shape_p50_mm,shape_p95_mm,shape_max_mm,force_rms,force_p95,hashes_equal,up_bytes_s,down_bytes_s\n";

fn csv(row: &Value) -> String {
    let shape = &row["shape_disagreement_mm"];
    let cells = [
        &row["profile"],
        &row["seeds"],
        &shape["p50"],
        &shape["p95"],
        &shape["max"],
        &row["force_error_rms"],
        &row["force_error_p95"],
        &row["hashes_equal"],
        &row["bytes_per_s"]["up"],
        &row["bytes_per_s"]["down"],
    ];
    let cells: Vec<String> = cells.iter().map(ToString::to_string).collect();
    cells.join(",") + "\n"
}

fn course(name: &str, colour: &'static str, points: &[CoursePoint]) -> Line {
    let began = points.first().map_or(0, |p| p.t_us);
    Line {
        name: name.to_owned(),
        colour,
        dashed: false,
        points: points
            .iter()
            .map(|p| ((p.t_us - began) as f64 * 1e-6, p.p95_mm))
            .collect(),
    }
}
