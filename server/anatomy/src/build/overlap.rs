//! Volume that the model and its input have in common, and the connected components of the input.
//!
//! Parallel rays run through both, and stretches of one region in both are counted: nine rays per cell column, in rows
//! that are turned against the lattice, or rays along the rows of a label volume. The model is then measured against the
//! voxels instead of the surface that was extracted from them. The distance of these rays is no whole fraction of a voxel, so
//! that they meet the steps between rows at all heights; rays in the middle of voxels would never see them. Components of
//! labels are exact.

use nalgebra::Matrix3;
use palpate_tissue::{Model, RegionId, Vec3};
use rayon::prelude::*;

use super::components::{Component, KnownParts, PartWalls, Piece, Shared, components, merge};
use super::faces::Face;
use super::grid::Grid;
use super::inside::PointQuery;
use super::layers::surface_of;
use super::parts::ClosedParts;
use super::rays::{Hits, Rays, cast_at};
use super::small_parts::{SmallPart, small_parts};
use super::strands::{Strand, Strands, Touching};
use crate::Surface;
use crate::labels::{Affine, VoxelRuns};
use crate::scene::SceneInput;

/// The frame that the rays run in.
struct Frame {
    to_world: Affine,
    rays: Rays,
    /// Volume in m³ that a unit of a ray stands for.
    volume: f64,
}

/// The input as stretches of rays.
pub(super) struct InputRays {
    frame: Frame,
    strands: Strands,
    /// Rows of voxels that the strands follow; without them there is a row per ray.
    rows: Option<Rows>,
    /// For each surface, the part of its rays that no later region covers. Empty with voxels.
    kept: Vec<f64>,
    /// Closed parts that are measured by lines of their own. None with voxels.
    small: Vec<SmallPart>,
    known: KnownParts,
}

/// Rows of voxels.
struct Rows {
    to_world: Affine,
    /// Along j and k.
    count: [usize; 2],
    /// Distance of rays in rows.
    step: [f64; 2],
}

/// Hits of rays below which a whole closed part is measured by lines of its own: 64 rays measure a volume within some
/// percent.
const FEW_HITS: u32 = 128;

/// Rays across a cell, along y and along z.
const RAYS_ACROSS: usize = 3;

/// Slope of the rows of rays through surfaces, the golden section. Faces along the lattice then cross the rows at all
/// heights; with rows along the lattice a wall is off by up to half the distance of rays, a sixth of a spacing.
const ROWS_SLOPE: f64 = 0.618_033_988_749_894_8;

/// Distance of rays in parts of a row that several rays share evenly; an irrational number.
const UNEVEN: f64 = 0.866_025_403_784_438_6;

/// Volumes of a region in m³.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Volumes {
    pub(super) input: f64,
    pub(super) model: f64,
    pub(super) common: f64,
}

impl Volumes {
    /// Dice coefficient; 1 for two empty regions.
    pub(super) fn dice(&self) -> f64 {
        let sum = self.input + self.model;
        if sum > 0.0 {
            2.0 * self.common / sum
        } else {
            1.0
        }
    }

    /// Volume of the symmetric difference in m³.
    pub(super) fn difference(&self) -> f64 {
        (self.input + self.model - 2.0 * self.common).max(0.0)
    }

    /// The same as a part of the input; 0 where there is no input.
    pub(super) fn difference_part(&self) -> f64 {
        if self.input > 0.0 {
            self.difference() / self.input
        } else {
            0.0
        }
    }
}

/// The model against its input.
pub(super) struct Overlap {
    /// Of each region.
    pub(super) volumes: Vec<Volumes>,
    pub(super) components: Vec<Component>,
}

impl InputRays {
    /// Rays through the voxels of a scene, or through its surfaces where not all regions come from one label volume.
    pub(super) fn of(
        input: &SceneInput,
        grid: &Grid,
        surfaces: &[&Surface],
        parts: &[ClosedParts],
        query: &PointQuery,
    ) -> Self {
        match &input.voxels {
            Some(voxels) => Self::of_voxels(voxels, grid.spacing),
            None => Self::of_surfaces(grid, surfaces, parts, query),
        }
    }

    /// Rays along x, because the cells were chosen by rays along z. Their rows are turned about x.
    fn of_surfaces(
        grid: &Grid,
        surfaces: &[&Surface],
        parts: &[ClosedParts],
        query: &PointQuery,
    ) -> Self {
        let step = grid.spacing / RAYS_ACROSS as f64;
        let cosine = 1.0 / (1.0 + ROWS_SLOPE * ROWS_SLOPE).sqrt();
        let sine = ROWS_SLOPE * cosine;
        let turn = Matrix3::new(1.0, 0.0, 0.0, 0.0, cosine, -sine, 0.0, sine, cosine);
        // Along y and z of the frame.
        let reach = [1, 2].map(|a| {
            let sides = turn.column(a).abs().component_mul(&grid.extent());
            sides.sum() / 2.0
        });
        let frame = Frame {
            to_world: Affine {
                linear: turn,
                origin: grid.middle(),
            },
            rays: Rays {
                axis: 0,
                first: reach.map(|r| step / 2.0 - r),
                step,
                count: reach.map(|r| (2.0 * r / step).ceil() as usize),
            },
            volume: step * step,
        };
        let hits: Vec<Hits> = surfaces
            .iter()
            .map(|s| cast_at(&frame.placed(&s.vertices), &s.triangles, &frame.rays))
            .collect();
        let mut strands = Strands::of_hits(&hits, &frame.rays, 0.0, 1.0);
        let kept = strands.kept(&hits);
        let walls = PartWalls::of(&strands, &hits, &frame.rays, parts);
        let doubt = walls.in_doubt(&strands, FEW_HITS);
        let are_whole = |(r, doubt): (usize, &Vec<bool>)| {
            parts[r].are_whole(surfaces[r], r, doubt, (query, grid.spacing))
        };
        let whole: Vec<Vec<bool>> = doubt.iter().enumerate().map(are_whole).collect();
        let small = surfaces.iter().enumerate().flat_map(|(r, surface)| {
            // The rest of a part that later regions cut may be several components, which only rays tell apart.
            let hits = |part| walls.hits(r, part);
            let is_small = |p| hits(p) == 0 || (hits(p) < FEW_HITS && whole[r][p as usize]);
            small_parts(r, surface, &parts[r], query, is_small)
        });
        let small: Vec<SmallPart> = small.collect();
        Self {
            kept,
            known: walls.join(&mut strands, &whole, &small),
            small,
            strands,
            frame,
            rows: None,
        }
    }

    /// Rays along the rows of a label volume, at most half a spacing and at most a row apart.
    fn of_voxels(voxels: &VoxelRuns, spacing: f64) -> Self {
        let sides = voxels.to_world.spacing_m();
        let step = [1, 2].map(|a| UNEVEN / (2.0 * sides[a] / spacing).ceil().max(1.0));
        // In the frame, rays are a unit apart. They begin beyond the image, where the model may end.
        let scale = [1.0, step[0], step[1]];
        let to_world = Affine {
            linear: Matrix3::from_fn(|r, c| voxels.to_world.linear[(r, c)] * scale[c]),
            origin: voxels.to_world.origin,
        };
        let margin = [0, 1].map(|a| (spacing / (sides[a + 1] * step[a])).ceil());
        let count = [voxels.size[1], voxels.size[2]];
        let rays = Rays {
            axis: 0,
            first: [0, 1].map(|a| 0.5 - margin[a] - 0.5 / step[a]),
            step: 1.0,
            count: [0, 1].map(|a| (count[a] as f64 / step[a] + 2.0 * margin[a]).ceil() as usize),
        };
        let rows = (0..count[1]).into_par_iter().map(|k| {
            let (mut ends, mut strands) = (Vec::with_capacity(count[0]), Vec::new());
            for j in 0..count[0] {
                strands.extend(voxels.row([j, k]).iter().map(|run| {
                    let [from, to] = run.range.map(|i| f64::from(i) - 0.5);
                    let region = run.region;
                    Strand { region, from, to }
                }));
                ends.push(strands.len() as u32);
            }
            (ends, strands)
        });
        Self {
            strands: Strands::of_rows(count[0], rows.collect(), Touching::Edge),
            frame: Frame {
                volume: to_world.determinant().abs(),
                to_world,
                rays,
            },
            rows: Some(Rows {
                to_world: voxels.to_world,
                count,
                step,
            }),
            kept: Vec::new(),
            small: Vec::new(),
            known: KnownParts::default(),
        }
    }

    /// For each surface, the part of its volume that no later region covers; 1 where the volume of voxels is known.
    pub(super) fn kept(&self, surface: usize) -> f64 {
        self.kept.get(surface).copied().unwrap_or(1.0)
    }

    /// The row of strands that a ray passes through; none beyond a label volume.
    fn row_of(&self, ray: [usize; 2]) -> Option<[usize; 2]> {
        let Some(rows) = &self.rows else {
            return Some(ray);
        };
        let at = self.frame.rays.position(ray);
        let row = [0, 1].map(|a| (at[a] * rows.step[a] + 0.5).floor());
        let within = (0..2).all(|a| row[a] >= 0.0 && row[a] < rows.count[a] as f64);
        within.then(|| row.map(|r| r as usize))
    }

    /// The position in the world at a depth of a row of strands.
    fn point(&self, row: [usize; 2], depth: f64) -> Vec3 {
        let (to_world, [y, z]) = match &self.rows {
            Some(rows) => (&rows.to_world, row.map(|r| r as f64)),
            None => (&self.frame.to_world, self.frame.rays.position(row)),
        };
        to_world.world(&Vec3::new(depth, y, z))
    }

    /// Volume in m³ that a unit of a strand stands for.
    fn strand_volume(&self) -> f64 {
        let rows = self.rows.as_ref();
        rows.map_or(self.frame.volume, |rows| rows.to_world.determinant().abs())
    }

    /// Compares the model with the input.
    pub(super) fn compare(&self, model: &Model, faces: &[Face]) -> Overlap {
        let own = self.frame.strands_of(model, faces);
        let unit = self.frame.volume;
        let rows: Vec<RowSums> = (0..self.frame.rays.count[1])
            .into_par_iter()
            .map(|v| self.row_sums(&own, v, model.regions.len()))
            .collect();
        let mut volumes = vec![Volumes::default(); model.regions.len()];
        for row in &rows {
            for (sums, one) in volumes.iter_mut().zip(&row.volumes) {
                sums.input += one.input * unit;
                sums.model += one.model * unit;
                sums.common += one.common * unit;
            }
        }
        let mut shared: Vec<Shared> = rows.into_iter().flat_map(|r| r.shared).collect();
        merge(&mut shared);
        let measured = self.small_pieces(model, faces, &own);
        Overlap {
            volumes,
            components: self.components(&shared, &measured),
        }
    }

    /// The components of the input: those of strands, then those that no strand meets. `measured` are the small parts.
    fn components(&self, shared: &[Shared], measured: &[Piece]) -> Vec<Component> {
        let point = |row, depth| self.point(row, depth);
        let unit = self.strand_volume();
        let known = (&self.known, measured);
        let mut components = components(&self.strands, shared, known, point, unit);
        let missed = self.known.missed.iter();
        components.extend(missed.map(|small| Component::from(measured[*small])));
        components
    }

    /// Measures the small parts in the model.
    fn small_pieces(&self, model: &Model, faces: &[Face], own: &Strands) -> Vec<Piece> {
        let same = self.small.chunk_by(|a, b| a.region == b.region);
        let pieces = same.map(|parts| {
            let region = parts[0].region;
            let surface = Surface {
                vertices: model.nodes.clone(),
                triangles: surface_of(model, faces, RegionId(region.into())),
            };
            let is_empty = surface.triangles.is_empty();
            let middle = self.frame.to_world.origin;
            let query = (!is_empty).then(|| PointQuery::new(&[&surface], middle, model.spacing_m));
            let component = |p| self.frame.nearest(own, region, p);
            let parts = parts.par_iter();
            parts
                .map(|part| part.piece(query.as_ref(), component))
                .collect::<Vec<_>>()
        });
        pieces.flatten().collect()
    }
}

impl Frame {
    /// Points of the world in the frame.
    fn placed(&self, points: &[Vec3]) -> Vec<Vec3> {
        let back = self
            .to_world
            .linear
            .try_inverse()
            .unwrap_or_else(Matrix3::identity);
        let place = |p: &Vec3| back * (p - self.to_world.origin);
        points.par_iter().map(place).collect()
    }

    /// The model along the rays.
    fn strands_of(&self, model: &Model, faces: &[Face]) -> Strands {
        let nodes = self.placed(&model.nodes);
        let hits = (0..model.regions.len() as u16).map(|r| {
            let triangles = surface_of(model, faces, RegionId(r));
            cast_at(&nodes, &triangles, &self.rays)
        });
        let hits: Vec<Hits> = hits.collect();
        Strands::of_hits(&hits, &self.rays, 0.0, 1.0)
    }

    /// The component of the model's region at a point, by the nearest ray that is in the region there.
    fn nearest(&self, model: &Strands, region: u8, point: Vec3) -> Option<u32> {
        let place = self.placed(&[point])[0];
        let sides = [place.y, place.z];
        let middle = [0, 1].map(|a| (sides[a] - self.rays.first[a]) / self.rays.step);
        let mut nearest = (f64::INFINITY, None);
        for near in 0..9 {
            let ray = [near % 3, near / 3];
            let ray = [0, 1].map(|a| middle[a].round() + f64::from(ray[a]) - 1.0);
            if (0..2).any(|a| ray[a] < 0.0 || ray[a] >= self.rays.count[a] as f64) {
                continue;
            }
            let off = (ray[0] - middle[0]).hypot(ray[1] - middle[1]);
            let inside = |s: &Strand| s.region == region && s.from <= place.x && place.x <= s.to;
            let mut strands = model.of(ray.map(|r| r as usize));
            if let Some((_, part)) = strands.find(|(s, _)| inside(s))
                && off < nearest.0
            {
                nearest = (off, Some(part));
            }
        }
        nearest.1
    }
}

/// Sums of a row of rays.
struct RowSums {
    /// Lengths, of each region.
    volumes: Vec<Volumes>,
    shared: Vec<Shared>,
}

impl InputRays {
    fn row_sums(&self, model: &Strands, v: usize, regions: usize) -> RowSums {
        let mut sums = RowSums {
            volumes: vec![Volumes::default(); regions],
            shared: Vec::new(),
        };
        for u in 0..self.frame.rays.count[0] {
            for (strand, _) in model.of([u, v]) {
                sums.volumes[usize::from(strand.region)].model += strand.to - strand.from;
            }
            if let Some(row) = self.row_of([u, v]) {
                sums.add(self.strands.of(row), model.of([u, v]));
            }
        }
        merge(&mut sums.shared);
        sums
    }
}

impl RowSums {
    /// Adds a ray through input and model.
    fn add<'a>(
        &mut self,
        input: impl Iterator<Item = (&'a Strand, u32)>,
        model: impl Iterator<Item = (&'a Strand, u32)>,
    ) {
        let mut model = model.peekable();
        for (a, part) in input {
            self.volumes[usize::from(a.region)].input += a.to - a.from;
            self.shared.push(Shared {
                input: part,
                model: None,
                length: a.to - a.from,
            });
            while let Some((b, own)) = model.peek() {
                let length = a.to.min(b.to) - a.from.max(b.from);
                if a.region == b.region && length > 0.0 {
                    self.volumes[usize::from(a.region)].common += length;
                    self.shared.push(Shared {
                        input: part,
                        model: Some(*own),
                        length,
                    });
                }
                if a.to < b.to {
                    break;
                }
                model.next();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::faces::faces;
    use super::super::tests::{both, built, cuboid};
    use super::*;
    use crate::LabelVolume;

    fn mm(x: f64, y: f64, z: f64) -> Vec3 {
        Vec3::new(x, y, z) * 1e-3
    }

    fn body() -> Surface {
        cuboid(mm(-40.0, -40.0, -40.0), mm(40.0, 40.0, 40.0))
    }

    #[test]
    fn dice_and_difference_are_those_of_a_shifted_box() {
        let (low, high) = (mm(0.0, 0.0, 0.0), mm(40.0, 32.0, 24.0));
        let still = cuboid(low, high);
        let (model, report) = built(4.0, &[("box", still.clone())]);
        assert!(report.regions[0].dice > 0.9999, "{report:?}");
        // Exact along the rays; across them the turned rows leave a tenth of the distance of rays.
        for (shift, error) in [
            (mm(5.0, 0.0, 0.0), 1e-3),
            (mm(0.0, 6.0, 0.0), 0.13 / 32.0),
            (mm(0.0, 0.3, 0.0), 0.13 / 32.0),
            (mm(0.0, 0.0, -3.3), 0.13 / 24.0),
            (mm(0.0, 0.0, 0.6), 0.13 / 24.0),
        ] {
            let moved = cuboid(low + shift, high + shift);
            let grid = Grid::around(&[&still, &moved], 4e-3);
            let query = PointQuery::new(&[&moved], grid.middle(), grid.spacing);
            let parts = [ClosedParts::of(&moved)];
            let rays = InputRays::of_surfaces(&grid, &[&moved], &parts, &query);
            let volumes = rays
                .compare(&model, &faces(&model.cells, &model.lattice))
                .volumes[0];
            let size = high - low;
            let common = (size - shift.abs()).product() / size.product();
            assert!(
                (volumes.dice() - common).abs() < error,
                "{shift} {volumes:?} {common}"
            );
        }
    }

    #[test]
    fn lost_component_and_its_distance_are_named_per_region() {
        // A chip flush with the outer wall: the outer surface is near, that of its own region is not.
        let bone = both(
            cuboid(mm(-30.0, -20.0, -20.0), mm(0.0, 20.0, 20.0)),
            &cuboid(mm(37.0, -2.0, -2.0), mm(40.0, 2.0, 2.0)),
        );
        let (_, report) = built(6.0, &[("body", body()), ("bone", bone)]);
        let region = &report.regions[1];
        assert!((region.volume_mm3 / region.input_volume_mm3 - 1.0).abs() < 0.01);
        assert_eq!([region.components, region.input_components], [1, 2]);
        let [lost] = report.component_loss.lost.as_slice() else {
            panic!("{:?}", report.component_loss);
        };
        assert_eq!((lost.region.as_str(), lost.kept), ("bone", 0.0));
        assert!((lost.volume_mm3 - 48.0).abs() < 0.1, "{lost:?}");
        assert!(
            (lost.at_mm[0] - 38.5).abs() < 0.1 && lost.at_mm[1].abs() < 2.0,
            "{lost:?}"
        );
        let far = region.input_distance_max_mm.unwrap();
        assert!((37.0..42.0).contains(&far), "{far}");
        assert!(
            report.regions[0].input_distance_max_mm.unwrap() < 6.0,
            "{report:?}"
        );
        // Five sides of the chip touch the body, one is outside.
        let [contact] = report.contacts.as_slice() else {
            panic!("{:?}", report.contacts);
        };
        assert!((contact.removed_mm2 - 64.0).abs() < 12.0, "{contact:?}");
        assert_eq!(contact.created_mm2, 0.0, "{contact:?}");
        let named = |what: &str| report.warnings.iter().filter(|w| w.contains(what)).count();
        assert_eq!(
            named("a component of region \"bone\" of 48"),
            1,
            "{:?}",
            report.warnings
        );
        assert_eq!(
            named("surface in the input is up to"),
            1,
            "{:?}",
            report.warnings
        );
        assert_eq!(named("do not in the model"), 1, "{:?}", report.warnings);
        assert_eq!(report.deviations, 3, "{:?}", report.warnings);
    }

    #[test]
    fn fused_bones_are_named_with_their_gap() {
        let left = || cuboid(mm(-20.0, -15.0, -15.0), mm(0.1, 15.0, 15.0));
        let right = || cuboid(mm(0.25, -15.0, -15.0), mm(20.0, 15.0, 15.0));
        let (_, report) = built(
            4.0,
            &[("body", body()), ("femur", left()), ("tibia", right())],
        );
        let pair = ["femur".to_owned(), "tibia".to_owned()];
        let contact = report.contacts.iter().find(|c| c.regions == pair);
        let contact = contact.unwrap_or_else(|| panic!("{:?}", report.contacts));
        assert_eq!(contact.input_mm2, 0.0);
        assert_eq!(contact.created_mm2, contact.model_mm2);
        assert!(
            (400.0..1000.0).contains(&contact.created_mm2),
            "{contact:?}"
        );
        assert!(
            (contact.gap_min_mm.unwrap() - 0.15).abs() < 0.01,
            "{contact:?}"
        );
        assert!(contact.created_at_mm.unwrap()[0].abs() < 2.0, "{contact:?}");
        assert!(
            report.component_loss.merged.is_empty(),
            "{:?}",
            report.component_loss
        );

        let (_, report) = built(4.0, &[("body", body()), ("bone", both(left(), &right()))]);
        let [merged] = report.component_loss.merged.as_slice() else {
            panic!("{:?}", report.component_loss);
        };
        assert!(
            (merged.component.volume_mm3 - 19.75 * 900.0).abs() < 1000.0,
            "{merged:?}"
        );
        let places = [merged.component.at_mm[0], merged.with_mm[0]];
        assert!(
            (places[0] - 10.125).abs() < 0.1 && (places[1] + 9.95).abs() < 0.1,
            "{merged:?}"
        );
        assert!(report.component_loss.lost.is_empty());
    }

    #[test]
    fn voxels_that_share_an_edge_are_one_component_and_those_that_share_a_corner_are_not() {
        // From the voxel at (1, 1, 1), the other one is one step away along these axes.
        let steps = (1..27).map(|n| [n % 3, n / 3 % 3, n / 9]);
        for step in steps.filter(|s| *s != [1, 1, 1]) {
            let mut labels = vec![0_u16; 27];
            labels[13] = 1;
            labels[step[0] + 3 * step[1] + 9 * step[2]] = 1;
            let volume = LabelVolume {
                size: [3; 3],
                labels,
                to_world: Affine {
                    linear: Matrix3::identity() * 2e-3,
                    origin: mm(10.0, 0.0, 0.0),
                },
                warnings: Vec::new(),
            };
            let region = crate::labels::LabelRegion { labels: vec![1] };
            let voxels = crate::labels::voxel_runs(&volume, "a.nii".as_ref(), &[region]).unwrap();
            for spacing in [1e-3, 4e-3] {
                let components = InputRays::of_voxels(&voxels, spacing).components(&[], &[]);
                let away = step.iter().filter(|s| **s != 1).count();
                assert_eq!(
                    components.len(),
                    if away == 3 { 2 } else { 1 },
                    "{step:?} {spacing}"
                );
                let volume: f64 = components.iter().map(|c| c.whole.volume).sum();
                assert!((volume * 1e9 - 16.0).abs() < 1e-9, "{step:?} {volume}");
            }
        }
    }
}
