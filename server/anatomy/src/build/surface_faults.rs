//! Faults of the surfaces of a model: edges that do not belong to two triangles, and triangles that pass through each
//! other.

use palpate_tissue::{Model, RegionId, Vec3};
use serde::{Deserialize, Serialize};

use super::faces::{Face, OUTSIDE};
use super::layers::surface_of;
use super::{BuildReport, outer_triangles};
use crate::surface::{Edges, crossings};

/// Most places of a kind that are listed per surface.
const PLACES_MAX: usize = 5;

/// A place where a surface of the model is faulty.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SurfaceFault {
    /// The region whose surface it is; `None` is the outer surface.
    pub region: Option<String>,
    /// The fault.
    pub kind: FaultKind,
    /// Its place in mm.
    pub at_mm: [f64; 3],
}

/// Kinds of faults of a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaultKind {
    /// An edge that does not belong to exactly two triangles.
    EdgeNotTwo,
    /// Two triangles pass through each other.
    SelfIntersection,
    /// A triangle passes through one of a surface without a region in common; the region is that of one of the two.
    OtherSurface,
}

/// Pairs of triangles that pass through each other; face f has the triangles 2 f and 2 f + 1.
pub(super) fn crossing_triangles(
    faces: &[Face],
    positions: &[Vec3],
    spacing: f64,
) -> Vec<[u32; 2]> {
    let triangles: Vec<[u32; 3]> = (faces.iter())
        .flat_map(|f| f.triangles(positions))
        .collect();
    crossings(&triangles, |n| positions[n as usize], spacing)
}

/// Enters the faults of all surfaces into a report.
pub(super) fn enter(
    report: &mut BuildReport,
    model: &Model,
    faces: &[Face],
    crossing: &[[u32; 2]],
) {
    let middle = |pair: &[u32; 2]| {
        let middles = pair.map(|f| faces[f as usize].middle_and_area(&model.nodes).0);
        (middles[0] + middles[1]) / 2.0
    };
    let surfaces = std::iter::once(OUTSIDE).chain(0..model.regions.len() as u16);
    for surface in surfaces {
        let (region, figures) = match surface {
            OUTSIDE => (None, &mut report.outer_surface),
            r => {
                let own = &mut report.regions[usize::from(r)];
                (Some(own.name.clone()), &mut own.surface)
            }
        };
        let mut places = Vec::new();
        if !figures.closed {
            let triangles = match surface {
                OUTSIDE => outer_triangles(faces, model),
                r => surface_of(model, faces, RegionId(r)),
            };
            let edges = Edges::of(&triangles);
            let odd = edges.each().filter(|uses| uses.len() != 2);
            places.extend(odd.take(PLACES_MAX).map(|uses| {
                let ends = [uses[0].low, uses[0].high].map(|n| model.nodes[n as usize]);
                (FaultKind::EdgeNotTwo, (ends[0] + ends[1]) / 2.0)
            }));
        }
        let of = |face: u32| {
            let face = &faces[face as usize];
            face.region == surface || face.other == surface
        };
        let own = crossing.iter().filter(|pair| pair.iter().all(|f| of(*f)));
        figures.self_intersections = own.clone().count();
        let own = own.take(PLACES_MAX);
        places.extend(own.map(|pair| (FaultKind::SelfIntersection, middle(pair))));
        let faults = places.into_iter().map(|(kind, at)| SurfaceFault {
            region: region.clone(),
            kind,
            at_mm: (at * 1e3).into(),
        });
        report.surface_faults.extend(faults);
    }
    let sides = |face: u32| {
        let face = &faces[face as usize];
        [face.region, face.other]
    };
    let apart = crossing
        .iter()
        .filter(|[a, b]| !sides(*a).iter().any(|s| sides(*b).contains(s)));
    report.surface_intersections = apart.clone().count();
    let faults = apart.take(PLACES_MAX).map(|pair| SurfaceFault {
        region: Some(report.regions[usize::from(sides(pair[0])[0])].name.clone()),
        kind: FaultKind::OtherSurface,
        at_mm: (middle(pair) * 1e3).into(),
    });
    report.surface_faults.extend(faults);
}
