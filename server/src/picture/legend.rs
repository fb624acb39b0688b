//! The legend: colours of regions, springs and cell quality.

use palpate_tissue::Model;
use palpate_tissue::cell::cell_volume;

use super::canvas::{Canvas, Letters};
use super::colour::{self, Colour, INK, INVERTED, PALE_INK, POOR};
use super::section::{self, Grade, Section};

/// Pixels.
pub(super) const WIDTH: f32 = 350.0;
const ENTRY: f32 = 52.0;
const SWATCH: f32 = 30.0;
const TEXT: f32 = 42.0;
/// Maximum named regions; more would exceed the height of a screen. Further regions are counted.
const REGIONS_MAX: usize = 16;

/// A region's lines.
struct Entry {
    colour: Colour,
    is_in_section: bool,
    name: String,
    material: String,
}

/// The legend of a section.
pub(super) struct Legend {
    entries: Vec<Entry>,
    more: usize,
    /// `None` for walls of wounds, which show no cell.
    grades: Option<[[usize; 2]; 3]>,
}

impl Legend {
    pub(super) fn of(model: &Model, section: &Section) -> Self {
        let colours = colour::of_regions(model);
        let mut volumes = vec![0.0; model.regions.len()];
        for (index, cell) in model.cells.iter().enumerate() {
            volumes[cell.region.index()] += cell_volume(&model.corners_of(index));
        }
        let mut is_cut = vec![false; model.regions.len()];
        for cell in &section.cells {
            is_cut[cell.region] = true;
        }
        let mut entries: Vec<Entry> = model
            .regions
            .iter()
            .enumerate()
            .map(|(r, region)| Entry {
                colour: colours[r],
                is_in_section: is_cut[r],
                name: region.name.clone(),
                material: format!(
                    "{}, {}, {} cm\u{b3}{}",
                    region.material.name,
                    modulus(region.material.young_pa),
                    Figures(volumes[r] * 1e6),
                    if region.pinned { ", pinned" } else { "" }
                ),
            })
            .collect();
        // Visible regions first, each group in scene order.
        entries.sort_by_key(|e| !e.is_in_section);
        let more = entries.len().saturating_sub(REGIONS_MAX);
        entries.truncate(REGIONS_MAX);
        Self {
            entries,
            more,
            grades: section.at_mm.map(|_| section.grades),
        }
    }

    /// Height in pixels.
    pub(super) fn height(&self) -> f32 {
        ENTRY * (self.entries.len() + usize::from(self.more > 0)) as f32 + 210.0
    }

    pub(super) fn draw(&self, canvas: &mut Canvas, [x, mut y]: [f32; 2], springs: bool) {
        for entry in &self.entries {
            let (ink, size) = if entry.is_in_section {
                (INK, SWATCH)
            } else {
                (PALE_INK, SWATCH * 0.4)
            };
            let inset = 0.5 * (SWATCH - size);
            canvas.rectangle([x + inset - 1.0, y + inset - 1.0], [size + 2.0; 2], INK);
            canvas.rectangle([x + inset, y + inset], [size; 2], entry.colour);
            let name = if entry.is_in_section {
                entry.name.clone()
            } else {
                format!("{} (not here)", entry.name)
            };
            line(canvas, &name, [x + TEXT, y], Letters::Bold, ink);
            line(
                canvas,
                &entry.material,
                [x + TEXT, y + 17.0],
                Letters::Small,
                PALE_INK,
            );
            y += ENTRY;
        }
        if self.more > 0 {
            let text = format!("and {} more regions", self.more);
            line(canvas, &text, [x + TEXT, y], Letters::Small, PALE_INK);
            y += ENTRY;
        }
        if let Some(grades) = &self.grades {
            y = draw_grades(canvas, grades, [x, y + 6.0]);
        }
        if springs {
            draw_springs(canvas, [x, y]);
        }
    }
}

/// Marks of poor cells with their counts. Returns the position below.
fn draw_grades(canvas: &mut Canvas, grades: &[[usize; 2]; 3], [x, mut y]: [f32; 2]) -> f32 {
    let grade = |grade: Grade| {
        let [here, all] = grades[grade as usize];
        format!("{here} here, {all} in the model")
    };
    let poor = format!("poor: scaled Jacobian < {}", section::POOR);
    for (with, what, count) in [
        (POOR, poor.as_str(), grade(Grade::Poor)),
        (
            INVERTED,
            "inverted, wholly or at a corner",
            grade(Grade::Inverted),
        ),
    ] {
        canvas.rectangle([x, y], [SWATCH; 2], with);
        line(canvas, what, [x + TEXT, y], Letters::Small, INK);
        line(
            canvas,
            &count,
            [x + TEXT, y + 15.0],
            Letters::Small,
            PALE_INK,
        );
        y += ENTRY - 8.0;
    }
    y
}

fn draw_springs(canvas: &mut Canvas, [x, mut y]: [f32; 2]) {
    for (width, opacity, what) in [
        (1.6, 0.7, "structural springs"),
        (1.0, 0.35, "shear springs"),
    ] {
        let middle = y + 0.5 * Letters::Small.height();
        let stroke = [[x, middle], [x + SWATCH, middle]];
        canvas.lines([stroke], width, INK, opacity);
        line(canvas, what, [x + TEXT, y], Letters::Small, INK);
        y += 18.0;
    }
    let layer = "of the layer nearest to the slice";
    line(canvas, layer, [x + TEXT, y], Letters::Small, PALE_INK);
}

/// A line of text, truncated to the legend's width.
fn line(canvas: &mut Canvas, text: &str, at: [f32; 2], letters: Letters, with: Colour) {
    let most = ((WIDTH - TEXT) / letters.width()) as usize;
    if text.chars().count() <= most {
        canvas.text(text, at, letters, with);
    } else {
        let kept: String = text.chars().take(most - 2).collect();
        canvas.text(&format!("{kept}.."), at, letters, with);
    }
}

fn modulus(pa: f64) -> String {
    let (value, unit) = match pa {
        pa if pa >= 1e9 => (pa / 1e9, "GPa"),
        pa if pa >= 1e6 => (pa / 1e6, "MPa"),
        pa if pa >= 1e3 => (pa / 1e3, "kPa"),
        pa => (pa, "Pa"),
    };
    format!("{} {unit}", Figures(value))
}

/// A number with three significant digits, or with all digits before the point.
pub(super) struct Figures(pub(super) f64);

impl std::fmt::Display for Figures {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let digits = match self.0.abs() {
            v if v >= 100.0 => 0,
            v if v >= 10.0 => 1,
            v if v >= 1.0 => 2,
            _ => 3,
        };
        let text = format!("{:.digits$}", self.0);
        if digits == 0 {
            return f.write_str(&text);
        }
        f.write_str(text.trim_end_matches('0').trim_end_matches('.'))
    }
}
