//! A figure: panels in a row, each with a title and a scale bar, over one legend of tissues.

use std::collections::BTreeSet;

use palpate_tissue::Model;

use super::canvas::{Canvas, Letters};
use super::colour::{self, Colour, INK, PALE_INK};
use super::frame::{Frame, round_length};
use super::panel::{Edge, Panel};

/// Pixels of all panels, which have equal widths; a drawing fills the width or the height of its panel.
const PANELS: [f32; 2] = [1280.0, 560.0];
const GAP: f32 = 32.0;
const TITLE: f32 = 34.0;
/// Below the panels: scale bars, then the legend.
const BAR: f32 = 40.0;
const LEGEND: f32 = 28.0;
const SWATCH: f32 = 16.0;
/// Lines and dots over a drawing: visible over every tissue.
const OVER: Colour = [0, 90, 200];
const LIP: Colour = [120, 0, 30];

/// Draws panels of one model as PNG.
pub fn figure(model: &Model, panels: &[Panel]) -> Result<Vec<u8>, String> {
    let room = [PANELS[0] / panels.len().max(1) as f32, PANELS[1]];
    let mut frames = Vec::new();
    let mut left = GAP;
    for panel in panels {
        let frame = Frame::around(panel.bounds, room, [left, TITLE]);
        // A title may be wider than a slender drawing.
        let title = panel.title.chars().count() as f32 * Letters::Bold.width();
        left += frame.size[0].max(title) + GAP;
        frames.push(frame);
    }
    let shown: BTreeSet<usize> = panels.iter().flat_map(|p| p.regions.clone()).collect();
    let entries = entries(model, &shown);
    let width = entries.iter().map(|e| e.1).fold(left, f32::max);
    let tallest = frames.iter().map(|f| f.size[1]).fold(0.0, f32::max);
    let rows = rows(&entries, width);
    let height = TITLE + tallest + BAR + LEGEND * rows.len() as f32;
    let mut canvas = Canvas::new(width as u32, height as u32)?;
    for (panel, frame) in panels.iter().zip(&frames) {
        canvas.text(&panel.title, [frame.corner[0], 10.0], Letters::Bold, INK);
        draw(&mut canvas, panel, frame);
        bar(&mut canvas, frame, TITLE + tallest + 10.0);
    }
    let colours = colour::of_regions(model);
    for (row, members) in rows.iter().enumerate() {
        let y = TITLE + tallest + BAR + LEGEND * row as f32;
        let mut x = GAP;
        for &(region, wide) in members {
            canvas.rectangle([x - 1.0, y - 1.0], [SWATCH + 2.0; 2], INK);
            canvas.rectangle([x, y], [SWATCH; 2], colours[region]);
            let name = &model.regions[region].name;
            canvas.text(name, [x + SWATCH + 8.0, y + 1.0], Letters::Small, INK);
            x += wide;
        }
    }
    canvas.png()
}

/// Regions of the legend with the width of their entries.
fn entries(model: &Model, shown: &BTreeSet<usize>) -> Vec<(usize, f32)> {
    let wide = |r: usize| {
        let letters = model.regions[r].name.chars().count() as f32;
        SWATCH + 8.0 + letters * Letters::Small.width() + GAP
    };
    shown.iter().map(|&r| (r, wide(r))).collect()
}

/// Entries in rows that fit into a width.
fn rows(entries: &[(usize, f32)], width: f32) -> Vec<Vec<(usize, f32)>> {
    let mut rows = vec![Vec::new()];
    let mut x = GAP;
    for &entry in entries {
        if x + entry.1 > width && x > GAP {
            rows.push(Vec::new());
            x = GAP;
        }
        x += entry.1;
        if let Some(row) = rows.last_mut() {
            row.push(entry);
        }
    }
    rows
}

fn draw(canvas: &mut Canvas, panel: &Panel, frame: &Frame) {
    for piece in &panel.pieces {
        for fill in &piece.fills {
            let corners: Vec<_> = fill.iter().map(|p| frame.at(*p)).collect();
            canvas.fill(&corners, piece.colour, 1.0);
        }
        for (kind, width, ink, opacity) in [
            (Edge::Mesh, 0.8, INK, 0.4),
            (Edge::Border, 1.6, INK, 0.9),
            (Edge::Lip, 2.6, LIP, 1.0),
        ] {
            let edges = piece.edges.iter().filter(|(_, k)| *k == kind);
            let edges = edges.map(|(line, _)| line.map(|p| frame.at(p)));
            canvas.lines(edges, width, ink, opacity);
        }
    }
    let lines = panel.lines.iter().map(|l| l.map(|p| frame.at(p)));
    canvas.lines(lines, 2.0, OVER, 1.0);
    for dot in &panel.dots {
        canvas.dot(frame.at(*dot), 3.5, OVER);
    }
}

/// A bar of a round length below a panel.
fn bar(canvas: &mut Canvas, frame: &Frame, y: f32) {
    let length = round_length(f64::from(frame.size[0]) / frame.scale / 6.0);
    let pixels = (length * frame.scale) as f32;
    canvas.rectangle([frame.corner[0], y + 4.0], [pixels, 4.0], PALE_INK);
    let label = format!("{length} mm");
    let place = [frame.corner[0] + pixels + 8.0, y];
    canvas.text(&label, place, Letters::Small, INK);
}

#[cfg(test)]
mod tests {
    use super::super::view::View;
    use super::*;
    use palpate_tissue::{BladePoint, CutStroke, Material, Shape, Topology, Vec3, block, cut};

    fn wounded() -> Topology {
        let mut topology = Topology::new(block([8, 6, 5], 4e-3, &Material::default(), 1).into());
        let point = |y: f64| BladePoint {
            tip: Vec3::new(0.017, y, 0.0101),
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: vec![point(-0.01), point(0.014)],
            width_m: 0.0,
        };
        cut(&mut topology, &stroke).unwrap();
        topology
    }

    #[test]
    fn surface_marks_the_lips_of_a_wound_and_only_these() {
        let topology = wounded();
        let shape = Shape::rest(&topology);
        let panel = Panel::surface("top", &topology, &shape, View::along(2), |_, _| true);
        let lips = |panel: &Panel| {
            let edges = panel.pieces.iter().flat_map(|p| &p.edges);
            edges.filter(|(_, k)| *k == Edge::Lip).count()
        };
        // Three or four edges on each side of the cut, which ends between two nodes.
        assert!((6..=8).contains(&lips(&panel)), "{}", lips(&panel));
        let whole = Topology::new(topology.model().clone());
        let shape = Shape::rest(&whole);
        let panel = Panel::surface("top", &whole, &shape, View::along(2), |_, _| true);
        assert_eq!(lips(&panel), 0);
    }

    #[test]
    fn figure_of_panels_is_drawn_deterministically_within_its_size() {
        let topology = wounded();
        let shape = Shape::rest(&topology);
        let oblique = View::from(Vec3::new(0.4, -1.0, 0.8), Vec3::z());
        let panels = |count: usize| -> Vec<Panel> {
            let one = |_| Panel::surface("seen obliquely", &topology, &shape, oblique, |_, _| true);
            (0..count).map(one).collect()
        };
        let png = |count| figure(topology.model(), &panels(count)).unwrap();
        assert_eq!(png(2), png(2));
        // Width and height follow the signature and the name of the first chunk.
        let size =
            |png: &[u8]| [16, 20].map(|at| u32::from_be_bytes(png[at..at + 4].try_into().unwrap()));
        for count in 1..=3 {
            let size = size(&png(count)).map(|v| v as f32);
            let around = [GAP * (count as f32 + 1.0), TITLE + BAR + LEGEND];
            let drawn: Vec<f32> = (0..2).map(|a| (size[a] - around[a]) / PANELS[a]).collect();
            // Each drawing fits, and fills the width or the height of its panel.
            let most = drawn[0].max(drawn[1]);
            assert!((0.99..=1.01).contains(&most), "{count}: {drawn:?}");
        }
    }
}
