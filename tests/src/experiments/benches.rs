//! Benchmarks on the page of all experiments.

use serde::Serialize;
use serde_json::{Value, json};

use super::inputs::SEED;
use super::registry::Experiment;
use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::attack::kinds::Attack;
use crate::attack::{self, AttackOptions};
use crate::bench::bytes::Bytes;
use crate::bench::coding::Coding;
use crate::bench::haptic_tick::HapticTick;
use crate::bench::press_cube::PressCube;
use crate::haptic_faults;
use crate::haptic_faults::run::Setup;
use crate::network::Profile;
use crate::progress::{Interrupt, Progress};
use crate::test_model::TestModel;

/// Ticks of each device, a quarter of the default: 50 samples remain above the 99.9th percentile.
const TICKS: u32 = 50_000;

/// Nodes per edge of the pressed cube.
const CUBE_NODES: u16 = 20;

/// Number of fault injection runs.
const FAULTS: u64 = 500;

/// Round trip of the coding benchmark, ms: both ends know older data.
const ROUND_TRIP_MS: i64 = 50;

/// Length of the bandwidth benchmark's scripts, s, and its tissue and network.
const BYTES_SECONDS: f64 = 8.0;
const BYTES_MODEL: &str = "thigh";
const BYTES_NETWORK: &str = "metro";

/// Attacks of the page, which run at once, and their length, s.
const ATTACKS: [&str; 6] = [
    "transfers",
    "handshakes",
    "delay",
    "seats",
    "slow-reader",
    "names",
];
const ATTACK_SECONDS: f64 = 6.0;
const ATTACK_NETWORK: &str = "lan";

/// All benchmarks in page order, each with the command that repeats it.
pub(super) const BENCHMARKS: &[(Experiment, &str)] = &[
    (
        Experiment {
            name: "coding",
            about: "bits per pose and per node on the wire: this codec, deflate, raw",
            takes: &[],
            run: coding,
        },
        "palpate-lab bench coding --round-trip-ms 50 --seed 1",
    ),
    (
        Experiment {
            name: "bytes",
            about: "bandwidth of a session while pressing and cutting, by purpose, with QUIC overhead",
            takes: &[],
            run: bytes,
        },
        "palpate-lab bench bytes --model thigh --seconds 8 --profile metro --seed 1",
    ),
    (
        Experiment {
            name: "haptic-tick",
            about: "duration of a tick of the 1 kHz loop: read, compute, write",
            takes: &[],
            run: haptic_tick,
        },
        "palpate-lab bench haptic-tick --ticks 50000",
    ),
    (
        Experiment {
            name: "press-cube",
            about: "solver time for a disc pressed into a cube of 8,000 nodes",
            takes: &[],
            run: press_cube,
        },
        "palpate-lab bench press-cube --moving",
    ),
    (
        Experiment {
            name: "haptic-faults",
            about: "injected faults during haptic contact: no fault may cause a force jump",
            takes: &[],
            run: faults,
        },
        "palpate-lab haptic-faults --seeds 500",
    ),
    (
        Experiment {
            name: "attack",
            about: "attacks on a server beside two trainees: force, delay, newcomers, memory",
            takes: &[],
            run: attacks,
        },
        "palpate-lab attack transfers handshakes delay seats slow-reader names --seconds 6",
    ),
];

fn outcome(caption: &str, report: &impl Serialize) -> Result<Outcome, String> {
    Ok(Outcome {
        caption: caption.to_owned(),
        figures: serde_json::to_value(report)
            .map_err(|e| format!("cannot serialise the figures: {e}"))?,
        charts: Vec::new(),
        tables: Vec::new(),
    })
}

fn coding(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    (bench.progress)("poses and nodes", 0.0);
    let report = Coding {
        round_trip_ms: ROUND_TRIP_MS,
        seed: SEED,
    }
    .run()?;
    let caption = "A random hand of 87 mm/s rms in batches of four new 1 kHz samples, and a block that is \
                   pressed and released, at 60 frames per second and 0.05 mm. Deflate compresses the same \
                   integers, as differences from the acknowledged state, per datagram or frame. Raw uses \
                   four-byte numbers. Headers are included.";
    let rows = [("per pose", report.pose), ("per node", report.node)];
    let rows = rows.map(|(per, bits)| json!({ "per": per, "bits": bits }));
    Ok(Outcome {
        tables: vec![("coding".to_owned(), Table::of_objects(&rows, CODING))],
        ..outcome(caption, &report)?
    })
}

const CODING: &[Column] = &[
    ("bits", "per", 1.0),
    ("ours", "bits.ours", 1.0),
    ("deflate_1", "bits.deflate_1", 1.0),
    ("deflate_9", "bits.deflate_9", 1.0),
    ("raw", "bits.raw", 1.0),
];

fn bytes(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    (bench.progress)(&format!("building the sample \"{BYTES_MODEL}\""), 0.0);
    let built = TestModel::prepare(BYTES_MODEL, bench.dir).map_err(|e| e.to_string())?;
    let measured = Bytes {
        model: BYTES_MODEL.to_owned(),
        seconds: BYTES_SECONDS,
        profile: Profile::named(BYTES_NETWORK).map_err(|e| e.to_string())?,
        seed: SEED,
    };
    let report = measured.run(&built.model, &mut |what| (bench.progress)(what, 0.0))?;
    let caption = format!(
        "Two full subscribers press and cut a thigh of {} nodes over the network {}: kbit/s of each by \
             purpose, over the length of their scripts. The column udp is the total with QUIC overhead and \
             must stay below limit. The other columns include acknowledgements. The worst second excludes \
             QUIC overhead. Method: {}.",
        report.nodes, report.network, report.method
    );
    let rows: Vec<Value> = (report.subscribers.iter())
        .flat_map(|s| {
            s.flows
                .each_ref()
                .map(|flow| json!({ "does": s.does, "flow": flow }))
        })
        .collect();
    Ok(Outcome {
        tables: vec![("bytes".to_owned(), Table::of_objects(&rows, BYTES))],
        ..outcome(&caption, &report)?
    })
}

const BYTES: &[Column] = &[
    ("who", "does", 1.0),
    ("direction", "flow.direction", 1.0),
    ("motion_kbit_s", "flow.motion", 1.0),
    ("operations_kbit_s", "flow.operations", 1.0),
    ("corrections_kbit_s", "flow.corrections", 1.0),
    ("clock_kbit_s", "flow.clock", 1.0),
    ("delays_kbit_s", "flow.delays", 1.0),
    ("quic_kbit_s", "flow.quic", 1.0),
    ("udp_kbit_s", "flow.udp", 1.0),
    ("limit_kbit_s", "flow.limit", 1.0),
    ("worst_second_kbit_s", "flow.worst_second", 1.0),
    ("acknowledgements_kbit_s", "flow.acknowledgements", 1.0),
    ("packets_per_s", "flow.packets_per_s", 1.0),
    ("ok", "flow.ok", 1.0),
];

fn haptic_tick(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    (bench.progress)("ticks", 0.0);
    let report = HapticTick { ticks: TICKS }.run()?;
    outcome(
        "Durations of a tick, by device and number of active contact points. One run on this machine: other \
         load changes the rare long ticks.",
        &report,
    )
}

fn press_cube(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let cube = PressCube {
        nodes: CUBE_NODES,
        threads: 1,
        poisson: 0.25,
        moving: true,
    };
    let report = cube.run(&mut |what| (bench.progress)(what, 0.0));
    outcome(
        "A cube of side 0.1 m pressed by a disc, on one thread: from rest to 1 % displacement error and to \
         convergence, then in ten steps of 0.1 mm.",
        &report,
    )
}

fn faults(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let mut each = |seed: u64, _: &haptic_faults::outcome::Outcome| {
        (bench.progress)("runs", seed as f64 / FAULTS as f64);
        true
    };
    let all =
        haptic_faults::all(0..FAULTS, &Setup::default(), &mut each).map_err(|e| e.to_string())?;
    if !all.ok {
        return Err(format!(
            "{} of {} runs violated a law; palpate-lab haptic-faults lists them",
            all.failed(),
            all.runs
        ));
    }
    outcome(
        "Faults during a press through the client's force loop, in virtual time. The force changes by at \
         most the slew-rate limit per tick and is zero within 150 ms after the loss of its source.",
        &all,
    )
}

fn attacks(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    (bench.progress)("a session without and with attacks", 0.0);
    let attacks: Result<Vec<Attack>, String> = ATTACKS.into_iter().map(Attack::named).collect();
    let options = AttackOptions {
        executable: attack::command::executable()?,
        model: BYTES_MODEL.to_owned(),
        seconds: ATTACK_SECONDS,
        profile: Profile::named(ATTACK_NETWORK).map_err(|e| e.to_string())?,
        seed: SEED,
        runs: vec![attacks?],
    };
    let report = attack::run(&options, &mut Progress::new(), &Interrupt::default())
        .map_err(|e| e.to_string())?;
    let rows: Vec<Value> = std::iter::once(&report.base)
        .chain(&report.runs)
        .map(|run| {
            let mut row = json!(run);
            row["label"] = run.label().into();
            row
        })
        .collect();
    let caption = "Two trainees press and cut over a local network, while attackers with valid links \
                   attack the server: unfinished model transfers, half-open handshakes, false delay reports, joins \
                   without end, a client that never reads, and names that look alike. The limits are relative to \
                   the same session without attack. `palpate-lab attack` runs every attack alone.";
    Ok(Outcome {
        tables: vec![(
            "attack".to_owned(),
            Table::of_objects(&rows, ATTACK_COLUMNS),
        )],
        ..outcome(caption, &report)?
    })
}

const ATTACK_COLUMNS: &[Column] = &[
    ("run", "label", 1.0),
    ("delay_median_ms", "delay.median_ms", 1.0),
    ("delay_max_ms", "delay.max_ms", 1.0),
    ("demotions", "demotions", 1.0),
    ("newcomers", "newcomers.attempts", 1.0),
    ("newcomers_joined", "newcomers.joined", 1.0),
    ("slowest_newcomer_s", "newcomers.slowest_s", 1.0),
    ("memory_quiet_mb", "memory.quiet_mb", 1.0),
    ("memory_largest_mb", "memory.largest_mb", 1.0),
    ("operations", "operations", 1.0),
];
