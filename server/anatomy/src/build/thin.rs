//! Parts of the input thinner than the spacing, and parts that were lost.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;
use serde::{Deserialize, Serialize};

use super::faces::OUTSIDE;
use super::grid::Grid;
use super::interface_samples::{Sample, Thin};
use super::mending::Crumb;
use super::parts::ClosedParts;

/// Most parts that a report lists, the largest first; the rest is counted.
pub const THIN_PARTS_MAX: usize = 64;

/// Samples in touching cubes of this side, in spacings, belong to one part.
const CUBE: f64 = 2.0;
/// A piece of an input interface is lost when the model's interface is farther away than this, in spacings.
const LOST: f64 = 0.5;

/// Kind of a thin or lost part of the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ThinKind {
    /// A layer of a region thinner than the spacing.
    Layer,
    /// A gap outside between two walls closer together than the spacing.
    Gap,
    /// Not thin, and still farther from the model than half a spacing: a sharp edge, a tip, or the
    /// neighbourhood of a lost thin part.
    Rim,
    /// A few cells of a region that were given to the surrounding regions, or cells of others that it fills in
    /// part while no cell represents it.
    Crumb,
    /// Closed pieces of a region's surface that are smaller than the spacing in at least two directions: grains
    /// and needles.
    Speck,
    /// Nodes released from their interface so that their cells meet the quality floors.
    LetGo,
    /// Nodes farther than half a spacing from their interface with no thin part nearby: the model's interface
    /// continues and the input's does not.
    Stray,
}

/// One part of the input that is thin or was lost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ThinPart {
    /// Kind of defect.
    pub kind: ThinKind,
    /// The region that is thin or was lost; `None` for a gap.
    pub region: Option<String>,
    /// The regions on its two sides; `None` is the outside.
    pub between: [Option<String>; 2],
    /// Middle of the box around it, in mm.
    pub centre_mm: [f64; 3],
    /// Extent of the box around it, in mm.
    pub size_mm: [f64; 3],
    /// Area of the interface there, in mm²; both sides of a layer count.
    pub area_mm2: f64,
    /// Part of that area, in mm², farther from the model's interface than half a spacing.
    pub lost_area_mm2: f64,
    /// Least thickness in mm; 0 if not measured.
    pub thickness_min_mm: f64,
    /// Mean thickness in mm; 0 if not measured.
    pub thickness_mean_mm: f64,
    /// Largest distance of the input from the model's interface there, in mm.
    pub distance_max_mm: f64,
    /// Number of cells of a crumb, of released nodes, or of samples of a layer.
    pub count: usize,
}

/// The thin and lost parts.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ThinParts {
    /// The largest ones, at most [`THIN_PARTS_MAX`].
    pub parts: Vec<ThinPart>,
    /// Number of further parts.
    pub more: usize,
    /// Area of these in mm².
    pub more_area_mm2: f64,
}

/// Key that distinguishes adjacent parts: kind, region, and the regions on both sides.
type Key = (ThinKind, u16, [u16; 2]);

#[derive(Debug, Clone, Copy)]
struct Heap {
    low: Vec3,
    high: Vec3,
    area: f64,
    lost: f64,
    thin_area: f64,
    /// Thickness times area.
    thickness: f64,
    thinnest: f64,
    distance: f64,
    count: usize,
}

impl Heap {
    fn empty() -> Self {
        Self {
            low: Vec3::repeat(f64::INFINITY),
            high: Vec3::repeat(f64::NEG_INFINITY),
            area: 0.0,
            lost: 0.0,
            thin_area: 0.0,
            thickness: 0.0,
            thinnest: f64::INFINITY,
            distance: 0.0,
            count: 0,
        }
    }

    fn add(&mut self, other: &Self) {
        self.low = self.low.inf(&other.low);
        self.high = self.high.sup(&other.high);
        self.area += other.area;
        self.lost += other.lost;
        self.thin_area += other.thin_area;
        self.thickness += other.thickness;
        self.thinnest = self.thinnest.min(other.thinnest);
        self.distance = self.distance.max(other.distance);
        self.count += other.count;
    }

    fn of_sample(sample: &Sample, spacing: f64) -> Self {
        let lost = sample.distance > LOST * spacing;
        let (thin_area, thickness) = sample
            .thin
            .map_or((0.0, 0.0), |t| (sample.area, t.thickness));
        Self {
            low: sample.at,
            high: sample.at,
            area: sample.area,
            lost: if lost { sample.area } else { 0.0 },
            thin_area,
            thickness: thickness * sample.area,
            thinnest: sample.thin.map_or(f64::INFINITY, |t| t.thickness),
            distance: sample.distance,
            count: 1,
        }
    }
}

/// Collects samples, crumbs and nodes into parts.
pub(super) struct Collector<'a> {
    grid: &'a Grid,
    cubes: BTreeMap<(Key, [i32; 3]), Heap>,
    /// Cells of the grid in or beside a thin or lost part.
    marked: Vec<bool>,
}

impl<'a> Collector<'a> {
    /// Collects from samples of the input, from pieces that were dropped or lost, and from grains.
    pub(super) fn of(
        grid: &'a Grid,
        samples: &[Sample],
        crumbs: &[Crumb],
        lost: &[(usize, u8, u8)],
        parts: &[ClosedParts],
    ) -> Self {
        let mut collector = Self {
            grid,
            cubes: BTreeMap::new(),
            marked: vec![false; grid.cell_count()],
        };
        collector.add_samples(samples);
        collector.add_crumbs(crumbs);
        collector.add_lost(lost);
        collector.add_specks(parts);
        collector
    }

    /// Adds the thin or lost samples.
    fn add_samples(&mut self, samples: &[Sample]) {
        let spacing = self.grid.spacing;
        for sample in samples {
            let key = match sample.thin {
                Some(Thin { region, beyond, .. }) => {
                    let near = if region == sample.behind {
                        sample.before
                    } else {
                        sample.behind
                    };
                    let kind = if region == OUTSIDE {
                        ThinKind::Gap
                    } else {
                        ThinKind::Layer
                    };
                    self.mark(&sample.at);
                    (kind, region, [near.min(beyond), near.max(beyond)])
                }
                None if sample.distance > LOST * spacing => {
                    (ThinKind::Rim, sample.behind, [sample.before, sample.behind])
                }
                None => continue,
            };
            self.put(key, &sample.at, &Heap::of_sample(sample, spacing));
        }
    }

    /// Adds released nodes; their surroundings count as a thin part.
    pub(super) fn add_nodes(&mut self, nodes: &[(Vec3, u16, f64)]) {
        for (at, _, _) in nodes {
            self.mark(at);
        }
        self.put_nodes(ThinKind::LetGo, nodes);
    }

    /// Adds nodes that are far from the input.
    pub(super) fn add_strays(&mut self, nodes: &[(Vec3, u16, f64)]) {
        self.put_nodes(ThinKind::Stray, nodes);
    }

    fn put_nodes(&mut self, kind: ThinKind, nodes: &[(Vec3, u16, f64)]) {
        for (at, region, distance) in nodes {
            let heap = Heap {
                low: *at,
                high: *at,
                distance: *distance,
                count: 1,
                ..Heap::empty()
            };
            self.put((kind, *region, [*region, OUTSIDE]), at, &heap);
        }
    }

    /// Adds dropped pieces of regions.
    fn add_crumbs(&mut self, crumbs: &[Crumb]) {
        let region = |label: u8| u16::from(label).checked_sub(1).unwrap_or(OUTSIDE);
        for crumb in crumbs {
            let mut heap = Heap {
                count: crumb.cells.len(),
                ..Heap::empty()
            };
            for cell in &crumb.cells {
                let low = self.grid.point(cell.map(|i| i as i32));
                let high = self.grid.point(cell.map(|i| i as i32 + 1));
                self.mark(&((low + high) / 2.0));
                heap.low = heap.low.inf(&low);
                heap.high = heap.high.sup(&high);
            }
            let given = region(crumb.given);
            let at = (heap.low + heap.high) / 2.0;
            let key = (ThinKind::Crumb, region(crumb.label), [given, given]);
            self.put(key, &at, &heap);
        }
    }

    /// Adds cells in which a part of a region was lost: cell, its label, and the lost label.
    fn add_lost(&mut self, lost: &[(usize, u8, u8)]) {
        let region = |label: u8| u16::from(label).checked_sub(1).unwrap_or(OUTSIDE);
        let [nx, ny, _] = self.grid.cells;
        for &(cell, given, label) in lost {
            let at = [cell % nx, cell / nx % ny, cell / (nx * ny)].map(|i| i as i32);
            let (low, high) = (self.grid.point(at), self.grid.point(at.map(|i| i + 1)));
            let middle = (low + high) / 2.0;
            self.mark(&middle);
            let heap = Heap {
                low,
                high,
                count: 1,
                ..Heap::empty()
            };
            let key = (ThinKind::Crumb, region(label), [region(given); 2]);
            self.put(key, &middle, &heap);
        }
    }

    /// Adds closed parts of each region's input surface that are smaller than the spacing in at least two
    /// directions.
    fn add_specks(&mut self, parts: &[ClosedParts]) {
        for (region, parts) in parts.iter().enumerate() {
            for part in &parts.boxes {
                let extent = part.extent();
                let along = extent.imax();
                if (0..3).any(|a| a != along && extent[a] >= self.grid.spacing) {
                    continue;
                }
                let middle = (part.min + part.max) / 2.0;
                let steps = (extent[along] / self.grid.spacing).ceil().max(1.0);
                for step in 0..=steps as usize {
                    let mut at = middle;
                    at[along] = part.min[along] + extent[along] * step as f64 / steps;
                    self.mark(&at);
                }
                let heap = Heap {
                    low: part.min,
                    high: part.max,
                    count: 1,
                    ..Heap::empty()
                };
                let key = (ThinKind::Speck, region as u16, [OUTSIDE; 2]);
                self.put(key, &middle, &heap);
            }
        }
    }

    /// Whether a point is in or beside a thin or lost part.
    pub(super) fn is_marked(&self, at: &Vec3) -> bool {
        self.cell_at(at).is_none_or(|cell| self.marked[cell])
    }

    fn cell_at(&self, at: &Vec3) -> Option<usize> {
        let cell = ((at - self.grid.origin) / self.grid.spacing).map(f64::floor);
        let inside = (0..3).all(|a| cell[a] >= 0.0 && cell[a] < self.grid.cells[a] as f64);
        inside.then(|| {
            self.grid
                .cell_index([cell.x as usize, cell.y as usize, cell.z as usize])
        })
    }

    /// Marks the cell at a point and its neighbours.
    fn mark(&mut self, at: &Vec3) {
        for near in 0..27 {
            let step = [near % 3, near / 3 % 3, near / 9].map(|i| f64::from(i - 1));
            let point = at + Vec3::from(step) * self.grid.spacing;
            if let Some(cell) = self.cell_at(&point) {
                self.marked[cell] = true;
            }
        }
    }

    fn put(&mut self, key: Key, at: &Vec3, heap: &Heap) {
        let cube = (at / (CUBE * self.grid.spacing)).map(f64::floor);
        let cube = [cube.x as i32, cube.y as i32, cube.z as i32];
        self.cubes
            .entry((key, cube))
            .or_insert_with(Heap::empty)
            .add(heap);
    }

    /// Joins touching cubes into parts, the largest first.
    pub(super) fn finish(self, names: &[String]) -> ThinParts {
        let mut rest = self.cubes;
        let mut parts = Vec::new();
        while let Some((&(key, seed), _)) = rest.first_key_value() {
            let mut whole = Heap::empty();
            let mut stack = vec![seed];
            while let Some(cube) = stack.pop() {
                let Some(heap) = rest.remove(&(key, cube)) else {
                    continue;
                };
                whole.add(&heap);
                for near in 0..27 {
                    let step = [near % 3, near / 3 % 3, near / 9].map(|i| i - 1);
                    let next = std::array::from_fn(|a| cube[a] + step[a]);
                    if rest.contains_key(&(key, next)) {
                        stack.push(next);
                    }
                }
            }
            parts.push((key, whole));
        }
        parts.sort_by(|(k, a), (l, b)| {
            let by_area = b.area.total_cmp(&a.area).then(b.count.cmp(&a.count));
            by_area.then(k.cmp(l)).then(a.low.x.total_cmp(&b.low.x))
        });
        let beyond = parts.iter().skip(THIN_PARTS_MAX);
        ThinParts {
            more: beyond.clone().count(),
            more_area_mm2: beyond.map(|p| p.1.area * 1e6).sum(),
            parts: parts
                .iter()
                .take(THIN_PARTS_MAX)
                .map(|(key, heap)| part(*key, heap, names))
                .collect(),
        }
    }
}

fn part((kind, region, between): Key, heap: &Heap, names: &[String]) -> ThinPart {
    let name = |r: u16| names.get(r as usize).cloned();
    let centre = (heap.low + heap.high) / 2.0 * 1e3;
    let size = (heap.high - heap.low) * 1e3;
    let measured = heap.thin_area > 0.0;
    ThinPart {
        kind,
        region: name(region),
        between: between.map(name),
        centre_mm: centre.into(),
        size_mm: size.into(),
        area_mm2: heap.area * 1e6,
        lost_area_mm2: heap.lost * 1e6,
        thickness_min_mm: if measured { heap.thinnest * 1e3 } else { 0.0 },
        thickness_mean_mm: if measured {
            heap.thickness / heap.thin_area * 1e3
        } else {
            0.0
        },
        distance_max_mm: heap.distance * 1e3,
        count: heap.count,
    }
}

impl std::fmt::Display for ThinPart {
    /// One line for the user.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let name = |n: &Option<String>| n.clone().unwrap_or_else(|| "outside".to_owned());
        let place = |v: &[f64; 3], between: &str| {
            let v = v.map(|x| format!("{x:.0}"));
            v.join(between)
        };
        let [a, b] = &self.between;
        let what = match self.kind {
            ThinKind::Layer => format!(
                "{} between {} and {} is {:.1} mm thin (least {:.1})",
                name(&self.region),
                name(b),
                name(a),
                self.thickness_mean_mm,
                self.thickness_min_mm
            ),
            ThinKind::Gap => format!(
                "the gap between {} and {} is {:.1} mm wide (least {:.1})",
                name(a),
                name(b),
                self.thickness_mean_mm,
                self.thickness_min_mm
            ),
            ThinKind::Rim => format!(
                "{} is lost at an edge, a tip or beside a thin part",
                name(&self.region)
            ),
            ThinKind::Crumb => format!(
                "{} cells of {} were given to {}",
                self.count,
                name(&self.region),
                name(a)
            ),
            ThinKind::Speck => format!(
                "{} closed pieces of the surface of {} are thinner than the spacing all around",
                self.count,
                name(&self.region)
            ),
            ThinKind::LetGo => format!(
                "{} nodes of {} left their interface for good cells",
                self.count,
                name(&self.region)
            ),
            ThinKind::Stray => format!(
                "{} nodes of {} lie off their interface",
                self.count,
                name(&self.region)
            ),
        };
        write!(
            f,
            "{what}: {} mm2, {} mm2 lost, at most {:.1} mm off, around ({}), {} mm",
            self.area_mm2.round(),
            self.lost_area_mm2.round(),
            self.distance_max_mm,
            place(&self.centre_mm, ", "),
            place(&self.size_mm, " x ")
        )
    }
}
