//! All experiments and benchmarks.

use super::inputs::Input::{self, Fine, Model, Motion, Profile, Real, Seed, Seeds};
use super::{
    Bench, Outcome, atc, atc_controllers, cut_force, cut_gallery, cut_methods, cut_time, cut_width,
    friction, handle, leg_press, missing_data, needle_force, press, replicas, scale, soft_hard,
    table_7_1, thin, tool_paths, validate,
};

#[derive(Debug, Clone, Copy)]
pub struct Experiment {
    pub name: &'static str,
    pub about: &'static str,
    /// Accepted options; others are rejected.
    pub takes: &'static [Input],
    /// Duration on two idle cores, s: CPU time, or wall time for real-time experiments. Only ratios matter,
    /// because completed parts calibrate the machine's speed.
    pub took_s: f64,
    pub(super) work: Work,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Work {
    Experiment(fn(&mut Bench<'_>) -> Result<Outcome, String>),
    /// A benchmark: the command that repeats it, and the caption of its report.
    Command(&'static str, &'static str),
}

macro_rules! experiments {
    ($($name:literal, $took_s:literal, $takes:expr, $work:expr, $about:literal;)*) => {
        &[$(Experiment { name: $name, about: $about, takes: &$takes, took_s: $took_s, work: $work }),*]
    };
}

/// All experiments in run order.
pub const ALL: &[Experiment] = experiments! {
    "validate", 32.0, [Fine], Work::Experiment(validate::run),
        "the tissue beside closed forms, published solutions, finite elements and a measured phantom: error per case";
    "soft-hard", 1.0, [], Work::Experiment(soft_hard::run),
        "a ball on soft tissue, on stiff tissue and between them (Lin 2007, fig 4.8)";
    "friction", 6.3, [], Work::Experiment(friction::run),
        "a ball and a line dragged over tissue: stick, slip and torque (figs 4.11 to 4.13)";
    "handle", 3.5, [Model], Work::Experiment(handle::run),
        "a soft grip around a hard core: force against depth for three materials (fig 7.4)";
    "tool-paths", 84.0, [Model], Work::Experiment(tool_paths::run),
        "one target point reached along four paths (fig 7.10)";
    "leg-press", 7.2, [Model], Work::Experiment(leg_press::run),
        "a leg with rigid bones pressed over muscle and over bone (fig 7.11)";
    "cut-methods", 1.3, [], Work::Experiment(cut_methods::run),
        "one stroke by element removal, subdivision, subdivision with snapping, and a sheet (fig 2.3)";
    "cut-force", 2.4, [], Work::Experiment(cut_force::run),
        "force of a blade that cuts skin, fat, muscle and liver, and its work per area of the wound";
    "needle-force", 5.8, [], Work::Experiment(needle_force::run),
        "force of a needle into fat, muscle, liver and layers, and out again";
    "cut-time", 3.5, [], Work::Experiment(cut_time::run),
        "time of a blade sample over the length of a cut, in models of three sizes (fig 7.13)";
    "cut-width", 8.0, [Model], Work::Experiment(cut_width::run),
        "opening of a cut over the depth below the surface, at rest and retracted (fig 7.17)";
    "cut-gallery", 3.3, [Model], Work::Experiment(cut_gallery::run),
        "pictures of cuts: snapping, curves, refinement, layers, depths, crossings, a piece (figs 5.10, 7.14 to 7.20)";
    "press", 71.0, [Model], Work::Experiment(press::run),
        "force error of the haptic path: a ball and a line pressed at 100 mm/s, the line then dragged";
    "atc-none", 7.5, [Seed, Seeds, Profile, Motion], Work::Experiment(atc::none),
        "two sites align a part without artificial time compensation (fig 7.26)";
    "atc-fixed", 2.0, [Seed, Seeds, Profile, Motion], Work::Experiment(atc::fixed),
        "two sites align a part with the smallest safe fixed playout delay (fig 7.27)";
    "atc-adaptive", 2.0, [Seed, Seeds, Profile, Motion], Work::Experiment(atc::adaptive),
        "two sites align a part with an adaptive playout delay (fig 7.28)";
    "atc-predicted", 2.7, [Seed, Seeds, Profile, Motion], Work::Experiment(atc::predicted),
        "two sites align a part with server-side prediction instead of a delay";
    "atc-controllers", 42.0, [Seed, Profile, Motion], Work::Experiment(atc_controllers::run),
        "the adaptive playout delay beside the controllers of NetEQ and of a Kalman filter";
    "transmission", 1.5, [Seed, Profile, Motion], Work::Experiment(atc::transmission),
        "delay of a motion from site to site, with and without compensation (fig 7.24)";
    "jitter", 1.3, [Seed, Profile, Motion], Work::Experiment(atc::jitter),
        "jitter of a shown tool, with and without compensation (fig 7.25)";
    "replicas", 72.0, [Model, Seed, Seeds, Real, Profile], Work::Experiment(replicas::run),
        "two trainees press and cut: error of their shapes and forces, over networks to 400 ms";
    "thin", 1.8, [Model, Seed, Profile], Work::Experiment(thin::run),
        "a spectator without tissue solver: error of the shown shape and bandwidth";
    "scale", 45.0, [Model, Seed, Profile], Work::Experiment(scale::run),
        "server load of 1 to 64 participants, a quarter of them in contact";
    "table-7-1", 9.6, [Seed, Motion], Work::Experiment(table_7_1::run),
        "error of reconstructed samples against the true hand motion (table 7.1)";
    "missing-data", 0.1, [Seed, Motion], Work::Experiment(missing_data::run),
        "one gap in a hand's motion, reconstructed by each method (fig 6.9)";
};

/// All benchmarks in page order.
pub(super) const BENCHMARKS: &[Experiment] = experiments! {
    "coding", 1.1, [], Work::Command("palpate-lab bench coding --round-trip-ms 50 --seed 1",
        "A random hand of 87 mm/s rms in batches of four new 1 kHz samples, and a block that is pressed and \
        released, at 60 frames per second and 0.05 mm. Deflate compresses the same integers, as differences \
        from the acknowledged state, per datagram or frame. Raw uses four-byte numbers. Headers are included."),
        "bits per pose and per node on the wire: this codec, deflate, raw";
    "bytes", 40.0, [], Work::Command("palpate-lab bench bytes --model thigh --seconds 8 --profile metro --seed 1",
        "Two full subscribers press and cut a thigh: kbit/s of each by purpose, over the length of their \
        scripts. The column UDP is the total with QUIC overhead and must stay below the limit. The other \
        columns include acknowledgements."),
        "bandwidth of a session while pressing and cutting, by purpose, with QUIC overhead";
    "haptic-tick", 1.7, [], Work::Command("palpate-lab bench haptic-tick --ticks 50000",
        "Durations of a tick, by device and number of active contact points. One run on this machine: other \
        load changes the rare long ticks."),
        "duration of a tick of the 1 kHz loop: read, compute, write";
    "press-cube", 2.5, [], Work::Command("palpate-lab bench press-cube --moving",
        "A cube of side 0.1 m pressed by a disc, on one thread: from rest to 1 % displacement error and to \
        convergence, then in ten steps of 0.1 mm."),
        "solver time for a disc pressed into a cube of 8,000 nodes";
    "haptic-faults", 8.4, [], Work::Command("palpate-lab haptic-faults --seeds 500",
        "Faults during a press through the client's force loop, in virtual time. The force changes by at \
        most the slew-rate limit per tick and is zero within 150 ms after the loss of its source."),
        "injected faults during haptic contact: no fault may cause a force jump";
    "attack", 28.0, [], Work::Command("palpate-lab attack transfers handshakes delay seats slow-reader names --seconds 6",
        "Six attacks at once beside two honest trainees, and the same session without attack."),
        "a server under attack: force, playout delay, newcomers and memory beside two honest trainees";
};
