//! Benches that belong on the page of all experiments: what the figures there cost.

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

/// Ticks of each device: four times fewer than by default, where the 99.9th percentile still stands on 50 of them.
const TICKS: usize = 50_000;

/// Nodes per edge of the cube that is pressed.
const CUBE_NODES: usize = 20;

/// Hands for which something breaks.
const FAULTS: u64 = 500;

/// Round trip for which the coding is measured, ms: what is older is known to both ends.
const ROUND_TRIP_MS: i64 = 50;

/// Length of the scripts of which bytes are counted, s, and their tissue and network.
const BYTES_SECONDS: f64 = 8.0;
const BYTES_MODEL: &str = "thigh";
const BYTES_NETWORK: &str = "metro";

/// Who is told what is done, and its share.
pub(super) type Told<'a> = dyn FnMut(&str, f64) + Send + 'a;

/// A bench on the page.
#[derive(Debug, Clone, Copy)]
pub(super) struct Measured {
    /// Its name.
    pub(super) name: &'static str,
    /// What it measures, in a line.
    pub(super) about: &'static str,
    /// What repeats it.
    pub(super) command: &'static str,
    /// Runs it, with a folder for models; tells what it does.
    pub(super) run: fn(&Path, &mut Told<'_>) -> Result<Outcome, String>,
}

/// In the order of the page.
pub(super) const ALL: &[Measured] = &[
    Measured {
        name: "coding",
        about: "bits per pose and per node on the wire: ours, deflate, raw",
        command: "palpate-lab bench coding --round-trip-ms 50 --seed 1",
        run: coding,
    },
    Measured {
        name: "bytes",
        about: "what a session of people who press and cut takes of a network, part by part, with what QUIC adds",
        command: "palpate-lab bench bytes --model thigh --seconds 8 --profile metro --seed 1",
        run: bytes,
    },
    Measured {
        name: "haptic-tick",
        about: "what a tick of the 1 kHz loop takes: read, compute, write",
        command: "palpate-lab bench haptic-tick --ticks 50000",
        run: haptic_tick,
    },
    Measured {
        name: "press-cube",
        about: "what solving takes for a cube of 8,000 nodes that a disc is pressed into",
        command: "palpate-lab bench press-cube --moving",
        run: press_cube,
    },
    Measured {
        name: "haptic-faults",
        about: "hands for which something breaks: no fault may jerk them",
        command: "palpate-lab haptic-faults --seeds 500",
        run: faults,
    },
];

/// A bench of that name.
pub(super) fn named(name: &str) -> Option<Measured> {
    ALL.iter().find(|b| b.name == name).copied()
}

fn outcome(caption: &str, report: &impl Serialize) -> Result<Outcome, String> {
    Ok(Outcome {
        caption: caption.to_owned(),
        figures: serde_json::to_value(report).map_err(|e| format!("no figures: {e}"))?,
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
    let caption = "A random hand of 87 mm/s rms in batches of four new 1 kHz samples, and a block that is pressed and released, 60 \
                   frames a second to 0.05 mm. Deflate is given the same integers as differences from what the other end is known \
                   to have, each datagram or frame by itself; raw are four-byte numbers. Headers are counted.";
    Ok(Outcome {
        tables: vec![("coding".to_owned(), coding_table(&report))],
        ..outcome(caption, &report)?
    })
}

fn coding_table(report: &CodingReport) -> String {
    let mut table = String::from("bits,ours,deflate_1,deflate_9,raw\n");
    for (per, bits) in [("per pose", report.pose), ("per node", report.node)] {
        // Writing to a string can not fail.
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
        "Two full subscribers press and cut a thigh of {} nodes over the network {}: kbit/s of each by part, over the whole of \
         their scripts. udp is all parts and what QUIC adds, and has to stay below limit; acknowledgements stand within the \
         parts. The worst second is without what QUIC adds. From {}.",
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
        "Times of a tick, by device and by the places on the tool that touch. It is one run on this machine: other \
         work on it changes the rare ticks.",
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
        "A cube of side 0.1 m pressed by a disc on one thread: from rest to 1 % of its displacement and to \
         convergence, and then in ten steps of 0.1 mm.",
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
            "{} of {} runs broke a law; palpate-lab haptic-faults tells which",
            all.failed(),
            all.runs
        ));
    }
    outcome(
        "In virtual time a hand presses through the loop that clients run, and something breaks. The force may change \
         by the slew limit per tick, and is zero within 150 ms of the loss of its source.",
        &all,
    )
}
