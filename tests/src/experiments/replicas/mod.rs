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
use palpate_tissue::Model;
use rayon::prelude::*;
use serde_json::json;

use super::table::Column;
use super::{Bench, Outcome, Table, missed_by};
use crate::bench::on_threads;
use crate::chart::{BLACK, BLUE, Chart, GREEN, Line, ORANGE, PURPLE, Panel, SKY};
use crate::disagreement::DisagreementPoint;
use crate::force_error::ForcePoint;
use crate::network::{Jitter, Link, Profile};
use crate::reference;
use crate::scripts::Scripts;
use crate::simulated_session::{SimulatedSession, adaptive};
use tally::{SessionRecord, Tally};

/// Default number of sessions per network. Each takes five seconds of CPU time, half of it for the
/// reference.
const SEEDS: u64 = 12;

/// Maximum number of sessions per network with a force comparison; its reference takes as long as the
/// session.
const FELT: u64 = 100;
const CHUNK: u64 = 16;
const SECONDS: f64 = 6.0;
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
const COLOURS: [&str; 6] = [BLACK, SKY, GREEN, BLUE, PURPLE, ORANGE];
pub(super) const SMALL_BLOCK: [usize; 3] = [18, 18, 6];

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = bench.model_or_block(SMALL_BLOCK);
    let scripts = Scripts::for_model(&model, SECONDS)?;
    // Both sides follow the scripts as rounded in the file.
    let files = [&scripts.holder, &scripts.cutter].map(Script::to_toml);
    let read = |text: &String| Script::from_toml(text).map_err(|e| e.to_string());
    let scripts = [&read(&files[0])?, &read(&files[1])?];
    (bench.progress)("reference", 0.0);
    let scripted = reference::run(&model, scripts, &[], |_| true).map_err(|e| e.to_string())?;
    let (networks, asked) = match bench.inputs.profile.clone() {
        Some(profile) => (vec![profile], 0),
        None => (ROUND_TRIPS_MS.map(far).into(), ASKED),
    };
    let seeds = bench.inputs.seeds.unwrap_or(SEEDS);
    let (mut rows, mut lines) = (Vec::new(), Vec::new());
    for (k, profile) in networks.iter().enumerate() {
        let all = std::thread::available_parallelism().map_or(1, usize::from);
        let base = bench.seed();
        let one = |seed: u64| session(&model, &scripts, profile, base, seed, &scripted.forces);
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
        let colour = COLOURS[k % COLOURS.len()];
        lines.push(disagreement(&profile.name, colour, &tally.disagreement));
        rows.push(row);
    }
    let panel_title = "95th percentile of tools and nodes, seed 0 of each network";
    let panels = vec![Panel::new(panel_title, "distance (mm)", lines)];
    let title = "Two trainees press and cut: disagreement of their views";
    let chart = Chart::new(title, "time (s)", panels);
    let mut figures = rows[asked].clone();
    figures["experiment"] = json!("replicas");
    figures["nodes"] = json!(model.nodes.len());
    let mut missed = missed_by(&rows);
    let mut table = Table::of_objects(&rows, COLUMNS);
    figures["networks"] = json!(rows);
    if let Some(n) = bench.inputs.real {
        let mut tally = real::sessions(
            bench,
            &model,
            &files,
            &networks[asked],
            n,
            |session, number| compared(&model, &scripts, session, &scripted.forces, number),
        )?;
        let row = tally.row(&networks[asked]);
        let mut in_processes = row.clone();
        let network = format!("{} (processes, QUIC)", networks[asked].name);
        in_processes["profile"] = json!(network);
        table
            .rows
            .extend(Table::of_objects(&[in_processes], COLUMNS).rows);
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
        ..Outcome::default()
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
        thin_spectator_count: 0,
        profile,
        seed: base.wrapping_mul(1_000_003).wrapping_add(seed),
        compensation: adaptive(100_000, CAP_US),
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

fn compared(
    model: &Arc<Model>,
    scripts: &[&Script; 2],
    session: SessionRecord,
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
        Some([&same_hands.forces, scripted]),
        number == 0,
    ))
}

const COLUMNS: &[Column] = &[
    ("network", "profile", 1.0),
    ("sessions", "seeds", 1.0),
    ("shape_p50_mm", "shape_disagreement_mm.p50", 1.0),
    ("shape_p95_mm", "shape_disagreement_mm.p95", 1.0),
    ("shape_max_mm", "shape_disagreement_mm.max", 1.0),
    ("force_rms_percent", "force_error_rms", 100.0),
    ("force_p95_percent", "force_error_p95", 100.0),
    ("hashes_equal", "hashes_equal", 1.0),
    ("up_kbit_s", "bytes_per_s.up", 8e-3),
    ("down_kbit_s", "bytes_per_s.down", 8e-3),
    ("ok", "ok", 1.0),
];

fn disagreement(name: &str, colour: &'static str, points: &[DisagreementPoint]) -> Line {
    let began = points.first().map_or(0, |p| p.t_us);
    let points = points
        .iter()
        .map(|p| ((p.t_us - began) as f64 * 1e-6, p.p95_mm));
    Line::new(name, colour, points)
}
