//! The tissue beside closed forms, published solutions, finite elements and a measured phantom.
//!
//! Loads are small, so that linear elasticity holds. A specimen is solved at several spacings; its error at the finest one
//! is limited. The order of convergence and the extrapolated value show the part of the discretisation.

mod beam;
mod bonded_layer;
mod bracket;
mod comparison;
mod hertz;
mod hollow_sphere;
mod layer_theory;
mod phantom;
mod plates;
#[cfg(test)]
mod reader;
mod shaft;
mod specimen;

use serde_json::{Value, json};

use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::chart::{AMBER, BLUE, Chart, GREEN, GREY, Line, ORANGE, PURPLE, Panel, SKY};
use comparison::{Case, Curve, CurveSet, LIMIT_PERCENT};

/// Springs alone, and built-in soft tissue.
const POISSON: [f64; 2] = [0.25, 0.45];

const COLUMNS: [Column; 10] = [
    ("case", "case", 1.0),
    ("Poisson's ratio", "poisson", 1.0),
    ("quantity", "quantity", 1.0),
    ("reference", "reference", 1.0),
    ("cells over", "resolved", 1.0),
    ("cells", "cells", 1.0),
    ("error (%)", "error_percent", 1.0),
    ("order", "order", 1.0),
    ("extrapolated (%)", "extrapolated_percent", 1.0),
    ("within the limit", "ok", 1.0),
];

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let is_fine = bench.inputs.fine;
    let mut curves = [beam::curve(), hollow_sphere::curve(), hertz::curve()];
    let mut cases: Vec<Case> = Vec::new();
    for (i, poisson) in POISSON.into_iter().enumerate() {
        let mut stage = |name: &str, part: usize| {
            let done = (i as f64 + part as f64 / 7.0) / POISSON.len() as f64;
            (bench.progress)(name, done);
        };
        stage("beam", 0);
        cases.push(beam::cantilever(is_fine, poisson, &mut curves[0])?);
        cases.push(beam::bending(is_fine, poisson)?);
        stage("shaft", 1);
        cases.push(shaft::torsion(is_fine, poisson)?);
        stage("thick-walled sphere", 2);
        cases.extend(hollow_sphere::pressure(is_fine, poisson, &mut curves[1])?);
        stage("Hertz contact", 3);
        cases.push(hertz::ball(poisson, &mut curves[2])?);
        stage("bonded layer", 4);
        for contact in bonded_layer::CONTACTS {
            cases.push(bonded_layer::indentation(is_fine, poisson, contact));
        }
        stage("bracket", 5);
        cases.extend(bracket::push(is_fine, poisson)?);
        stage("plates", 6);
        cases.extend(plates::glued(is_fine, poisson)?);
    }
    (bench.progress)("phantom", 1.0);
    let phantom = phantom::compressed()?;
    let layer = bonded_layer::curve(&cases);
    let plates = plates::curve(&cases);
    let mut charts = vec![("validate".to_owned(), convergence(&cases))];
    charts.extend(curves.into_iter().chain([layer, plates]).map(drawn));
    charts.push(("validate-phantom".to_owned(), phantom.chart));
    let missed = cases.iter().filter_map(Case::missed);
    let missed: Vec<String> = missed.chain(phantom.missed).collect();
    let rows: Vec<Value> = cases.iter().map(Case::figures).collect();
    Ok(Outcome {
        caption: format!(
            "Small loads on specimens with known solutions. Each is solved at several spacings; the error at the finest \
             one counts, and the limit is {LIMIT_PERCENT} %. Order and extrapolated error follow from the last three \
             spacings, where these converge monotonically. The references of the bracket and of the plates are other \
             programs. The phantom is a silicone cube that was compressed and measured: rows at a Poisson's ratio of 0.5, \
             extrapolated from 0.48 and 0.49, count; a root mean square deviation of two standard deviations is within \
             the scatter."
        ),
        figures: json!({
            "experiment": "validate",
            "limit_percent": LIMIT_PERCENT,
            "fine": is_fine,
            "cases": rows,
            "phantom": phantom.rows,
            "ok": missed.is_empty(),
            "missed": missed,
        }),
        charts,
        tables: vec![
            ("validate".to_owned(), Table::of_objects(&rows, &COLUMNS)),
            ("validate-runs".to_owned(), runs(&cases)),
            (
                "validate-phantom".to_owned(),
                Table::of_objects(&phantom.rows, &phantom::COLUMNS),
            ),
        ],
        ..Outcome::default()
    })
}

/// Every run with all its figures.
fn runs(cases: &[Case]) -> Table {
    let mut table = Table::new(
        "case,Poisson's ratio,quantity,spacing (mm),cells,nodes,iterations,residual,expected,measured,error (%)",
    );
    for case in cases {
        for run in &case.runs {
            let numbers = [1e3 * run.spacing_m, case.cells(run)].map(|n| format!("{n:.4}"));
            let counts = [run.nodes, run.iterations].map(|n| n.to_string());
            let values = [run.residual, case.expected, run.measured].map(|n| format!("{n:.6e}"));
            let case_of = [
                case.name.to_owned(),
                case.poisson.to_string(),
                case.quantity.to_owned(),
            ];
            let error = format!("{:.4}", case.error_percent(run.measured));
            let cells = case_of
                .into_iter()
                .chain(numbers)
                .chain(counts)
                .chain(values);
            table.rows.push(cells.chain([error]).collect());
        }
    }
    table
}

/// Errors over the cells that resolve each specimen, a panel per Poisson's ratio.
fn convergence(cases: &[Case]) -> Chart {
    let all = cases
        .iter()
        .flat_map(|case| case.runs.iter().map(|run| case.cells(run)));
    let cells = all.fold((f64::INFINITY, 0.0_f64), |(low, high), n| {
        (low.min(n), high.max(n))
    });
    let panel = |poisson: f64| {
        let colours = [BLUE, ORANGE, GREEN, PURPLE, SKY, AMBER];
        let of_ratio = cases.iter().filter(|case| case.poisson == poisson);
        let line = |(i, case): (usize, &Case)| {
            let points = case.runs.iter();
            let points = points.map(|run| (case.cells(run), case.error_percent(run.measured)));
            let name = format!("{}: {}", case.name, case.quantity);
            Line::new(name, colours[i % colours.len()], points).dashed(i >= colours.len())
        };
        let limits = [-LIMIT_PERCENT, LIMIT_PERCENT].map(|limit| {
            let name = if limit > 0.0 { "limit" } else { "" };
            Line::new(name, GREY, [cells.0, cells.1].map(|x| (x, limit)))
        });
        let title = format!("Poisson's ratio {poisson}");
        let lines = of_ratio.enumerate().map(line).chain(limits);
        Panel::new(title, "error (%)", lines)
    };
    Chart::new(
        "Error of the tissue against references",
        "cells over the resolved length",
        POISSON.map(panel).into(),
    )
}

/// The measured curve on the reference, a panel per Poisson's ratio.
fn drawn(curve: Curve) -> (String, Chart) {
    let [x_label, y_label] = curve.axes;
    let panel = |set: CurveSet| {
        let lines = [
            Line::new("reference", GREY, set.reference).dashed(true),
            Line::new("tissue", BLUE, set.measured).dots(),
        ];
        Panel::new(format!("Poisson's ratio {}", set.poisson), y_label, lines)
    };
    let panels = curve.sets.into_iter().map(panel).collect();
    (
        curve.name.to_owned(),
        Chart::new(curve.title, x_label, panels),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::inputs::Inputs;

    #[test]
    fn tissue_meets_every_reference() {
        let outcome = run(&mut Bench {
            inputs: Inputs::default(),
            dir: std::env::temp_dir().as_path(),
            progress: &mut |_, _| (),
        });
        let outcome = outcome.unwrap();
        assert_eq!(outcome.missed(), Vec::<String>::new());
        assert_eq!(outcome.figures["cases"].as_array().unwrap().len(), 24);
        for (name, chart) in &outcome.charts {
            assert!(chart.to_svg().contains("<path"), "{name}");
        }
    }
}
