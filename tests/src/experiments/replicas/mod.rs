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
             the network {}. Bandwidth excludes QUIC overhead. A row is ok if outside stalls the 95th \
             percentile of the distance is within 0.1 mm and the force error within 5 % rms, if in stalls no force \
             has a dropout or a step above 0.5 N, and if all topologies are equal. A stall lasts from the time at \
             which the newest motion is older than D and the 50 ms that extrapolation bridges, until 200 ms after \
             its end.",
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
    ("stalls_percent", "stalls.share", 100.0),
    ("dropouts", "dropouts", 1.0),
    (
        "shape_p95_outside_mm",
        "outside_stalls.shape_disagreement_mm.p95",
        1.0,
    ),
    (
        "force_rms_outside_percent",
        "outside_stalls.force_error_rms",
        100.0,
    ),
    ("dropouts_in_stalls", "stalls.dropouts", 1.0),
    ("force_step_in_stalls_n", "stalls.force_step_max_n", 1.0),
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

#[cfg(test)]
mod tests {
    use palpate_tissue::{Material, block};
    use serde_json::Value;

    use super::*;
    use crate::network::{Outage, Outages, Step, Steps};

    /// A link that holds packets for 0.7 s at `stall_s` and loses all of 0.6 s at `outage_s`.
    fn interrupted(stall_s: f64, outage_s: f64) -> Link {
        let step = |at_s, delay_ms| Step { at_s, delay_ms };
        let outage = Outage {
            from_s: outage_s,
            to_s: outage_s + 0.6,
        };
        Link {
            delay_ms: 30.0,
            loss: 0.01,
            jitter: Jitter::Uniform { reach_ms: 3.0 },
            // Packets behind the late one wait for it.
            steps: Some(Steps {
                repeat_s: None,
                delays: vec![step(stall_s, 730.0), step(stall_s + 0.01, 30.0)],
            }),
            outages: Some(Outages {
                repeat_s: None,
                times: vec![outage],
            }),
            ..Link::default()
        }
    }

    #[test]
    fn replicas_agree_200_ms_after_a_stall_and_an_outage_and_own_forces_stay() {
        let model = Arc::new(block(SMALL_BLOCK, 0.005, &Material::default(), 1));
        let scripts = Scripts::for_model(&model, SECONDS).unwrap();
        let scripts = [&scripts.holder, &scripts.cutter];
        let scripted = reference::run(&model, scripts, &[], |_| true).unwrap();
        // Both links, with tools in contact; and one link each, while the blade cuts.
        let profiles = [
            Profile::both("both", interrupted(3.0, 5.0)),
            Profile {
                up: interrupted(4.0, 60.0),
                down: interrupted(60.0, 6.0),
                name: "each".to_owned(),
            },
        ];
        for profile in profiles {
            let tally = session(&model, &scripts, &profile, 1, 0, &scripted.forces);
            let row = tally.unwrap().row(&profile);
            assert_eq!(row["missed"], json!([]), "{row:#}");
            let number = |pointer: &str| row.pointer(pointer).and_then(Value::as_f64).unwrap();
            // Two stalls of 1.3 s and 0.4 s after them, less D, of 7.5 s.
            assert!((0.15..0.24).contains(&number("/stalls/share")), "{row:#}");
            let max_mm = number("/shape_disagreement_mm/max");
            assert!(max_mm > 1.0, "no stall had an effect: {row:#}");
            assert!(
                number("/outside_stalls/shape_disagreement_mm/p95") < 0.03,
                "{row:#}"
            );
            // Tools that press no more 50 ms after their newest sample: 0.33 and 0.42 mm, 1.0 and 1.4 %.
            assert!(number("/shape_disagreement_mm/p95") < 0.25, "{row:#}");
            assert!(number("/force_error_rms") < 0.007, "{row:#}");
        }
    }
}
