//! Gaps between parts of the input that no cell is empty for (reconstructed).
//!
//! Two bones of a joint are apart by less than a spacing here and there, so their cells share faces, and the joint
//! cannot move. Such faces are opened as a cut opens them: neither cell is a neighbour of the other, and each node has
//! one copy per group of its cells that stay connected ([`super::lattice`]). Each copy is put onto the input surface
//! that its own cells face, so the gap gets its true width.
//!
//! Lines across a face show whether the regions of its cells touch there. It is opened where most lines find a gap of
//! [`GAP_MIN`] or more, unless the scene fuses the two. Tissue on the line holds both only if no such gap is beside it.
//! Where a face lies on one side of the gap and no line shows both regions, it is opened between parts of the regions that
//! touch nowhere, as the rays know that measure the fill of the cells.

use std::collections::BTreeMap;
use std::fmt;

use palpate_tissue::cell::FACES;
use palpate_tissue::{Model, RegionId, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::grid::Grid;
use super::inside::PointQuery;
use super::label::Labels;
use super::lattice::{self, Lattice, cell_at, face_neighbours};
use super::walls::{Share, Walls};

/// A piece of the model of fewer cells than this that only opened faces would separate stays attached, because
/// nothing holds it.
const PIECE_MIN: usize = 4;

/// Width in spacings from which on a gap between regions stays open, and one within a region: necks thinner than a cell
/// may hold the parts of one tissue.
const GAP_MIN: [f64; 2] = [0.125, 0.25];
/// Lines across a face along each of its sides, and points along each line over both cells.
const LINES: usize = 4;
const PROBES: usize = 32;

/// Two regions between which a gap of the input stays open although no cell is empty there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GapReport {
    /// The regions on both sides; parts of one region have its name twice.
    pub between: [String; 2],
    /// Number of opened faces.
    pub faces: usize,
    /// Area of one side in mm².
    pub area_mm2: f64,
}

impl fmt::Display for GapReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b] = &self.between;
        let (faces, area) = (self.faces, self.area_mm2);
        write!(
            f,
            "{a} and {b} stay apart at {faces} cell faces, {area:.1} mm²"
        )
    }
}

/// Consecutive cells of a column along z that one part of a region fills alone.
#[derive(Debug, Clone, Copy)]
pub(super) struct Run {
    /// The column: its x plus the number of cells along x times its y.
    pub(super) column: u32,
    /// First cell along z. Mixed cells may interrupt the run.
    pub(super) from: u32,
    pub(super) label: u8,
    pub(super) part: u32,
}

/// The parts of the regions. Parts have different numbers, also in different regions.
#[derive(Debug, Default)]
pub(super) struct Parts {
    /// Sorted by column and first cell.
    runs: Vec<Run>,
    /// Pairs of parts that touch somewhere, both ways, sorted.
    touching: Vec<[u32; 2]>,
}

impl Parts {
    pub(super) fn new(touching: Vec<[u32; 2]>) -> Self {
        let runs = Vec::new();
        Self { runs, touching }
    }

    /// Takes the runs of the next columns.
    pub(super) fn add_runs(&mut self, mut runs: Vec<Run>) {
        self.runs.append(&mut runs);
    }

    /// The part that fills most of a cell among those with its label.
    fn own(&self, grid: &Grid, labels: &Labels, cell: usize, shares: &[Share]) -> Option<u32> {
        let label = labels.label[cell];
        if shares.is_empty() {
            let [x, y, z] = cell_at(grid, cell);
            let place = ((x + grid.cells[0] * y) as u32, z as u32);
            let after = self.runs.partition_point(|r| (r.column, r.from) <= place);
            let run = self.runs[..after].last()?;
            return (run.column == place.0 && run.label == label).then_some(run.part);
        }
        let own = shares.iter().filter(|s| s.label == label);
        own.max_by(|a, b| a.filled().total_cmp(&b.filled()).then(b.part.cmp(&a.part)))
            .map(|s| s.part)
    }

    fn touch(&self, a: u32, b: u32) -> bool {
        a == b || self.touching.binary_search(&[a, b]).is_ok()
    }

    /// Whether a third part touches both.
    fn have_a_neighbour_in_common(&self, a: u32, b: u32) -> bool {
        let from = self.touching.partition_point(|pair| pair[0] < a);
        let own = self.touching[from..].iter().take_while(|pair| pair[0] == a);
        own.into_iter().any(|&[_, third]| self.touch(third, b))
    }
}

/// A labelled grid and the parts of its cells.
pub(super) struct Joints<'a> {
    pub(super) grid: &'a Grid,
    pub(super) labels: &'a Labels,
    pub(super) walls: &'a Walls,
    pub(super) parts: &'a Parts,
    pub(super) query: &'a PointQuery,
    /// Pairs of regions that the scene fuses, the earlier one first.
    pub(super) fused: &'a [[usize; 2]],
}

/// The most empty points in a row on a line between two regions, from the regions of its points; `None` unless the line
/// passes from one to the other.
fn empty_between(
    points: impl Iterator<Item = Option<usize>>,
    regions: [usize; 2],
) -> Option<usize> {
    let [a, b] = regions;
    // The last of the two regions; since then the number of points, of empty ones in a row, and the most of these.
    let mut last: Option<(usize, [usize; 3])> = None;
    let mut found = None;
    for point in points {
        if let Some(region) = point.filter(|r| regions.contains(r)) {
            if let Some((before, [width, _, empty])) = last
                && (before != region || a == b && width > 0)
            {
                found = found.max(Some(empty));
            }
            last = Some((region, [0; 3]));
        } else if let Some((_, [width, empty, most])) = &mut last {
            *width += 1;
            *empty = if point.is_none() { *empty + 1 } else { 0 };
            *most = (*most).max(*empty);
        }
    }
    found
}

/// The width of the narrowest gap between two regions that stays open.
fn narrowest([a, b]: [usize; 2]) -> f64 {
    GAP_MIN[usize::from(a == b)]
}

impl Joints<'_> {
    /// Numbers the lattice with all gaps open, but for faces around pieces of few cells and those that would make a surface
    /// touch itself along an edge, as the end of a gap may. `None` without a cell.
    pub(super) fn number(&self) -> Option<Lattice> {
        let mut open = self.open_faces();
        loop {
            self.keep_attached(&mut open);
            let lattice = lattice::number(self.grid, self.labels, &open);
            let mut kept = lattice.may_stay_open().into_iter();
            let before = open.len();
            open.retain(|_| kept.next().unwrap_or(true));
            if open.len() == before {
                return (!lattice.cells.is_empty()).then_some(lattice);
            }
        }
    }

    /// The faces to open, as three times the lower cell plus the axis across; sorted.
    fn open_faces(&self) -> Vec<usize> {
        let layers = (0..self.grid.cells[2]).into_par_iter();
        let mut open: Vec<usize> = layers.flat_map_iter(|k| self.between_regions(k)).collect();
        open.extend(self.within_regions());
        open.sort_unstable();
        open.dedup();
        open
    }

    /// Faces to open above the cells of layer `k`, between cells of different regions.
    fn between_regions(&self, k: usize) -> Vec<usize> {
        let mut open = Vec::new();
        let [nx, ny, _] = self.grid.cells;
        for cell in nx * ny * k..nx * ny * (k + 1) {
            let label = self.labels.label[cell];
            if label == 0 {
                continue;
            }
            let around = face_neighbours(self.grid, cell);
            for axis in 0..3 {
                let Some(other) = around[2 * axis + 1] else {
                    continue;
                };
                let beyond = self.labels.label[other];
                if beyond != 0 && beyond != label && self.is_gap([cell, other]) {
                    open.push(3 * cell + axis);
                }
            }
        }
        open
    }

    /// Faces to open between cells of one region. One of the two cells is mixed.
    fn within_regions(&self) -> Vec<usize> {
        let several = self.labels_of_several_parts();
        let mixed = self.walls.mixed().filter(|(cell, _)| {
            let label = self.labels.label[*cell];
            label != 0 && several[usize::from(label)]
        });
        let found = mixed.flat_map_iter(|(cell, _)| {
            let label = self.labels.label[cell];
            let around = face_neighbours(self.grid, cell).into_iter().enumerate();
            around.filter_map(move |(face, other)| {
                let other = other.filter(|o| self.labels.label[*o] == label)?;
                let (low, axis) = (cell.min(other), face / 2);
                self.is_gap([low, cell.max(other)])
                    .then_some(3 * low + axis)
            })
        });
        found.collect()
    }

    fn labels_of_several_parts(&self) -> Vec<bool> {
        let mut first: Vec<Option<u32>> = vec![None; 256];
        let mut several = vec![false; 256];
        let runs = self.parts.runs.iter().map(|r| (r.label, r.part));
        for (label, part) in self.walls.parts().chain(runs) {
            let label = usize::from(label);
            several[label] |= *first[label].get_or_insert(part) != part;
        }
        several
    }

    /// Whether the face between two cells lies in a gap.
    fn is_gap(&self, cells: [usize; 2]) -> bool {
        let [a, b] = cells.map(|c| self.labels.label[c]);
        let regions = [a.min(b), a.max(b)].map(|label| usize::from(label) - 1);
        let [Some(p), Some(q)] = cells.map(|c| self.part(c)) else {
            return false;
        };
        if p == q || self.fused.contains(&regions) {
            return false;
        }
        let touch = self.parts.touch(p, q);
        // A gap takes half of the face at least.
        if touch && self.empty_volume(cells) <= narrowest(regions) / 2.0 {
            return false;
        }
        // Where no line shows both, the face lies on one side of the gap; it may lie in tissue that holds both parts.
        let none = || !touch && !self.parts.have_a_neighbour_in_common(p, q);
        self.most_find_a_gap(cells, regions).unwrap_or_else(none)
    }

    /// The empty volume of two cells, in cells.
    fn empty_volume(&self, cells: [usize; 2]) -> f64 {
        let filled = |cell: usize| match self.walls.shares_of(cell) {
            [] => 1.0,
            shares => shares.iter().map(Share::filled).sum(),
        };
        2.0 - cells.map(filled).iter().sum::<f64>()
    }

    /// Whether most lines across the face of two cells find a gap; `None` where no line shows both regions.
    fn most_find_a_gap(&self, [low, high]: [usize; 2], regions: [usize; 2]) -> Option<bool> {
        let (from, to) = (cell_at(self.grid, low), cell_at(self.grid, high));
        let axis = (0..3).find(|a| from[*a] != to[*a])?;
        let (mut held, mut gaps) = (0, 0);
        for line in 0..LINES * LINES {
            let aside = [line % LINES, line / LINES].map(|i| (i as f64 + 0.5) / LINES as f64);
            let mut at = Vec3::from(from.map(|i| i as f64));
            at[(axis + 1) % 3] += aside[0];
            at[(axis + 2) % 3] += aside[1];
            let seen = (0..PROBES).map(|probe| {
                let mut point = at;
                point[axis] += 2.0 * (probe as f64 + 0.5) / PROBES as f64;
                self.query
                    .region_at(self.grid.origin + point * self.grid.spacing)
            });
            let Some(empty) = empty_between(seen, regions) else {
                continue;
            };
            if 2.0 * empty as f64 / PROBES as f64 >= narrowest(regions) {
                gaps += 1;
            } else {
                held += 1;
            }
        }
        (gaps + held > 0).then_some(gaps > held)
    }

    /// The part that a cell belongs to. A cell of a label that does not reach into it belongs to the part of most
    /// cells beside it.
    fn part(&self, cell: usize) -> Option<u32> {
        let own = |cell: usize| {
            let shares = self.walls.shares_of(cell);
            self.parts.own(self.grid, self.labels, cell, shares)
        };
        own(cell).or_else(|| {
            let mut votes: BTreeMap<u32, usize> = BTreeMap::new();
            for other in face_neighbours(self.grid, cell).into_iter().flatten() {
                if self.labels.label[other] == self.labels.label[cell]
                    && let Some(part) = own(other)
                {
                    *votes.entry(part).or_default() += 1;
                }
            }
            let most = votes
                .into_iter()
                .min_by_key(|(part, n)| (usize::MAX - n, *part));
            most.map(|(part, _)| part)
        })
    }

    /// Closes the faces around pieces of the model that are too small to be on their own.
    fn keep_attached(&self, open: &mut Vec<usize>) {
        if open.is_empty() {
            return;
        }
        let steps = [
            1,
            self.grid.cells[0],
            self.grid.cells[0] * self.grid.cells[1],
        ];
        let ends = |face: usize| [face / 3, face / 3 + steps[face % 3]];
        let small = |cell: usize| self.piece_size(cell, open) < PIECE_MIN;
        let kept: Vec<usize> = open
            .par_iter()
            .copied()
            .filter(|&face| !ends(face).into_iter().any(small))
            .collect();
        *open = kept;
    }

    /// Number of cells that are connected to a cell through faces that are not open, at most [`PIECE_MIN`].
    fn piece_size(&self, cell: usize, open: &[usize]) -> usize {
        let mut piece = vec![cell];
        let mut next = 0;
        while let Some(&cell) = piece.get(next) {
            next += 1;
            for (face, other) in face_neighbours(self.grid, cell).into_iter().enumerate() {
                let Some(other) = other.filter(|o| self.labels.label[*o] != 0) else {
                    continue;
                };
                let key = 3 * cell.min(other) + face / 2;
                if !piece.contains(&other) && open.binary_search(&key).is_err() {
                    piece.push(other);
                }
            }
            if piece.len() >= PIECE_MIN {
                break;
            }
        }
        piece.len().min(PIECE_MIN)
    }
}

/// Sums up the opened faces of each pair of regions.
pub(super) fn reports(model: &Model, opened: &[([u32; 2], usize)]) -> Vec<GapReport> {
    let mut gaps: BTreeMap<[RegionId; 2], (usize, f64)> = BTreeMap::new();
    for &([cell, other], face) in opened {
        let [a, b] = [cell, other].map(|c| model.cells[c as usize].region);
        let corners = model.corners_of(cell as usize);
        let [p, q, r, s] = FACES[face].map(|c| corners[c]);
        let gap = gaps.entry([a.min(b), a.max(b)]).or_default();
        gap.0 += 1;
        gap.1 += (r - p).cross(&(s - q)).norm() / 2.0;
    }
    let name = |r: RegionId| model.regions[r.index()].name.clone();
    gaps.into_iter()
        .map(|(between, (faces, area))| GapReport {
            between: between.map(name),
            faces,
            area_mm2: area * 1e6,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{assert_sound, ball, both, built, cuboid, scene};
    use super::super::{BuildReport, build};
    use super::*;
    use crate::Surface;

    const SPACING: f64 = 2e-3;

    fn moved(mut surface: Surface, by: Vec3) -> Surface {
        surface.vertices.iter_mut().for_each(|v| *v += by);
        surface
    }

    /// Two balls so many spacings apart, and the direction from one to the other.
    fn balls([one, other]: [f64; 2], gap: f64) -> [([Surface; 2], Vec3); 4] {
        let ways = [
            Vec3::new(0.0, 0.0, 1.0),
            Vec3::new(1.0, 0.0, 0.0),
            Vec3::new(0.5, 0.7, 0.6).normalize(),
            Vec3::new(-0.2, 0.9, 0.1).normalize(),
        ];
        ways.map(|way| {
            let apart = way * (one + other + gap * SPACING);
            ([ball(one), moved(ball(other), apart)], way)
        })
    }

    /// Two balls, or two boxes, so many spacings apart, and the direction from one to the other.
    fn pairs(gap: f64) -> Vec<([Surface; 2], Vec3)> {
        let size = Vec3::new(0.0214, 0.0186, 0.0203);
        let boxes = [0, 1, 2].map(|axis| {
            let mut low = Vec3::repeat(1.3e-3);
            low[axis] = size[axis] + gap * SPACING;
            let boxes = [cuboid(Vec3::zeros(), size), cuboid(low, low + size)];
            (boxes, Vec3::ith(axis, 1.0))
        });
        let balls = balls([0.018, 0.014], gap);
        balls.into_iter().chain(boxes).collect()
    }

    /// Nodes that cells of both of two pieces use, where `of` gives the piece of a cell.
    fn shared(model: &Model, of: impl Fn(usize) -> usize) -> usize {
        let mut users = vec![[false; 2]; model.nodes.len()];
        for (c, cell) in model.cells.iter().enumerate() {
            for &node in &cell.corners {
                users[node as usize][of(c)] = true;
            }
        }
        users.iter().filter(|u| u[0] && u[1]).count()
    }

    fn assert_apart(
        (surfaces, way): &([Surface; 2], Vec3),
        model: &Model,
        report: &BuildReport,
        gap: f64,
    ) {
        assert_sound(model, report);
        let heights = surfaces[0].vertices.iter().map(|p| p.dot(way));
        let highest = heights.fold(0.0, f64::max);
        let mut least = f64::INFINITY;
        for cell in 0..model.cells.len() {
            let corners = model.corners_of(cell);
            let middle = corners.iter().sum::<Vec3>() / 8.0;
            let of_first = middle.dot(way) < highest;
            for p in corners {
                // Every node is on its own side of the middle of the gap.
                let above = (p.dot(way) - highest) / SPACING - gap / 2.0;
                let side = if of_first { -above } else { above };
                least = least.min(side);
            }
        }
        assert!(least > 0.0, "{least} of a gap of {gap} along {way}");
        let pieces = report.warnings.iter();
        let pieces = pieces.filter(|w| w.contains("2 separate pieces"));
        assert_eq!(pieces.count(), 1, "{:?}", report.warnings);
    }

    #[test]
    fn two_regions_share_no_node_across_a_narrow_gap() {
        let mut opened = 0;
        for gap in [0.3, 0.6] {
            for pair in pairs(gap) {
                let [a, b] = pair.0.clone();
                let (model, report) = built(SPACING * 1e3, &[("a", a), ("b", b)]);
                assert_eq!(shared(&model, |c| model.cells[c].region.index()), 0);
                assert_apart(&pair, &model, &report, gap);
                opened += report.gaps.iter().map(|g| g.faces).sum::<usize>();
            }
        }
        assert!(opened > 100, "{opened}");
    }

    #[test]
    fn two_parts_of_a_region_share_no_node_across_a_narrow_gap() {
        for gap in [0.3, 0.6] {
            for pair in pairs(gap) {
                let [a, b] = &pair.0;
                let (model, report) = built(SPACING * 1e3, &[("a", both(a.clone(), b))]);
                assert_apart(&pair, &model, &report, gap);
            }
        }
    }

    #[test]
    fn small_part_beside_a_gap_keeps_its_volume() {
        for gap in [0.3, 0.6] {
            for pair in balls([0.018, 0.004], gap) {
                let [a, b] = pair.0.clone();
                let (model, report) = built(SPACING * 1e3, &[("a", a), ("b", b)]);
                assert_apart(&pair, &model, &report, gap);
                for region in &report.regions {
                    let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
                    assert!(error.abs() < 1e-3, "{gap}: {region:?}");
                }
            }
        }
    }

    #[test]
    fn parts_that_stay_apart_are_reported_neither_joined_nor_in_contact() {
        for gap in [0.35, 0.45, 0.6] {
            for ([a, b], way) in pairs(gap) {
                let (_, report) = built(SPACING * 1e3, &[("a", both(a.clone(), &b))]);
                let region = &report.regions[0];
                assert_eq!(
                    [region.components, region.input_components],
                    [2, 2],
                    "{gap} {way}"
                );
                assert_eq!(report.component_loss.merged, [], "{gap} {way}");
                let (_, report) = built(SPACING * 1e3, &[("a", a), ("b", b)]);
                assert_eq!(report.contacts, [], "{gap} {way}");
            }
        }
    }

    #[test]
    fn piece_of_few_cells_stays_attached() {
        let joined = balls([0.018, 0.0018], 0.3).map(|pair| {
            let [a, b] = pair.0.clone();
            let (model, report) = built(SPACING * 1e3, &[("a", a), ("b", b)]);
            let cells = model.cells.iter().filter(|c| c.region == RegionId(1));
            let cells = cells.count();
            let joined = shared(&model, |c| model.cells[c].region.index()) > 0;
            assert_eq!((1..PIECE_MIN).contains(&cells), joined, "{cells} cells");
            if cells >= PIECE_MIN {
                assert_apart(&pair, &model, &report, 0.3);
            }
            joined
        });
        assert!(joined.contains(&true) && joined.contains(&false));
    }

    #[test]
    fn gap_below_a_quarter_of_the_spacing_leaves_good_cells() {
        for gap in [0.1, 0.2] {
            for ([a, b], _) in pairs(gap) {
                let (model, report) = built(SPACING * 1e3, &[("a", a), ("b", b)]);
                assert_sound(&model, &report);
            }
        }
    }

    #[test]
    fn touching_and_fused_regions_stay_joined() {
        for ([a, b], _) in pairs(0.0).into_iter().skip(4) {
            let (model, report) = built(SPACING * 1e3, &[("a", a), ("b", b)]);
            assert!(shared(&model, |c| model.cells[c].region.index()) > 20);
            assert_eq!(report.gaps, []);
        }
        for ([a, b], _) in pairs(0.3).into_iter().skip(4) {
            let mut input = scene(SPACING * 1e3, &[("a", a), ("b", b)]);
            input.scene.fuse = vec![[0, 1]];
            let (model, report) = build(&input, &mut |_, _| {}).unwrap();
            assert!(shared(&model, |c| model.cells[c].region.index()) > 20);
            assert_eq!(report.gaps, []);
            // The contact is new, and intended.
            assert!(report.contacts[0].created_mm2 > 100.0);
            assert_eq!(report.deviations, 0, "{:?}", report.warnings);
        }
    }

    #[test]
    fn tissue_that_fills_a_gap_holds_both_sides() {
        for gap in [0.3, 0.6] {
            for ([a, b], _) in pairs(gap) {
                let around = ball(0.06);
                let (_, report) = built(SPACING * 1e3, &[("tissue", around), ("a", a), ("b", b)]);
                assert_eq!(report.gaps, []);
                assert_eq!(report.quality.inverted_cells, 0);
                let pieces = report.warnings.iter();
                assert!(!pieces.into_iter().any(|w| w.contains("separate pieces")));
            }
        }
    }
}
