//! Benchmarks on the page of all experiments.

use std::fmt::Write as _;
use std::path::Path;

use serde::Serialize;

use super::Outcome;
use super::cells::of_file;
use super::command::SEED;
use crate::bench::bytes::{Bytes, BytesReport, Flow};
use crate::bench::coding::{Coding, CodingReport};
use crate::bench::haptic_tick::HapticTick;
use crate::bench::press_cube::PressCube;
use crate::haptic_faults;
use crate::haptic_faults::course::Setup;
use crate::network::Profile;
use crate::test_model::TestModel;

/// Ticks of each device, a quarter of the default: 50 samples remain above the 99.9th percentile.
const TICKS: usize = 50_000;

/// Nodes per edge of the pressed cube.
const CUBE_NODES: usize = 20;

/// Number of fault injection runs.
const FAULTS: u64 = 500;

/// Round trip of the coding benchmark, ms: both ends know older data.
const ROUND_TRIP_MS: i64 = 50;

/// Length of the bandwidth benchmark's scripts, s, and its tissue and network.
const BYTES_SECONDS: f64 = 8.0;
const BYTES_MODEL: &str = "thigh";
const BYTES_NETWORK: &str = "metro";

/// Callback for progress: the activity and the completed share.
pub(super) type Told<'a> = dyn FnMut(&str, f64) + Send + 'a;

/// A benchmark on the page.
#[derive(Debug, Clone, Copy)]
pub(super) struct Measured {
    /// Name.
    pub(super) name: &'static str,
    /// One-line description.
    pub(super) about: &'static str,
    /// Command that repeats it.
    pub(super) command: &'static str,
    /// Runs the benchmark with a directory for models and a progress callback.
    pub(super) run: fn(&Path, &mut Told<'_>) -> Result<Outcome, String>,
}

/// All benchmarks in page order.
pub(super) const ALL: &[Measured] = &[
    Measured {
        name: "coding",
        about: "bits per pose and per node on the wire: this codec, deflate, raw",
        command: "palpate-lab bench coding --round-trip-ms 50 --seed 1",
        run: coding,
    },
    Measured {
        name: "bytes",
        about: "bandwidth of a session while pressing and cutting, by purpose, with QUIC overhead",
        command: "palpate-lab bench bytes --model thigh --seconds 8 --profile metro --seed 1",
        run: bytes,
    },
    Measured {
        name: "haptic-tick",
        about: "duration of a tick of the 1 kHz loop: read, compute, write",
        command: "palpate-lab bench haptic-tick --ticks 50000",
        run: haptic_tick,
    },
    Measured {
        name: "press-cube",
        about: "solver time for a disc pressed into a cube of 8,000 nodes",
        command: "palpate-lab bench press-cube --moving",
        run: press_cube,
    },
    Measured {
        name: "haptic-faults",
        about: "injected faults during haptic contact: no fault may cause a force jump",
        command: "palpate-lab haptic-faults --seeds 500",
        run: faults,
    },
];

/// The benchmark with this name.
pub(super) fn named(name: &str) -> Option<Measured> {
    ALL.iter().find(|b| b.name == name).copied()
}

fn outcome(caption: &str, report: &impl Serialize) -> Result<Outcome, String> {
    Ok(Outcome {
        caption: caption.to_owned(),
        figures: serde_json::to_value(report)
            .map_err(|e| format!("cannot serialise the figures: {e}"))?,
        charts: Vec::new(),
        tables: Vec::new(),
    })
}

fn coding(_: &Path, told: &mut Told<'_>) -> Result<Outcome, String> {
    told("poses and nodes", 0.0);
    let report = Coding {
        round_trip_ms: ROUND_TRIP_MS,
        seed: SEED,
    }
    .run()?;
    let caption = "A random hand of 87 mm/s rms in batches of four new 1 kHz samples, and a block that is \
                   pressed and released, at 60 frames per second and 0.05 mm. Deflate compresses the same \
                   integers, as differences from the acknowledged state, per datagram or frame. Raw uses \
                   four-byte numbers. Headers are included.";
    Ok(Outcome {
        tables: vec![("coding".to_owned(), coding_table(&report))],
        ..outcome(caption, &report)?
    })
}

fn coding_table(report: &CodingReport) -> String {
    let mut table = String::from("bits,ours,deflate_1,deflate_9,raw\n");
    for (per, bits) in [("per pose", report.pose), ("per node", report.node)] {
        // Writing to a string cannot fail.
        let _ = writeln!(
            table,
            "{per},{},{},{},{}",
            bits.ours, bits.deflate_1, bits.deflate_9, bits.raw
        );
    }
    table
}

fn bytes(dir: &Path, told: &mut Told<'_>) -> Result<Outcome, String> {
    told(&format!("building the sample \"{BYTES_MODEL}\""), 0.0);
    let subject = TestModel::prepare(BYTES_MODEL, dir).map_err(|e| e.to_string())?;
    let bench = Bytes {
        seconds: BYTES_SECONDS,
        profile: Profile::named(BYTES_NETWORK).map_err(|e| e.to_string())?,
        seed: SEED,
    };
    let report = bench.run(&subject.model, &mut |what| told(what, 0.0))?;
    let caption = format!(
        "Two full subscribers press and cut a thigh of {} nodes over the network {}: kbit/s of each by \
             purpose, over the length of their scripts. The column udp is the total with QUIC overhead and \
             must stay below limit. The other columns include acknowledgements. The worst second excludes \
             QUIC overhead. Method: {}.",
        report.nodes, report.network, report.method
    );
    Ok(Outcome {
        tables: vec![("bytes".to_owned(), bytes_table(&report))],
        ..outcome(&caption, &report)?
    })
}

fn bytes_table(report: &BytesReport) -> String {
    const HEAD: &str = "who,direction,motion_kbit_s,operations_kbit_s,corrections_kbit_s,clock_kbit_s,delays_kbit_s,\
                        quic_kbit_s,udp_kbit_s,limit_kbit_s,worst_second_kbit_s,acknowledgements_kbit_s,packets_per_s,ok\n";
    let mut table = String::from(HEAD);
    for subscriber in &report.subscribers {
        for f in &subscriber.flows {
            let Flow { direction, ok, .. } = f;
            let figures = [
                f.motion,
                f.operations,
                f.corrections,
                f.clock,
                f.delays,
                f.quic,
                f.udp,
                f.limit,
                f.worst_second,
                f.acknowledgements,
                f.packets_per_s,
            ];
            let figures = figures.map(|x| x.to_string()).join(",");
            let does = of_file(&subscriber.does.into());
            let _ = writeln!(table, "{does},{direction},{figures},{ok}");
        }
    }
    table
}

fn haptic_tick(_: &Path, told: &mut Told<'_>) -> Result<Outcome, String> {
    told("ticks", 0.0);
    let report = HapticTick { ticks: TICKS }.run()?;
    outcome(
        "Durations of a tick, by device and number of active contact points. One run on this machine: other \
         load changes the rare long ticks.",
        &report,
    )
}

fn press_cube(_: &Path, told: &mut Told<'_>) -> Result<Outcome, String> {
    let cube = PressCube {
        nodes: CUBE_NODES,
        poisson: 0.25,
        moving: true,
    };
    let report = cube.run(&mut |what| told(what, 0.0));
    outcome(
        "A cube of side 0.1 m pressed by a disc, on one thread: from rest to 1 % displacement error and to \
         convergence, then in ten steps of 0.1 mm.",
        &report,
    )
}

fn faults(_: &Path, told: &mut Told<'_>) -> Result<Outcome, String> {
    let mut each = |seed: u64, _: &haptic_faults::outcome::Outcome| {
        told("runs", seed as f64 / FAULTS as f64);
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
