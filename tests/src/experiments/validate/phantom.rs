//! A compressed silicone cube with beads, measured by computed tomography: the Truth Cube (Kerdok et al. 2003, Medical
//! Image Analysis 7, 283-291).
//!
//! Beads lie in a lattice of 7 x 7 x 7, 10 mm apart, in a cube of 80 mm. Their positions without load and at three
//! compressions were published on the project page of the Truth Cube; the file is `uniaxial_positions.csv` in
//! `OpenSurgSim` (Apache 2.0).
//!
//! The tissue is the part between the outermost layers of beads. Nodes in these two layers move as measured, so travel
//! and friction of the plates are not needed, and Young's modulus has no influence. The displacements of the five
//! layers between are predicted: down, which the plates govern, and sideways, which Poisson's ratio and the free sides
//! govern.
//!
//! Silicone is incompressible. The largest Poisson's ratio of the tissue is 0.49, so two ratios are extrapolated to 0.5.

use palpate_tissue::{Vec3, block};
use serde_json::{Value, json};

use super::specimen::{Specimen, material};
use crate::chart::{BLUE, Chart, GREEN, GREY, Line, ORANGE, Panel};
use crate::experiments::table::Column;

const SIDE_M: f64 = 80e-3;
/// Cells between the outermost layers; with 18 no displacement changes by more than 0.02 mm.
const CELLS: usize = 12;
/// The upper end of the range, and a ratio near it. Displacements are linear in it there.
const POISSON: [f64; 2] = [0.49, 0.48];
const INCOMPRESSIBLE: f64 = 0.5;
const LAYERS: usize = 7;
const INNER: usize = LAYERS - 2;
/// Heights of the layers over the first one in mm.
const HEIGHT_MM: [f64; LAYERS] = [0.0, 9.21, 19.19, 29.36, 39.33, 49.63, 59.57];
/// Distance from the axis of the outermost beads of the middle rows, for each layer in mm.
const OUTER_MM: [f64; LAYERS] = [31.46, 30.45, 30.75, 30.59, 30.32, 30.26, 30.03];
/// The same for the beads before them, in the first and the last layer.
const BESIDE_MM: [f64; 2] = [21.46, 20.12];
/// Mean square distance in mm² from the axis: of the nine beads next to it, and of the outer ones in the middle rows.
const SQUARES_MM2: [f64; 2] = [400.0 / 3.0, 900.0 + 200.0 / 3.0];
/// Standard deviations up to which a root mean square deviation is within the scatter.
const SCATTERS: f64 = 2.0;

/// Measured displacements of an outermost layer in mm.
struct End {
    /// Away from the axis, of the beads at [`BESIDE_MM`] and [`OUTER_MM`].
    sideways: [f64; 2],
    /// Down: means of the nine beads next to the axis and of the outer ones in the middle rows.
    down: [f64; 2],
}

/// A compressed cube. Displacements in mm are means: down over the nine beads next to the axis, sideways over half the
/// widening of the three middle rows.
struct State {
    name: &'static str,
    ends: [End; 2],
    down: [f64; INNER],
    sideways: [f64; INNER],
    /// Standard deviations of those nine beads and of those three rows, pooled over all layers.
    scatter: [f64; 2],
}

const STATES: [State; 3] = [
    State {
        name: "5 %",
        ends: [
            End {
                sideways: [0.397, 0.713],
                down: [0.208, 0.365],
            },
            End {
                sideways: [0.708, 1.163],
                down: [4.273, 4.368],
            },
        ],
        down: [0.640, 1.358, 2.067, 2.820, 3.586],
        sideways: [1.087, 1.155, 1.222, 1.133, 1.135],
        scatter: [0.107, 0.052],
    },
    State {
        name: "12.5 %",
        ends: [
            End {
                sideways: [1.055, 1.715],
                down: [0.697, 1.025],
            },
            End {
                sideways: [1.488, 2.355],
                down: [10.142, 10.127],
            },
        ],
        down: [1.768, 3.313, 5.110, 6.813, 8.590],
        sideways: [2.557, 2.998, 3.010, 2.932, 2.682],
        scatter: [0.136, 0.054],
    },
    State {
        name: "18.25 %",
        ends: [
            End {
                sideways: [1.625, 2.758],
                down: [1.141, 1.588],
            },
            End {
                sideways: [2.168, 3.405],
                down: [15.011, 14.957],
            },
        ],
        down: [2.737, 5.077, 7.688, 10.346, 12.896],
        sideways: [4.065, 4.797, 4.870, 4.720, 4.302],
        scatter: [0.151, 0.086],
    },
];

/// Displacements of the inner layers in mm, down and sideways, for each state.
type Predicted = [[[f64; INNER]; 2]; 3];

impl State {
    fn measured(&self) -> [[f64; INNER]; 2] {
        [self.down, self.sideways]
    }

    /// Displacement in m of the first (0) or the last (1) layer at a place in m from the axis: odd cubic polynomials
    /// sideways and a quadratic one down, which have the measured values at the beads.
    fn end(&self, end: usize, x: f64, y: f64) -> Vec3 {
        let measured = &self.ends[end];
        let radii = [BESIDE_MM[end], OUTER_MM[end * (LAYERS - 1)]];
        let slopes = [0, 1].map(|i| measured.sideways[i] / radii[i]);
        let cubic = (slopes[1] - slopes[0]) / (radii[1] * radii[1] - radii[0] * radii[0]);
        let linear = slopes[0] - cubic * radii[0] * radii[0];
        let sideways = |along_mm: f64| along_mm * (linear + cubic * along_mm * along_mm);
        let [inside, outside] = measured.down;
        let square = (outside - inside) / (SQUARES_MM2[1] - SQUARES_MM2[0]);
        let [x, y] = [1e3 * x, 1e3 * y];
        let down = inside + square * (x * x + y * y - SQUARES_MM2[0]);
        Vec3::new(sideways(x), sideways(y), -down) * 1e-3
    }
}

/// Displacement in m at a place of the block, linear in each direction within a cell.
fn displacement(specimen: &Specimen, wide: usize, at: Vec3) -> Vec3 {
    let of_cells = at / specimen.spacing_m();
    let most = [wide, wide, CELLS];
    let low: [usize; 3] = std::array::from_fn(|a| (of_cells[a] as usize).min(most[a] - 1));
    let share = Vec3::from_fn(|a, _| of_cells[a] - low[a] as f64);
    let corner = |c: usize| {
        let on = [c & 1, c >> 1 & 1, c >> 2];
        let weights = (0..3).map(|a| if on[a] == 1 { share[a] } else { 1.0 - share[a] });
        let [i, j, k] = std::array::from_fn(|a| low[a] + on[a]);
        let node = i + (wide + 1) * (j + (wide + 1) * k);
        specimen.displacement(node as u32) * weights.product::<f64>()
    };
    (0..8).map(corner).sum()
}

fn predicted(poisson: f64) -> Result<Predicted, String> {
    let height_m = 1e-3 * HEIGHT_MM[LAYERS - 1];
    let spacing_m = height_m / CELLS as f64;
    let wide = 2 * (SIDE_M / spacing_m / 2.0).round() as usize;
    let model = block([wide, wide, CELLS], spacing_m, &material(poisson), 0);
    let mut specimen = Specimen::new(model);
    let axis_m = wide as f64 * spacing_m / 2.0;
    let mut all = [[[0.0; INNER]; 2]; 3];
    for (state, found) in STATES.iter().zip(&mut all) {
        specimen.hold(|_, at| {
            let is_first = at.z < 0.25 * spacing_m;
            let is_last = at.z > height_m - 0.25 * spacing_m;
            let end = usize::from(is_last);
            (is_first || is_last).then(|| state.end(end, at.x - axis_m, at.y - axis_m))
        })?;
        specimen.solve(&[]);
        if !specimen.is_converged() {
            let residual = specimen.tissue.report().residual;
            return Err(format!(
                "phantom at {}: residual {residual:.1e}",
                state.name
            ));
        }
        for layer in 1..=INNER {
            let of_place = |x_mm: f64, y_mm: f64| {
                let at = Vec3::new(x_mm, y_mm, HEIGHT_MM[layer]) * 1e-3;
                1e3 * displacement(&specimen, wide, at + Vec3::new(axis_m, axis_m, 0.0))
            };
            let rows = [-10.0, 0.0, 10.0];
            let places = rows.iter().flat_map(|&x| rows.map(|y| of_place(x, y).z));
            found[0][layer - 1] = -places.sum::<f64>() / 9.0;
            let beads = rows.map(|y| of_place(OUTER_MM[layer], y).x);
            found[1][layer - 1] = beads.iter().sum::<f64>() / 3.0;
        }
    }
    Ok(all)
}

/// Predictions beside the measurement.
pub(super) struct Comparison {
    /// A row per state, direction and Poisson's ratio.
    pub(super) rows: Vec<Value>,
    pub(super) chart: Chart,
    /// Rows of the incompressible limit that are outside of the scatter.
    pub(super) missed: Vec<String>,
}

pub(super) const COLUMNS: [Column; 8] = [
    ("nominal compression", "compression", 1.0),
    ("displacement", "displacement", 1.0),
    ("Poisson's ratio", "poisson", 1.0),
    ("deviation, rms (mm)", "rms_mm", 1.0),
    ("largest (mm)", "largest_mm", 1.0),
    ("of the largest displacement (%)", "largest_percent", 1.0),
    ("scatter (mm)", "scatter_mm", 1.0),
    ("within the scatter", "ok", 1.0),
];

const DIRECTIONS: [&str; 2] = ["down, near the axis", "sideways, 30 mm from it"];

fn row(state: usize, direction: usize, poisson: f64, found: &Predicted) -> Value {
    let [found, measured] = [found[state], STATES[state].measured()].map(|both| both[direction]);
    let deviations: [f64; INNER] = std::array::from_fn(|i| found[i] - measured[i]);
    let rms = (deviations.iter().map(|d| d * d).sum::<f64>() / INNER as f64).sqrt();
    let largest = |numbers: &[f64]| numbers.iter().fold(0.0_f64, |most, n| most.max(n.abs()));
    let scatter = STATES[state].scatter[direction];
    json!({
        "compression": STATES[state].name,
        "displacement": DIRECTIONS[direction],
        "poisson": poisson,
        "rms_mm": rms,
        "largest_mm": largest(&deviations),
        "largest_percent": 100.0 * largest(&deviations) / largest(&measured),
        "scatter_mm": scatter,
        "ok": rms <= SCATTERS * scatter,
    })
}

pub(super) fn compressed() -> Result<Comparison, String> {
    let [found, near] = [predicted(POISSON[0])?, predicted(POISSON[1])?];
    let further = (INCOMPRESSIBLE - POISSON[0]) / (POISSON[0] - POISSON[1]);
    let mut limit = found;
    for (limit, near) in limit.as_flattened_mut().iter_mut().zip(near.as_flattened()) {
        for (limit, near) in limit.iter_mut().zip(near) {
            *limit += further * (*limit - near);
        }
    }
    let mut rows = Vec::new();
    for (poisson, found) in [(POISSON[0], &found), (INCOMPRESSIBLE, &limit)] {
        for state in 0..STATES.len() {
            rows.extend([0, 1].map(|direction| row(state, direction, poisson, found)));
        }
    }
    let missed = rows.iter().filter(|row| {
        row["poisson"].as_f64() == Some(INCOMPRESSIBLE) && row["ok"].as_bool() == Some(false)
    });
    let missed = missed.map(|row| {
        let text = |key: &str| row[key].as_str().unwrap_or_default().to_owned();
        let number = |key: &str| row[key].as_f64().unwrap_or(f64::NAN);
        format!(
            "phantom at {}, {}: deviation of {:.2} mm (rms), scatter {:.2} mm",
            text("compression"),
            text("displacement"),
            number("rms_mm"),
            number("scatter_mm")
        )
    });
    Ok(Comparison {
        missed: missed.collect(),
        chart: chart(&found, &limit),
        rows,
    })
}

fn chart(found: &Predicted, limit: &Predicted) -> Chart {
    let panel = |direction: usize| {
        let lines = (0..STATES.len()).flat_map(|i| {
            let state = &STATES[i];
            let over =
                |values: [[f64; INNER]; 2]| HEIGHT_MM[1..].iter().copied().zip(values[direction]);
            let colour = [BLUE, ORANGE, GREEN][i];
            let [name, name_of_limit] = [POISSON[0], INCOMPRESSIBLE]
                .map(|ratio| format!("tissue at {}, Poisson's ratio {ratio}", state.name));
            [
                Line::new(name, colour, over(found[i])),
                Line::new(name_of_limit, colour, over(limit[i])).dashed(true),
                Line::new(
                    if i == 0 { "measured" } else { "" },
                    GREY,
                    over(state.measured()),
                )
                .dots(),
            ]
        });
        Panel::new(DIRECTIONS[direction], "displacement (mm)", lines)
    };
    Chart::new(
        "Displacements of beads in a compressed silicone cube",
        "height over the first layer (mm)",
        [0, 1].map(panel).into(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outermost_layers_have_the_measured_displacements() {
        for state in &STATES {
            for (end, radius) in [(0, OUTER_MM[0]), (1, OUTER_MM[LAYERS - 1])] {
                let outer = 1e3 * state.end(end, 1e-3 * radius, 0.0);
                let beside = 1e3 * state.end(end, 1e-3 * BESIDE_MM[end], 0.0);
                let measured = &state.ends[end];
                assert!((beside.x - measured.sideways[0]).abs() < 1e-9);
                assert!((outer.x - measured.sideways[1]).abs() < 1e-9);
                let rows = [-10e-3, 0.0, 10e-3];
                let down = |x: &[f64]| {
                    let all = x
                        .iter()
                        .flat_map(|&x| rows.map(|y| -1e3 * state.end(end, x, y).z));
                    let all: Vec<f64> = all.collect();
                    all.iter().sum::<f64>() / all.len() as f64
                };
                assert!((down(&rows) - measured.down[0]).abs() < 1e-9);
                assert!((down(&[-30e-3, 30e-3]) - measured.down[1]).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn springs_alone_do_not_bulge_as_the_phantom() {
        let found = predicted(0.25).unwrap();
        let row = row(2, 1, 0.25, &found);
        assert!(row["largest_percent"].as_f64().unwrap() > 50.0, "{row}");
    }
}
