//! Table and chart of one run.

use std::fmt::Write as _;
use std::path::Path;

use palpate_tissue::write_file;

use crate::chart::{BLUE, Chart, GREEN, GREY, Line, Mark, ORANGE, Panel, Scale};

use super::Trial;
use super::course::Point;

/// The ticks of a run, one row each. A pause of the process has three rows, because the device continues. The
/// fault-free run is not included.
pub fn table(points: &[Point]) -> String {
    let mut text = String::from("t_s,asked_n,rendered_n,changed_n,above_mm,events\n");
    for p in points {
        let _ = writeln!(
            text,
            "{:.6},{:.6},{:.6},{:.6},{:.4},{}",
            p.t_s,
            p.asked_n,
            p.rendered_n,
            p.changed_n,
            p.above_mm,
            p.events.bits()
        );
    }
    text
}

/// A run with and without faults.
pub fn chart(trial: &Trial) -> Chart {
    let line = |name: &str, colour, dashed, points: &[Point], value: fn(&Point) -> f64| Line {
        name: name.to_owned(),
        colour,
        dashed,
        points: points.iter().map(|p| (p.t_s, value(p))).collect(),
    };
    let (run, without) = (&trial.run, &trial.without);
    let limit = [0.0, trial.plan.length_us as f64 * 1e-6].map(|t| (t, run.step_n));
    let limit = Line {
        name: "slew limit".to_owned(),
        colour: GREY,
        dashed: true,
        points: limit.into(),
    };
    let panels = vec![
        Panel {
            title: "Force that the device renders".to_owned(),
            y_label: "force (N)".to_owned(),
            lines: vec![
                line("without faults", GREY, false, &without.points, |p| {
                    p.rendered_n
                }),
                line("asked for", ORANGE, true, &run.points, |p| p.asked_n),
                line("rendered", BLUE, false, &run.points, |p| p.rendered_n),
            ],
            scale: Scale::Linear,
        },
        Panel {
            title: "Its change per tick, without that of the device itself".to_owned(),
            y_label: "force (N)".to_owned(),
            lines: vec![
                limit,
                line("change", BLUE, false, &run.points, |p| p.changed_n),
            ],
            scale: Scale::Linear,
        },
        Panel {
            title: "Height of the tool above the surface".to_owned(),
            y_label: "distance (mm)".to_owned(),
            lines: vec![line("tool", GREEN, false, &run.points, |p| p.above_mm)],
            scale: Scale::Linear,
        },
    ];
    let marks = trial.plan.faults.iter().flat_map(|fault| {
        let begins = Mark {
            x: fault.from_us as f64 * 1e-6,
            label: fault.to_string(),
        };
        let ends = (fault.until_us > fault.from_us).then(|| Mark {
            x: fault.until_us as f64 * 1e-6,
            label: "over".to_owned(),
        });
        std::iter::once(begins).chain(ends)
    });
    Chart {
        title: format!("{}, seed {}", trial.plan.class, trial.plan.seed),
        x_label: "time of the run (s)".to_owned(),
        panels,
        marks: marks.collect(),
    }
}

/// Writes table and chart of a recorded run into `dir`; returns the file name of the chart.
pub fn write(trial: &Trial, dir: &Path) -> std::io::Result<String> {
    let name = format!("{}-{}", trial.plan.class, trial.plan.seed);
    std::fs::create_dir_all(dir)?;
    let write = |name: &str, text: String| write_file(&dir.join(name), text).map_err(|e| e.source);
    write(&format!("{name}.csv"), table(&trial.run.points))?;
    let picture = format!("{name}.svg");
    write(&picture, chart(trial).to_svg())?;
    Ok(picture)
}
