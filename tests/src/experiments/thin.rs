//! A thin spectator, without tissue solver, of two trainees who press and cut: error of the shown shape and
//! bandwidth.
//!
//! One [session](crate::simulated_session) is simulated per network. Distances are measured at every view, from the
//! server's shape at the shown time, over all displaced surface nodes.

use serde_json::json;

use super::replicas::SMALL_BLOCK;
use super::table::Column;
use super::{Bench, Outcome, Table, missed_by};
use crate::network::Profile;
use crate::scripts::Scripts;
use crate::simulated_session::{SessionResult, SimulatedSession, ThinSpectatorResult, adaptive};

const SECONDS: f64 = 6.0;
const TICK_HZ: u32 = 60;
const CAP_US: u32 = 500_000;

/// Limit of the rate in any second, bit/s, with 5 % for accumulated rate budget.
const RATE_MAX: f64 = 1.05e6;
/// Limit of the distance at rest, mm, with a margin for single precision.
const REST_MM: f64 = 0.0501;
const NETWORKS: [&str; 4] = ["lan", "transatlantic", "intercontinental", "wifi-bursts"];

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = bench.model_or_block(SMALL_BLOCK);
    let scripts = Scripts::for_model(&model, SECONDS)?;
    let scripts = [&scripts.holder, &scripts.cutter];
    let networks: Vec<Profile> = match &bench.inputs.profile {
        Some(profile) => vec![profile.clone()],
        None => NETWORKS
            .iter()
            .filter_map(|n| Profile::named(n).ok())
            .collect(),
    };
    let mut rows = Vec::new();
    for (k, profile) in networks.iter().enumerate() {
        let session = SimulatedSession {
            model: &model,
            scripts: &scripts,
            motion_only: true,
            thin_spectator_count: 1,
            profile,
            seed: bench.seed(),
            compensation: adaptive(100_000, CAP_US),
            tick_hz: TICK_HZ,
        };
        let all = networks.len() as f64;
        let done = session.run(|share| {
            (bench.progress)(&profile.name, (k as f64 + share) / all);
            true
        })?;
        let thin = done.thin_results.first().copied().unwrap_or_default();
        let missed = missed(profile, &thin, &done);
        let row = json!({
            "profile": profile.name,
            "thin": thin,
            "hashes_equal": done.hashes_equal(),
            "troubles": done.troubles,
            "ok": missed.is_empty(),
            "missed": missed,
        });
        rows.push(row);
    }
    let mut figures = rows.first().cloned().unwrap_or_default();
    figures["experiment"] = json!("thin");
    figures["nodes"] = json!(model.nodes.len());
    let table = Table::of_objects(&rows, COLUMNS);
    let missed = missed_by(&rows);
    figures["networks"] = json!(rows);
    figures["ok"] = json!(missed.is_empty());
    figures["missed"] = json!(missed);
    Ok(Outcome {
        caption: format!(
            "Two trainees press, cut and press again on {} nodes, watched by a spectator without tissue \
             solver, in virtual time over emulated networks. Columns give the distance of the shown shape \
             from the server's shape at the shown time, during motion and at rest, and the bandwidth. Bits \
             include all data that the server sends to the spectator, without QUIC overhead, also per sent \
             node. A row is ok if no second exceeds 1 Mbit/s and the shape at rest is within the \
             quantisation step of 0.05 mm.",
            model.nodes.len()
        ),
        figures,
        tables: vec![("thin".to_owned(), table)],
        ..Outcome::default()
    })
}

fn missed(profile: &Profile, thin: &ThinSpectatorResult, done: &SessionResult) -> Vec<String> {
    let (rate, rest_mm) = (thin.bits_per_s_max, thin.rest_mm.max);
    let mut missed = Vec::new();
    let mut miss = |what: String| missed.push(format!("{}: {what}", profile.name));
    // NaN also misses the limit.
    if rate.is_nan() || rate > RATE_MAX {
        miss(format!(
            "{rate:.0} bit/s in one second, limit {RATE_MAX:.0}"
        ));
    }
    if rest_mm.is_nan() || rest_mm > REST_MM {
        miss(format!(
            "the shown tissue at rest is off by {rest_mm:.4} mm, limit {REST_MM}"
        ));
    }
    if !done.hashes_equal() {
        miss("topologies differ at the end".to_owned());
    }
    if let [first, ..] = &done.troubles[..] {
        let n = done.troubles.len();
        miss(format!("{n} errors; the first: {first}"));
    }
    missed
}

const COLUMNS: &[Column] = &[
    ("network", "profile", 1.0),
    ("apart_p50_mm", "thin.apart_mm.p50", 1.0),
    ("apart_p95_mm", "thin.apart_mm.p95", 1.0),
    ("apart_max_mm", "thin.apart_mm.max", 1.0),
    ("rest_max_mm", "thin.rest_mm.max", 1.0),
    ("kbit_s", "thin.bits_per_s", 1e-3),
    ("kbit_s_worst_second", "thin.bits_per_s_max", 1e-3),
    ("bits_per_node", "thin.bits_per_node", 1.0),
    ("nodes_waiting_max", "thin.waiting_max", 1.0),
    ("lag_ms", "thin.lag_ms", 1.0),
    ("hashes_equal", "hashes_equal", 1.0),
    ("ok", "ok", 1.0),
];
