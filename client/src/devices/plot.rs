//! Workspace plots as SVG.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use nalgebra::{Unit, UnitQuaternion, Vector3};
use palpate_device::backend::five_dof::{Linkage, Middle, SINGULAR, TILT_RAD, manipulability};
use palpate_tissue::file::write_file;

/// Side of a map cell, m.
const CELL_M: f64 = 2.5e-3;
/// Pixels per metre.
const SCALE: f64 = 1000.0;
/// Colours of increasing manipulability, without the singular range (viridis).
const COLOURS: [&str; 8] = [
    "#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39", "#fde725",
];
/// Manipulability of the last colour; with the lengths of 2007 the maximum is 0.71.
const MOST: f64 = 0.71;
/// Colour of singular configurations: the arms fold or stretch.
const SINGULAR_COLOUR: &str = "#c9c9c9";

/// A plane section of the workspace.
struct Section {
    title: String,
    /// Names of the horizontal and the vertical axis.
    across: &'static str,
    up: &'static str,
    /// Range of each axis: from, to, m.
    range: [[f64; 2]; 2],
    axis: Unit<Vector3<f64>>,
    place: fn(f64, f64, &Middle) -> Vector3<f64>,
}

/// Plots the workspace of the 5-DOF device and returns the path of the file.
pub(super) fn five_dof(folder: &Path) -> Result<PathBuf, String> {
    let linkage = Linkage::default();
    let middle = Middle::of(&linkage).map_err(|e| e.to_string())?;
    let upright = Vector3::y_axis();
    let tilted = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), TILT_RAD) * upright;
    let side = |title: String, axis| Section {
        title,
        across: "x",
        up: "z",
        range: [[-0.05, 0.35], [-0.35, 0.1]],
        axis,
        place: |a, b, _| Vector3::new(a, 0.0, b),
    };
    let sections = [
        side("from the side, y = 0".to_owned(), upright),
        Section {
            title: format!("from above, z = {:.0} mm", middle.pivot.z * 1e3),
            across: "x",
            up: "y",
            range: [[-0.05, 0.35], [-0.225, 0.225]],
            axis: upright,
            place: |a, b, middle| Vector3::new(a, b, middle.pivot.z),
        },
        side(
            format!(
                "from the side, probe tilted by {:.0}°",
                TILT_RAD.to_degrees()
            ),
            tilted,
        ),
    ];
    let text = picture(&linkage, &middle, &sections);
    let path = folder.join("five-dof-workspace.svg");
    std::fs::create_dir_all(folder)
        .and_then(|()| write_file(&path, text).map_err(|e| e.source))
        .map_err(|e| format!("cannot write {}: {e}", path.display()))?;
    Ok(path)
}

fn picture(linkage: &Linkage, middle: &Middle, sections: &[Section]) -> String {
    const LEFT: f64 = 60.0;
    const TOP: f64 = 74.0;
    let width: f64 = sections
        .iter()
        .map(|s| LEFT + span(s.range[0]) + 16.0)
        .sum();
    let height = sections
        .iter()
        .map(|s| span(s.range[1]))
        .fold(0.0, f64::max)
        + TOP
        + 110.0;
    let mut out = String::new();
    // Writing to a string can not fail.
    let _ = writeln!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" width=\"{width:.0}\" \
         height=\"{height:.0}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"{LEFT}\" y=\"24\" font-size=\"16\">Where the 5-DOF device can hold the pivot of its probe</text>"
    );
    let mut x = LEFT;
    for section in sections {
        map(&mut out, linkage, middle, section, [x, TOP]);
        x += span(section.range[0]) + 16.0 + LEFT;
    }
    legend(&mut out, LEFT, height - 40.0);
    out.push_str("</svg>\n");
    out
}

fn span([from, to]: [f64; 2]) -> f64 {
    (to - from) * SCALE
}

/// One section with its axes; a run of cells of one colour is one rectangle.
fn map(out: &mut String, linkage: &Linkage, middle: &Middle, section: &Section, at: [f64; 2]) {
    let [left, top] = at;
    let [across, up] = section.range;
    let (width, height) = (span(across), span(up));
    let (columns, rows) = (
        (width / SCALE / CELL_M) as usize,
        (height / SCALE / CELL_M) as usize,
    );
    let colour = |i: usize, j: usize| {
        let a = across[0] + (i as f64 + 0.5) * CELL_M;
        let b = up[1] - (j as f64 + 0.5) * CELL_M;
        let place = (section.place)(a, b, middle);
        let m = manipulability(linkage, &place, &section.axis);
        (m > 0.0).then(|| colour_of(m))
    };
    let cell = CELL_M * SCALE;
    let _ = writeln!(
        out,
        "<text x=\"{left}\" y=\"{:.0}\">{}</text>\n<g shape-rendering=\"crispEdges\">",
        top - 10.0,
        section.title
    );
    for j in 0..rows {
        let mut from = 0;
        while from < columns {
            let kind = colour(from, j);
            let mut to = from + 1;
            while to < columns && colour(to, j) == kind {
                to += 1;
            }
            if let Some(kind) = kind {
                let _ = writeln!(
                    out,
                    "<rect x=\"{:.0}\" y=\"{:.0}\" width=\"{:.0}\" height=\"{cell}\" fill=\"{kind}\"/>",
                    left + from as f64 * cell,
                    top + j as f64 * cell,
                    (to - from) as f64 * cell
                );
            }
            from = to;
        }
    }
    out.push_str("</g>\n");
    axes(out, section, at);
    // The workspace, a cube.
    let half = middle.half_m * SCALE;
    let upwards = if section.up == "z" {
        middle.pivot.z
    } else {
        middle.pivot.y
    };
    let x = left + (middle.pivot.x - across[0]) * SCALE;
    let y = top + (up[1] - upwards) * SCALE;
    let _ = writeln!(
        out,
        "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"none\" stroke=\"black\" \
         stroke-width=\"1.5\"/>",
        x - half,
        y - half,
        2.0 * half,
        2.0 * half
    );
}

fn axes(out: &mut String, section: &Section, [left, top]: [f64; 2]) {
    let [across, up] = section.range;
    let (width, height) = (span(across), span(up));
    let bottom = top + height;
    let _ = writeln!(
        out,
        "<rect x=\"{left}\" y=\"{top}\" width=\"{width:.0}\" height=\"{height:.0}\" fill=\"none\" stroke=\"#888\"/>"
    );
    for mm in (-300..=300).step_by(100) {
        let m = f64::from(mm) * 1e-3;
        if (across[0]..=across[1]).contains(&m) {
            let x = left + (m - across[0]) * SCALE;
            let _ = writeln!(
                out,
                "<path d=\"M{x:.0} {bottom:.0}v5\" stroke=\"#888\"/>\
                 <text x=\"{x:.0}\" y=\"{:.0}\" text-anchor=\"middle\">{mm}</text>",
                bottom + 18.0
            );
        }
        if (up[0]..=up[1]).contains(&m) {
            let y = top + (up[1] - m) * SCALE;
            let _ = writeln!(
                out,
                "<path d=\"M{left} {y:.0}h-5\" stroke=\"#888\"/>\
                 <text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"end\">{mm}</text>",
                left - 8.0,
                y + 4.0
            );
        }
    }
    let _ = writeln!(
        out,
        "<text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"middle\">{} / mm</text>\
         <text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"end\">{} / mm</text>",
        left + 0.5 * width,
        bottom + 36.0,
        section.across,
        left - 8.0,
        top - 10.0,
        section.up
    );
}

fn colour_of(m: f64) -> &'static str {
    if m < SINGULAR {
        return SINGULAR_COLOUR;
    }
    let share = (m - SINGULAR) / (MOST - SINGULAR);
    COLOURS[((share * COLOURS.len() as f64) as usize).min(COLOURS.len() - 1)]
}

fn legend(out: &mut String, left: f64, y: f64) {
    let step = (MOST - SINGULAR) / COLOURS.len() as f64;
    let named = COLOURS.iter().enumerate().map(|(i, c)| {
        let name = format!("{:.2}", SINGULAR + step * i as f64);
        (*c, name)
    });
    let first = (SINGULAR_COLOUR, format!("below {SINGULAR}: forces fade"));
    let mut x = left;
    for (colour, name) in std::iter::once(first).chain(named) {
        let _ = writeln!(
            out,
            "<rect x=\"{x:.0}\" y=\"{:.0}\" width=\"14\" height=\"14\" fill=\"{colour}\"/>\
             <text x=\"{:.0}\" y=\"{y:.0}\">{name}</text>",
            y - 11.0,
            x + 19.0
        );
        x += 36.0 + 7.0 * name.len() as f64;
    }
    let _ = writeln!(
        out,
        "<text x=\"{:.0}\" y=\"{y:.0}\">manipulability |det J| / L1 L2 (L1 + L2) from there on; frame: workspace</text>",
        x + 8.0
    );
}
