//! Comparing the finished model with its input.

use palpate_tissue::cell::NO_CELL;
use palpate_tissue::cell::scaled_jacobian;
use palpate_tissue::{Model, RegionId, Vec3};
use rayon::prelude::*;

use super::component_loss::counts;
use super::faces::{Face, OUTSIDE, volumes};
use super::interface_samples::Sample;
use super::interfaces::{Interface, Interfaces};
use super::layers::{Layers, surface_of};
use super::overlap::Overlap;
use super::quality::{CORNER_FLOOR, SPRING_FLOOR, passes, shortest_spring, worst_corner};
use super::region_distances::{from_input, from_model};
use super::report::{
    LayerReport, QualityReport, RegionReport, SpringCounts, SurfaceReport, report_triangles,
};
use super::thin::Collector;

/// A node farther than this from its interface, in spacings, is listed with its position.
const STRAY: f64 = 0.5;

/// Counts springs by kind. Each node has up to 27 directions in which a cell has a spring, half of which belong to the
/// other end.
pub(super) fn count_springs(model: &Model, around: &[[u32; 8]], faces: &[Face]) -> SpringCounts {
    let mut interface = vec![false; model.nodes.len()];
    for node in faces
        .iter()
        .filter(|f| f.other != OUTSIDE)
        .flat_map(|f| f.nodes)
    {
        interface[node as usize] = true;
    }
    let add = |a: SpringCounts, b: SpringCounts| SpringCounts {
        structural: a.structural + b.structural,
        shear: a.shear + b.shear,
        body_diagonal: a.body_diagonal + b.body_diagonal,
        layer: a.layer + b.layer,
        within_interfaces: a.within_interfaces + b.within_interfaces,
    };
    around
        .par_iter()
        .enumerate()
        .map(|(node, cells)| {
            let mut counts = SpringCounts::default();
            let mut seen = [NO_CELL; 27];
            // At the end of a gap two copies of a node are in one direction.
            let mut copies: Vec<u32> = Vec::new();
            for (corner, &cell) in cells.iter().enumerate().filter(|(_, c)| **c != NO_CELL) {
                for step in 1..8_usize {
                    let to = model.cells[cell as usize].corners[corner ^ step];
                    let code: usize = (0..3).fold(0, |code, a| {
                        let way = match (step >> a & 1, corner >> a & 1) {
                            (0, _) => 1,
                            (_, 0) => 2,
                            _ => 0,
                        };
                        code * 3 + way
                    });
                    // Codes above the middle one lead to nodes of higher number.
                    if code < 13 || seen[code] == to || copies.contains(&to) {
                        continue;
                    }
                    if seen[code] == NO_CELL {
                        seen[code] = to;
                    } else {
                        copies.push(to);
                    }
                    let (here, there) = (interface[node], interface[to as usize]);
                    let both = here && there;
                    match step.count_ones() {
                        1 if here != there => counts.layer += 1,
                        1 => counts.structural += 1,
                        2 => counts.shear += 1,
                        _ => counts.body_diagonal += 1,
                    }
                    counts.within_interfaces += usize::from(both && step.count_ones() < 3);
                }
            }
            counts
        })
        .reduce(SpringCounts::default, add)
}

/// Measures the shape of all cells.
pub(super) fn quality(model: &Model) -> QualityReport {
    let spacing = model.spacing_m;
    let empty = QualityReport {
        shortest_spring: f64::INFINITY,
        bad_cells: 0,
        inverted_cells: 0,
        least_corner: f64::INFINITY,
        scaled_jacobian: [0; 10],
        nodes_let_go: 0,
        nodes_tied: 0,
        cells_flipped: 0,
    };
    (0..model.cells.len())
        .into_par_iter()
        .map(|cell| {
            let corners = model.corners_of(cell);
            let worst = worst_corner(&corners) / spacing.powi(3);
            let decile = (scaled_jacobian(&corners) * 10.0).floor().clamp(0.0, 9.0) as usize;
            let mut one = empty;
            one.shortest_spring = shortest_spring(&corners) / spacing;
            one.bad_cells = usize::from(!passes(&corners, spacing, CORNER_FLOOR, SPRING_FLOOR));
            one.inverted_cells = usize::from(worst <= 0.0);
            one.least_corner = worst;
            one.scaled_jacobian[decile] = 1;
            one
        })
        .reduce(
            || empty,
            |a, b| QualityReport {
                shortest_spring: a.shortest_spring.min(b.shortest_spring),
                bad_cells: a.bad_cells + b.bad_cells,
                inverted_cells: a.inverted_cells + b.inverted_cells,
                least_corner: a.least_corner.min(b.least_corner),
                scaled_jacobian: std::array::from_fn(|d| {
                    a.scaled_jacobian[d] + b.scaled_jacobian[d]
                }),
                ..a
            },
        )
}

/// Sums up the layers of each interface.
pub(super) fn layers(layers: &Layers, names: &[String]) -> Vec<LayerReport> {
    layers
        .layers
        .chunk_by(|a, b| (a.inside, a.outside) == (b.inside, b.outside))
        .map(|chunk| {
            let nodes = chunk.iter().map(|l| l.nodes.len()).sum();
            LayerReport {
                inside: names[chunk[0].inside.index()].clone(),
                outside: chunk[0].outside.map(|r| names[r.index()].clone()),
                nodes,
                springs: chunk.iter().map(|l| l.springs.len()).sum(),
                components: chunk.len(),
                small_components: chunk.iter().filter(|l| l.nodes.len() * 100 < nodes).count(),
            }
        })
        .collect()
}

/// Input of [`regions`].
pub(super) struct Compared<'a> {
    pub(super) model: &'a Model,
    pub(super) around: &'a [[u32; 8]],
    pub(super) faces: &'a [Face],
    pub(super) interfaces: &'a Interfaces,
    pub(super) samples: &'a [Sample],
    pub(super) thin: &'a Collector<'a>,
    pub(super) overlap: &'a Overlap,
    pub(super) input_volumes: &'a [f64],
}

/// Compares each region with its input. Also returns the positions where the model's interface is farther than
/// [`STRAY`] from the input's and outside of thin parts: point, region, distance in m.
pub(super) fn regions(compared: &Compared<'_>) -> (Vec<RegionReport>, Vec<Stray>) {
    let Compared { model, faces, .. } = compared;
    let regions = model.regions.len();
    let volumes = volumes(faces, &model.nodes, regions);
    let nodes = nodes_of(compared);
    let at_corners = corner_distances(compared);
    let from_input = from_input(model, faces, compared.interfaces);
    let from_model = from_model(compared.samples, regions);
    let in_middles: Vec<Found> = faces
        .par_iter()
        .map(|face| {
            let corners = face.corners(&model.nodes);
            let middle = (corners[0] + corners[1] + corners[2] + corners[3]) / 4.0;
            distance(face.interface(), &middle, compared)
        })
        .collect();
    let strays = strays(compared, &at_corners);
    let surfaces = || -> Vec<SurfaceReport> {
        (0..regions as u16)
            .into_par_iter()
            .map(|r| report_triangles(&surface_of(model, faces, RegionId(r))))
            .collect()
    };
    let (surfaces, components) = rayon::join(surfaces, || components(model));
    let input_components = counts(&compared.overlap.components, regions);
    let reports = (0..regions)
        .map(|r| {
            let overlap = &compared.overlap.volumes[r];
            let counts = input_components[r];
            let mut model_side = SoundDistances::default();
            for (face, &(middle, thin)) in faces.iter().zip(&in_middles) {
                if usize::from(face.region) == r || usize::from(face.other) == r {
                    model_side.put(f64::from(middle), 1.0, thin);
                    for node in face.nodes {
                        let key = (face.interface(), node);
                        let at = at_corners.partition_point(|c| c.0 < key);
                        let (corner, thin) = at_corners[at].1;
                        model_side.put(f64::from(corner), 1.0, thin);
                    }
                }
            }
            let mut input_side = SoundDistances::default();
            for s in compared.samples {
                if usize::from(s.behind) == r || usize::from(s.before) == r {
                    input_side.put(s.distance, s.area, compared.thin.is_marked(&s.at));
                }
            }
            let (from_input, from_model) = (from_input[r].unwrap_or_default(), from_model[r]);
            RegionReport {
                name: model.regions[r].name.clone(),
                nodes: nodes[r],
                volume_mm3: volumes[r] * 1e9,
                input_volume_mm3: compared.input_volumes[r] * 1e9,
                dice: overlap.dice(),
                difference_mm3: overlap.difference() * 1e9,
                difference_part: overlap.difference_part(),
                components: components[r],
                surface: surfaces[r],
                input_components: counts.components,
                input_crumbs: counts.crumbs,
                input_crumbs_kept: counts.crumbs_kept,
                surface_distance_mean_mm: from_input.mean * 1e3,
                surface_distance_p99_mm: from_input.p99 * 1e3,
                surface_distance_max_mm: from_input.max * 1e3,
                input_distance_mean_mm: from_model.map(|d| d.mean * 1e3),
                input_distance_p99_mm: from_model.map(|d| d.p99 * 1e3),
                input_distance_max_mm: from_model.map(|d| d.max * 1e3),
                distance_mean_outside_thin_mm: model_side.mean().max(input_side.mean()) * 1e3,
                distance_max_outside_thin_mm: model_side.max.max(input_side.max) * 1e3,
            }
        })
        .collect();
    (reports, strays)
}

/// A point of the model, its region, and a distance in m.
pub(super) type Stray = (Vec3, u16, f64);

fn strays(compared: &Compared<'_>, corners: &[((Interface, u32), Found)]) -> Vec<Stray> {
    let far = (STRAY * compared.model.spacing_m) as f32;
    let found = corners.iter().filter(|(_, (d, thin))| *d > far && !thin);
    found
        .map(|&((_, node), (distance, _))| {
            let cells = compared.around[node as usize].iter();
            let regions = cells
                .filter(|c| **c != NO_CELL)
                .map(|&c| compared.model.cells[c as usize].region.0);
            let at = compared.model.nodes[node as usize];
            (at, regions.max().unwrap_or(0), f64::from(distance))
        })
        .collect()
}

fn nodes_of(compared: &Compared<'_>) -> Vec<usize> {
    let cells = &compared.model.cells;
    let mut nodes = vec![0; compared.model.regions.len()];
    for around in compared.around {
        let mut seen = 0_u64;
        for &cell in around.iter().filter(|c| **c != NO_CELL) {
            seen |= 1 << cells[cell as usize].region.index();
        }
        while seen != 0 {
            nodes[seen.trailing_zeros() as usize] += 1;
            seen &= seen - 1;
        }
    }
    nodes
}

/// Distances outside of thin parts.
#[derive(Debug, Default)]
struct SoundDistances {
    sum: f64,
    weight: f64,
    max: f64,
}

impl SoundDistances {
    fn put(&mut self, distance: f64, weight: f64, thin: bool) {
        if !thin {
            self.sum += distance * weight;
            self.weight += weight;
            self.max = self.max.max(distance);
        }
    }

    fn mean(&self) -> f64 {
        if self.weight > 0.0 {
            self.sum / self.weight
        } else {
            0.0
        }
    }
}

/// A distance in m from the input, and whether it belongs to a thin part.
type Found = (f32, bool);

/// Distances of the nodes of each interface, sorted.
fn corner_distances(compared: &Compared<'_>) -> Vec<((Interface, u32), Found)> {
    let corners = compared.faces.iter();
    let mut corners: Vec<(Interface, u32)> = corners
        .flat_map(|f| f.nodes.map(|n| (f.interface(), n)))
        .collect();
    corners.par_sort_unstable();
    corners.dedup();
    corners
        .into_par_iter()
        .map(|(interface, node)| {
            let at = compared.model.nodes[node as usize];
            ((interface, node), distance(interface, &at, compared))
        })
        .collect()
}

fn distance(interface: Interface, point: &Vec3, compared: &Compared<'_>) -> Found {
    let Some(nearest) = compared
        .interfaces
        .bvh(interface)
        .nearest(point, f64::INFINITY)
    else {
        return (0.0, true);
    };
    let thin = compared.thin.is_marked(point) || compared.thin.is_marked(&nearest);
    ((nearest - point).norm() as f32, thin)
}

/// Face-connected pieces of each region's cells.
fn components(model: &Model) -> Vec<usize> {
    let mut counts = vec![0; model.regions.len()];
    let mut seen = vec![false; model.cells.len()];
    let mut stack = Vec::new();
    for seed in 0..model.cells.len() {
        if seen[seed] {
            continue;
        }
        seen[seed] = true;
        stack.push(seed);
        counts[model.cells[seed].region.index()] += 1;
        while let Some(cell) = stack.pop() {
            for next in model.cells[cell].neighbours {
                if next != NO_CELL
                    && !seen[next as usize]
                    && model.cells[next as usize].region == model.cells[cell].region
                {
                    seen[next as usize] = true;
                    stack.push(next as usize);
                }
            }
        }
    }
    counts
}

/// Distance in m of a node from the nearest of its interfaces.
pub(super) fn off_interface(
    interfaces: &Interfaces,
    of: impl Iterator<Item = Interface>,
    at: &Vec3,
) -> f64 {
    let distances = of.filter_map(|i| interfaces.bvh(i).nearest(at, f64::INFINITY));
    let least = distances
        .map(|p| (p - at).norm())
        .fold(f64::INFINITY, f64::min);
    if least.is_finite() { least } else { 0.0 }
}
