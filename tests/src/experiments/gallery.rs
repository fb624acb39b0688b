//! One page with every chart and every figure, readable without a network.

use std::fmt::Write as _;

use super::{Experiment, Outcome};
use crate::chart::escape;

/// The page.
pub fn page(done: &[(Experiment, Outcome)]) -> String {
    let mut html = String::from(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>Palpate: experiments</title>\n\
         <style>body{font-family:sans-serif;max-width:980px;margin:2em auto;padding:0 1em;color:#222}\
         figure{margin:1em 0}svg{max-width:100%;height:auto}pre{background:#f4f4f4;padding:.8em;overflow-x:auto}\
         h2{margin-top:2em;border-top:1px solid #ccc;padding-top:1em}</style></head><body>\n\
         <h1>Experiments</h1>\n<p>What a hand feels of a tool on tissue, against converged solutions that know nothing of \
         the haptic path.</p>\n<ul>\n",
    );
    for (experiment, _) in done {
        // Writing to a string can not fail.
        let _ = writeln!(
            html,
            "<li><a href=\"#{0}\">{0}</a>: {1}</li>",
            experiment.name,
            escape(experiment.about)
        );
    }
    html.push_str("</ul>\n");
    for (experiment, outcome) in done {
        let _ = writeln!(
            html,
            "<h2 id=\"{0}\">{0}</h2>\n<p>{1}</p>",
            experiment.name,
            escape(&outcome.caption)
        );
        for (_, chart) in &outcome.charts {
            let _ = writeln!(html, "<figure>{}</figure>", chart.to_svg());
        }
        let figures =
            serde_json::to_string_pretty(&outcome.figures).expect("figures are plain data");
        let _ = writeln!(
            html,
            "<details><summary>Figures</summary><pre>{}</pre></details>",
            escape(&figures)
        );
    }
    html.push_str("</body></html>\n");
    html
}
