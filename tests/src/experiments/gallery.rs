//! One page with all charts and tables, readable offline.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde_json::{Map, Value};

use super::registry::Experiment;
use super::{Outcome, Table, table};

pub(super) const ROWS_OPEN: usize = 48;

/// Maximum number of rows of a table on the page. Longer tables are time series; they are drawn and stay in
/// their files.
const ROWS_MAX: usize = 400;

const INTRODUCTION: &str = "Forces and views of participants who share one tissue over a network. The network \
experiments compare the views of two sites at one shared time, over emulated networks in virtual time; a seed reproduces \
every packet. The tissue experiments compare the force rendered at 1 kHz with independent converged solutions; they depend \
slightly on the machine's speed. Figures and tables in brackets are the corresponding ones of the dissertation (Lin 2007).";

const STYLE: &str = "body{font-family:sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222;line-height:1.4}\
figure{margin:1em 0}svg,img{max-width:100%;height:auto}\
pre,code{background:#f4f4f4}pre{padding:.8em;overflow-x:auto}code{padding:.1em .3em}\
h2{margin-top:2em;border-top:1px solid #ccc;padding-top:1em}\
.scroll{overflow-x:auto}table{border-collapse:collapse;margin:.8em 0;font-size:.85em;font-variant-numeric:tabular-nums}\
th,td{padding:.2em .7em;border-bottom:1px solid #e2e2e2;text-align:right}th{background:#f4f4f4}\
th:first-child,td:first-child,td.word,th.word{text-align:left}\
.failed{border-left:4px solid #d55e00;padding:.4em .8em;background:#fdf1ea}\
.aside{color:#666;font-size:.9em}@media print{details{display:none}}";

#[derive(Debug, Clone)]
pub struct Part {
    pub item: Experiment,
    pub command: String,
    pub took_s: f64,
    pub result: Result<Outcome, String>,
}

impl Part {
    /// Whether it ran and its figures report a missed limit.
    fn has_missed(&self) -> bool {
        let outcome = self.result.as_ref().ok();
        outcome.is_some_and(|o| o.figures["ok"] == Value::Bool(false))
    }
}

#[derive(Debug, Clone)]
pub struct Origin {
    pub versions: String,
    pub machine: String,
    pub planned: usize,
}

pub fn page(parts: &[Part], origin: &Origin) -> String {
    let failed: Vec<&Part> = parts.iter().filter(|p| p.result.is_err()).collect();
    let missed: Vec<&Part> = parts.iter().filter(|p| p.has_missed()).collect();
    let took_s = parts.iter().map(|p| p.took_s).sum();
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width";
                title { "Palpate: experiments" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { "Experiments" }
                p { (INTRODUCTION) }
                p.aside {
                    (origin.versions) ". " (origin.machine) ". "
                    (parts.len()) " of " (origin.planned) " parts in " (time(took_s)) "."
                }
                (links("Failed", &failed))
                (links("Limits missed", &missed))
                ul {
                    @for p in parts { li { (link(&format!("#{}", p.item.name), p.item.name)) ": " (p.item.about) } }
                }
                @for part in parts { (section(part)) }
            }
        }
    };
    page.into_string()
}

fn link(to: &str, name: &str) -> Markup {
    html! { a href=(to) { (name) } }
}

/// Links to parts with a problem, if there are any.
fn links(problem: &str, parts: &[&Part]) -> Markup {
    html! {
        @if !parts.is_empty() {
            p.failed {
                (problem) ": "
                @for (k, part) in parts.iter().enumerate() {
                    @if k > 0 { ", " }
                    (link(&format!("#{}", part.item.name), part.item.name))
                }
                "."
            }
        }
    }
}

fn time(s: f64) -> String {
    if s < 90.0 {
        format!("{s:.1} s")
    } else {
        format!("{:.1} min", s / 60.0)
    }
}

fn section(part: &Part) -> Markup {
    html! {
        h2 id=(part.item.name) { (part.item.name) }
        p { b { (part.item.about) } }
        p.aside { "Command: " code { (part.command) } " (took " (time(part.took_s)) ")" }
        @match &part.result {
            Ok(outcome) => (results(part, outcome)),
            Err(why) => p.failed { "Error: " (why) },
        }
    }
}

fn results(part: &Part, outcome: &Outcome) -> Markup {
    let mut scalars = Map::new();
    flatten("", &outcome.figures, &mut scalars);
    scalars.remove("experiment");
    let mut figures = Table::new("figure,value");
    for (name, value) in scalars {
        figures.rows.push(vec![name, table::alone(&value)]);
    }
    let tables = outcome.tables.iter().cloned();
    let tables = tables.filter(|(_, t)| !t.rows.is_empty() && t.rows.len() <= ROWS_MAX);
    html! {
        p { (outcome.caption) }
        @for (_, chart) in &outcome.charts { figure { (PreEscaped(chart.to_svg())) } }
        @for (name, _) in &outcome.pictures {
            figure { img src=(format_args!("{name}.png")) alt=(name); figcaption.aside { (name) } }
        }
        @match &outcome.text {
            Some(text) => pre { (text) },
            None => (shown(&figures)),
        }
        @for (name, table) in tables { (folded(&name, table)) }
        (files(part, outcome))
    }
}

fn files(part: &Part, outcome: &Outcome) -> Markup {
    let charts = outcome.charts.iter().map(|(n, _)| format!("{n}.svg"));
    let pictures = outcome.pictures.iter().map(|(n, _)| format!("{n}.png"));
    let tables = outcome.tables.iter().map(|(n, _)| format!("{n}.csv"));
    let json = std::iter::once(format!("{}.json", part.item.name));
    html! {
        p.aside {
            "Files: "
            @for (k, file) in charts.chain(pictures).chain(tables).chain(json).enumerate() {
                @if k > 0 { ", " }
                (link(&file, &file))
            }
        }
    }
}

/// Collects single figures by their path. Lists of objects are in tables.
fn flatten(path: &str, value: &Value, scalars: &mut Map<String, Value>) {
    match value {
        Value::Object(object) => {
            for (key, value) in object {
                let below = [path, key].join(if path.is_empty() { "" } else { "." });
                flatten(&below, value, scalars);
            }
        }
        Value::Array(values) if values.iter().any(Value::is_object) => {}
        _ => {
            scalars.insert(path.to_owned(), value.clone());
        }
    }
}

/// A table that is folded if it is long.
fn folded(name: &str, mut table: Table) -> Markup {
    table::aligned(&mut table.rows);
    html! {
        details open[table.rows.len() <= ROWS_OPEN] {
            summary { (name) ": " (table.rows.len()) " rows" }
            (shown(&table))
        }
    }
}

fn shown(Table { head, rows }: &Table) -> Markup {
    // Text columns and their headings are left-aligned.
    let is_word = |k: usize| rows.iter().any(|row| table::is_word(&row[k]));
    let classes: Vec<Option<&str>> = (0..head.len())
        .map(|k| is_word(k).then_some("word"))
        .collect();
    html! {
        @if !rows.is_empty() {
            div.scroll {
                table {
                    tr { @for (name, class) in head.iter().zip(&classes) { th class=[class] { (name) } } }
                    @for row in rows {
                        tr { @for (cell, class) in row.iter().zip(&classes) { td class=[class] { (cell) } } }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::experiments::registry::ALL;

    fn part(name: &'static str, result: Result<Outcome, String>) -> Part {
        let item = Experiment {
            name,
            about: "a < b (fig 7.26)",
            ..ALL[0]
        };
        Part {
            item,
            command: format!("palpate-lab run {name} --seed 1"),
            took_s: 1.5,
            result,
        }
    }

    fn outcome() -> Outcome {
        Outcome {
            caption: "what it shows".to_owned(),
            figures: json!({ "apart_mm": { "p95": 0.012_345_6 }, "rows": [{ "a": 1, "b": { "c": "word" } }] }),
            ..Outcome::default()
        }
    }

    fn origin() -> Origin {
        Origin {
            versions: "palpate-lab 1".to_owned(),
            machine: "two cores".to_owned(),
            planned: 3,
        }
    }

    #[test]
    fn page_shows_failed_parts() {
        let parts = [
            part("good", Ok(outcome())),
            part("bad", Err("no <room>".to_owned())),
        ];
        let html = page(&parts, &origin());
        for expected in [
            "Failed: <a href=\"#bad\">bad</a>",
            "Error: no &lt;room&gt;",
            "<h2 id=\"good\">good</h2>",
            "what it shows",
            "a &lt; b (fig 7.26)",
            "palpate-lab run good --seed 1",
            "2 of 3 parts",
        ] {
            assert!(html.contains(expected), "{expected} is not in {html}");
        }
    }

    #[test]
    fn parts_with_missed_limits_are_listed_at_the_top() {
        let short = Outcome {
            figures: json!({ "ok": false }),
            ..outcome()
        };
        let html = page(
            &[part("good", Ok(outcome())), part("short", Ok(short))],
            &origin(),
        );
        assert!(html.contains("Limits missed: <a href=\"#short\">short</a>.<"));
        assert!(!html.contains("Failed"));
    }

    #[test]
    fn page_loads_no_external_resources() {
        let pictured = Outcome {
            pictures: vec![("wound".to_owned(), Vec::new())],
            ..outcome()
        };
        let html = page(&[part("good", Ok(pictured))], &origin());
        // Pictures are files beside the page.
        assert_eq!(html.matches("src=\"wound.png\"").count(), 1);
        let html = html.replace("src=\"wound.png\"", "");
        for loading in ["<script", "src=", "<link", "@import", "url("] {
            assert!(!html.contains(loading), "{loading}");
        }
    }

    #[test]
    fn single_figures_are_listed_by_their_path_and_a_report_replaces_them() {
        let html = page(&[part("good", Ok(outcome()))], &origin());
        assert!(html.contains("apart_mm.p95") && html.contains(">0.01235<"));
        let reported = Outcome {
            text: Some("a <report>".to_owned()),
            ..outcome()
        };
        let html = page(&[part("good", Ok(reported))], &origin());
        assert!(html.contains("<pre>a &lt;report&gt;</pre>") && !html.contains("apart_mm"));
    }

    #[test]
    fn long_tables_are_only_linked() {
        let mut table = Table::new("t_s,x");
        table.rows = vec![vec!["1".to_owned(), "2".to_owned()]; 1000];
        let long = Outcome {
            tables: vec![("course".to_owned(), table)],
            ..outcome()
        };
        let html = page(&[part("good", Ok(long))], &origin());
        assert!(html.contains("href=\"course.csv\"") && !html.contains("t_s"));
    }
}
