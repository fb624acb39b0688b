//! Experiments that compare simulated forces and views with reference solutions.
//!
//! An experiment returns figures, tables (CSV) and charts (SVG). Those on haptics consist of
//! [trials](crate::scenario). Descriptions name the corresponding figures of the dissertation. The
//! [`gallery`](mod@gallery) presents all results on one page.

mod atc;
mod benches;
mod cells;
pub mod command;
mod friction;
pub mod gallery;
mod handle;
mod leg_press;
mod missing_data;
mod press;
pub mod recipe;
mod replicas;
mod samples;
mod scale;
pub mod schedule;
mod soft_hard;
mod table_7_1;
mod thin;
mod tool_paths;
pub mod tour;

use std::path::Path;

use palpate_tissue::{Model, Topology, write_file};
use serde_json::Value;

use crate::chart::{Chart, Line, Panel, Scale};
use crate::hand::{Hand, Random, Recorded, Temper};
use crate::network::Profile;
use crate::scenario::{Course, Scenario};
use crate::tool_location::ToolLocation;

/// An experiment of the command line.
#[derive(Debug, Clone, Copy)]
pub struct Experiment {
    /// Name on the command line.
    pub name: &'static str,
    /// One-line description.
    pub about: &'static str,
    /// Accepted options; others are rejected.
    pub takes: Takes,
    run: fn(&mut Bench<'_>) -> Result<Outcome, String>,
}

/// The options that an experiment accepts.
// The options are independent, so an enum does not fit.
#[allow(clippy::struct_excessive_bools)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Takes {
    /// Another tissue model.
    pub model: bool,
    /// Seed of the random numbers.
    pub seed: bool,
    /// Number of seeds.
    pub seeds: bool,
    /// Number of sessions in real time, with processes and sockets.
    pub real: bool,
    /// A network.
    pub profile: bool,
    /// Recorded hand motion.
    pub motion: bool,
}

impl Takes {
    /// No options.
    pub const NOTHING: Self = Self {
        model: false,
        seed: false,
        seeds: false,
        real: false,
        profile: false,
        motion: false,
    };

    /// A network and a seed.
    pub const NETWORKS: Self = Self {
        seed: true,
        profile: true,
        ..Self::NOTHING
    };

    /// Only a tissue model.
    pub const MODELS: Self = Self {
        model: true,
        ..Self::NOTHING
    };

    /// Two sites over a network, with hand motions and several seeds.
    pub const ALIGNMENTS: Self = Self {
        seeds: true,
        motion: true,
        ..Self::NETWORKS
    };

    /// A recorded hand motion, or the seed of a random one.
    pub const HANDS: Self = Self {
        seed: true,
        motion: true,
        ..Self::NOTHING
    };
}

/// All experiments in run order.
pub const ALL: &[Experiment] = &[
    Experiment {
        name: "soft-hard",
        about: "a ball on soft tissue, on stiff tissue and between them (Lin 2007, fig 4.8)",
        takes: Takes::NOTHING,
        run: soft_hard::run,
    },
    Experiment {
        name: "friction",
        about: "a ball and a line dragged over tissue: stick, slip and torque (figs 4.11 to 4.13)",
        takes: Takes::NOTHING,
        run: friction::run,
    },
    Experiment {
        name: "handle",
        about: "a soft grip around a hard core: force against depth for three materials (fig 7.4)",
        takes: Takes::MODELS,
        run: handle::run,
    },
    Experiment {
        name: "tool-paths",
        about: "one target point reached along four paths (fig 7.10)",
        takes: Takes::MODELS,
        run: tool_paths::run,
    },
    Experiment {
        name: "leg-press",
        about: "a leg with rigid bones pressed over muscle and over bone (fig 7.11)",
        takes: Takes::MODELS,
        run: leg_press::run,
    },
    Experiment {
        name: "press",
        about: "force error of the haptic path: a ball and a line pressed at 100 mm/s, the line then dragged",
        takes: Takes::MODELS,
        run: press::run,
    },
    Experiment {
        name: "atc-none",
        about: "two sites align a part without artificial time compensation (fig 7.26)",
        takes: Takes::ALIGNMENTS,
        run: atc::none,
    },
    Experiment {
        name: "atc-fixed",
        about: "two sites align a part with the smallest safe fixed playout delay (fig 7.27)",
        takes: Takes::ALIGNMENTS,
        run: atc::fixed,
    },
    Experiment {
        name: "atc-adaptive",
        about: "two sites align a part with an adaptive playout delay (fig 7.28)",
        takes: Takes::ALIGNMENTS,
        run: atc::adaptive,
    },
    Experiment {
        name: "atc-predicted",
        about: "two sites align a part with server-side prediction instead of a delay",
        takes: Takes::ALIGNMENTS,
        run: atc::predicted,
    },
    Experiment {
        name: "transmission",
        about: "delay of a motion from site to site, with and without compensation (fig 7.24)",
        takes: Takes {
            motion: true,
            ..Takes::NETWORKS
        },
        run: atc::transmission,
    },
    Experiment {
        name: "jitter",
        about: "jitter of a shown tool, with and without compensation (fig 7.25)",
        takes: Takes {
            motion: true,
            ..Takes::NETWORKS
        },
        run: atc::jitter,
    },
    Experiment {
        name: "replicas",
        about: "two trainees press and cut: error of their shapes and forces, over networks to 400 ms",
        takes: Takes {
            model: true,
            seed: true,
            seeds: true,
            real: true,
            profile: true,
            motion: false,
        },
        run: replicas::run,
    },
    Experiment {
        name: "thin",
        about: "a spectator without tissue solver: error of the shown shape and bandwidth",
        takes: Takes {
            model: true,
            ..Takes::NETWORKS
        },
        run: thin::run,
    },
    Experiment {
        name: "scale",
        about: "server load of 1 to 64 participants, a quarter of them in contact",
        takes: Takes {
            model: true,
            seed: true,
            seeds: false,
            real: false,
            profile: true,
            motion: false,
        },
        run: scale::run,
    },
    Experiment {
        name: "table-7-1",
        about: "error of reconstructed samples against the true hand motion (table 7.1)",
        takes: Takes::HANDS,
        run: table_7_1::run,
    },
    Experiment {
        name: "missing-data",
        about: "one gap in a hand's motion, reconstructed by each method (fig 6.9)",
        takes: Takes::HANDS,
        run: missing_data::run,
    },
];

/// The experiment with this name.
pub fn named(name: &str) -> Option<Experiment> {
    ALL.iter().find(|e| e.name == name).copied()
}

/// Inputs of an experiment.
pub struct Bench<'a> {
    /// Tissue model instead of the default.
    pub model: Option<std::sync::Arc<Model>>,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Number of seeds.
    pub seeds: Option<u64>,
    /// Number of sessions in real time.
    pub real: Option<u64>,
    /// Network instead of the default.
    pub profile: Option<Profile>,
    /// Recorded motion instead of the default hand.
    pub motion: Option<std::sync::Arc<Recorded>>,
    /// Directory for built models.
    pub dir: &'a Path,
    /// Progress callback: the activity and the completed share.
    pub progress: &'a mut (dyn FnMut(&str, f64) + Send),
}

impl Bench<'_> {
    /// Runs a trial and reports its progress.
    fn run(&mut self, what: &str, trial: &Scenario) -> Course {
        trial.run(&mut |done| (self.progress)(what, done))
    }

    /// The given motion, or a random hand of 87 mm/s with 0.1 mm tremor.
    fn hand(&self) -> std::sync::Arc<dyn Hand> {
        match &self.motion {
            Some(recorded) => std::sync::Arc::<Recorded>::clone(recorded),
            None => std::sync::Arc::new(Random::new(Temper::default(), self.seed)),
        }
    }

    /// The given model, or a built-in sample.
    fn model_or(&mut self, sample: &str) -> Result<std::sync::Arc<Model>, String> {
        if let Some(model) = &self.model {
            return Ok(std::sync::Arc::clone(model));
        }
        (self.progress)(&format!("building the sample \"{sample}\""), 0.0);
        let subject = crate::test_model::TestModel::prepare(sample, self.dir);
        Ok(subject.map_err(|e| e.to_string())?.model)
    }
}

/// Results of an experiment.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Description for readers of the page.
    pub caption: String,
    /// Figures, a JSON object.
    pub figures: Value,
    /// Charts by file name, without extension.
    pub charts: Vec<(String, Chart)>,
    /// Tables by file name, without extension.
    pub tables: Vec<(String, String)>,
}

impl Experiment {
    /// Runs the experiment.
    pub fn run(&self, bench: &mut Bench<'_>) -> Result<Outcome, String> {
        (self.run)(bench)
    }
}

impl Outcome {
    /// Writes charts and tables into `dir`, which is created if necessary.
    pub fn write(&self, dir: &Path) -> Result<(), String> {
        std::fs::create_dir_all(dir).map_err(|e| {
            format!(
                "{}: {e}; check that the directory is writable and has free space",
                dir.display()
            )
        })?;
        for (name, chart) in &self.charts {
            let path = dir.join(format!("{name}.svg"));
            write_file(&path, chart.to_svg()).map_err(|e| e.to_string())?;
        }
        for (name, table) in &self.tables {
            let path = dir.join(format!("{name}.csv"));
            write_file(&path, table).map_err(|e| e.to_string())?;
        }
        Ok(())
    }
}

/// The missed limits in rows of figures.
fn missed_by<'a>(rows: impl IntoIterator<Item = &'a Value>) -> Vec<String> {
    let missed = rows.into_iter().filter_map(|row| row["missed"].as_array());
    let sentence = |what: &Value| what.as_str().map(str::to_owned);
    missed.flatten().filter_map(sentence).collect()
}

impl Outcome {
    /// The caption with the short tables, or with the figures if there are none.
    pub fn for_people(&self) -> String {
        let short = |table: &&(String, String)| table.1.lines().count() <= 1 + gallery::ROWS_OPEN;
        let tables: Vec<String> = (self.tables.iter().filter(short))
            .map(|(name, text)| format!("{name}\n{}", cells::in_columns(text)))
            .collect();
        let below = if tables.is_empty() {
            format!("{:#}", self.figures)
        } else {
            tables.join("\n")
        };
        format!("{}\n\n{}", self.caption, below.trim_end())
    }

    /// Descriptions of the missed limits; empty for experiments without limits.
    pub fn missed(&self) -> Vec<String> {
        missed_by([&self.figures])
    }

    /// Writes charts, tables and the figures as `name.json` into `dir`.
    pub fn write_all(&self, dir: &Path, name: &str) -> Result<(), String> {
        self.write(dir)?;
        let path = dir.join(format!("{name}.json"));
        let figures = serde_json::to_string_pretty(&self.figures).expect("figures are plain data");
        write_file(&path, figures + "\n").map_err(|e| e.to_string())
    }
}

/// The model without friction.
fn without_friction(model: &Model) -> Model {
    let mut model = model.clone();
    for region in &mut model.regions {
        region.material.friction_static = 0.0;
        region.material.friction_dynamic = 0.0;
    }
    model
}

/// The model with uniform friction coefficients, static and dynamic.
fn with_friction(model: &Model, [still, sliding]: [f64; 2]) -> Model {
    let mut model = model.clone();
    for region in &mut model.regions {
        region.material.friction_static = still;
        region.material.friction_dynamic = sliding;
    }
    model
}

/// A place to press in the middle of the model.
fn place(model: &std::sync::Arc<Model>) -> Result<ToolLocation, String> {
    let topology = Topology::new(std::sync::Arc::clone(model));
    ToolLocation::find(&topology).map_err(|e| e.to_string())
}

/// The rendered force in colour, and the converged solution in dashed grey.
fn felt_and_true(
    name: &str,
    colour: &'static str,
    course: &Course,
    of: impl Fn(&crate::scenario::Point, Option<crate::scenario::Truth>) -> (f64, f64),
) -> [Line; 2] {
    let felt = course.points.iter().map(|p| of(p, None)).collect();
    let truth = course.checked().map(|(p, t)| of(p, Some(t))).collect();
    [line(name, colour, felt), converged(truth)]
}

fn line(name: &str, colour: &'static str, points: Vec<(f64, f64)>) -> Line {
    Line {
        name: name.to_owned(),
        colour,
        dashed: false,
        points,
    }
}

/// A line of the converged solution. [`panel`] names the first one.
fn converged(points: Vec<(f64, f64)>) -> Line {
    Line {
        name: String::new(),
        colour: crate::chart::GREY,
        dashed: true,
        points,
    }
}

fn panel(title: &str, y_label: &str, mut lines: Vec<Line>) -> Panel {
    if let Some(first) = lines.iter_mut().find(|l| l.dashed) {
        "converged".clone_into(&mut first.name);
    }
    Panel {
        title: title.to_owned(),
        y_label: y_label.to_owned(),
        lines,
        scale: Scale::Linear,
    }
}
