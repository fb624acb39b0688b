//! Experiments that compare simulated forces and views with reference solutions.
//!
//! An experiment returns figures, tables (CSV), charts (SVG) and pictures (PNG). Those on haptics consist of
//! [scenarios](crate::scenario). Descriptions name the corresponding figures of the dissertation. The
//! [`gallery`](mod@gallery) presents all results on one page.

mod atc;
mod atc_controllers;
pub mod command;
mod cut_force;
mod cut_gallery;
mod cut_methods;
mod cut_site;
mod cut_time;
mod cut_width;
mod friction;
pub mod gallery;
mod handle;
mod inputs;
mod leg_press;
mod missing_data;
mod needle_force;
mod press;
pub mod recipe;
pub mod registry;
mod replicas;
pub mod run_all;
mod safe_delays;
mod samples;
mod scale;
pub mod schedule;
mod soft_hard;
mod table;
mod table_7_1;
mod thin;
mod tissue;
mod tool_paths;
mod validate;

use std::path::Path;

use palpate_tissue::file::write_file;
use serde_json::{Value, json};

use crate::chart::Chart;
use command::make_folder;

pub use inputs::{Bench, Input};
pub use table::Table;

#[derive(Debug, Clone, Default)]
pub struct Outcome {
    pub caption: String,
    pub figures: Value,
    /// Charts by file name, without extension.
    pub charts: Vec<(String, Chart)>,
    /// Pictures (PNG) by file name, without extension.
    pub pictures: Vec<(String, Vec<u8>)>,
    pub tables: Vec<(String, Table)>,
    /// A report that shows the figures instead of tables.
    pub text: Option<String>,
}

impl Outcome {
    /// The outcomes of one experiment over several networks, which end the names of charts, pictures and tables.
    fn of_networks(mut outcomes: Vec<(String, Self)>) -> Self {
        if outcomes.len() == 1 {
            return outcomes.swap_remove(0).1;
        }
        let mut all = Self::default();
        let mut rows = Vec::new();
        let mut missed = Vec::new();
        for (network, outcome) in outcomes {
            let is_safe = |c: char| c.is_alphanumeric() || "._-".contains(c);
            let network = network.replace(|c| !is_safe(c), "-");
            let of = |name: String| format!("{name}-{network}");
            missed.extend(outcome.missed());
            rows.push(outcome.figures);
            let between = if all.caption.is_empty() { "" } else { "\n\n" };
            all.caption += between;
            all.caption += &outcome.caption;
            all.charts
                .extend(outcome.charts.into_iter().map(|(n, c)| (of(n), c)));
            all.pictures
                .extend(outcome.pictures.into_iter().map(|(n, p)| (of(n), p)));
            all.tables
                .extend(outcome.tables.into_iter().map(|(n, t)| (of(n), t)));
        }
        all.figures = json!({ "networks": rows, "ok": missed.is_empty(), "missed": missed });
        all
    }

    /// An experiment that failed over one of several networks.
    fn failed_over(network: &str, why: &str) -> Self {
        let caption = format!("{network}: {why}");
        Self {
            figures: json!({ "profile": network, "error": why, "missed": [caption] }),
            caption,
            ..Self::default()
        }
    }

    /// Writes charts, pictures, tables and the figures as `name.json` into `dir`, which is created if necessary.
    pub fn write(&self, dir: &Path, name: &str) -> Result<(), String> {
        make_folder(dir)?;
        let write = |file: String, bytes: &[u8]| {
            write_file(&dir.join(file), bytes).map_err(|e| e.to_string())
        };
        for (name, chart) in &self.charts {
            write(format!("{name}.svg"), chart.to_svg().as_bytes())?;
        }
        for (name, picture) in &self.pictures {
            write(format!("{name}.png"), picture)?;
        }
        for (name, table) in &self.tables {
            write(format!("{name}.csv"), table.to_csv().as_bytes())?;
        }
        let figures = serde_json::to_string_pretty(&self.figures).expect("figures are plain data");
        write(format!("{name}.json"), (figures + "\n").as_bytes())
    }

    /// The caption with the short tables, or with the figures if there are none.
    pub fn to_text(&self) -> String {
        let short = |(_, table): &&(String, Table)| table.rows.len() <= gallery::ROWS_OPEN;
        let tables: Vec<String> = (self.tables.iter().filter(short))
            .map(|(name, table)| format!("{name}\n{}", table.in_columns()))
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
}

fn missed_by<'a>(rows: impl IntoIterator<Item = &'a Value>) -> Vec<String> {
    let missed = rows.into_iter().filter_map(|row| row["missed"].as_array());
    let sentence = |what: &Value| what.as_str().map(str::to_owned);
    missed.flatten().filter_map(sentence).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failure_over_one_network_keeps_the_results_of_the_others() {
        let good = Outcome {
            figures: json!({ "rms": 1.0 }),
            tables: vec![("press".to_owned(), Table::new("t"))],
            ..Outcome::default()
        };
        let failed = Outcome::failed_over("b", "nothing arrives");
        let all = Outcome::of_networks(vec![("a/1".to_owned(), good), ("b".to_owned(), failed)]);
        assert_eq!(all.figures["networks"][0]["rms"], 1.0);
        assert_eq!(all.figures["ok"], false);
        assert_eq!(all.missed(), ["b: nothing arrives"]);
        assert_eq!(all.tables[0].0, "press-a-1");
    }
}
