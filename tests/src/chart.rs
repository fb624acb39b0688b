//! Charts of courses over time, as SVG text.
//!
//! One chart is a stack of panels that share the x axis. Every panel has its title, its axis with
//! a unit, a legend line above the plot, where it can hide nothing, and vertical marks with labels
//! at their tops. Lines with more points than the plot is wide are drawn as their range per column.

use std::fmt::Write as _;

/// Width of the whole picture, px.
const WIDTH: f64 = 960.0;
/// Height of the plot of one panel, px.
const PLOT_HEIGHT: f64 = 190.0;
/// Room above a plot for its title and legend, px.
const HEAD: f64 = 46.0;
/// Room below a plot for the numbers of the x axis, px.
const FOOT: f64 = 24.0;
/// Room left of the plots, px.
const LEFT: f64 = 74.0;
/// Room right of the plots, px.
const RIGHT: f64 = 24.0;
/// Room at the top for the chart's title, px.
const TOP: f64 = 36.0;
/// Room at the bottom for the label of the x axis, px.
const BOTTOM: f64 = 30.0;
/// Columns of the plot in which a line is thinned out.
const COLUMNS: usize = 800;
/// Width of a character of the legend, px, as good as it can be known without the font.
const CHARACTER: f64 = 6.6;

/// Colours that stay apart for most eyes (Okabe and Ito 2008).
pub const BLUE: &str = "#0072b2";
/// Orange of the same set.
pub const ORANGE: &str = "#d55e00";
/// Grey for what others are compared with.
pub const GREY: &str = "#808080";
/// Green of the same set.
pub const GREEN: &str = "#009e73";

/// One line.
#[derive(Debug, Clone)]
pub struct Line {
    /// What it is, for the legend; empty for a line that another one's entry stands for.
    pub name: String,
    /// Its colour.
    pub colour: &'static str,
    /// Whether it is drawn with dashes.
    pub dashed: bool,
    /// x and y, x not decreasing.
    pub points: Vec<(f64, f64)>,
}

/// A plot.
#[derive(Debug, Clone)]
pub struct Panel {
    /// What it shows.
    pub title: String,
    /// Quantity and unit of y.
    pub y_label: String,
    /// The lines, later ones on top.
    pub lines: Vec<Line>,
}

/// A moment worth a vertical line.
#[derive(Debug, Clone)]
pub struct Mark {
    /// Where.
    pub x: f64,
    /// What it was.
    pub label: String,
}

/// Panels above each other.
#[derive(Debug, Clone)]
pub struct Chart {
    /// What it shows.
    pub title: String,
    /// Quantity and unit of x.
    pub x_label: String,
    /// The panels.
    pub panels: Vec<Panel>,
    /// Moments marked in every panel.
    pub marks: Vec<Mark>,
}

/// Numbers along an axis.
#[derive(Debug, Clone, Copy)]
struct Axis {
    from: f64,
    until: f64,
    step: f64,
}

impl Axis {
    /// An axis over a range, at steps of 1, 2 or 5 times a power of ten.
    fn over(from: f64, until: f64, steps: f64) -> Self {
        let length = if until - from > 1e-12 {
            until - from
        } else {
            1.0
        };
        let rough = length / steps;
        let power = 10f64.powf(rough.log10().floor());
        let factor = [1.0, 2.0, 5.0, 10.0]
            .into_iter()
            .find(|f| f * power >= rough * 0.999)
            .unwrap_or(10.0);
        Self {
            from,
            until: from + length,
            step: factor * power,
        }
    }

    fn share(&self, v: f64) -> f64 {
        (v - self.from) / (self.until - self.from)
    }

    fn ticks(&self) -> impl Iterator<Item = f64> + use<> {
        let (step, from, until) = (self.step, self.from, self.until);
        let first = (from / step).ceil() as i64;
        (first..)
            .map(move |i| i as f64 * step)
            .take_while(move |v| *v <= until + 1e-9 * step)
    }

    fn number(&self, v: f64) -> String {
        let digits = (-self.step.log10().floor()).max(0.0) as usize;
        format!("{v:.digits$}")
    }
}

impl Chart {
    /// The chart as the text of an SVG file.
    pub fn to_svg(&self) -> String {
        let panel_height = HEAD + PLOT_HEIGHT + FOOT;
        let height = TOP + self.panels.len() as f64 * panel_height + BOTTOM;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" \
             width=\"{WIDTH}\" height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
        );
        text(&mut svg, WIDTH / 2.0, 22.0, "middle", 16, &self.title);
        let xs = self
            .panels
            .iter()
            .flat_map(|p| &p.lines)
            .flat_map(|l| &l.points);
        let (low, high) = range(xs.map(|p| p.0));
        let x = Axis::over(low, high, 10.0);
        for (i, panel) in self.panels.iter().enumerate() {
            panel.draw(&mut svg, TOP + i as f64 * panel_height, x, &self.marks);
        }
        let middle = LEFT + plot_width() / 2.0;
        text(&mut svg, middle, height - 10.0, "middle", 13, &self.x_label);
        svg.push_str("</svg>\n");
        svg
    }
}

fn plot_width() -> f64 {
    WIDTH - LEFT - RIGHT
}

/// Smallest and largest of some numbers; 0 to 1 of none.
fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
            (l.min(v), h.max(v))
        });
    if low <= high { (low, high) } else { (0.0, 1.0) }
}

impl Panel {
    fn draw(&self, svg: &mut String, top: f64, x: Axis, marks: &[Mark]) {
        let plot = top + HEAD;
        let (low, high) = range(self.lines.iter().flat_map(|l| &l.points).map(|p| p.1));
        let y = Axis::over(low.min(0.0), high.max(low + 1e-3) * 1.08, 5.0);
        text(svg, LEFT, top + 16.0, "start", 13, &self.title);
        self.legend(svg, top + 36.0);
        grid(svg, plot, x, y);
        let centre = plot + PLOT_HEIGHT / 2.0;
        let _ = writeln!(
            svg,
            "<text x=\"18\" y=\"{centre}\" text-anchor=\"middle\" \
             transform=\"rotate(-90 18 {centre})\">{}</text>",
            escape(&self.y_label)
        );
        for line in &self.lines {
            line.draw(svg, plot, x, y);
        }
        draw_marks(svg, plot, x, marks);
    }

    fn legend(&self, svg: &mut String, y: f64) {
        let mut at = LEFT;
        for line in self.lines.iter().filter(|l| !l.name.is_empty()) {
            let dash = dash(line.dashed);
            let (colour, end, middle) = (line.colour, at + 22.0, y - 4.0);
            let _ = writeln!(
                svg,
                "<line x1=\"{at}\" y1=\"{middle}\" x2=\"{end}\" y2=\"{middle}\" \
                 stroke=\"{colour}\" stroke-width=\"2\"{dash}/>"
            );
            text(svg, at + 28.0, y, "start", 12, &line.name);
            at += 28.0 + CHARACTER * line.name.chars().count() as f64 + 22.0;
        }
    }
}

impl Line {
    fn draw(&self, svg: &mut String, plot: f64, x: Axis, y: Axis) {
        let mut path = String::new();
        for (px, py) in thinned(&self.points, x) {
            let letter = if path.is_empty() { 'M' } else { 'L' };
            let (px, py) = (
                LEFT + x.share(px) * plot_width(),
                plot + (1.0 - y.share(py)) * PLOT_HEIGHT,
            );
            let _ = write!(path, "{letter}{px:.1} {py:.1}");
        }
        if !path.is_empty() {
            let _ = writeln!(
                svg,
                "<path d=\"{path}\" fill=\"none\" stroke=\"{}\" stroke-width=\"1.4\" \
                 stroke-linejoin=\"round\"{}/>",
                self.colour,
                dash(self.dashed)
            );
        }
    }
}

fn dash(dashed: bool) -> &'static str {
    if dashed {
        " stroke-dasharray=\"6 4\""
    } else {
        ""
    }
}

/// Of more points than columns, the first, lowest, highest and last of each column.
fn thinned(points: &[(f64, f64)], x: Axis) -> Vec<(f64, f64)> {
    let finite: Vec<(f64, f64)> = (points.iter().copied())
        .filter(|p| p.0.is_finite() && p.1.is_finite())
        .collect();
    if finite.len() <= 2 * COLUMNS {
        return finite;
    }
    let column = |p: &(f64, f64)| (x.share(p.0) * COLUMNS as f64) as i64;
    let mut out = Vec::new();
    for chunk in finite.chunk_by(|a, b| column(a) == column(b)) {
        let lowest = (0..chunk.len()).min_by(|a, b| chunk[*a].1.total_cmp(&chunk[*b].1));
        let highest = (0..chunk.len()).max_by(|a, b| chunk[*a].1.total_cmp(&chunk[*b].1));
        let mut keep: Vec<usize> = [Some(0), lowest, highest, Some(chunk.len() - 1)]
            .into_iter()
            .flatten()
            .collect();
        keep.sort_unstable();
        keep.dedup();
        out.extend(keep.into_iter().map(|i| chunk[i]));
    }
    out
}

fn grid(svg: &mut String, plot: f64, x: Axis, y: Axis) {
    let (right, bottom) = (LEFT + plot_width(), plot + PLOT_HEIGHT);
    for v in x.ticks() {
        let at = LEFT + x.share(v) * plot_width();
        let _ = writeln!(
            svg,
            "<line x1=\"{at:.1}\" y1=\"{plot}\" x2=\"{at:.1}\" y2=\"{bottom}\" stroke=\"#e6e6e6\"/>"
        );
        text(svg, at, bottom + 16.0, "middle", 12, &x.number(v));
    }
    for v in y.ticks() {
        let at = plot + (1.0 - y.share(v)) * PLOT_HEIGHT;
        let _ = writeln!(
            svg,
            "<line x1=\"{LEFT}\" y1=\"{at:.1}\" x2=\"{right}\" y2=\"{at:.1}\" stroke=\"#e6e6e6\"/>"
        );
        text(svg, LEFT - 8.0, at + 4.0, "end", 12, &y.number(v));
    }
    let _ = writeln!(
        svg,
        "<rect x=\"{LEFT}\" y=\"{plot}\" width=\"{}\" height=\"{PLOT_HEIGHT}\" fill=\"none\" \
         stroke=\"#404040\"/>",
        plot_width()
    );
}

/// Marks, their labels in as many rows as it takes for them not to meet.
fn draw_marks(svg: &mut String, plot: f64, x: Axis, marks: &[Mark]) {
    let mut rows: Vec<f64> = Vec::new();
    for mark in marks.iter().filter(|m| (0.0..=1.0).contains(&x.share(m.x))) {
        let at = LEFT + x.share(mark.x) * plot_width();
        let _ = writeln!(
            svg,
            "<line x1=\"{at:.1}\" y1=\"{plot}\" x2=\"{at:.1}\" y2=\"{}\" stroke=\"#404040\" \
             stroke-dasharray=\"2 3\"/>",
            plot + PLOT_HEIGHT
        );
        let length = CHARACTER * mark.label.chars().count() as f64;
        let fits = at + 4.0 + length < LEFT + plot_width();
        let (start, anchor, from) = if fits {
            (at + 4.0, "start", at)
        } else {
            (at - 4.0, "end", at - 8.0 - length)
        };
        let row = rows
            .iter()
            .position(|end| *end < from)
            .unwrap_or(rows.len());
        if row == rows.len() {
            rows.push(0.0);
        }
        rows[row] = from + length + 10.0;
        text(
            svg,
            start,
            plot + 13.0 + 13.0 * row as f64,
            anchor,
            11,
            &mark.label,
        );
    }
}

fn text(svg: &mut String, x: f64, y: f64, anchor: &str, size: u32, words: &str) {
    let words = escape(words);
    let _ = writeln!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" font-size=\"{size}\">{words}</text>"
    );
}

/// Words as they may stand in XML.
pub fn escape(words: &str) -> String {
    words
        .replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::{Axis, BLUE, Chart, Line, Mark, Panel, thinned};

    #[test]
    fn steps_are_round_numbers() {
        for (length, step) in [(20.0, 2.0), (30.0, 5.0), (7.0, 1.0), (0.3, 0.05)] {
            let axis = Axis::over(0.0, length, 10.0);
            assert!(
                (axis.step - step).abs() < 1e-9 * step,
                "{length}: {}",
                axis.step
            );
        }
        let axis = Axis::over(0.0, 0.3, 10.0);
        assert_eq!(axis.ticks().map(|v| axis.number(v)).last().unwrap(), "0.30");
    }

    #[test]
    fn a_thinned_line_keeps_its_peaks() {
        let mut points: Vec<(f64, f64)> = (0..100_000).map(|i| (f64::from(i), 0.0)).collect();
        points[51_234].1 = 9.0;
        points[51_240].1 = -9.0;
        let few = thinned(&points, Axis::over(0.0, 100_000.0, 10.0));
        assert!(few.len() < 4000);
        assert!(few.contains(&(51_234.0, 9.0)) && few.contains(&(51_240.0, -9.0)));
    }

    #[test]
    fn nothing_to_show_and_bad_numbers_still_make_a_picture() {
        let line = Line {
            name: "a < b & c".into(),
            colour: BLUE,
            dashed: true,
            points: vec![(0.0, f64::NAN), (f64::INFINITY, 1.0)],
        };
        let chart = Chart {
            title: "t".into(),
            x_label: "x".into(),
            panels: vec![Panel {
                title: "p".into(),
                y_label: "y".into(),
                lines: vec![line],
            }],
            marks: vec![Mark {
                x: 0.5,
                label: "m".into(),
            }],
        };
        let svg = chart.to_svg();
        assert!(svg.contains("a &lt; b &amp; c") && !svg.contains("NaN") && !svg.contains("inf"));
    }
}
