//! Distances between the surface of each region in the model and in the input.

use palpate_tissue::Model;
use rayon::prelude::*;

use super::faces::Face;
use super::interface_samples::Sample;
use super::interfaces::{Interface, Interfaces};
use super::region_surfaces::RegionSurfaces;

/// Distances in m over an area.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Distances {
    pub(super) mean: f64,
    /// 99th percentile, by area.
    pub(super) p99: f64,
    pub(super) max: f64,
}

impl Distances {
    /// From distances with the area of each; none without a surface to measure from.
    fn of(mut found: Vec<(f32, f32)>) -> Option<Self> {
        found.retain(|(distance, _)| distance.is_finite());
        found.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let area = |found: &[(f32, f32)]| found.iter().map(|f| f64::from(f.1)).sum::<f64>();
        let whole = area(&found);
        let max = f64::from(found.last()?.0);
        let sum: f64 = found
            .iter()
            .map(|(d, a)| f64::from(*d) * f64::from(*a))
            .sum();
        let mut below = 0.0;
        let p99 = found.iter().find(|(_, area)| {
            below += f64::from(*area);
            below >= 0.99 * whole
        });
        Some(Self {
            mean: if whole > 0.0 { sum / whole } else { 0.0 },
            p99: p99.map_or(max, |p| f64::from(p.0)),
            max,
        })
    }
}

/// Distances of the surface of each region of the model from that of the input, at the corners and the middle of every
/// face.
pub(super) fn from_input(
    model: &Model,
    faces: &[Face],
    interfaces: &Interfaces,
) -> Vec<Option<Distances>> {
    let surfaces = RegionSurfaces::of_input(interfaces);
    let measure = |region: u16| {
        let own = |f: &&Face| f.region == region || f.other == region;
        let own: Vec<&Face> = faces.iter().filter(own).collect();
        let corners = own.iter().flat_map(|f| f.nodes.map(|n| (n, f.interface())));
        let mut corners: Vec<(u32, Interface)> = corners.collect();
        corners.par_sort_unstable();
        corners.dedup_by_key(|c| c.0);
        let at_corner = |&(node, first): &(u32, Interface)| {
            surfaces.distance(&model.nodes[node as usize], region, first) as f32
        };
        let at_corners: Vec<f32> = corners.par_iter().map(at_corner).collect();
        let faces = own.par_iter().flat_map_iter(|face| {
            let (middle, area) = face.middle_and_area(&model.nodes);
            let middle = surfaces.distance(&middle, region, face.interface()) as f32;
            let corner = |n| at_corners[corners.partition_point(|c| c.0 < n)];
            let [a, b, c, d] = face.nodes.map(corner);
            [middle, a, b, c, d].map(|d| (d, (area / 5.0) as f32))
        });
        Distances::of(faces.collect())
    };
    (0..model.regions.len() as u16).map(measure).collect()
}

/// Distances of the surface of each region of the input from that of the model.
pub(super) fn from_model(samples: &[Sample], regions: usize) -> Vec<Option<Distances>> {
    let mut found = vec![Vec::new(); regions];
    for sample in samples {
        for (region, distance) in [sample.behind, sample.before]
            .into_iter()
            .zip(sample.from_region)
        {
            if let Some(found) = found.get_mut(usize::from(region)) {
                found.push((distance, sample.area as f32));
            }
        }
    }
    found.into_iter().map(Distances::of).collect()
}
