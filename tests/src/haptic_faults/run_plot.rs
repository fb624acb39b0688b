//! Table and chart of one run.

use std::path::Path;

use palpate_tissue::file::write_file;

use crate::chart::{BLUE, Chart, GREEN, GREY, Line, Mark, ORANGE, Panel};
use crate::experiments::Table;

use super::SeedResult;
use super::run::Point;

/// The ticks of a run, one row each. A pause of the process has three rows, because the device continues. The
/// fault-free run is not included.
fn table(points: &[Point]) -> Table {
    let mut table = Table::new("t_s,commanded_n,rendered_n,changed_n,above_mm,events");
    for p in points {
        let numbers = [p.t_s, p.commanded_n, p.rendered_n, p.changed_n];
        let mut row = numbers.map(|x| format!("{x:.6}")).to_vec();
        row.extend([format!("{:.4}", p.above_mm), p.events.bits().to_string()]);
        table.rows.push(row);
    }
    table
}

pub fn chart(result: &SeedResult) -> Chart {
    let line = |name: &str, colour, points: &[Point], value: fn(&Point) -> f64| {
        Line::new(name, colour, points.iter().map(|p| (p.t_s, value(p))))
    };
    let (faulty, fault_free) = (&result.faulty.points, &result.fault_free.points);
    let limit = [0.0, result.plan.length_us as f64 * 1e-6].map(|t| (t, result.faulty.step_n));
    let force = [
        line("without faults", GREY, fault_free, |p| p.rendered_n),
        line("commanded", ORANGE, faulty, |p| p.commanded_n).dashed(true),
        line("rendered", BLUE, faulty, |p| p.rendered_n),
    ];
    let change = [
        Line::new("slew limit", GREY, limit).dashed(true),
        line("change", BLUE, faulty, |p| p.changed_n),
    ];
    let height = [line("tool", GREEN, faulty, |p| p.above_mm)];
    let change_title = "Its change per tick, without that of the device itself";
    let panels = vec![
        Panel::new("Force that the device renders", "force (N)", force),
        Panel::new(change_title, "force (N)", change),
        Panel::new(
            "Height of the tool above the surface",
            "distance (mm)",
            height,
        ),
    ];
    let mark = |us: i64, label: String| Mark {
        x: us as f64 * 1e-6,
        label,
    };
    let marks = result.plan.faults.iter().flat_map(|fault| {
        let ends = fault.until_us > fault.from_us;
        let ends = ends.then(|| mark(fault.until_us, "over".to_owned()));
        std::iter::once(mark(fault.from_us, fault.to_string())).chain(ends)
    });
    let title = format!("{}, seed {}", result.plan.class, result.plan.seed);
    Chart::new(title, "time of the run (s)", panels).with_marks(marks.collect())
}

/// Writes table and chart of a recorded run into `dir`; returns the file name of the chart.
pub fn write(result: &SeedResult, dir: &Path) -> std::io::Result<String> {
    let name = format!("{}-{}", result.plan.class, result.plan.seed);
    std::fs::create_dir_all(dir)?;
    let write = |name: &str, text: String| write_file(&dir.join(name), text).map_err(|e| e.source);
    write(
        &format!("{name}.csv"),
        table(&result.faulty.points).to_csv(),
    )?;
    let picture = format!("{name}.svg");
    write(&picture, chart(result).to_svg())?;
    Ok(picture)
}
