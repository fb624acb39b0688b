//! The topology: rest positions and wiring of the cells, which cuts change, and all derived data.
//!
//! A cut separates cells along shared faces and doubles the nodes between them; the number of cells is
//! constant. So the topology is a rest position per node, eight corners per cell, and a mask of cut faces per
//! cell. Masses and the outer surface are derived from these, and updated only around changed nodes; springs are
//! derived when asked for.

use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};

use rayon::prelude::*;

use crate::cell::{FACES, NO_CELL, cell_volume};
use crate::equilibrium::Elastic;
use crate::pages::Pages;
use crate::springs::{BODY_SHARE, DIAGONAL_SHARE, EDGE_SHARE, LENGTH_FLOOR, Spring};
use crate::{Model, RegionId, Vec3};

/// Identifies a topology: equal hashes mean the same cells, wired alike, at the same rest
/// positions. The version is no part of it, so that the topology after an undo has its earlier hash.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TopologyHash(pub u64);

impl TopologyHash {
    /// The hash of a model's uncut topology, without deriving that topology.
    pub fn of_uncut(model: &Model) -> Self {
        let cells = model.cells.par_iter().zip(0..model.cells.len() as u32);
        let cells = cells.map(|(cell, c)| hash_of_cell(c, &cell.corners, 0));
        let nodes = model.nodes.par_iter().zip(0..model.nodes.len() as u32);
        let nodes = nodes.map(|(rest, n)| hash_of_node(n, rest));
        Self(cells.chain(nodes).reduce(|| 0, u64::wrapping_add))
    }
}

/// Hash of a cell. The hash of a topology is the sum of those of its cells and nodes, so that a cut updates it locally.
fn hash_of_cell(cell: u32, corners: &[u32; 8], cut: u8) -> u64 {
    let mut bytes = [0; 33];
    for (c, node) in corners.iter().enumerate() {
        bytes[4 * c..4 * c + 4].copy_from_slice(&node.to_le_bytes());
    }
    bytes[32] = cut;
    xxhash_rust::xxh3::xxh3_64_with_seed(&bytes, cell.into())
}

/// Hash of a node at rest.
fn hash_of_node(node: u32, rest: &Vec3) -> u64 {
    let mut bytes = [0; 24];
    for (a, v) in rest.iter().enumerate() {
        bytes[8 * a..8 * a + 8].copy_from_slice(&v.to_bits().to_le_bytes());
    }
    xxhash_rust::xxh3::xxh3_64_with_seed(&bytes, node.into())
}

impl std::fmt::Display for TopologyHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

/// One face of one cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FaceId(pub u32);

impl FaceId {
    /// Face `face` (0..6) of a cell.
    pub const fn new(cell: u32, face: usize) -> Self {
        Self(cell * 6 + face as u32)
    }

    /// The cell it belongs to.
    pub const fn cell(self) -> u32 {
        self.0 / 6
    }

    /// Its index in [`FACES`].
    pub const fn face(self) -> usize {
        (self.0 % 6) as usize
    }
}

/// The outer surface: closed, wound outwards, over the model's own nodes. Face `i` carries the
/// triangles `2 i` and `2 i + 1`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Boundary {
    /// The exposed faces, those of the model as built first, those laid open by cuts after.
    pub faces: Vec<FaceId>,
    /// Two triangles per face, as node indices.
    pub triangles: Vec<[u32; 3]>,
}

impl Boundary {
    /// Whether every edge belongs to exactly two triangles.
    pub fn is_closed(&self) -> bool {
        let sides = self
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
        let mut edges: Vec<[u32; 2]> = sides.map(|[a, b]| [a.min(b), a.max(b)]).collect();
        edges.sort_unstable();
        edges.chunk_by(|a, b| a == b).all(|uses| uses.len() == 2)
    }
}

/// The outer surface in pages: the exposed faces in the order of the [`Boundary`], and the two triangles of each.
#[derive(Debug, Clone, Default)]
pub(crate) struct Exposed {
    pub(crate) faces: Pages<FaceId>,
    pub(crate) triangles: Pages<[[u32; 3]; 2]>,
}

/// The mutable wiring of a [`Model`]. Copies share all that has not changed since.
#[derive(Debug, Clone)]
pub struct Topology {
    pub(crate) model: Arc<Model>,
    /// Moduli of each region.
    elastic: Vec<Elastic>,
    pub(crate) version: u32,
    hash: TopologyHash,
    pub(crate) rest: Pages<Vec3>,
    pub(crate) corners: Pages<[u32; 8]>,
    /// Bit `f` is set when face `f` of the cell was cut.
    pub(crate) cut: Pages<u8>,
    /// Slot `c` of a node: the cell of which it is corner `c`, or [`NO_CELL`].
    pub(crate) node_cells: Pages<[u32; 8]>,
    pub(crate) cell_volume: Pages<f64>,
    /// Volume of each cell as it was built; its mass follows from it, so that no cut changes the mass.
    built_volume: Arc<Vec<f64>>,
    pub(crate) mass: Pages<f64>,
    pub(crate) pinned: Pages<bool>,
    pub(crate) exposed: Exposed,
    /// Made of them when first asked for.
    boundary: OnceLock<Arc<Boundary>>,
    pub(crate) cut_index: crate::cut::CutIndex,
}

/// The data that the hash of a topology covers, as they were before a change.
pub(crate) struct Hashed {
    rest: Pages<Vec3>,
    corners: Pages<[u32; 8]>,
    cut: Pages<u8>,
}

impl Topology {
    /// The uncut topology of a model.
    pub fn new(model: Arc<Model>) -> Self {
        let nodes = model.nodes.len();
        let mut node_cells = vec![[NO_CELL; 8]; nodes];
        for (index, cell) in model.cells.iter().enumerate() {
            for (c, &node) in cell.corners.iter().enumerate() {
                node_cells[node as usize][c] = index as u32;
            }
        }
        let cell_volume: Vec<f64> = (0..model.cells.len())
            .into_par_iter()
            .map(|c| cell_volume(&model.corners_of(c)))
            .collect();
        let corners: Vec<[u32; 8]> = model.cells.iter().map(|c| c.corners).collect();
        let mut topology = Self {
            elastic: model.regions.iter().map(Elastic::of).collect(),
            version: 0,
            hash: TopologyHash::of_uncut(&model),
            rest: model.nodes.clone().into(),
            corners: corners.into(),
            cut: vec![0; model.cells.len()].into(),
            node_cells: node_cells.into(),
            built_volume: Arc::new(cell_volume.clone()),
            cell_volume: cell_volume.into(),
            mass: vec![0.0; nodes].into(),
            pinned: vec![false; nodes].into(),
            exposed: Exposed::default(),
            boundary: OnceLock::new(),
            cut_index: crate::cut::CutIndex::new(model.cells.len()),
            model,
        };
        for node in 0..nodes as u32 {
            topology.derive_node(node);
        }
        topology.derive_boundary();
        topology
    }

    /// The model that this is a topology of.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Number of operations that have changed it.
    pub fn version(&self) -> u32 {
        self.version
    }

    /// Number of nodes, doubled ones included.
    pub fn node_count(&self) -> usize {
        self.rest.len()
    }

    /// Number of cells.
    pub fn cell_count(&self) -> usize {
        self.corners.len()
    }

    /// Rest position of a node in m.
    pub fn rest(&self, node: u32) -> Vec3 {
        self.rest[node as usize]
    }

    /// Nodes at the corners of a cell.
    pub fn corners(&self, cell: u32) -> [u32; 8] {
        self.corners[cell as usize]
    }

    /// Cells around a node; slot `c` holds the cell of which the node is corner `c`.
    pub fn cells_around(&self, node: u32) -> [u32; 8] {
        self.node_cells[node as usize]
    }

    /// Moduli of a cell.
    pub(crate) fn elastic(&self, cell: u32) -> &Elastic {
        &self.elastic[self.region(cell).index()]
    }

    /// Region of a cell.
    pub fn region(&self, cell: u32) -> RegionId {
        self.model.cells[cell as usize].region
    }

    /// The cell behind a face, or [`NO_CELL`] where the face is outside or cut.
    pub fn across(&self, face: FaceId) -> u32 {
        let cell = face.cell() as usize;
        if self.cut[cell] >> face.face() & 1 == 1 {
            NO_CELL
        } else {
            self.model.cells[cell].neighbours[face.face()]
        }
    }

    /// Mass of a node in kg: an eighth of each of its cells.
    pub fn mass(&self, node: u32) -> f64 {
        self.mass[node as usize]
    }

    /// Whether a node belongs to a pinned region and does not move.
    pub fn is_pinned(&self, node: u32) -> bool {
        self.pinned[node as usize]
    }

    /// The outer surface, cut faces included. The first call after a change copies all of it.
    pub fn boundary(&self) -> &Boundary {
        self.boundary.get_or_init(|| {
            Arc::new(Boundary {
                faces: self.exposed.faces.iter().copied().collect(),
                triangles: self.exposed.triangles.iter().flatten().copied().collect(),
            })
        })
    }

    /// A copy to keep, without the flat copy of the surface.
    pub(crate) fn to_keep(&self) -> Self {
        Self {
            boundary: OnceLock::new(),
            ..self.clone()
        }
    }

    /// The outer surface, for a change.
    pub(crate) fn exposed_mut(&mut self) -> &mut Exposed {
        self.boundary = OnceLock::new();
        &mut self.exposed
    }

    /// The nodes of a triangle of the outer surface.
    #[inline]
    pub(crate) fn triangle(&self, triangle: u32) -> [u32; 3] {
        self.exposed.triangles[triangle as usize / 2][triangle as usize % 2]
    }

    /// Rest volume of a cell in m³.
    pub fn volume(&self, cell: u32) -> f64 {
        self.cell_volume[cell as usize]
    }

    /// Whether all cells around a node exist and are uncut, so that the node is on no surface.
    pub(crate) fn is_within(&self, node: u32) -> bool {
        let is_whole = |cell: u32| cell != NO_CELL && self.cut[cell as usize] == 0;
        self.node_cells[node as usize].into_iter().all(is_whole)
    }

    /// Whether a node is on the outer surface.
    pub fn on_boundary(&self, node: u32) -> bool {
        let cells = self.node_cells[node as usize];
        cells.iter().enumerate().any(|(corner, &cell)| {
            cell != NO_CELL
                && (0..3).any(|axis| {
                    let face = 2 * axis + (corner >> axis & 1);
                    self.across(FaceId::new(cell, face)) == NO_CELL
                })
        })
    }

    /// Hash over wiring, cut faces and rest positions.
    pub fn hash(&self) -> TopologyHash {
        self.hash
    }

    /// A copy of the data that the hash covers, for [`rehash`](Self::rehash) after a change.
    pub(crate) fn hashed(&self) -> Hashed {
        Hashed {
            rest: self.rest.clone(),
            corners: self.corners.clone(),
            cut: self.cut.clone(),
        }
    }

    /// Updates the hash after a change of these nodes and of some of these cells.
    pub(crate) fn rehash(&mut self, before: &Hashed, nodes: &BTreeSet<u32>, cells: &[u32]) {
        let mut sum = self.hash.0;
        for &node in nodes {
            let n = node as usize;
            if n < before.rest.len() {
                sum = sum.wrapping_sub(hash_of_node(node, &before.rest[n]));
            }
            sum = sum.wrapping_add(hash_of_node(node, &self.rest[n]));
        }
        for &cell in cells {
            let c = cell as usize;
            let [old, new] = [(&before.corners, &before.cut), (&self.corners, &self.cut)]
                .map(|(corners, cut)| (corners[c], cut[c]));
            if old != new {
                let [old, new] = [old, new].map(|(corners, cut)| hash_of_cell(cell, &corners, cut));
                sum = sum.wrapping_sub(old).wrapping_add(new);
            }
        }
        self.hash = TopologyHash(sum);
    }

    /// Hash of the whole, without the earlier one.
    pub(crate) fn hash_anew(&mut self) {
        let cells = (0..).zip(self.corners.iter().zip(self.cut.iter()));
        let cells = cells.map(|(c, (corners, &cut))| hash_of_cell(c, corners, cut));
        let nodes = (0..).zip(self.rest.iter());
        let nodes = nodes.map(|(n, rest)| hash_of_node(n, rest));
        self.hash = TopologyHash(cells.chain(nodes).fold(0, u64::wrapping_add));
    }

    /// Mass and pinning of a node, from the cells around it.
    pub(crate) fn derive_node(&mut self, node: u32) {
        let mut mass = 0.0;
        let mut pinned = false;
        for cell in self.node_cells[node as usize] {
            if cell != NO_CELL {
                let region = &self.model.regions[self.region(cell).index()];
                mass += region.material.density_kg_m3 * self.built_volume[cell as usize] / 8.0;
                pinned |= region.pinned;
            }
        }
        // A write copies a shared page.
        if self.mass[node as usize] != mass {
            self.mass[node as usize] = mass;
        }
        if self.pinned[node as usize] != pinned {
            self.pinned[node as usize] = pinned;
        }
    }

    /// The springs of a node, from the cells around it, sorted by their far end.
    pub fn springs_of(&self, node: u32) -> Vec<Spring> {
        let mut sums: Vec<(u32, f64)> = Vec::with_capacity(32);
        self.visit_springs(node, |to, stiffness| {
            match sums.iter_mut().find(|s| s.0 == to) {
                Some(sum) => sum.1 += stiffness,
                None => sums.push((to, stiffness)),
            }
        });
        sums.sort_unstable_by_key(|s| s.0);
        sums.into_iter()
            .map(|(to, stiffness)| Spring {
                to,
                stiffness: stiffness as f32,
            })
            .collect()
    }

    /// Sum of the stiffness of the springs of a node in N/m.
    pub(crate) fn stiffness_around(&self, node: u32) -> f64 {
        let mut sum = 0.0;
        self.visit_springs(node, |_, stiffness| sum += stiffness);
        sum
    }

    /// Visits the springs of each cell around a node: the far end and the stiffness in N/m.
    fn visit_springs(&self, node: u32, mut visit: impl FnMut(u32, f64)) {
        let from = self.rest(node);
        let floor = (LENGTH_FLOOR * self.model.spacing_m).powi(2);
        for (corner, &cell) in self.node_cells[node as usize].iter().enumerate() {
            if cell == NO_CELL {
                continue;
            }
            let elastic = self.elastic(cell);
            let energy = elastic.spring_pa * self.cell_volume[cell as usize].max(0.0);
            let corners = self.corners[cell as usize];
            // 1, 2, 4 lead along an edge, 3, 5, 6 across a face, 7 through the body.
            for step in [1_usize, 2, 4, 3, 5, 6, 7] {
                let to = corners[corner ^ step];
                let share = match step.count_ones() {
                    1 => EDGE_SHARE,
                    2 => DIAGONAL_SHARE,
                    _ => BODY_SHARE,
                };
                let d = self.rest(to) - from;
                let square = d.norm_squared().max(floor);
                visit(to, share * energy * elastic.fibre_factor(&d) / square);
            }
        }
    }

    /// Collects the exposed faces of all cells into the boundary.
    fn derive_boundary(&mut self) {
        let mut boundary = Boundary::default();
        for cell in 0..self.cell_count() as u32 {
            for face in 0..6 {
                let id = FaceId::new(cell, face);
                if self.across(id) == NO_CELL {
                    boundary.faces.push(id);
                    boundary.triangles.extend(self.face_triangles(id));
                }
            }
        }
        crate::cut_model::part_diagonals(&mut boundary);
        let pairs = boundary.triangles.chunks_exact(2);
        self.exposed = Exposed {
            triangles: pairs.map(|t| [t[0], t[1]]).collect::<Vec<_>>().into(),
            faces: boundary.faces.into(),
        };
    }

    /// Splits a face along its shorter diagonal at rest.
    pub fn face_triangles(&self, face: FaceId) -> [[u32; 3]; 2] {
        let corners = self.corners(face.cell());
        let [a, b, c, d] = FACES[face.face()].map(|i| corners[i]);
        let ac = (self.rest(c) - self.rest(a)).norm_squared();
        let bd = (self.rest(d) - self.rest(b)).norm_squared();
        if ac <= bd {
            [[a, b, c], [a, c, d]]
        } else {
            [[a, b, d], [b, c, d]]
        }
    }
}
