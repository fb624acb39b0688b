//! Benches that belong on the page of all experiments: what the figures there cost.

use serde::Serialize;

use super::Outcome;
use crate::bench::haptic_tick::HapticTick;
use crate::bench::press_cube::PressCube;
use crate::haptic_faults;
use crate::haptic_faults::course::Setup;

/// Ticks of each device: four times fewer than by default, where the 99.9th percentile still stands on 50 of them.
const TICKS: usize = 50_000;

/// Nodes per edge of the cube that is pressed.
const CUBE_NODES: usize = 20;

/// Hands for which something breaks.
const FAULTS: u64 = 500;

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
    /// Runs it; is told what it does.
    pub(super) run: fn(&mut Told<'_>) -> Result<Outcome, String>,
}

/// In the order of the page.
pub(super) const ALL: &[Measured] = &[
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

fn haptic_tick(told: &mut Told<'_>) -> Result<Outcome, String> {
    told("ticks", 0.0);
    let report = HapticTick { ticks: TICKS }.run()?;
    outcome(
        "Times of a tick, by device and by the places on the tool that touch. It is one run on this machine: other \
         work on it changes the rare ticks.",
        &report,
    )
}

fn press_cube(told: &mut Told<'_>) -> Result<Outcome, String> {
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

fn faults(told: &mut Told<'_>) -> Result<Outcome, String> {
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
