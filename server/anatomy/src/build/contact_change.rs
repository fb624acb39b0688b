//! Contacts between regions that the model has and the input has not, and the reverse.
//!
//! A contact counts in both when the other one has a contact of the same two regions in the same cell of the grid or
//! in one of the 26 around it. A shift of the contact by one spacing is therefore no change.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;
use serde::{Deserialize, Serialize};

use super::faces::{Face, OUTSIDE};
use super::grid::Grid;
use super::interface_samples::Sample;

/// Contact of two regions in the model and in its input.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ContactReport {
    /// The two regions, the earlier one first.
    pub regions: [String; 2],
    /// Contact area in the input, in mm².
    pub input_mm2: f64,
    /// Contact area in the model, in mm².
    pub model_mm2: f64,
    /// Contact area of the model where they do not touch in the input, in mm².
    pub created_mm2: f64,
    /// A point of it in the middle of a face, in mm.
    pub created_at_mm: Option<[f64; 3]>,
    /// Smallest distance of the two in the input around there, in mm; none if it is wider than the spacing everywhere.
    pub gap_min_mm: Option<f64>,
    /// Contact area of the input where they do not touch in the model, in mm².
    pub removed_mm2: f64,
    /// A point of it, in mm.
    pub removed_at_mm: Option<[f64; 3]>,
}

/// Two regions, the earlier one first.
type Pair = [u16; 2];

/// A patch of a contact: its middle and its area in m².
type Patch = (Vec3, f64);

/// Patches of each pair.
#[derive(Default)]
struct Contacts(BTreeMap<Pair, Vec<Patch>>);

impl Contacts {
    fn of(patches: impl Iterator<Item = (u16, u16, Patch)>) -> Self {
        let mut contacts = Self::default();
        for (a, b, patch) in patches.filter(|p| p.0 != OUTSIDE && p.1 != OUTSIDE && p.0 != p.1) {
            contacts
                .0
                .entry([a.min(b), a.max(b)])
                .or_default()
                .push(patch);
        }
        contacts
    }

    fn of_pair(&self, pair: Pair) -> &[Patch] {
        self.0.get(&pair).map_or(&[], Vec::as_slice)
    }
}

/// Cells of a grid, sorted.
struct Cells<'a> {
    grid: &'a Grid,
    cells: Vec<usize>,
}

impl<'a> Cells<'a> {
    fn around(grid: &'a Grid, patches: &[Patch]) -> Self {
        let mut cells: Vec<usize> = patches
            .iter()
            .map(|(at, _)| grid.cell_index(grid.cell_at(at)))
            .collect();
        cells.sort_unstable();
        cells.dedup();
        Self { grid, cells }
    }

    /// Whether the cell at a point or one around it is among them.
    fn near(&self, at: &Vec3) -> bool {
        let at = self.grid.cell_at(at);
        // The own row first: most points have a contact there.
        let mut rows = (4..13).map(|n| [n % 9 % 3, n % 9 / 3]);
        rows.any(|[y, z]| {
            let row = [at[0], at[1] + y, at[2] + z].map(|i| i.saturating_sub(1));
            if row[1] >= self.grid.cells[1] || row[2] >= self.grid.cells[2] {
                return false;
            }
            let from = self.grid.cell_index(row);
            let to = from + (at[0] + 1).min(self.grid.cells[0] - 1) - row[0];
            let first = self.cells.partition_point(|c| *c < from);
            self.cells.get(first).is_some_and(|c| *c <= to)
        })
    }
}

/// Compares the contacts of all pairs; pairs without a change are left out, the largest change comes first.
pub(super) fn contacts(
    grid: &Grid,
    samples: &[Sample],
    faces: &[Face],
    nodes: &[Vec3],
    names: &[String],
) -> Vec<ContactReport> {
    let input = Contacts::of(samples.iter().map(|s| (s.behind, s.before, (s.at, s.area))));
    let model = Contacts::of(
        faces
            .iter()
            .map(|f| (f.region, f.other, f.middle_and_area(nodes))),
    );
    // The distance across a thin layer between the two.
    let gaps = Contacts::of(samples.iter().filter_map(|s| {
        let thin = s.thin?;
        let near = if thin.region == s.behind {
            s.before
        } else {
            s.behind
        };
        Some((near, thin.beyond, (s.at, thin.thickness)))
    }));
    let mut pairs: Vec<Pair> = input.0.keys().chain(model.0.keys()).copied().collect();
    pairs.sort_unstable();
    pairs.dedup();
    let reports = pairs.into_iter().map(|pair| {
        let (theirs, ours) = (input.of_pair(pair), model.of_pair(pair));
        let created = apart(ours, &Cells::around(grid, theirs));
        let removed = apart(theirs, &Cells::around(grid, ours));
        let at_created = Cells::around(grid, &created);
        let near = gaps
            .of_pair(pair)
            .iter()
            .filter(|(at, _)| at_created.near(at));
        let gap = near.map(|(_, gap)| *gap).fold(f64::INFINITY, f64::min);
        ContactReport {
            regions: pair.map(|r| names[usize::from(r)].clone()),
            input_mm2: area(theirs),
            model_mm2: area(ours),
            created_mm2: area(&created),
            created_at_mm: place(&created),
            gap_min_mm: gap.is_finite().then_some(gap * 1e3),
            removed_mm2: area(&removed),
            removed_at_mm: place(&removed),
        }
    });
    let mut reports: Vec<ContactReport> = reports.collect();
    reports.retain(|r| r.created_mm2 > 0.0 || r.removed_mm2 > 0.0);
    let change = |r: &ContactReport| r.created_mm2.max(r.removed_mm2);
    reports.sort_by(|a, b| change(b).total_cmp(&change(a)));
    reports
}

/// The patches that are not near any of these cells.
fn apart(patches: &[Patch], cells: &Cells<'_>) -> Vec<Patch> {
    patches
        .iter()
        .filter(|p| !cells.near(&p.0))
        .copied()
        .collect()
}

fn area(patches: &[Patch]) -> f64 {
    // The sum of no numbers would be -0.
    patches.iter().fold(0.0, |sum, p| sum + p.1) * 1e6
}

/// The patch nearest to the centre of all, in mm.
fn place(patches: &[Patch]) -> Option<[f64; 3]> {
    let whole: f64 = patches.iter().map(|p| p.1).sum();
    let centre = patches.iter().map(|p| p.0 * (p.1 / whole)).sum::<Vec3>();
    let far = |p: &&Patch| (p.0 - centre).norm_squared();
    let nearest = patches.iter().min_by(|a, b| far(a).total_cmp(&far(b)))?;
    Some((nearest.0 * 1e3).into())
}
