//! The cross-section of a model with a plane normal to an axis.

use std::collections::BTreeSet;

use palpate_tissue::cell::{FACES, NO_CELL, cell_volume, scaled_jacobian};
use palpate_tissue::{Model, Vec3};

use super::Slice;

pub(super) const MM: f64 = 1e3;

/// Scaled Jacobian below which a cell is marked as poor: its edge springs hardly resist a change of its diagonals.
pub(super) const POOR: f64 = 0.2;

/// A point of the section in mm: right and up.
pub(super) type Point = [f64; 2];

/// Quality of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Grade {
    Good,
    /// Scaled Jacobian below [`POOR`].
    Poor,
    /// Inverted at a corner or as a whole.
    Inverted,
}

/// A cell in the section.
#[derive(Debug, Clone)]
pub(super) struct CellCut {
    pub(super) region: usize,
    pub(super) grade: Grade,
    /// Convex pieces that fill it.
    pub(super) pieces: Vec<Vec<Point>>,
    /// Its outline. The flag marks lines that border another region. Faces normal to the axis have a line only if
    /// they are such a border.
    pub(super) outline: Vec<([Point; 2], bool)>,
}

/// A cross-section of a model.
#[derive(Debug, Clone)]
pub(super) struct Section {
    /// The axis normal to the section.
    pub(super) axis: usize,
    /// Position on the axis, in mm; `None` for walls of wounds, seen along the axis.
    pub(super) at_mm: Option<f64>,
    pub(super) cells: Vec<CellCut>,
    /// Edges of cells in the layer nearest to the plane.
    pub(super) structural: Vec<[Point; 2]>,
    /// Their face diagonals.
    pub(super) shear: Vec<[Point; 2]>,
    /// Outlines of the model behind walls.
    pub(super) context: Vec<[Point; 2]>,
    /// Lower and upper corner of the section in mm.
    pub(super) bounds: [Point; 2],
    /// Cells of each grade in the section, and in the model.
    pub(super) grades: [[usize; 2]; 3],
}

impl Section {
    /// Cuts through a model. The error for a miss contains the extent of the model.
    pub(super) fn through(model: &Model, slice: Slice) -> Result<Self, String> {
        let axis = slice.axis;
        let along = || model.nodes.iter().map(|p| p[axis] * MM);
        let (low, high) = (
            along().fold(f64::INFINITY, f64::min),
            along().fold(f64::NEG_INFINITY, f64::max),
        );
        let at_mm = slice.at_mm.unwrap_or(0.5 * (low + high));
        let name = ["x", "y", "z"][axis];
        let misses = format!(
            "the slice {name} = {at_mm} mm meets no cell; the model spans {name} = {low:.1} to \
             {high:.1} mm"
        );
        if !(low..=high).contains(&at_mm) {
            return Err(misses);
        }
        // A plane on the boundary of the model cuts only cells on its inner side.
        let inset = (high - low) * 1e-9;
        let at = at_mm.clamp(low + inset, high - inset) / MM;
        let mut section = Self {
            axis,
            at_mm: Some(at_mm),
            cells: Vec::new(),
            structural: Vec::new(),
            shear: Vec::new(),
            context: Vec::new(),
            bounds: [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]],
            grades: [[0; 2]; 3],
        };
        let mut springs = [BTreeSet::new(), BTreeSet::new()];
        for index in 0..model.cells.len() {
            section.add_cell(model, index, at, &mut springs);
        }
        if section.cells.is_empty() {
            return Err(misses);
        }
        let lines = |pairs: &BTreeSet<[u32; 2]>| {
            let place = |n: u32| flat(axis, model.nodes[n as usize]);
            pairs.iter().map(|p| p.map(place)).collect()
        };
        section.structural = lines(&springs[0]);
        section.shear = lines(&springs[1]);
        Ok(section)
    }

    fn add_cell(
        &mut self,
        model: &Model,
        index: usize,
        at: f64,
        springs: &mut [BTreeSet<[u32; 2]>; 2],
    ) {
        let corners = model.corners_of(index);
        let grade = grade(&corners);
        self.grades[grade as usize][1] += 1;
        let above = corners.map(|p| p[self.axis] > at);
        if above.iter().all(|&a| a) || !above.contains(&true) {
            return;
        }
        self.grades[grade as usize][0] += 1;
        let cell = cut_cell(model, index, self.axis, at, grade);
        for p in cell.pieces.iter().flatten() {
            for a in 0..2 {
                self.bounds[0][a] = self.bounds[0][a].min(p[a]);
                self.bounds[1][a] = self.bounds[1][a].max(p[a]);
            }
        }
        self.cells.push(cell);
        // The side of the cell nearer to the plane.
        let distance = |face: usize| {
            let sum: f64 = FACES[face].iter().map(|&c| corners[c][self.axis]).sum();
            (sum / 4.0 - at).abs()
        };
        let [low, high] = [2 * self.axis, 2 * self.axis + 1];
        let near = if distance(low) <= distance(high) {
            low
        } else {
            high
        };
        let [a, b, c, d] = FACES[near].map(|c| model.cells[index].corners[c]);
        let pair = |a: u32, b: u32| [a.min(b), a.max(b)];
        springs[0].extend([pair(a, b), pair(b, c), pair(c, d), pair(d, a)]);
        springs[1].extend([pair(a, c), pair(b, d)]);
    }
}

fn grade(corners: &[Vec3; 8]) -> Grade {
    let shape = scaled_jacobian(corners);
    if shape <= 0.0 || cell_volume(corners) <= 0.0 {
        Grade::Inverted
    } else if shape < POOR {
        Grade::Poor
    } else {
        Grade::Good
    }
}

/// Cuts the tetrahedra between a cell's centre and the halves of its faces. Neighbours halve their common face
/// alike, so the pieces fit.
fn cut_cell(model: &Model, index: usize, axis: usize, at: f64, grade: Grade) -> CellCut {
    let corners = model.corners_of(index);
    let cell = &model.cells[index];
    let middle = corners.iter().sum::<Vec3>() / 8.0;
    let mut pieces = Vec::new();
    let mut outline = Vec::new();
    for (face, ring) in FACES.iter().enumerate() {
        let behind = cell.neighbours[face];
        let is_border = behind == NO_CELL || model.cells[behind as usize].region != cell.region;
        let [a, b, c, d] = ring.map(|i| corners[i]);
        for [p, q, r] in [[a, b, c], [a, c, d]] {
            let crossings = |edges: &[[Vec3; 2]]| -> Vec<Point> {
                let crossed = edges.iter().filter_map(|e| crossing(axis, at, *e));
                crossed.collect()
            };
            let shows = is_border || face / 2 != axis;
            if let [from, to] = crossings(&[[p, q], [q, r], [r, p]])[..]
                && shows
            {
                outline.push(([from, to], is_border));
            }
            // Ordered around the piece: opposite edges are never neighbours.
            let m = middle;
            let edges = [[p, q], [p, r], [r, m], [q, m], [q, r], [p, m]];
            let piece = around(&crossings(&edges));
            if piece.len() >= 3 {
                pieces.push(piece);
            }
        }
    }
    CellCut {
        region: cell.region.index(),
        grade,
        pieces,
        outline,
    }
}

/// Intersection of an edge with the plane. End points on the plane count as below, so that no crossing counts twice.
fn crossing(axis: usize, at: f64, [from, to]: [Vec3; 2]) -> Option<Point> {
    if (from[axis] > at) == (to[axis] > at) {
        return None;
    }
    let part = (at - from[axis]) / (to[axis] - from[axis]);
    Some(flat(axis, from + (to - from) * part))
}

/// Points of a convex shape in the order around it.
fn around(points: &[Point]) -> Vec<Point> {
    let count = points.len().max(1) as f64;
    let [x, y] = [0, 1].map(|a| points.iter().map(|p| p[a]).sum::<f64>() / count);
    let mut sorted = points.to_vec();
    let angle = |p: &Point| (p[1] - y).atan2(p[0] - x);
    sorted.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
    sorted
}

/// Projection of a point along the axis, in mm: x to the right and z up where they exist.
pub(super) fn flat(axis: usize, p: Vec3) -> Point {
    let [right, up] = [[1, 2], [0, 2], [0, 1]][axis];
    [p[right] * MM, p[up] * MM]
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{Material, block};

    fn area(piece: &[Point]) -> f64 {
        let next = piece.iter().cycle().skip(1);
        let twice: f64 = piece
            .iter()
            .zip(next)
            .map(|(a, b)| a[0] * b[1] - b[0] * a[1])
            .sum();
        0.5 * twice
    }

    #[test]
    fn pieces_fill_the_section_without_gap_or_overlap() {
        let mut model = block([6, 5, 4], 0.004, &Material::default(), 1);
        for (i, p) in model.nodes.iter_mut().enumerate() {
            // Only inner nodes, so that the section stays a rectangle.
            let inside = (0..3).all(|a| p[a] > 0.001 && p[a] < [0.023, 0.019, 0.015][a]);
            if inside {
                *p += Vec3::new(3e-4, -2e-4, 7e-4) * f64::from(i as u32 % 3);
            }
        }
        for at in ["x=8", "x=9.1", "y=4.2", "z=8.3", "z=11.9999"] {
            let slice: Slice = at.parse().unwrap();
            let section = Section::through(&model, slice).unwrap();
            let filled: f64 = section
                .cells
                .iter()
                .flat_map(|c| &c.pieces)
                .map(|p| area(p))
                .sum();
            let whole = [20.0 * 16.0, 24.0 * 16.0, 24.0 * 20.0][slice.axis];
            assert!((filled / whole - 1.0).abs() < 1e-9, "{at}: {filled}");
        }
    }

    #[test]
    fn inverted_cell_is_graded_as_inverted() {
        let mut model = block([3, 3, 3], 0.004, &Material::default(), 1);
        let slice = Slice::default();
        let grades = Section::through(&model, slice).unwrap().grades;
        assert_eq!(grades, [[9, 27], [0, 0], [0, 0]]);
        let corner = model.cells[13].corners[0] as usize;
        model.nodes[corner] += Vec3::repeat(0.006);
        let grades = Section::through(&model, slice).unwrap().grades;
        assert!(grades[Grade::Inverted as usize][1] >= 1, "{grades:?}");
    }
}
