//! Deep presses of a soft layer over a rigid one. Extreme springs transmit the force, no cell folds, and the
//! iteration does not cycle.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod places;

use std::sync::Arc;

use palpate_anatomy::build;
use palpate_anatomy::sample::Sample;
use palpate_tissue::{Budget, Material, StepReport, Tissue, Tool, Topology, Vec3, block};

use places::outermost;

const MM: f64 = 1e-3;
/// Radius of the sphere in m.
const RADIUS: f64 = 8.0 * MM;
/// Spacing and cells of the slab: a layer of fat on a pinned layer of bone.
const SPACING: f64 = 2.0 * MM;
const FAT_CELLS: usize = 7;
const THICKNESS: f64 = SPACING * FAT_CELLS as f64;
const ACROSS: usize = 20;
/// θ of the guard: the minimum ratio of a spring's projection on its rest direction to its rest length.
const GUARDED: f64 = 0.3;
/// Residual that counts as converged here; forces are then accurate to 1e-3.
const CONVERGED: f64 = 1e-5;

/// A layer of tissue under a sphere.
struct Press {
    tissue: Tissue,
    /// First point of contact of the sphere, and the outward normal there.
    at: Vec3,
    normal: Vec3,
}

impl Press {
    fn new(topology: Topology, at: Vec3, normal: Vec3) -> Self {
        let tissue = Tissue::at_rest(topology);
        Self { tissue, at, normal }
    }

    /// Fat over bone; `limit` is the compression limit of the springs.
    fn slab(limit: f64) -> Self {
        Self::slab_of(limit, Material::built_in("fat").unwrap().poisson)
    }

    fn slab_of(limit: f64, poisson: f64) -> Self {
        let fat = Material {
            compress_limit: limit,
            poisson,
            ..Material::built_in("fat").unwrap()
        };
        let mut model = block([ACROSS, ACROSS, FAT_CELLS + 1], SPACING, &fat, 1);
        model.regions[0].material = Material::built_in("bone").unwrap();
        let middle = 0.5 * SPACING * ACROSS as f64;
        let at = Vec3::new(middle, middle, THICKNESS + SPACING);
        Self::new(Topology::new(Arc::new(model)), at, Vec3::z())
    }

    fn tool(&self, depth: f64) -> Tool {
        Tool::ball(1, self.at + self.normal * (RADIUS - depth), RADIUS)
    }

    fn step(&mut self, depth: f64, iterations: usize, tolerance: f64) -> StepReport {
        let tool = self.tool(depth);
        let budget = Budget::new(iterations, tolerance);
        let report = self.tissue.step(&[tool], budget);
        assert!(!report.rolled_back, "blown up at {} mm", depth / MM);
        report.clone()
    }

    /// Presses to `depth` in steps of a quarter of a millimetre and converges there.
    fn down(&mut self, from: f64, depth: f64) -> f64 {
        let steps = ((depth - from) / (0.25 * MM)).ceil().max(1.0) as usize;
        for s in 1..steps {
            let part = s as f64 / steps as f64;
            self.step(from + (depth - from) * part, 20, 1e-3);
        }
        let mut report = StepReport::default();
        for _ in 0..4 {
            report = self.step(depth, 300, CONVERGED);
            if report.residual <= CONVERGED && report.lag_m == 0.0 {
                break;
            }
        }
        println!(
            "{:.2} mm: {:.5} N, residual {:.1e}, {} iterations, corner {:.3}, part {:.3}",
            depth / MM,
            report.reactions[0].force.dot(&self.normal),
            report.residual,
            report.iterations,
            self.least_corner(),
            self.least_part()
        );
        report.reactions[0].force.dot(&self.normal)
    }

    /// The least determinant of the edges at any corner of any cell, over that at rest.
    fn least_corner(&self) -> f64 {
        let cells = 0..self.tissue.topology().cell_count() as u32;
        let per_cell = cells.map(|cell| {
            let nodes = self.tissue.topology().corners(cell);
            let now = nodes.map(|n| self.tissue.shape().position(self.tissue.topology(), n));
            let rest = nodes.map(|n| self.tissue.topology().rest(n));
            let pairs = (0..8).map(|c| determinant(&now, c) / determinant(&rest, c));
            pairs.fold(f64::MAX, f64::min)
        });
        per_cell.fold(f64::MAX, f64::min)
    }

    /// The least ratio of any spring's projection on its rest direction to its rest length.
    fn least_part(&self) -> f64 {
        let mut least = f64::MAX;
        for node in 0..self.tissue.topology().node_count() as u32 {
            let at = self.tissue.shape().position(self.tissue.topology(), node);
            for spring in self.tissue.topology().springs_of(node) {
                let rest =
                    self.tissue.topology().rest(spring.to) - self.tissue.topology().rest(node);
                let now = self
                    .tissue
                    .shape()
                    .position(self.tissue.topology(), spring.to)
                    - at;
                least = least.min(now.dot(&rest) / rest.norm_squared());
            }
        }
        least
    }
}

/// Determinant of the three edges at a corner of a cell.
fn determinant(corners: &[Vec3; 8], c: usize) -> f64 {
    let [x, y, z] = [1, 2, 4].map(|step| corners[c | step] - corners[c & !step]);
    x.dot(&y.cross(&z))
}

/// The default compression limit, and one that a moderate press reaches already.
const LIMITS: [f64; 2] = [0.3, 0.8];

#[test]
fn force_over_bone_rises_steeply_in_deep_presses() {
    for limit in LIMITS {
        let [springs, tissue] = [0.25, 0.45].map(|poisson| {
            let mut press = Press::slab_of(limit, poisson);
            let mut last = 0.0;
            let mut forces = vec![0.0];
            for part in 1..=19 {
                let depth = THICKNESS * 0.05 * f64::from(part);
                forces.push(press.down(last, depth));
                last = depth;
            }
            forces
        });
        // A sphere on a half-space has 3.2 times the slope in its last fifth.
        for (forces, least) in [(&springs, 10.0), (&tissue, 4.0)] {
            let first = forces[4] / 4.0;
            let slopes: Vec<f64> = forces.windows(2).map(|w| (w[1] - w[0]) / first).collect();
            let most = slopes.iter().copied().fold(f64::MIN, f64::max);
            assert!(most >= least, "limit {limit}: slopes {slopes:.2?}");
        }
        // Nearly incompressible tissue must flow out from under the sphere, so it resists from the beginning. Beyond 90 % its
        // slope falls (server/tissue/DECISIONS.md).
        let stiffer = springs[..19].iter().zip(&tissue).all(|(a, b)| b >= a);
        assert!(stiffer, "limit {limit}: {springs:.4?} {tissue:.4?}");
    }
}

#[test]
fn extreme_springs_converge_under_a_resting_tool() {
    for limit in LIMITS {
        for part in [0.3, 0.5, 0.7, 0.8, 0.9] {
            let mut press = Press::slab(limit);
            press.down(0.0, THICKNESS * part);
            for _ in 0..50 {
                press.step(THICKNESS * part, 1, 1e-12);
            }
            let forces: Vec<f64> = (0..50)
                .map(|_| {
                    let report = press.step(THICKNESS * part, 1, 1e-12);
                    report.reactions[0].force.z
                })
                .collect();
            let least = forces.iter().copied().fold(f64::MAX, f64::min);
            let most = forces.iter().copied().fold(f64::MIN, f64::max);
            println!("limit {limit}, {part}: {least} to {most} N");
            assert!(
                most - least < 1e-3 * most,
                "limit {limit}, at {part} of the layer: {forces:.5?}"
            );
        }
    }
}

/// Presses into the outer layer; checks that cells stay valid and that the guard stays inactive in moderate
/// presses.
fn press_into(mut press: Press, thickness: f64, parts: &[f64]) {
    let mut last = 0.0;
    for &part in parts {
        press.down(last, part * thickness);
        last = part * thickness;
        let (corner, kept) = (press.least_corner(), press.least_part());
        assert!(corner > 0.0, "corner {corner} at {part} of the layer");
        if part <= 0.4 {
            assert!(kept >= GUARDED, "a spring at {kept} at {part} of the layer");
        }
    }
}

#[test]
fn press_of_80_percent_into_slab_inverts_no_cell() {
    press_into(
        Press::slab(LIMITS[0]),
        THICKNESS,
        &[0.1, 0.2, 0.3, 0.4, 0.6, 0.8],
    );
}

#[test]
fn press_of_40_percent_into_thigh_inverts_no_cell() {
    let input = Sample::Thigh.input().unwrap();
    let (model, _) = build(&input, &mut |_, _| {}).unwrap();
    let topology = Topology::new(Arc::new(model));
    // Along -x the tool meets a corner that is flat at rest, which a press of a tenth of the layer inverts.
    for normal in [Vec3::x(), Vec3::y()] {
        let at = outermost(&topology, normal);
        let thickness = layer(&topology, at, -normal);
        println!("along {normal:?}, a layer of {} mm", thickness / MM);
        let press = Press::new(topology.clone(), at, normal);
        press_into(press, thickness, &[0.1, 0.2, 0.3, 0.4]);
    }
}

/// Thickness of the outer region under a point of the surface: distance along the inward line to the middle of
/// the first nearby cell of another region, less half a cell.
fn layer(topology: &Topology, at: Vec3, inward: Vec3) -> f64 {
    let spacing = topology.model().spacing_m;
    let mut least = f64::MAX;
    for cell in 0..topology.cell_count() as u32 {
        let sum: Vec3 = topology
            .corners(cell)
            .iter()
            .map(|&n| topology.rest(n))
            .sum();
        let from = sum / 8.0 - at;
        let depth = from.dot(&inward);
        let beside = (from - inward * depth).norm();
        if topology.region(cell).index() != 0 && depth > 0.0 && beside < spacing {
            least = least.min(depth - 0.5 * spacing);
        }
    }
    least
}
