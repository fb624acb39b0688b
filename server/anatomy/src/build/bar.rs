//! Virtual bars: Young's modulus and Poisson's ratio of a built region compared with those of its material.
//!
//! From each region that is not pinned a bar of cells is cut: a box of the lattice that lies wholly within the
//! region, with its nodes where the builder placed them. Its ends are pulled apart by a small strain. With F
//! the force on them, ε the strain of its middle half and A the sections of that half,
//!
//! ```text
//! E = F <1/A> / ε
//! ```
//!
//! Poisson's ratio is the mean strain of that half across the bar over -ε. Both are compared with those of the
//! material's tensor in that direction (`Region::tension_along`).

use palpate_tissue::cell::NO_CELL;
use palpate_tissue::{Budget, Cell, Model, RegionId, Tension, Tissue, Topology, Vec3};
use rayon::prelude::*;

use super::report::BarReport;

/// Widths of a bar in cells, tried from the first to the last. Wider bars are no more accurate; 5 x 5 x 20
/// cells are found and pulled in a few milliseconds.
const WIDTHS: [usize; 4] = [5, 4, 3, 2];
/// Length of a bar in widths: the clamped ends disturb one width each.
const SLENDER: usize = 4;
/// Strain of a pull. It is small, because stiffening springs have the material's modulus at rest only.
const STRAIN: f64 = 1e-3;
/// Relative residual and most iterations of a pull. The residual is a tenth of the accuracy required of the
/// modulus.
const TOLERANCE: f64 = 5e-4;
const ITERATIONS: usize = 200;

/// A bar for every region that is not pinned.
pub(super) fn bars(model: &Model) -> Vec<BarReport> {
    let regions: Vec<usize> = (0..model.regions.len())
        .filter(|&r| !model.regions[r].pinned)
        .collect();
    regions.par_iter().map(|&r| bar(model, r)).collect()
}

fn bar(model: &Model, region: usize) -> BarReport {
    let of = &model.regions[region];
    let mut report = BarReport {
        region: of.name.clone(),
        cells: [0; 3],
        axis: 0,
        expected_kpa: of.material.young_pa / 1e3,
        measured_kpa: None,
        expected_poisson: of.material.poisson,
        measured_poisson: None,
    };
    let Some(place) = Grid::new(model, region).and_then(|grid| grid.largest_box()) else {
        return report;
    };
    report.cells = place.size;
    report.axis = place.axis;
    let expected = of.tension_along(Vec3::ith(place.axis, 1.0));
    report.expected_kpa = expected.young_pa / 1e3;
    report.expected_poisson = expected.poisson;
    let topology = Topology::new(cut_out(model, region, &place).into());
    let measured = pull(&topology, &place, expected.poisson);
    report.measured_kpa = measured.map(|m| m.young_pa / 1e3);
    report.measured_poisson = measured.map(|m| m.poisson);
    report
}

/// A box of cells: its low corner in lattice coordinates, its size in cells, its long axis.
#[derive(Debug, Clone, Copy)]
struct Place {
    low: [i32; 3],
    size: [usize; 3],
    axis: usize,
}

/// Summed-area table: number of a region's cells in each box from the low corner on.
struct Grid {
    low: [i32; 3],
    /// Points: one more than cells along each axis.
    points: [usize; 3],
    sums: Vec<u32>,
    /// Twice the middle of the region's cells, from the low corner.
    middle: [i64; 3],
}

impl Grid {
    /// `None` when the region has no cell.
    fn new(model: &Model, region: usize) -> Option<Self> {
        let cells = || cells_of(model, region).map(|(_, at)| at);
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        let (mut sum, mut count) = ([0_i64; 3], 0_i64);
        for at in cells() {
            for a in 0..3 {
                low[a] = low[a].min(at[a]);
                high[a] = high[a].max(at[a]);
                sum[a] += i64::from(at[a]);
            }
            count += 1;
        }
        if count == 0 {
            return None;
        }
        let points: [usize; 3] = std::array::from_fn(|a| (high[a] - low[a]) as usize + 2);
        let mut grid = Self {
            low,
            points,
            sums: vec![0; points.iter().product()],
            middle: std::array::from_fn(|a| 2 * sum[a] / count + 1 - 2 * i64::from(low[a])),
        };
        let place = |at: [i32; 3]| std::array::from_fn(|a| (at[a] - low[a]) as usize + 1);
        for at in cells() {
            let index = grid.index(place(at));
            grid.sums[index] = 1;
        }
        for index in grid.beside_gaps(model, region, place) {
            grid.sums[index] = 0;
        }
        let strides = [1, points[0], points[0] * points[1]];
        for (a, stride) in strides.into_iter().enumerate() {
            for i in 0..grid.sums.len() {
                if i / stride % points[a] > 0 {
                    grid.sums[i] += grid.sums[i - stride];
                }
            }
        }
        Some(grid)
    }

    /// Cells that are no neighbours of a cell of the region in the next place: a gap parts them, and a bar.
    fn beside_gaps(
        &self,
        model: &Model,
        region: usize,
        place: impl Fn([i32; 3]) -> [usize; 3],
    ) -> Vec<usize> {
        let mut beside = Vec::new();
        for (cell, at) in cells_of(model, region) {
            let at = place(at);
            for face in (0..6).filter(|f| cell.neighbours[*f] == NO_CELL) {
                let mut next = at;
                next[face / 2] = next[face / 2] - 1 + face % 2 * 2;
                let within = next[face / 2] < self.points[face / 2];
                if within && self.sums[self.index(next)] != 0 {
                    beside.push(self.index(at));
                }
            }
        }
        beside
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        x + self.points[0] * (y + self.points[1] * z)
    }

    /// Number of the region's cells in the box at `low`.
    fn count(&self, low: [usize; 3], size: [usize; 3]) -> u32 {
        let at = |c: usize| {
            let corner = std::array::from_fn(|a| low[a] + size[a] * (c >> a & 1));
            self.sums[self.index(corner)]
        };
        // Unsigned sums may pass below zero on the way.
        [7, 1, 2, 4]
            .map(at)
            .into_iter()
            .fold(0_u32, u32::wrapping_add)
            .wrapping_sub([3, 5, 6, 0].map(at).into_iter().fold(0, u32::wrapping_add))
    }

    /// The widest bar that is full; among bars of this width the one nearest to the region's middle.
    fn largest_box(&self) -> Option<Place> {
        WIDTHS.into_iter().find_map(|width| {
            let places = (0..3).filter_map(|axis| self.nearest_box(width, axis));
            places.min_by_key(|p| p.0).map(|p| p.1)
        })
    }

    /// The full box of one width along one axis that is nearest to the middle, with its distance.
    fn nearest_box(&self, width: usize, axis: usize) -> Option<(i64, Place)> {
        let mut size = [width; 3];
        size[axis] = width * SLENDER;
        let rooms: [usize; 3] = std::array::from_fn(|a| self.points[a].saturating_sub(size[a]));
        let full = size.iter().product::<usize>() as u32;
        let mut best: Option<(i64, [usize; 3])> = None;
        for z in 0..rooms[2] {
            for y in 0..rooms[1] {
                for x in 0..rooms[0] {
                    let low = [x, y, z];
                    let off = |a: usize| (2 * low[a] + size[a]) as i64 - self.middle[a];
                    let square = (0..3).map(|a| off(a) * off(a)).sum();
                    if best.is_none_or(|b| square < b.0) && self.count(low, size) == full {
                        best = Some((square, low));
                    }
                }
            }
        }
        best.map(|(square, low)| {
            let low = std::array::from_fn(|a| self.low[a] + low[a] as i32);
            (square, Place { low, size, axis })
        })
    }
}

/// A region's cells with their lattice coordinates.
fn cells_of(model: &Model, region: usize) -> impl Iterator<Item = (&Cell, [i32; 3])> {
    let cells = model.cells.iter();
    cells
        .filter(move |c| c.region.index() == region)
        .map(|c| (c, model.lattice[c.corners[0] as usize]))
}

/// The bar as a model of its own, its nodes where they are; numbered along the lattice.
fn cut_out(model: &Model, region: usize, place: &Place) -> Model {
    let [nx, ny, nz] = place.size;
    let points = [nx + 1, ny + 1, nz + 1];
    let cell_at = |[x, y, z]: [usize; 3]| x + nx * (y + ny * z);
    let node_at = |[x, y, z]: [usize; 3]| x + points[0] * (y + points[1] * z);
    let mut nodes = vec![Vec3::zeros(); points.iter().product()];
    let mut lattice = vec![[0; 3]; nodes.len()];
    let blank = Cell {
        corners: [0; 8],
        neighbours: [NO_CELL; 6],
        region: RegionId(0),
    };
    let mut cells = vec![blank; nx * ny * nz];
    for (cell, at) in cells_of(model, region) {
        let from: [i32; 3] = std::array::from_fn(|a| at[a] - place.low[a]);
        if (0..3).any(|a| from[a] < 0 || from[a] >= place.size[a] as i32) {
            continue;
        }
        let from = from.map(|v| v as usize);
        let own = &mut cells[cell_at(from)];
        for (c, &node) in cell.corners.iter().enumerate() {
            let corner = std::array::from_fn(|a| from[a] + (c >> a & 1));
            let to = node_at(corner);
            own.corners[c] = to as u32;
            nodes[to] = model.nodes[node as usize];
            lattice[to] = model.lattice[node as usize];
        }
        for face in 0..6 {
            let (axis, up) = (face / 2, face % 2 == 1);
            let mut to = from;
            let inside = if up {
                to[axis] += 1;
                to[axis] < place.size[axis]
            } else {
                to[axis] = to[axis].wrapping_sub(1);
                from[axis] > 0
            };
            if inside {
                own.neighbours[face] = cell_at(to) as u32;
            }
        }
    }
    Model {
        spacing_m: model.spacing_m,
        gravity: [0.0; 3],
        regions: vec![model.regions[region].clone()],
        nodes,
        lattice,
        cells,
    }
}

/// Pulls a bar along its axis, from the strain that `thinning` as Poisson's ratio expects. Returns its response, or `None`
/// when no equilibrium is found.
fn pull(topology: &Topology, place: &Place, thinning: f64) -> Option<Tension> {
    let axis = place.axis;
    let layers = place.size[axis];
    let layer = |node: u32| {
        let at = topology.model().lattice[node as usize][axis];
        (at - place.low[axis]) as usize
    };
    let mut tissue = Tissue::at_rest(topology.clone());
    let nodes = 0..topology.node_count() as u32;
    let middle = nodes.clone().map(|n| topology.rest(n)).sum::<Vec3>() / nodes.len() as f64;
    // The initial guess is the bar without clamps, so that only their effect has to be solved for.
    let stretched = |node: u32| {
        let from = topology.rest(node) - middle;
        let mut u = from * (-STRAIN * thinning);
        u[axis] = STRAIN * from[axis];
        (node, u)
    };
    let stretched: Vec<(u32, Vec3)> = nodes.clone().map(stretched).collect();
    tissue.displace(&stretched);
    for (node, u) in stretched {
        if layer(node) % layers == 0 {
            tissue.hold(node, Vec3::ith(axis, u[axis]));
        }
    }
    let budget = Budget::new(ITERATIONS, TOLERANCE);
    let residual = tissue.step(&[], budget).residual;
    if residual > TOLERANCE {
        return None;
    }
    // The reaction opposes the displacement.
    let force: f64 = nodes
        .clone()
        .filter(|&n| layer(n) == layers)
        .map(|n| -tissue.force_on(n)[axis])
        .sum();
    let (from, to) = (layers / 4, layers - layers / 4);
    let strain = [0, 1, 2].map(|a| {
        let inside = nodes.clone().filter(|&n| (from..=to).contains(&layer(n)));
        let displacement = &tissue.shape().displacement;
        slope(inside.map(|n| (topology.rest(n)[a], displacement[n as usize][a])))
    });
    let along = strain[axis];
    let across = 0.5 * (strain.iter().sum::<f64>() - along);
    Some(Tension {
        young_pa: force * mean_inverse_section(topology, &layer, from..to, axis) / along,
        poisson: -across / along,
    })
}

/// <1/A> over some layers of cells, each as thick as the mean of its nodes.
fn mean_inverse_section(
    topology: &Topology,
    layer: &impl Fn(u32) -> usize,
    layers: std::ops::Range<usize>,
    axis: usize,
) -> f64 {
    let mut volumes = vec![0.0; layers.end + 1];
    for cell in 0..topology.cell_count() as u32 {
        volumes[layer(topology.corners(cell)[0]).min(layers.end)] += topology.volume(cell);
    }
    let mut heights = vec![(0.0, 0.0); layers.end + 1];
    for node in 0..topology.node_count() as u32 {
        if let Some(height) = heights.get_mut(layer(node)) {
            height.0 += topology.rest(node)[axis];
            height.1 += 1.0;
        }
    }
    let at = |l: usize| heights[l].0 / heights[l].1;
    let inverse = layers
        .clone()
        .map(|l| (at(l + 1) - at(l)).powi(2) / volumes[l]);
    inverse.sum::<f64>() / (at(layers.end) - at(layers.start))
}

/// Slope of the straight line nearest to some points.
fn slope(points: impl Iterator<Item = (f64, f64)> + Clone) -> f64 {
    let n = points.clone().count() as f64;
    let (x, y) = points
        .clone()
        .fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
    let (x, y) = (x / n, y / n);
    let (mut xx, mut xy) = (0.0, 0.0);
    for (a, b) in points {
        xx += (a - x) * (a - x);
        xy += (a - x) * (b - y);
    }
    xy / xx
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{FibreAxis, Material, block};

    fn model(cells: [usize; 3], material: &Material) -> Model {
        block(cells, 0.004, material, 1)
    }

    #[test]
    fn bar_of_cubes_has_the_material_modulus() {
        for poisson in [0.25, 0.45] {
            let material = Material {
                poisson,
                ..Material::default()
            };
            let reports = bars(&model([6, 26, 7], &material));
            assert_eq!(reports.len(), 1, "the pinned base has none");
            let report = &reports[0];
            assert_eq!((report.cells, report.axis), ([5, 20, 5], 1));
            assert!(
                (report.expected_kpa / 10.0 - 1.0).abs() < 1e-4,
                "{report:?}"
            );
            let measured = report.measured_kpa.unwrap();
            assert!((measured / 10.0 - 1.0).abs() < 0.02, "{report:?}");
            let ratio = report.measured_poisson.unwrap();
            assert!((ratio / poisson - 1.0).abs() < 0.05, "{report:?}");
        }
    }

    #[test]
    fn fibred_bar_has_the_modulus_of_its_direction() {
        let material = Material {
            fibre_ratio: 3.0,
            fibre_axis: FibreAxis::Given([1.0, 0.0, 0.0]),
            ..Material::default()
        };
        let expected = |cells| bars(&model(cells, &material))[0].expected_kpa;
        assert!((expected([10, 3, 3]) / 30.0 - 1.0).abs() < 1e-3);
        assert!((expected([3, 10, 3]) / 10.0 - 1.0).abs() < 1e-3);
    }

    #[test]
    fn thin_region_has_no_bar() {
        let reports = bars(&model([20, 20, 2], &Material::default()));
        assert_eq!(reports[0].cells, [0; 3]);
        assert_eq!(reports[0].measured_kpa, None);
    }

    #[test]
    fn bar_uses_moved_node_positions() {
        let mut model = model([5, 5, 22], &Material::default());
        let turn = |i: usize, k: usize| ((i * 7 + k * 13) % 11) as f64 / 11.0 - 0.5;
        for i in 0..model.nodes.len() {
            model.nodes[i] += Vec3::new(turn(i, 0), turn(i, 1), turn(i, 2)) * 0.0012;
        }
        let report = bars(&model).remove(0);
        assert_eq!(report.cells, [5, 5, 20]);
        let measured = report.measured_kpa.unwrap();
        assert!((measured / 10.0 - 1.0).abs() < 0.05, "{measured}");
    }
}
