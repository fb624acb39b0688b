//! The mass-spring layers of the interfaces (Lin 2007, section 3.3 and fig. 3.10).
//!
//! Interface nodes of one kind (*homogeneous*: between the same two regions) are joined into one
//! layer by marching over them from a seed, breadth first: each node takes up its direct neighbours
//! first, then the diagonal ones, until it has [`NEIGHBOURS_MAX`]. Neighbours are nodes of one face of
//! the interface, so a layer never takes a short cut through a thin tissue.
//!
//! Springs of a layer are springs of the model, a named subset: their stiffness is in those of the
//! cells on both sides, which are assembled per cell in the cell's own material. Giving them a
//! second stiffness would count the tissue beside an interface twice.

use std::collections::VecDeque;

use palpate_tissue::{Model, RegionId, Rows};

use super::faces::{Face, OUTSIDE, faces};

/// Most homogeneous neighbours of a node, `N_max`: four direct and four diagonal ones, as on a flat
/// interface. The seed leaves the number open.
pub const NEIGHBOURS_MAX: usize = 8;

/// One connected mass-spring layer of an interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layer {
    /// The later one of the two regions: the layer's triangles look out of it.
    pub inside: RegionId,
    /// The region on the other side; `None` at the outside of the model.
    pub outside: Option<RegionId>,
    /// Its nodes in the order of the march.
    pub nodes: Vec<u32>,
    /// Its springs as pairs of nodes, each once, in the order of the march.
    pub springs: Vec<[u32; 2]>,
    /// Its triangles, wound to look out of `inside`.
    pub triangles: Vec<[u32; 3]>,
}

/// All layers of a model: those of one interface side by side, one per connected component.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Layers {
    /// Sorted by the two regions, larger components first.
    pub layers: Vec<Layer>,
}

impl Layers {
    /// Marches over the interfaces of a model as built.
    pub fn new(model: &Model) -> Self {
        Self::of_faces(model, &faces(&model.cells, &model.lattice))
    }

    pub(super) fn of_faces(model: &Model, faces: &[Face]) -> Self {
        let mut order: Vec<u32> = (0..faces.len() as u32).collect();
        let pair = |f: u32| (faces[f as usize].region, faces[f as usize].other);
        order.sort_by_key(|&f| pair(f));
        let mut layers = Vec::new();
        let mut slots = vec![u32::MAX; model.nodes.len()];
        for group in order.chunk_by(|&f, &g| pair(f) == pair(g)) {
            let mut found = march(model, faces, group, &mut slots);
            found.sort_by_key(|l| std::cmp::Reverse(l.nodes.len()));
            layers.append(&mut found);
        }
        Self { layers }
    }
}

/// The surface of one region over the model's own nodes: closed, wound outwards.
pub fn region_surface(model: &Model, region: RegionId) -> Vec<[u32; 3]> {
    surface_of(model, &faces(&model.cells, &model.lattice), region)
}

pub(super) fn surface_of(model: &Model, faces: &[Face], region: RegionId) -> Vec<[u32; 3]> {
    faces
        .iter()
        .filter(|f| f.region == region.0 || f.other == region.0)
        .flat_map(|f| {
            let triangles = f.triangles(&model.nodes);
            if f.region == region.0 {
                triangles
            } else {
                triangles.map(|[a, b, c]| [a, c, b])
            }
        })
        .collect()
}

/// The layers of one interface, whose faces are `group`. `slots` has [`u32::MAX`] for every node
/// before and after.
fn march(model: &Model, faces: &[Face], group: &[u32], slots: &mut [u32]) -> Vec<Layer> {
    let neighbours = Neighbours::new(faces, group, slots);
    let mut layer_of = vec![u32::MAX; neighbours.nodes.len()];
    let mut layers: Vec<Layer> = Vec::new();
    let first = faces[group[0] as usize];
    for seed in 0..neighbours.nodes.len() as u32 {
        if layer_of[seed as usize] != u32::MAX {
            continue;
        }
        let number = layers.len() as u32;
        let mut layer = Layer {
            inside: RegionId(first.region),
            outside: (first.other != OUTSIDE).then_some(RegionId(first.other)),
            nodes: Vec::new(),
            springs: Vec::new(),
            triangles: Vec::new(),
        };
        layer_of[seed as usize] = number;
        let mut queue = VecDeque::from([seed]);
        while let Some(node) = queue.pop_front() {
            layer.nodes.push(neighbours.nodes[node as usize]);
            let found = neighbours.of(node);
            for (count, &other) in found.iter().enumerate() {
                if layer_of[other as usize] == u32::MAX {
                    layer_of[other as usize] = number;
                    queue.push_back(other);
                }
                // Joined when it is among the first `N_max` of either end; the lower end decides.
                let chosen = count < NEIGHBOURS_MAX || {
                    let back = neighbours.of(other);
                    back.iter().take(NEIGHBOURS_MAX).any(|&n| n == node)
                };
                if node < other && chosen {
                    layer
                        .springs
                        .push([node, other].map(|n| neighbours.nodes[n as usize]));
                }
            }
        }
        layers.push(layer);
    }
    for &f in group {
        let face = faces[f as usize];
        let slot = slots[face.nodes[0] as usize];
        let layer = &mut layers[layer_of[slot as usize] as usize];
        layer.triangles.extend(face.triangles(&model.nodes));
    }
    for &node in &neighbours.nodes {
        slots[node as usize] = u32::MAX;
    }
    layers
}

/// The homogeneous neighbours of the nodes of one interface, direct ones first.
struct Neighbours {
    /// The nodes, in order; all other tables refer to positions in this list.
    nodes: Vec<u32>,
    rows: Rows<u32>,
}

impl Neighbours {
    fn new(faces: &[Face], group: &[u32], slots: &mut [u32]) -> Self {
        let corners = group.iter().flat_map(|&f| faces[f as usize].nodes);
        let mut nodes: Vec<u32> = corners.collect();
        nodes.sort_unstable();
        nodes.dedup();
        for (slot, &node) in nodes.iter().enumerate() {
            slots[node as usize] = slot as u32;
        }
        // (node, diagonal, other): sorting puts direct neighbours first.
        let mut pairs: Vec<(u32, bool, u32)> = Vec::with_capacity(group.len() * 12);
        for &f in group {
            let [a, b, c, d] = faces[f as usize].nodes.map(|n| slots[n as usize]);
            for (from, to, diagonal) in [
                (a, b, false),
                (b, c, false),
                (c, d, false),
                (d, a, false),
                (a, c, true),
                (b, d, true),
            ] {
                pairs.extend([(from, diagonal, to), (to, diagonal, from)]);
            }
        }
        pairs.sort_unstable();
        pairs.dedup();
        let rows = Rows::new(nodes.len(), pairs.iter().map(|p| (p.0, p.2)));
        Self { nodes, rows }
    }

    fn of(&self, node: u32) -> &[u32] {
        self.rows.row(node)
    }
}
