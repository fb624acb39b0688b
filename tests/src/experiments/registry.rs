//! All experiments of the command line.

use super::inputs::Input::{self, Model, Motion, Profile, Real, Seed, Seeds};
use super::{
    Bench, Outcome, atc, friction, handle, leg_press, missing_data, press, replicas, scale,
    soft_hard, table_7_1, thin, tool_paths,
};

/// An experiment or a benchmark.
#[derive(Debug, Clone, Copy)]
pub struct Experiment {
    /// Name on the command line.
    pub name: &'static str,
    /// One-line description.
    pub about: &'static str,
    /// Accepted options; others are rejected.
    pub takes: &'static [Input],
    /// Runs it.
    pub(super) run: fn(&mut Bench<'_>) -> Result<Outcome, String>,
}

/// All experiments in run order.
pub const ALL: &[Experiment] = &[
    Experiment {
        name: "soft-hard",
        about: "a ball on soft tissue, on stiff tissue and between them (Lin 2007, fig 4.8)",
        takes: &[],
        run: soft_hard::run,
    },
    Experiment {
        name: "friction",
        about: "a ball and a line dragged over tissue: stick, slip and torque (figs 4.11 to 4.13)",
        takes: &[],
        run: friction::run,
    },
    Experiment {
        name: "handle",
        about: "a soft grip around a hard core: force against depth for three materials (fig 7.4)",
        takes: &[Model],
        run: handle::run,
    },
    Experiment {
        name: "tool-paths",
        about: "one target point reached along four paths (fig 7.10)",
        takes: &[Model],
        run: tool_paths::run,
    },
    Experiment {
        name: "leg-press",
        about: "a leg with rigid bones pressed over muscle and over bone (fig 7.11)",
        takes: &[Model],
        run: leg_press::run,
    },
    Experiment {
        name: "press",
        about: "force error of the haptic path: a ball and a line pressed at 100 mm/s, the line then dragged",
        takes: &[Model],
        run: press::run,
    },
    Experiment {
        name: "atc-none",
        about: "two sites align a part without artificial time compensation (fig 7.26)",
        takes: &[Seed, Seeds, Profile, Motion],
        run: atc::none,
    },
    Experiment {
        name: "atc-fixed",
        about: "two sites align a part with the smallest safe fixed playout delay (fig 7.27)",
        takes: &[Seed, Seeds, Profile, Motion],
        run: atc::fixed,
    },
    Experiment {
        name: "atc-adaptive",
        about: "two sites align a part with an adaptive playout delay (fig 7.28)",
        takes: &[Seed, Seeds, Profile, Motion],
        run: atc::adaptive,
    },
    Experiment {
        name: "atc-predicted",
        about: "two sites align a part with server-side prediction instead of a delay",
        takes: &[Seed, Seeds, Profile, Motion],
        run: atc::predicted,
    },
    Experiment {
        name: "transmission",
        about: "delay of a motion from site to site, with and without compensation (fig 7.24)",
        takes: &[Seed, Profile, Motion],
        run: atc::transmission,
    },
    Experiment {
        name: "jitter",
        about: "jitter of a shown tool, with and without compensation (fig 7.25)",
        takes: &[Seed, Profile, Motion],
        run: atc::jitter,
    },
    Experiment {
        name: "replicas",
        about: "two trainees press and cut: error of their shapes and forces, over networks to 400 ms",
        takes: &[Model, Seed, Seeds, Real, Profile],
        run: replicas::run,
    },
    Experiment {
        name: "thin",
        about: "a spectator without tissue solver: error of the shown shape and bandwidth",
        takes: &[Model, Seed, Profile],
        run: thin::run,
    },
    Experiment {
        name: "scale",
        about: "server load of 1 to 64 participants, a quarter of them in contact",
        takes: &[Model, Seed, Profile],
        run: scale::run,
    },
    Experiment {
        name: "table-7-1",
        about: "error of reconstructed samples against the true hand motion (table 7.1)",
        takes: &[Seed, Motion],
        run: table_7_1::run,
    },
    Experiment {
        name: "missing-data",
        about: "one gap in a hand's motion, reconstructed by each method (fig 6.9)",
        takes: &[Seed, Motion],
        run: missing_data::run,
    },
];

/// The experiment with this name.
pub fn named(name: &str) -> Option<Experiment> {
    ALL.iter().find(|e| e.name == name).copied()
}
