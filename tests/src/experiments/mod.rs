//! Experiments: what a hand feels of a tool on tissue, against what is true.
//!
//! Each is a few [trials](crate::scenario) and gives figures, tables (CSV) and charts (SVG). The figures of the
//! dissertation that they stand for are named at each. All together make one page, [`gallery`](mod@gallery).

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

/// An experiment that can be asked for.
#[derive(Debug, Clone, Copy)]
pub struct Experiment {
    /// What to call it.
    pub name: &'static str,
    /// What it shows, in a line.
    pub about: &'static str,
    /// Which options it takes. Others are refused.
    pub takes: Takes,
    run: fn(&mut Bench<'_>) -> Result<Outcome, String>,
}

/// The options that an experiment takes.
// Options that have nothing to do with each other, and no states of one thing.
#[allow(clippy::struct_excessive_bools)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Takes {
    /// Another model than its own.
    pub model: bool,
    /// A seed of what is left to chance.
    pub seed: bool,
    /// How many seeds to try.
    pub seeds: bool,
    /// Sessions in real time, with processes and sockets.
    pub real: bool,
    /// A network.
    pub profile: bool,
    /// A recorded motion of a hand.
    pub motion: bool,
}

impl Takes {
    /// None of them.
    pub const NOTHING: Self = Self {
        model: false,
        seed: false,
        seeds: false,
        real: false,
        profile: false,
        motion: false,
    };

    /// A network and what its chances come from.
    pub const NETWORKS: Self = Self {
        seed: true,
        profile: true,
        ..Self::NOTHING
    };

    /// Only another model.
    pub const MODELS: Self = Self {
        model: true,
        ..Self::NOTHING
    };

    /// Two sites over a network, what their hands do, and several seeds.
    pub const ALIGNMENTS: Self = Self {
        seeds: true,
        motion: true,
        ..Self::NETWORKS
    };

    /// A hand: a recorded one, or the seed of a random one.
    pub const HANDS: Self = Self {
        seed: true,
        motion: true,
        ..Self::NOTHING
    };
}

/// All of them, in the order in which they are run.
pub const ALL: &[Experiment] = &[
    Experiment {
        name: "soft-hard",
        about: "a ball on soft, on stiff tissue and between them (Lin 2007, fig 4.8)",
        takes: Takes::NOTHING,
        run: soft_hard::run,
    },
    Experiment {
        name: "friction",
        about: "a ball and a line dragged over tissue: stick, slip and the torque of it (figs 4.11 to 4.13)",
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
        about: "the same place reached along four paths (fig 7.10)",
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
        about: "a ball and a line pressed in at 100 mm/s, the line dragged on: what one solving thread and 1 kHz make of it",
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
        about: "two sites align a part, everything shown at the smallest fixed delay that is safe (fig 7.27)",
        takes: Takes::ALIGNMENTS,
        run: atc::fixed,
    },
    Experiment {
        name: "atc-adaptive",
        about: "two sites align a part, the delay follows what the network needs (fig 7.28)",
        takes: Takes::ALIGNMENTS,
        run: atc::adaptive,
    },
    Experiment {
        name: "atc-predicted",
        about: "two sites align a part, nobody waits and the server predicts: the other reading of the source",
        takes: Takes::ALIGNMENTS,
        run: atc::predicted,
    },
    Experiment {
        name: "transmission",
        about: "what a motion takes from site to site, with the delay and without (fig 7.24)",
        takes: Takes {
            motion: true,
            ..Takes::NETWORKS
        },
        run: atc::transmission,
    },
    Experiment {
        name: "jitter",
        about: "how a tool shakes that jitter has come over, with compensation and without (fig 7.25)",
        takes: Takes {
            motion: true,
            ..Takes::NETWORKS
        },
        run: atc::jitter,
    },
    Experiment {
        name: "replicas",
        about: "two people press, cut and let go: how far apart are their shapes and forces, over networks to 400 ms",
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
        about: "a spectator who computes no tissue: how far what is shown is from the server's shape, and what it costs",
        takes: Takes {
            model: true,
            ..Takes::NETWORKS
        },
        run: thin::run,
    },
    Experiment {
        name: "scale",
        about: "1 to 64 participants who only move, a quarter of them touching: what their server has to do",
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
        about: "what is made up for missing samples of a hand, against its true motion (table 7.1)",
        takes: Takes::HANDS,
        run: table_7_1::run,
    },
    Experiment {
        name: "missing-data",
        about: "one gap in a hand's motion, as every method fills it (fig 6.9)",
        takes: Takes::HANDS,
        run: missing_data::run,
    },
];

/// The experiment of that name.
pub fn named(name: &str) -> Option<Experiment> {
    ALL.iter().find(|e| e.name == name).copied()
}

/// What an experiment works with.
pub struct Bench<'a> {
    /// A model instead of the experiment's own, for those that press any tissue.
    pub model: Option<std::sync::Arc<Model>>,
    /// The seed of everything that is left to chance.
    pub seed: u64,
    /// How many seeds to try, where the experiment tries several.
    pub seeds: Option<u64>,
    /// How many sessions in real time too.
    pub real: Option<u64>,
    /// A network instead of the experiment's own ones.
    pub profile: Option<Profile>,
    /// A recorded motion instead of the experiment's own hand.
    pub motion: Option<std::sync::Arc<Recorded>>,
    /// Where built models may be kept.
    pub dir: &'a Path,
    /// Told what is done, and its share.
    pub progress: &'a mut (dyn FnMut(&str, f64) + Send),
}

impl Bench<'_> {
    /// Makes a trial and says so.
    fn run(&mut self, what: &str, scenario: &Scenario) -> Course {
        scenario.run(&mut |done| (self.progress)(what, done))
    }

    /// The hand asked for, or a random one of 87 mm/s with a tremor of 0.1 mm.
    fn hand(&self) -> std::sync::Arc<dyn Hand> {
        match &self.motion {
            Some(recorded) => std::sync::Arc::<Recorded>::clone(recorded),
            None => std::sync::Arc::new(Random::new(Temper::default(), self.seed)),
        }
    }

    /// The model asked for, or a built-in sample.
    fn model_or(&mut self, sample: &str) -> Result<std::sync::Arc<Model>, String> {
        if let Some(model) = &self.model {
            return Ok(std::sync::Arc::clone(model));
        }
        (self.progress)(&format!("building the sample \"{sample}\""), 0.0);
        let subject = crate::test_model::TestModel::prepare(sample, self.dir);
        Ok(subject.map_err(|e| e.to_string())?.model)
    }
}

/// What came of an experiment.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// What it shows, for a reader of its page.
    pub caption: String,
    /// Its figures: an object.
    pub figures: Value,
    /// Charts, by the name of their file.
    pub charts: Vec<(String, Chart)>,
    /// Tables, by the name of their file.
    pub tables: Vec<(String, String)>,
}

impl Experiment {
    /// Runs it.
    pub fn run(&self, bench: &mut Bench<'_>) -> Result<Outcome, String> {
        (self.run)(bench)
    }
}

impl Outcome {
    /// Writes charts and tables into `dir`, which is made when it is not there.
    pub fn write(&self, dir: &Path) -> Result<(), String> {
        std::fs::create_dir_all(dir).map_err(|e| {
            format!(
                "{}: {e}; check that the folder can be written and has room",
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

/// What rows of figures say that was missed.
fn missed_by<'a>(rows: impl IntoIterator<Item = &'a Value>) -> Vec<String> {
    let missed = rows.into_iter().filter_map(|row| row["missed"].as_array());
    let sentence = |what: &Value| what.as_str().map(str::to_owned);
    missed.flatten().filter_map(sentence).collect()
}

impl Outcome {
    /// What it shows, and its tables or, where none is short, its figures.
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

    /// Which limits were not kept, a sentence each; experiments without limits miss none.
    pub fn missed(&self) -> Vec<String> {
        missed_by([&self.figures])
    }

    /// Writes charts, tables, and the figures as `name.json` into `dir`.
    pub fn write_all(&self, dir: &Path, name: &str) -> Result<(), String> {
        self.write(dir)?;
        let path = dir.join(format!("{name}.json"));
        let figures = serde_json::to_string_pretty(&self.figures).expect("figures are plain data");
        write_file(&path, figures + "\n").map_err(|e| e.to_string())
    }
}

/// The same tissue without friction.
fn without_friction(model: &Model) -> Model {
    let mut model = model.clone();
    for region in &mut model.regions {
        region.material.friction_static = 0.0;
        region.material.friction_dynamic = 0.0;
    }
    model
}

/// The same tissue with this friction everywhere, static and dynamic.
fn with_friction(model: &Model, [still, sliding]: [f64; 2]) -> Model {
    let mut model = model.clone();
    for region in &mut model.regions {
        region.material.friction_static = still;
        region.material.friction_dynamic = sliding;
    }
    model
}

/// A place to press in the middle of a model.
fn place(model: &std::sync::Arc<Model>) -> Result<ToolLocation, String> {
    let topology = Topology::new(std::sync::Arc::clone(model));
    ToolLocation::find(&topology).map_err(|e| e.to_string())
}

/// What was felt in a colour, and the converged answer in grey dashes.
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

/// A line of what converged. [`panel`] names the first.
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
