//! Line charts as SVG text.
//!
//! A chart is a stack of panels with a common x axis. Each panel has a title, a y axis with a unit, a legend
//! above the plot, and labelled vertical marks. A line with more points than the plot has columns is drawn as
//! its range per column.

use maud::{Markup, html};

const WIDTH: f64 = 960.0;
const PLOT_WIDTH: f64 = WIDTH - LEFT - RIGHT;
const PLOT_HEIGHT: f64 = 190.0;
const HEAD: f64 = 46.0;
/// Height of a row of the legend, px; [`HEAD`] has room for one.
const LEGEND_ROW: f64 = 16.0;
const FOOT: f64 = 24.0;
const LEFT: f64 = 74.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 36.0;
const BOTTOM: f64 = 30.0;
/// Columns of the plot for thinning of a line.
const COLUMNS: usize = 800;
/// Margin at an end of the y axis, as a share of its length.
const MARGIN: f64 = 0.08;
/// A panel with all values below this is all zero.
const NOTHING: f64 = 1e-9;
/// Decades up to which a logarithmic axis has labels at 2 and 5.
const DECADES_CLOSE: f64 = 4.0;
/// Estimated width of a legend character, px.
const CHARACTER: f64 = 6.6;

/// Blue of the colour-blind safe palette of Okabe and Ito (2008).
pub const BLUE: &str = "#0072b2";
pub const ORANGE: &str = "#d55e00";
pub const GREY: &str = "#808080";
pub const GREEN: &str = "#009e73";
pub const PURPLE: &str = "#cc79a7";
pub const SKY: &str = "#56b4e9";
pub const AMBER: &str = "#e69f00";
pub const BLACK: &str = "#000000";

#[derive(Debug, Clone)]
pub struct Line {
    /// Legend entry; empty if another line has it.
    pub name: String,
    /// x and y, x not decreasing.
    pub points: Vec<(f64, f64)>,
    colour: &'static str,
    dashed: bool,
    dotted: bool,
}

#[derive(Debug, Clone)]
pub struct Panel {
    title: String,
    y_label: String,
    /// The lines, later ones on top.
    lines: Vec<Line>,
    scale: Scale,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Scale {
    #[default]
    Linear,
    /// Logarithmic, for positive values over several decades. Other values are left out.
    Logarithmic,
}

#[derive(Debug, Clone)]
pub struct Mark {
    pub x: f64,
    pub label: String,
}

#[derive(Debug, Clone)]
pub struct Chart {
    title: String,
    x_label: String,
    panels: Vec<Panel>,
    marks: Vec<Mark>,
}

#[derive(Debug, Clone, Copy)]
struct Axis {
    from: f64,
    until: f64,
    /// Distance of two ticks; unused on a logarithmic axis.
    step: f64,
    scale: Scale,
}

impl Axis {
    /// An axis over a range, with steps of 1, 2 or 5 times a power of ten.
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
            scale: Scale::Linear,
        }
    }

    /// An axis that contains these values and zero, with a margin.
    fn of_heights(values: impl Iterator<Item = f64>, scale: Scale) -> Self {
        if scale == Scale::Logarithmic {
            let (low, high) = range(values.filter(|v| *v > 0.0));
            let low = if low > 0.0 { low } else { 0.1 };
            let room = (high / low).max(2.0).powf(MARGIN);
            return Self {
                from: low / room,
                until: high * room,
                step: 1.0,
                scale,
            };
        }
        let (low, high) = range(values);
        let (low, high) = (low.min(0.0), high.max(0.0));
        if high - low < NOTHING {
            return Self::over(0.0, 1.0, 5.0);
        }
        let room = MARGIN * (high - low);
        let below = if low < 0.0 { low - room } else { 0.0 };
        let above = if high > 0.0 { high + room } else { 0.0 };
        Self::over(below, above, 5.0)
    }

    fn share(&self, v: f64) -> f64 {
        match self.scale {
            Scale::Linear => (v - self.from) / (self.until - self.from),
            Scale::Logarithmic => (v / self.from).ln() / (self.until / self.from).ln(),
        }
    }

    fn ticks(&self) -> Vec<f64> {
        let (from, until) = (self.from, self.until);
        match self.scale {
            Scale::Linear => {
                let first = (from / self.step).ceil() as i64;
                let last = (until / self.step + 1e-9).floor() as i64;
                (first..=last).map(|i| i as f64 * self.step).collect()
            }
            Scale::Logarithmic => {
                let factors: &[f64] = if (until / from).log10() <= DECADES_CLOSE {
                    &[1.0, 2.0, 5.0]
                } else {
                    &[1.0]
                };
                let decades = from.log10().floor() as i32..=until.log10().ceil() as i32;
                decades
                    .flat_map(|d| factors.iter().map(move |f| f * 10f64.powi(d)))
                    .filter(|v| (from..=until).contains(v))
                    .collect()
            }
        }
    }

    fn number(&self, v: f64) -> String {
        let step = match self.scale {
            Scale::Linear => self.step,
            Scale::Logarithmic => v * (1.0 + 1e-9),
        };
        let digits = (-step.log10().floor()).max(0.0) as usize;
        format!("{v:.digits$}")
    }
}

impl Chart {
    pub fn new(title: impl Into<String>, x_label: &str, panels: Vec<Panel>) -> Self {
        Self {
            title: title.into(),
            x_label: x_label.to_owned(),
            panels,
            marks: Vec::new(),
        }
    }

    #[must_use]
    pub fn with_marks(mut self, marks: Vec<Mark>) -> Self {
        self.marks = marks;
        self
    }

    pub fn to_svg(&self) -> String {
        let panels: f64 = self.panels.iter().map(Panel::height).sum();
        let height = TOP + panels + BOTTOM;
        let lines = self.panels.iter().flat_map(|p| &p.lines);
        let (low, high) = range(lines.flat_map(|l| &l.points).map(|p| p.0));
        let x = Axis::over(low, high, 10.0);
        let mut top = TOP;
        let panels = self.panels.iter().map(|panel| {
            let drawn = panel.draw(top, x, &self.marks);
            top += panel.height();
            drawn
        });
        let drawn = html! {
            svg xmlns="http://www.w3.org/2000/svg" viewBox=(format_args!("0 0 {WIDTH} {height}"))
                width=(WIDTH) height=(height) font-family="sans-serif" font-size="12" {
                rect width="100%" height="100%" fill="white" {}
                (text(WIDTH / 2.0, 22.0, "middle", 16, &self.title))
                @for panel in panels { (panel) "\n" }
                (text(LEFT + PLOT_WIDTH / 2.0, height - 10.0, "middle", 13, &self.x_label))
            }
        };
        drawn.into_string() + "\n"
    }
}

/// Minimum and maximum; 0 and 1 without values.
fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
            (l.min(v), h.max(v))
        });
    if low <= high { (low, high) } else { (0.0, 1.0) }
}

impl Panel {
    /// A linear plot; `y_label` is the quantity and unit of y.
    pub fn new(
        title: impl Into<String>,
        y_label: &str,
        lines: impl IntoIterator<Item = Line>,
    ) -> Self {
        Self {
            title: title.into(),
            y_label: y_label.to_owned(),
            lines: lines.into_iter().collect(),
            scale: Scale::Linear,
        }
    }

    /// The plot with a logarithmic scale, for values over several decades.
    #[must_use]
    pub fn logarithmic(mut self) -> Self {
        self.scale = Scale::Logarithmic;
        self
    }

    fn draw(&self, top: f64, x: Axis, marks: &[Mark]) -> Markup {
        let plot = top + self.head();
        let heights = self.lines.iter().flat_map(|l| &l.points).map(|p| p.1);
        let y = Axis::of_heights(heights, self.scale);
        let centre = plot + PLOT_HEIGHT / 2.0;
        html! {
            (text(LEFT, top + 16.0, "start", 13, &self.title))
            (self.legend(top + 36.0))
            (grid(plot, x, y))
            text x="18" y=(centre) text-anchor="middle" transform=(format_args!("rotate(-90 18 {centre})")) {
                (self.y_label)
            }
            @for line in &self.lines { (line.draw(plot, x, y)) }
            (draw_marks(plot, x, marks))
        }
    }

    /// Height above the plot, px.
    fn head(&self) -> f64 {
        let rows = self.entries().last().map_or(0, |(row, ..)| *row);
        HEAD + LEGEND_ROW * rows as f64
    }

    fn height(&self) -> f64 {
        self.head() + PLOT_HEIGHT + FOOT
    }

    /// Legend entries, each with its row and its position in it, px.
    fn entries(&self) -> Vec<(usize, f64, &Line)> {
        let (mut row, mut at) = (0, LEFT);
        let mut entries = Vec::new();
        for line in self.lines.iter().filter(|l| l.is_named()) {
            let width = 28.0 + CHARACTER * line.name.chars().count() as f64;
            if at > LEFT && at + width > WIDTH - RIGHT {
                (row, at) = (row + 1, LEFT);
            }
            entries.push((row, at, line));
            at += width + 22.0;
        }
        entries
    }

    fn legend(&self, first: f64) -> Markup {
        html! {
            @for (row, at, line) in self.entries() {
                @let y = first + LEGEND_ROW * row as f64;
                @if line.dotted {
                    circle cx=(px(at + 11.0)) cy=(px(y - 4.0)) r="2.6" fill="none" stroke=(line.colour) stroke-width="1.2" {}
                } @else {
                    line x1=(at) y1=(y - 4.0) x2=(at + 22.0) y2=(y - 4.0)
                        stroke=(line.colour) stroke-width="2" stroke-dasharray=[line.dashes()] {}
                }
                (text(at + 28.0, y, "start", 12, &line.name))
            }
        }
    }
}

impl Line {
    /// A solid line through points with x not decreasing.
    pub fn new(
        name: impl Into<String>,
        colour: &'static str,
        points: impl IntoIterator<Item = (f64, f64)>,
    ) -> Self {
        Self {
            name: name.into(),
            points: points.into_iter().collect(),
            colour,
            dashed: false,
            dotted: false,
        }
    }

    /// Dots instead of a line, for measurements that no line connects.
    #[must_use]
    pub fn dots(mut self) -> Self {
        self.dotted = true;
        self
    }

    #[must_use]
    pub fn dashed(mut self, dashed: bool) -> Self {
        self.dashed = dashed;
        self
    }

    pub fn is_dashed(&self) -> bool {
        self.dashed
    }

    fn dashes(&self) -> Option<&'static str> {
        self.dashed.then_some("6 4")
    }

    /// Whether the legend lists it: it has a name and a visible point.
    fn is_named(&self) -> bool {
        !self.name.is_empty() && !self.points.is_empty()
    }

    fn draw(&self, plot: f64, x: Axis, y: Axis) -> Markup {
        let places: Vec<(f64, f64)> = (thinned(&self.points, x).into_iter())
            .map(|(px, py)| (x.share(px), y.share(py)))
            .filter(|(_, up)| up.is_finite())
            .map(|(along, up)| (LEFT + along * PLOT_WIDTH, plot + (1.0 - up) * PLOT_HEIGHT))
            .collect();
        if self.dotted {
            return html! {
                @for (at, up) in places {
                    circle cx=(px(at)) cy=(px(up)) r="2.6" fill="none" stroke=(self.colour) stroke-width="1.2" {}
                }
            };
        }
        let points: Vec<String> = (places.iter())
            .map(|(px, py)| format!("{px:.1} {py:.1}"))
            .collect();
        html! {
            @if !points.is_empty() {
                path d=(format_args!("M{}", points.join("L"))) fill="none" stroke=(self.colour) stroke-width="1.4"
                    stroke-linejoin="round" stroke-dasharray=[self.dashes()] {}
            }
        }
    }
}

/// Thins more points than columns to the first, lowest, highest and last of each column.
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

fn grid(plot: f64, x: Axis, y: Axis) -> Markup {
    let (right, bottom) = (LEFT + PLOT_WIDTH, plot + PLOT_HEIGHT);
    html! {
        @for v in x.ticks() {
            @let at = LEFT + x.share(v) * PLOT_WIDTH;
            line x1=(px(at)) y1=(plot) x2=(px(at)) y2=(bottom) stroke="#e6e6e6" {}
            (text(at, bottom + 16.0, "middle", 12, &x.number(v)))
        }
        @for v in y.ticks() {
            @let at = plot + (1.0 - y.share(v)) * PLOT_HEIGHT;
            line x1=(LEFT) y1=(px(at)) x2=(right) y2=(px(at)) stroke="#e6e6e6" {}
            (text(LEFT - 8.0, at + 4.0, "end", 12, &y.number(v)))
        }
        rect x=(LEFT) y=(plot) width=(PLOT_WIDTH) height=(PLOT_HEIGHT) fill="none" stroke="#404040" {}
    }
}

/// Draws marks, with labels in as many rows as needed to avoid overlap.
fn draw_marks(plot: f64, x: Axis, marks: &[Mark]) -> Markup {
    let mut row_ends: Vec<f64> = Vec::new();
    let mut drawn = Vec::new();
    for mark in marks.iter().filter(|m| (0.0..=1.0).contains(&x.share(m.x))) {
        let at = LEFT + x.share(mark.x) * PLOT_WIDTH;
        let length = CHARACTER * mark.label.chars().count() as f64;
        let fits = at + 4.0 + length < LEFT + PLOT_WIDTH;
        let (start, anchor, from) = if fits {
            (at + 4.0, "start", at)
        } else {
            (at - 4.0, "end", at - 8.0 - length)
        };
        let free = row_ends.iter().position(|end| *end < from);
        let row = free.unwrap_or(row_ends.len());
        row_ends.resize(row_ends.len().max(row + 1), 0.0);
        row_ends[row] = from + length + 10.0;
        let y = plot + 13.0 + 13.0 * row as f64;
        drawn.push(html! {
            line x1=(px(at)) y1=(plot) x2=(px(at)) y2=(plot + PLOT_HEIGHT) stroke="#404040" stroke-dasharray="2 3" {}
            (text(start, y, anchor, 11, &mark.label))
        });
    }
    html! { @for mark in drawn { (mark) } }
}

fn text(x: f64, y: f64, anchor: &str, size: u32, words: &str) -> Markup {
    html! { text x=(px(x)) y=(px(y)) text-anchor=(anchor) font-size=(size) { (words) } }
}

fn px(length: f64) -> String {
    format!("{length:.1}")
}

#[cfg(test)]
mod tests {
    use super::{Axis, BLUE, Chart, HEAD, LEGEND_ROW, Line, Mark, Panel, Scale, thinned};

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
        assert_eq!(axis.number(*axis.ticks().last().unwrap()), "0.30");
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

    fn line(name: &str, points: Vec<(f64, f64)>) -> Line {
        Line::new(name, BLUE, points).dashed(true)
    }

    fn chart(lines: Vec<Line>, scale: Scale) -> Chart {
        let panel = Panel {
            scale,
            ..Panel::new("p", "y", lines)
        };
        let label = "m".into();
        Chart::new("t", "x", vec![panel]).with_marks(vec![Mark { x: 0.5, label }])
    }

    #[test]
    fn empty_and_non_finite_data_still_give_a_chart() {
        for scale in [Scale::Linear, Scale::Logarithmic] {
            for points in [
                vec![(0.0, f64::NAN), (f64::INFINITY, 1.0)],
                vec![(0.0, 0.0), (1.0, 0.0)],
                vec![(0.0, -1.0), (1.0, -2.0)],
                vec![(0.0, 1.0)],
                vec![],
            ] {
                let lines = vec![line("a < b & c", points), line("", vec![(0.0, 0.0)])];
                let svg = chart(lines, scale).to_svg();
                assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
            }
        }
        let svg = chart(vec![line("a < b & c", vec![(0.0, 1.0)])], Scale::Linear).to_svg();
        assert!(svg.contains("a &lt; b &amp; c"));
    }

    #[test]
    fn lines_lie_within_the_axis_with_a_margin() {
        for heights in [[-5.0, -1.0], [-1.0, 3.0], [2.0, 2.0], [0.0, 4e-4]] {
            let y = Axis::of_heights(heights.into_iter(), Scale::Linear);
            let shares = heights.map(|v| y.share(v));
            assert!(
                shares.iter().all(|s| (0.0..0.95).contains(s)),
                "{heights:?}: {shares:?}"
            );
            assert!(y.share(0.0) >= 0.0 && y.share(0.0) <= 1.0);
        }
    }

    #[test]
    fn logarithmic_axis_has_equal_decades_and_round_labels() {
        let y = Axis::of_heights([0.003, 5.0].into_iter(), Scale::Logarithmic);
        let decade = y.share(1.0) - y.share(0.1);
        assert!((decade - (y.share(0.1) - y.share(0.01))).abs() < 1e-9);
        let numbers: Vec<String> = y.ticks().into_iter().map(|v| y.number(v)).collect();
        assert_eq!(
            numbers,
            [
                "0.002", "0.005", "0.01", "0.02", "0.05", "0.1", "0.2", "0.5", "1", "2", "5"
            ]
        );
    }

    #[test]
    fn long_legend_wraps_into_rows() {
        let lines =
            (0..6).map(|k| line(&format!("{k} and a long name of a line"), vec![(0.0, 1.0)]));
        let panel = chart(lines.collect(), Scale::Linear).panels.remove(0);
        let rows: Vec<usize> = panel.entries().iter().map(|e| e.0).collect();
        assert_eq!(rows, [0, 0, 0, 1, 1, 1]);
        assert!((panel.head() - HEAD - LEGEND_ROW).abs() < 1e-9);
    }

    #[test]
    fn dots_are_not_connected() {
        let points = vec![(0.0, 1.0), (1.0, 2.0), (2.0, 1.5)];
        let svg = chart(vec![Line::new("dots", BLUE, points).dots()], Scale::Linear).to_svg();
        // Three points and the legend.
        assert_eq!(svg.matches("<circle").count(), 4);
        assert!(!svg.contains("<path"));
    }

    #[test]
    fn legend_omits_lines_without_points() {
        let lines = vec![line("drawn", vec![(0.0, 1.0)]), line("absent", vec![])];
        let svg = chart(lines, Scale::Linear).to_svg();
        assert!(svg.contains("drawn") && !svg.contains("absent"));
    }
}
