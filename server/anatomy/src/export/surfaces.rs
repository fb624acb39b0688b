//! The surfaces of a model over its own nodes: the outer one, one around each region, and one
//! between every two regions that touch.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use palpate_tissue::cell::NO_CELL;
use palpate_tissue::file::{Staged, WriteError};
use palpate_tissue::{FaceId, RegionId, Shape, Topology};

use super::apart::{StlFigures, apart};
use crate::Surface;

/// Longest file name made of region names, in characters. Reason: file systems end at 255 bytes,
/// and a character takes up to four.
const NAME_CHARS_MAX: usize = 48;

/// A surface with the name of its file.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedSurface {
    /// Made of letters, digits, `-` and `_`; unique among the surfaces of a model.
    pub name: String,
    /// Over the model's nodes in their current places.
    pub surface: Surface,
}

/// Every surface of a model in its current state:
///
/// - `outer`, closed, with the walls of wounds;
/// - `region-NAME` around each region that has cells, closed, wound outwards;
/// - `interface-A-B` between two regions that touch, open where it ends in a third region or at the
///   outside, wound outwards from the region that comes later in the scene.
///
/// Two surfaces have the same triangles where they coincide.
pub fn surfaces(topology: &Topology, shape: &Shape) -> Vec<NamedSurface> {
    let parts = sort_faces(topology);
    let regions = &topology.model().regions;
    let region_name = |r: RegionId| regions[r.index()].name.as_str();
    let mut names = BTreeSet::new();
    let mut found = vec![named(
        &mut names,
        "outer",
        topology,
        shape,
        &topology.boundary().triangles,
    )];
    for (region, triangles) in &parts.around {
        let name = format!("region-{}", region_name(*region));
        found.push(named(&mut names, &name, topology, shape, triangles));
    }
    for ([first, later], triangles) in &parts.between {
        let name = format!("interface-{}-{}", region_name(*first), region_name(*later));
        found.push(named(&mut names, &name, topology, shape, triangles));
    }
    found
}

/// Writes every surface as a binary STL in mm into a folder, which is made if it does not exist. The files
/// appear at their paths only after [`Staged::put_in_place`]. The walls of closed wounds are 0.01 mm apart, see
/// [`StlFigures`].
pub fn stage_stl(
    topology: &Topology,
    shape: &Shape,
    folder: &Path,
) -> Result<Vec<Staged>, WriteError> {
    std::fs::create_dir_all(folder).map_err(|source| WriteError {
        path: folder.to_owned(),
        source,
    })?;
    let (apart, _) = apart(topology, shape);
    surfaces(topology, &apart)
        .iter()
        .map(|s| {
            let path = folder.join(format!("{}.stl", s.name));
            Staged::write(&path, |out| s.surface.write_stl_to(out))
        })
        .collect()
}

/// Writes the outer surface as one binary STL in mm; the file appears at its path only after [`Staged::put_in_place`].
/// Also returns its deviations from the model.
pub fn stage_outer_stl(
    topology: &Topology,
    shape: &Shape,
    path: &Path,
) -> Result<(Staged, StlFigures), WriteError> {
    let triangles = &topology.boundary().triangles;
    let (apart, figures) = apart(topology, shape);
    let outer = named(&mut BTreeSet::new(), "outer", topology, &apart, triangles);
    let staged = Staged::write(path, |out| outer.surface.write_stl_to(out))?;
    Ok((staged, figures))
}

/// Triangles of faces between regions.
#[derive(Default)]
struct Parts {
    around: BTreeMap<RegionId, Vec<[u32; 3]>>,
    between: BTreeMap<[RegionId; 2], Vec<[u32; 3]>>,
}

fn sort_faces(topology: &Topology) -> Parts {
    // The outer surface may split a face along the other diagonal than an inner face would be.
    let outer: BTreeMap<FaceId, usize> = topology
        .boundary()
        .faces
        .iter()
        .enumerate()
        .map(|(i, &face)| (face, i))
        .collect();
    let mut parts = Parts::default();
    for cell in 0..topology.cell_count() as u32 {
        let region = topology.region(cell);
        for face in (0..6).map(|f| FaceId::new(cell, f)) {
            let behind = topology.across(face);
            if behind == NO_CELL {
                let triangles = &topology.boundary().triangles[2 * outer[&face]..][..2];
                parts.around.entry(region).or_default().extend(triangles);
                continue;
            }
            let other = topology.region(behind);
            if other == region {
                continue;
            }
            let triangles = topology.face_triangles(face);
            parts.around.entry(region).or_default().extend(triangles);
            if other < region {
                let sheet = parts.between.entry([other, region]).or_default();
                sheet.extend(triangles);
            }
        }
    }
    parts
}

/// Takes the nodes of some triangles out of the model, in the order of their numbers.
fn named(
    names: &mut BTreeSet<String>,
    name: &str,
    topology: &Topology,
    shape: &Shape,
    triangles: &[[u32; 3]],
) -> NamedSurface {
    let mut nodes: Vec<u32> = triangles.iter().flatten().copied().collect();
    nodes.sort_unstable();
    nodes.dedup();
    let place = |node: u32| nodes.partition_point(|&n| n < node) as u32;
    NamedSurface {
        name: unique(names, name),
        surface: Surface {
            vertices: nodes.iter().map(|&n| shape.position(topology, n)).collect(),
            triangles: triangles.iter().map(|t| t.map(place)).collect(),
        },
    }
}

/// A unique name of characters that every file system accepts. Names that differ in case only count as the
/// same, because some file systems ignore case.
fn unique(names: &mut BTreeSet<String>, name: &str) -> String {
    let plain: String = name
        .chars()
        .take(NAME_CHARS_MAX)
        .map(|c| {
            if c.is_alphanumeric() || c == '-' {
                c
            } else {
                '_'
            }
        })
        .collect();
    let mut candidate = plain.clone();
    let mut number = 2;
    while !names.insert(candidate.to_lowercase()) {
        candidate = format!("{plain}-{number}");
        number += 1;
    }
    candidate
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surface_names_are_unique_valid_file_names() {
        let mut names = BTreeSet::new();
        let mut of = |name: &str| unique(&mut names, name);
        assert_eq!(of("region-m. vastus/../x"), "region-m__vastus____x");
        assert_eq!(of("region-Bone"), "region-Bone");
        assert_eq!(of("region-bone"), "region-bone-2");
        assert_eq!(of("région"), "région");
        assert_eq!(of(&"x".repeat(300)).len(), NAME_CHARS_MAX);
        assert_eq!(of(&"x".repeat(301)).len(), NAME_CHARS_MAX + 2);
    }
}
