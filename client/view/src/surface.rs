//! The surface that pages draw: the outer surface, the walls of wounds, and the interfaces between regions.

use std::collections::BTreeMap;

use palpate_tissue::cell::NO_CELL;
use palpate_tissue::{FaceId, RegionId, Topology, TopologyHash};
use serde::Serialize;

/// Number of this message, see `WIRE.md`.
const KIND: u8 = 1;

/// A surface of one version of the topology, as the message for pages.
pub(crate) struct Surface {
    pub(crate) version: u32,
    /// Numbers of its nodes in the model, ascending.
    pub(crate) nodes: Vec<u32>,
    /// The message.
    pub(crate) bytes: Vec<u8>,
}

/// Triangles with the same tissue on both sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Sides {
    region: RegionId,
    /// The region on the other side; `None` outside.
    other: Option<RegionId>,
    is_wound: bool,
}

#[derive(Serialize)]
struct Header {
    version: u32,
    hash: String,
    spacing_m: f64,
    nodes: usize,
    triangles: usize,
    groups: Vec<Group>,
}

#[derive(Serialize)]
struct Group {
    region: u16,
    other: Option<u16>,
    is_wound: bool,
    start: usize,
    count: usize,
}

impl Surface {
    /// The surface of a topology. Visits all cells.
    pub(crate) fn of(topology: &Topology) -> Self {
        let groups = sort_faces(topology);
        let mut nodes: Vec<u32> = groups.values().flatten().flatten().copied().collect();
        nodes.sort_unstable();
        nodes.dedup();
        let bytes = encode(topology, topology.hash(), &groups, &nodes);
        Self {
            version: topology.version(),
            nodes,
            bytes,
        }
    }
}

fn sort_faces(topology: &Topology) -> BTreeMap<Sides, Vec<[u32; 3]>> {
    let mut groups: BTreeMap<Sides, Vec<[u32; 3]>> = BTreeMap::new();
    let boundary = topology.boundary();
    for (face, triangles) in boundary
        .faces
        .iter()
        .zip(boundary.triangles.chunks_exact(2))
    {
        let built = &topology.model().cells[face.cell() as usize];
        let sides = Sides {
            region: topology.region(face.cell()),
            other: None,
            is_wound: built.neighbours[face.face()] != NO_CELL,
        };
        groups.entry(sides).or_default().extend(triangles);
    }
    for cell in 0..topology.cell_count() as u32 {
        let region = topology.region(cell);
        for face in (0..6).map(|f| FaceId::new(cell, f)) {
            let behind = topology.across(face);
            // An interface belongs to the later region.
            if behind == NO_CELL || topology.region(behind) >= region {
                continue;
            }
            let sides = Sides {
                region,
                other: Some(topology.region(behind)),
                is_wound: false,
            };
            let triangles = topology.face_triangles(face);
            groups.entry(sides).or_default().extend(triangles);
        }
    }
    groups
}

fn encode(
    topology: &Topology,
    hash: TopologyHash,
    groups: &BTreeMap<Sides, Vec<[u32; 3]>>,
    nodes: &[u32],
) -> Vec<u8> {
    let mut start = 0;
    let header = Header {
        version: topology.version(),
        hash: hash.to_string(),
        spacing_m: topology.model().spacing_m,
        nodes: nodes.len(),
        triangles: groups.values().map(Vec::len).sum(),
        groups: groups
            .iter()
            .map(|(sides, triangles)| {
                let group = Group {
                    region: sides.region.0,
                    other: sides.other.map(|other| other.0),
                    is_wound: sides.is_wound,
                    start,
                    count: triangles.len(),
                };
                start += triangles.len();
                group
            })
            .collect(),
    };
    let mut json = serde_json::to_vec(&header).unwrap_or_default();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut bytes = vec![KIND, 0, 0, 0];
    bytes.extend((json.len() as u32).to_le_bytes());
    bytes.extend(json);
    for node in nodes {
        bytes.extend(node.to_le_bytes());
    }
    for node in nodes {
        for x in topology.rest(*node).iter() {
            bytes.extend((*x as f32).to_le_bytes());
        }
    }
    let index = |node: u32| nodes.partition_point(|n| *n < node) as u32;
    for node in groups.values().flatten().flatten() {
        bytes.extend(index(*node).to_le_bytes());
    }
    bytes
}

#[cfg(test)]
mod tests {
    use palpate_tissue::{BladePoint, CutStroke, Material, Vec3, block, cut};

    use super::*;

    fn header(surface: &Surface) -> serde_json::Value {
        let length = u32::from_le_bytes(surface.bytes[4..8].try_into().unwrap()) as usize;
        serde_json::from_slice(&surface.bytes[8..8 + length]).unwrap()
    }

    #[test]
    fn region_surfaces_are_closed_and_wounds_are_marked() {
        let mut model = block([8, 6, 4], 4e-3, &Material::default(), 1);
        let mut second = model.regions[0].clone();
        second.name = "second".into();
        model.regions.push(second);
        for (cell, corner) in model.cells.iter_mut().zip(0..) {
            if corner % 8 >= 4 {
                cell.region = RegionId(1);
            }
        }
        let mut topology = Topology::new(model.into());
        let before = header(&Surface::of(&topology));
        assert!(
            before["groups"]
                .as_array()
                .unwrap()
                .iter()
                .all(|g| g["is_wound"] == false)
        );
        let point = |y| BladePoint {
            tip: Vec3::new(0.0081, y, 0.006),
            axis: Vec3::z(),
            depth_m: 0.02,
        };
        let stroke = CutStroke {
            points: vec![point(0.004), point(0.016)],
            width_m: 0.0,
        };
        cut(&mut topology, &stroke).unwrap();
        let surface = Surface::of(&topology);
        let after = header(&surface);
        assert_eq!(after["version"], 1);
        assert_eq!(after["hash"], topology.hash().to_string());
        let groups = after["groups"].as_array().unwrap();
        assert!(groups.iter().any(|g| g["is_wound"] == true));
        // Each region is bounded by its own groups and by the interfaces that name it as the other side.
        let (n, t) = (
            surface.nodes.len(),
            after["triangles"].as_u64().unwrap() as usize,
        );
        let indices = &surface.bytes[surface.bytes.len() - 12 * t..];
        let index = |i: usize| u32::from_le_bytes(indices[4 * i..4 * i + 4].try_into().unwrap());
        for region in [0, 1] {
            let mut edges = BTreeMap::<[u32; 2], i32>::new();
            for g in groups {
                let sign = if g["region"] == region { 1 } else { -1 };
                if g["region"] != region && g["other"] != region {
                    continue;
                }
                let start = g["start"].as_u64().unwrap() as usize;
                for i in start..start + g["count"].as_u64().unwrap() as usize {
                    let [a, b, c] = [0, 1, 2].map(|k| index(3 * i + k));
                    assert!(a.max(b).max(c) < n as u32);
                    for [from, to] in [[a, b], [b, c], [c, a]] {
                        let way = if from < to { 1 } else { -1 };
                        *edges.entry([from.min(to), from.max(to)]).or_default() += sign * way;
                    }
                }
            }
            assert!(
                !edges.is_empty() && edges.values().all(|sum| *sum == 0),
                "region {region}"
            );
        }
    }
}
