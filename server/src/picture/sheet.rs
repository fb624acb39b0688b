//! The sheet: title above, section with a scale on its left, legend on its right.

use palpate_tissue::Model;

use super::canvas::{Canvas, Letters};
use super::colour::{self, Colour, INK, INVERTED, PALE_INK, POOR};
use super::frame::{Frame, round_length};
use super::legend::{self, Figures, Legend};
use super::section::{Grade, Point, Section};

/// Area of the section in pixels; the section fills its width or its height.
const ROOM: [f32; 2] = [1150.0, 1000.0];
/// Around the section: left (numbers), top (title), right, bottom (numbers and scale).
const LEFT: f32 = 70.0;
const TOP: f32 = 76.0;
const GAP: f32 = 40.0;
const BOTTOM: f32 = 84.0;
/// Minimum pixels per spacing at which springs are drawn by default; outlines of cells need fewer.
const SPRINGS_FROM: f64 = 12.0;
const OUTLINES_FROM: f64 = 4.0;
/// Pixels between the numbers of the scale.
const TICK_APART: f64 = 80.0;

/// Draws the sheet as PNG.
pub(super) fn draw(
    model: &Model,
    section: &Section,
    name: &str,
    springs: bool,
) -> Result<Vec<u8>, String> {
    let frame = Frame::around(section.bounds, ROOM, [LEFT, TOP]);
    let legend = Legend::of(model, section);
    let width = LEFT + frame.size[0] + GAP + legend::WIDTH;
    let height = TOP + (frame.size[1] + BOTTOM).max(legend.height());
    let mut canvas = Canvas::new(width as u32, height as u32)?;
    let spacing = model.spacing_m * 1e3 * frame.scale;
    let springs = section.at_mm.is_some() && (springs || spacing >= SPRINGS_FROM);
    title(&mut canvas, model, section, name);
    canvas.lines(lines(&frame, &section.context), 1.2, PALE_INK, 0.8);
    cells(&mut canvas, &frame, section, &colour::of_regions(model));
    if springs {
        draw_springs(&mut canvas, &frame, section, spacing);
    } else if spacing >= OUTLINES_FROM {
        canvas.lines(outlines(&frame, section, false), 0.6, INK, 0.35);
    }
    canvas.lines(outlines(&frame, section, true), 2.0, INK, 1.0);
    marks(&mut canvas, &frame, section);
    scale(&mut canvas, &frame, section.axis);
    let right = LEFT + frame.size[0] + GAP;
    legend.draw(&mut canvas, [right, TOP], springs);
    canvas.png()
}

fn lines(frame: &Frame, of: &[[Point; 2]]) -> Vec<[[f32; 2]; 2]> {
    of.iter().map(|l| l.map(|p| frame.at(p))).collect()
}

fn outlines(frame: &Frame, section: &Section, border: bool) -> Vec<[[f32; 2]; 2]> {
    let lines = section.cells.iter().flat_map(|c| &c.outline);
    lines
        .filter(|(_, is_border)| *is_border == border)
        .map(|(line, _)| line.map(|p| frame.at(p)))
        .collect()
}

fn title(canvas: &mut Canvas, model: &Model, section: &Section, name: &str) {
    let axis = ["x", "y", "z"][section.axis];
    let (title, shown) = match section.at_mm {
        Some(at) => (format!("{name}   {axis} = {at:.1} mm"), "in this section"),
        None => (
            format!("{name}   walls of wounds, seen along {axis}"),
            "with a wall in view",
        ),
    };
    canvas.text(&title, [LEFT, 14.0], Letters::Large, INK);
    let figures = format!(
        "spacing {} mm   {} nodes   {} cells, {} {shown}",
        Figures(model.spacing_m * 1e3),
        model.nodes.len(),
        model.cells.len(),
        section.cells.len()
    );
    canvas.text(&figures, [LEFT, 42.0], Letters::Small, PALE_INK);
}

fn cells(canvas: &mut Canvas, frame: &Frame, section: &Section, colours: &[Colour]) {
    for cell in &section.cells {
        for piece in &cell.pieces {
            let corners: Vec<_> = piece.iter().map(|p| frame.at(*p)).collect();
            canvas.fill(&corners, colours[cell.region], 1.0);
        }
    }
}

fn draw_springs(canvas: &mut Canvas, frame: &Frame, section: &Section, spacing: f64) {
    let width = (spacing * 0.05).clamp(0.5, 1.6) as f32;
    canvas.lines(lines(frame, &section.shear), width * 0.6, INK, 0.28);
    canvas.lines(lines(frame, &section.structural), width, INK, 0.6);
}

/// Cells of poor shape, over everything else.
fn marks(canvas: &mut Canvas, frame: &Frame, section: &Section) {
    // The colour of a layer must stay visible when most of its cells are poor.
    for (grade, with, opacity) in [(Grade::Poor, POOR, 0.3), (Grade::Inverted, INVERTED, 0.5)] {
        for cell in section.cells.iter().filter(|c| c.grade == grade) {
            for piece in &cell.pieces {
                let corners: Vec<_> = piece.iter().map(|p| frame.at(*p)).collect();
                canvas.fill(&corners, with, opacity);
            }
            let outline = cell.outline.iter().map(|(l, _)| l.map(|p| frame.at(p)));
            canvas.lines(outline, 1.4, with, 1.0);
        }
    }
}

/// The frame with its numbers, and a bar of a round length below it.
fn scale(canvas: &mut Canvas, frame: &Frame, axis: usize) {
    let [x0, y0] = [LEFT, TOP];
    let [x1, y1] = [LEFT + frame.size[0], TOP + frame.size[1]];
    let border = [
        [[x0, y0], [x1, y0]],
        [[x1, y0], [x1, y1]],
        [[x1, y1], [x0, y1]],
        [[x0, y1], [x0, y0]],
    ];
    canvas.lines(border, 1.0, PALE_INK, 1.0);
    let step = round_length(TICK_APART / frame.scale);
    let digits = usize::from(step < 1.0) * 2;
    let small = Letters::Small;
    for a in 0..2 {
        let low = frame.origin[a];
        let high = low + f64::from(frame.size[a]) / frame.scale;
        let first = (low / step).ceil() as i64;
        for number in first..=(high / step).floor() as i64 {
            let value = number as f64 * step;
            let mut p = frame.origin;
            p[a] = value;
            let [x, y] = frame.at(p);
            let label = format!("{value:.digits$}");
            let width = label.chars().count() as f32 * small.width();
            let (tick, place) = if a == 0 {
                ([x, y + 6.0], [x - 0.5 * width, y + 10.0])
            } else {
                ([x - 6.0, y], [x - 10.0 - width, y - 0.5 * small.height()])
            };
            canvas.lines([[[x, y], tick]], 1.0, PALE_INK, 1.0);
            canvas.text(&label, place, small, PALE_INK);
        }
    }
    let [right, up] = [["y", "z"], ["x", "z"], ["x", "y"]][axis];
    let below = y1 + 38.0;
    let label = format!("{right} to the right, {up} up, in mm");
    let caption = label.chars().count() as f32 * small.width();
    let bar = round_length(f64::from(frame.size[0]) / frame.scale / 5.0);
    let length = (bar * frame.scale) as f32;
    // The caption goes below the bar if it does not fit beside it.
    let beside = x0 + caption + GAP < x1 - length;
    let line = if beside { below } else { below + 24.0 };
    canvas.text(&label, [x0, line], small, PALE_INK);
    canvas.rectangle([x1 - length, below], [length, 5.0], INK);
    let label = format!("{bar} mm");
    let width = label.chars().count() as f32 * Letters::Bold.width();
    let place = [x1 - 0.5 * (length + width), below + 9.0];
    canvas.text(&label, place, Letters::Bold, INK);
}
