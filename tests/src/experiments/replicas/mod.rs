//! Two trainees press, cut and release one tissue over a network: error of their shapes against each other
//! and of their forces against a reference without a network.
//!
//! One session is [simulated](crate::simulated_session) per seed and network. The disagreement counts every node
//! that is displaced by more than 0.05 mm at either site, every 10 ms. The force reference without a
//! network is the [replay](reference::replay) of the same hand motions, and a [run](reference::run) of the
//! scripts.

mod real;
mod tally;

use std::sync::Arc;

use palpate_device::Script;
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_tissue::{Material, Model, Topology, block};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::cells::of_file;
use super::{Bench, Outcome, missed_by, panel};
use crate::bench::on_threads;
use crate::chart::{BLACK, BLUE, Chart, GREEN, Line, ORANGE, PURPLE, SKY};
use crate::disagreement::CoursePoint;
use crate::force_error::ForcePoint;
use crate::network::{Jitter, Link, Profile};
use crate::reference;
use crate::scripts::Scripts;
use crate::simulated_session::SimulatedSession;
use crate::tool_location::ToolLocation;
use tally::{Sat, Tally};

/// Default number of sessions per network. Each takes five seconds of CPU time, half of it for the
/// reference.
const SEEDS: u64 = 12;

/// Maximum number of sessions per network with a force comparison; its reference takes as long as the
/// session.
const FELT: u64 = 100;

/// Sessions between two progress reports.
const CHUNK: u64 = 16;

/// Length of the session's scripts, s.
const SECONDS: f64 = 6.0;

/// Server ticks per second.
const TICK_HZ: u32 = 60;

/// Maximum playout delay, µs. At 400 ms round trip to the server, an event is 400 ms old when it reaches
/// the other trainee.
const CAP_US: u32 = 700_000;

/// A network with this round trip to the server, 5 % loss and up to 20 ms of jitter; without delay it has
/// no jitter.
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

/// Default round trips to the server, ms, and the index of the one that the summary reports.
const ROUND_TRIPS_MS: [f64; 6] = [0.0, 50.0, 100.0, 200.0, 300.0, 400.0];
const ASKED: usize = 3;

/// Line colours of the networks.
const COLOURS: [&str; 6] = [BLACK, SKY, GREEN, BLUE, PURPLE, ORANGE];

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
    let place =
        ToolLocation::find(&Topology::new(Arc::clone(&model))).map_err(|e| e.to_string())?;
    let scripts = Scripts::for_place(&place, SECONDS).map_err(|e| e.to_string())?;
    // Both sides follow the scripts as rounded in the file.
    let files = [&scripts.holder, &scripts.cutter].map(Script::to_toml);
    let read = |text: &String| Script::from_toml(text).map_err(|e| e.to_string());
    let scripts = [&read(&files[0])?, &read(&files[1])?];
    (bench.progress)("reference", 0.0);
    let truth = reference::run(&model, scripts, &[], |_| true).map_err(|e| e.to_string())?;
    let (networks, asked) = match bench.profile.clone() {
        Some(profile) => (vec![profile], 0),
        None => (ROUND_TRIPS_MS.map(far).into(), ASKED),
    };
    let seeds = bench.seeds.unwrap_or(SEEDS);
    let (mut rows, mut lines, mut table) = (Vec::new(), Vec::new(), String::from(HEADER));
    for (k, profile) in networks.iter().enumerate() {
        let all = std::thread::available_parallelism().map_or(1, usize::from);
        let base = bench.seed;
        let one = |seed: u64| session(&model, &scripts, profile, base, seed, &truth.courses);
        let mut tally = Tally::default();
        for first in (0..seeds).step_by(CHUNK as usize) {
            let share = (k as f64 + first as f64 / seeds as f64) / networks.len() as f64;
            (bench.progress)(&profile.name, share);
            let some: Result<Tally, String> = on_threads(all, || {
                (first..seeds.min(first + CHUNK))
                    .into_par_iter()
                    .map(one)
                    .try_reduce(Tally::default, |a, b| Ok(a.join(b)))
            })?;
            tally = tally.join(some?);
        }
        let row = tally.row(profile);
        table.push_str(&csv(&row, ""));
        let colour = COLOURS[k % COLOURS.len()];
        lines.push(course(&profile.name, colour, &tally.course));
        rows.push(row);
    }
    let chart = Chart {
        title: "Two trainees press and cut: disagreement of their views".to_owned(),
        x_label: "time (s)".to_owned(),
        panels: vec![panel(
            "95th percentile of tools and nodes, seed 0 of each network",
            "distance (mm)",
            lines,
        )],
        marks: Vec::new(),
    };
    let mut figures = rows[asked].clone();
    figures["experiment"] = json!("replicas");
    figures["nodes"] = json!(model.nodes.len());
    let mut missed = missed_by(&rows);
    figures["networks"] = json!(rows);
    if let Some(n) = bench.real {
        let mut tally =
            real::sessions(bench, &model, &files, &networks[asked], n, |sat, number| {
                compared(&model, &scripts, sat, &truth.courses, number)
            })?;
        let row = tally.row(&networks[asked]);
        table.push_str(&csv(&row, " (processes, QUIC)"));
        let in_real_time = missed_by([&row]).into_iter();
        missed.extend(in_real_time.map(|what| format!("real time: {what}")));
        figures["real"] = row;
    }
    figures["ok"] = json!(missed.is_empty());
    figures["missed"] = json!(missed);
    Ok(Outcome {
        caption: format!(
            "Two trainees press, cut and press again on {} nodes, in virtual time over emulated networks: \
             distance of their shapes at one shared time, and error of their forces against a replay of the \
             same hand motions without a network, relative to the rms force. The single figures are those of \
             the network {}. Bandwidth excludes QUIC overhead. A row is ok if the 95th percentile of the \
             distance is within 0.1 mm, the force error within 5 % rms, and all topologies are equal.",
            model.nodes.len(),
            networks[asked].name
        ),
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
    scripted: &[Vec<ForcePoint>; 2],
) -> Result<Tally, String> {
    let session = SimulatedSession {
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
    compared(
        model,
        scripts,
        session.run(|_| true)?.try_into()?,
        scripted,
        seed,
    )
}

/// Compares a session with the reference of the same hand motions.
fn compared(
    model: &Arc<Model>,
    scripts: &[&Script; 2],
    session: Sat,
    scripted: &[Vec<ForcePoint>; 2],
    number: u64,
) -> Result<Tally, String> {
    if number >= FELT {
        return Ok(Tally::of(session, None, false));
    }
    let recordings = session.recordings.each_ref();
    let same_hands = reference::replay(model, *scripts, recordings, |_| true);
    let same_hands = same_hands.map_err(|e| e.to_string())?;
    Ok(Tally::of(
        session,
        Some([&same_hands.courses, scripted]),
        number == 0,
    ))
}

const HEADER: &str = "network,sessions,shape_p50_mm,shape_p95_mm,shape_max_mm,force_rms_percent,force_p95_percent,hashes_equal,up_kbit_s,down_kbit_s,ok\n";

/// A line of the table; `how` is appended to the network's name.
fn csv(row: &Value, how: &str) -> String {
    let shape = &row["shape_disagreement_mm"];
    let network = json!(row["profile"].as_str().unwrap_or_default().to_owned() + how);
    let cells = [
        &network,
        &row["seeds"],
        &shape["p50"],
        &shape["p95"],
        &shape["max"],
        &times(&row["force_error_rms"], 100.0),
        &times(&row["force_error_p95"], 100.0),
        &row["hashes_equal"],
        &times(&row["bytes_per_s"]["up"], 8e-3),
        &times(&row["bytes_per_s"]["down"], 8e-3),
        &row["ok"],
    ];
    cells.map(of_file).join(",") + "\n"
}

/// A figure in another unit; null stays null.
fn times(figure: &Value, factor: f64) -> Value {
    json!(figure.as_f64().map(|x| x * factor))
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
