//! One page with all charts and tables, readable offline.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde_json::{Map, Value};

use super::{Outcome, Table, table};

/// Maximum number of rows of an initially open table.
pub(super) const ROWS_OPEN: usize = 48;

/// Maximum number of rows of a table on the page. Longer tables are time series; they are drawn and stay in
/// their files.
const ROWS_MAX: usize = 400;

const INTRODUCTION: &str = "Forces and views of participants who share one tissue over a network. The network \
experiments compare the views of two sites at one shared time, over emulated networks in virtual time; a seed reproduces \
every packet. The tissue experiments compare the force rendered at 1 kHz with independent converged solutions; they depend \
slightly on the machine's speed. Figures and tables in brackets are the corresponding ones of the dissertation (Lin 2007).";

const STYLE: &str = "body{font-family:sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222;line-height:1.4}\
figure{margin:1em 0}svg{max-width:100%;height:auto}\
pre,code{background:#f4f4f4}pre{padding:.8em;overflow-x:auto}code{padding:.1em .3em}\
h2{margin-top:2em;border-top:1px solid #ccc;padding-top:1em}\
.scroll{overflow-x:auto}table{border-collapse:collapse;margin:.8em 0;font-size:.85em;font-variant-numeric:tabular-nums}\
th,td{padding:.2em .7em;border-bottom:1px solid #e2e2e2;text-align:right}th{background:#f4f4f4}\
th:first-child,td:first-child,td.word,th.word{text-align:left}\
.failed{border-left:4px solid #d55e00;padding:.4em .8em;background:#fdf1ea}\
.aside{color:#666;font-size:.9em}@media print{details{display:none}}";

/// An experiment or benchmark after its run.
#[derive(Debug, Clone)]
pub struct Part {
    /// Name.
    pub name: String,
    /// One-line description with the dissertation's figure.
    pub about: String,
    /// Command that repeats it.
    pub command: String,
    /// Duration, s.
    pub took_s: f64,
    /// Result, or the error message.
    pub result: Result<Outcome, String>,
}

impl Part {
    /// Whether it ran and its figures report a missed limit.
    fn has_missed(&self) -> bool {
        let outcome = self.result.as_ref().ok();
        outcome.is_some_and(|o| o.figures["ok"] == Value::Bool(false))
    }
}

/// Description of the whole page.
#[derive(Debug, Clone)]
pub struct Origin {
    /// Versions of the program and the protocol.
    pub versions: String,
    /// Machine of the run.
    pub machine: String,
    /// Number of planned parts.
    pub planned: usize,
}

/// The page as HTML.
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
                    @for p in parts { li { (link(&format!("#{}", p.name), &p.name)) ": " (p.about) } }
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
                    (link(&format!("#{}", part.name), &part.name))
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
        h2 id=(part.name) { (part.name) }
        p { b { (part.about) } }
        p.aside { "Command: " code { (part.command) } " (took " (time(part.took_s)) ")" }
        @match &part.result {
            Ok(outcome) => (results(part, outcome)),
            Err(why) => p.failed { "Error: " (why) },
        }
    }
}

fn results(part: &Part, outcome: &Outcome) -> Markup {
    let (mut lists, mut scalars) = (Vec::new(), Map::new());
    flatten("", &outcome.figures, &mut scalars, &mut lists);
    scalars.remove("experiment");
    let scalars = Table {
        head: vec!["figure".to_owned(), "value".to_owned()],
        rows: (scalars
            .iter()
            .map(|(name, value)| vec![name.clone(), table::alone(value)]))
        .collect(),
    };
    let fits =
        |(_, table): &&(String, Table)| !table.rows.is_empty() && table.rows.len() <= ROWS_MAX;
    let mut tables: Vec<(String, Table)> = outcome.tables.iter().filter(fits).cloned().collect();
    if tables.is_empty() {
        // Tables contain the same figures as the lists, in readable form.
        tables.extend(
            lists
                .iter()
                .map(|(name, objects)| (name.clone(), of_objects(objects))),
        );
    }
    html! {
        p { (outcome.caption) }
        @for (_, chart) in &outcome.charts { figure { (PreEscaped(chart.to_svg())) } }
        @if !scalars.rows.is_empty() { (shown(&scalars.head, &scalars.rows)) }
        @for (name, table) in &mut tables { (folded(name, table)) }
        (files(part, outcome))
    }
}

/// Links to the part's files.
fn files(part: &Part, outcome: &Outcome) -> Markup {
    let charts = outcome.charts.iter().map(|(n, _)| format!("{n}.svg"));
    let tables = outcome.tables.iter().map(|(n, _)| format!("{n}.csv"));
    let json = std::iter::once(format!("{}.json", part.name));
    html! {
        p.aside {
            "Files: "
            @for (k, file) in charts.chain(tables).chain(json).enumerate() {
                @if k > 0 { ", " }
                (link(&file, &file))
            }
        }
    }
}

/// Collects single figures by their path, and lists of objects.
fn flatten(
    path: &str,
    value: &Value,
    scalars: &mut Map<String, Value>,
    lists: &mut Vec<(String, Vec<Value>)>,
) {
    let below = |key: &str| match path {
        "" => key.to_owned(),
        _ => format!("{path}.{key}"),
    };
    match value {
        // An object whose values all have the same keys is a list.
        Value::Object(object) if !path.is_empty() && is_list(object) => {
            let named = object.iter().map(|(name, value)| {
                let mut row = value.clone();
                row["name"] = Value::from(name.clone());
                row
            });
            lists.push((path.to_owned(), named.collect()));
        }
        Value::Object(object) => {
            for (key, value) in object {
                flatten(&below(key), value, scalars, lists);
            }
        }
        Value::Array(values) if values.iter().any(Value::is_object) => {
            lists.push((path.to_owned(), values.clone()));
        }
        _ => {
            scalars.insert(path.to_owned(), value.clone());
        }
    }
}

/// Whether all values have the same keys, at least two.
fn is_list(object: &Map<String, Value>) -> bool {
    let mut keys = (object.values()).map(|v| v.as_object().map(|o| o.keys().collect::<Vec<_>>()));
    let Some(Some(first)) = keys.next() else {
        return false;
    };
    object.len() > 2 && first.len() > 1 && keys.all(|k| k.as_ref() == Some(&first))
}

/// Objects as rows, with one column for each path in any object.
fn of_objects(objects: &[Value]) -> Table {
    let flat: Vec<Map<String, Value>> = (objects.iter())
        .map(|object| {
            let (mut scalars, mut lists) = (Map::new(), Vec::new());
            flatten("", object, &mut scalars, &mut lists);
            for (name, list) in lists {
                scalars.insert(name, Value::String(format!("{} rows", list.len())));
            }
            scalars
        })
        .collect();
    let mut head: Vec<String> = Vec::new();
    for key in flat.iter().flat_map(Map::keys) {
        if !head.contains(key) {
            head.push(key.clone());
        }
    }
    // Text columns come first.
    let is_word = |key: &String| {
        let values = flat.iter().filter_map(|row| row.get(key));
        values.clone().next().is_some() && values.into_iter().all(Value::is_string)
    };
    head.sort_by_key(|key| !is_word(key));
    let cells = |row: &Map<String, Value>| -> Vec<String> {
        let cell = |key| row.get(key).map_or(String::new(), table::whole);
        head.iter().map(cell).collect()
    };
    let rows = flat.iter().map(cells).collect();
    Table { head, rows }
}

/// A table that is folded if it is long.
fn folded(name: &str, table: &mut Table) -> Markup {
    table::aligned(&mut table.rows);
    html! {
        details open[table.rows.len() <= ROWS_OPEN] {
            summary { (name) ": " (table.rows.len()) " rows" }
            (shown(&table.head, &table.rows))
        }
    }
}

fn shown(head: &[String], rows: &[Vec<String>]) -> Markup {
    // Text columns and their headings are left-aligned.
    let is_word = |k: usize| {
        let mut column = rows.iter().filter_map(|row| row.get(k));
        column.any(|cell| table::is_word(cell))
    };
    let classes: Vec<Option<&str>> = (0..head.len())
        .map(|k| is_word(k).then_some("word"))
        .collect();
    html! {
        div.scroll {
            table {
                tr { @for (name, class) in head.iter().zip(&classes) { th class=[class] { (name) } } }
                @for row in rows.iter().take(ROWS_MAX) {
                    tr { @for (cell, class) in row.iter().zip(&classes) { td class=[class] { (cell) } } }
                }
            }
        }
        @if rows.len() > ROWS_MAX {
            p.aside { "The first " (ROWS_MAX) " of " (rows.len()) " rows." }
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn part(name: &str, result: Result<Outcome, String>) -> Part {
        Part {
            name: name.to_owned(),
            about: "a < b (fig 7.26)".to_owned(),
            command: format!("palpate-lab run {name} --seed 1"),
            took_s: 1.5,
            result,
        }
    }

    fn outcome() -> Outcome {
        Outcome {
            caption: "what it shows".to_owned(),
            figures: json!({ "apart_mm": { "p95": 0.012_345_6 }, "rows": [{ "a": 1, "b": { "c": "word" } }] }),
            charts: Vec::new(),
            tables: Vec::new(),
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
        let html = page(&[part("good", Ok(outcome()))], &origin());
        for loading in ["<script", "src=", "<link", "@import", "url("] {
            assert!(!html.contains(loading), "{loading}");
        }
    }

    #[test]
    fn nested_figures_become_tables() {
        let html = page(&[part("good", Ok(outcome()))], &origin());
        for expected in [
            "apart_mm.p95",
            ">0.01235<",
            "<th class=\"word\">b.c</th>",
            ">word<",
        ] {
            assert!(html.contains(expected), "{expected} is not in {html}");
        }
    }

    #[test]
    fn objects_with_equal_keys_become_rows() {
        let figures = json!({ "classes": { "x": { "a": 1, "b": 2 }, "y": { "a": 3, "b": 4 }, "z": { "a": 5, "b": 6 } } });
        let outcome = Outcome {
            figures,
            ..outcome()
        };
        let html = page(&[part("good", Ok(outcome))], &origin());
        assert!(
            html.contains("classes: 3 rows")
                && html.contains(">name<")
                && !html.contains("classes.x")
        );
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
