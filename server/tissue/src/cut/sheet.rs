//! The sheet of a cut: which faces between cells it opens.
//!
//! Reconstructed; of Lin 2007, chapter 5, captions survive. A face is crossed when the segment
//! between the weighted centres of its two cells crosses the swept surface. Nodes on interfaces and walls weigh more,
//! because they only slide: where the blade crosses an interface flatly, fewer of them belong to the sheet. Faces between cells
//! of bone (pinned regions) are not crossed; a blade at the surface of a bone parts tissue from it. Around any edge of the
//! lattice these segments form a loop, so crossed faces make a sheet that ends only where the swept surface
//! ends. The sheet is then eroded until opening it leaves a proper surface:
//!
//! - a face none of whose four nodes would be doubled opens nothing, and leaves the sheet;
//! - an edge whose ends both stay single may not have four exposed faces around it (a *chord*): the
//!   least useful face at it leaves the sheet.
//!
//! Faces around a piece of a few cells (a crumb, as two cuts close to each other leave) leave it too.
//! Only faces of the new sheet leave it, so erosion ends, at worst with the topology as it was.

use std::collections::{BTreeSet, HashMap};

use super::cell_fans::{Fans, Opening};
use super::ribbon::{Bounds, Ribbon};
use super::{CutError, DRIFT_MAX};
use crate::cell::{FACES, NO_CELL};
use crate::number_map::NumberMap;
use crate::{FaceId, RegionId, Topology, Vec3};

/// How far from the blade a cell may be whose segments are tested, in spacings: neighbours are at most two apart, and
/// weighted centres half a spacing from the means.
const SEGMENT_MAX: f64 = 2.5;
/// A shift of all centres, in spacings, that only decides ties, which are frequent in cuts along the lattice of a
/// block.
const TIE: Vec3 = Vec3::new(6.13e-8, 3.71e-8, 7.93e-8);

/// How often a node on an interface, surface or wall counts in the centre of its cells. The sheet leaves an interface at
/// a quarter of a spacing instead of a half.
const HELD_WEIGHT: f64 = 3.0;

/// Faces and regions that a ribbon crosses.
#[derive(Default)]
struct Met {
    faces: BTreeSet<FaceId>,
    pinned: Option<RegionId>,
    open: bool,
}

/// The faces that a ribbon crosses, each from its lower side along its axis, sorted; open ones and those within bone left
/// out.
pub(crate) fn crossed(topology: &Topology, ribbon: &Ribbon) -> Result<Vec<FaceId>, CutError> {
    let index = topology.cell_index();
    let spacing = topology.model.spacing_m;
    let mut met = Met::default();
    let mut known = Known {
        topology,
        places: NumberMap::default(),
    };
    for cell in index.cells_around(ribbon, (SEGMENT_MAX + DRIFT_MAX) * spacing) {
        if ribbon.may_reach(&topology.centre(cell), SEGMENT_MAX * spacing) {
            known.meet(cell, ribbon, &mut met);
        }
    }
    match (met.faces.is_empty(), met.pinned) {
        (false, _) => Ok(met.faces.into_iter().collect()),
        (true, Some(region)) => Err(CutError::Rejected(format!(
            "the blade meets only the pinned region `{}`, which it can not cut",
            topology.model.regions[region.index()].name
        ))),
        (true, None) if met.open => Err(CutError::NothingNew),
        (true, None) => Err(CutError::NoTissue),
    }
}

pub(crate) fn is_bone(topology: &Topology, cell: u32) -> bool {
    topology.model.regions[topology.region(cell).index()].pinned
}

/// Mean of a cell's corners, in which those on interfaces, surfaces and walls count [`HELD_WEIGHT`] times; in bone the plain
/// mean, because its nodes do not move.
fn weighted_centre(topology: &Topology, cell: u32) -> Vec3 {
    if is_bone(topology, cell) {
        return topology.centre(cell);
    }
    let region = topology.region(cell);
    let mut sum = Vec3::zeros();
    let mut weights = 0.0;
    for node in topology.corners(cell) {
        let around = topology.node_cells[node as usize];
        let is_inside = around
            .into_iter()
            .all(|c| c != NO_CELL && topology.region(c) == region);
        let weight = if is_inside { 1.0 } else { HELD_WEIGHT };
        sum += topology.rest(node) * weight;
        weights += weight;
    }
    sum / weights
}

/// Boxes and weighted centres of the cells around a ribbon, each derived once.
struct Known<'a> {
    topology: &'a Topology,
    places: NumberMap<u32, (Bounds, Option<Vec3>)>,
}

impl Known<'_> {
    /// The box of a cell, which has its weighted centre.
    fn bounds(&mut self, cell: u32) -> Bounds {
        let topology = self.topology;
        let derive = || {
            let corners = topology.corners(cell).into_iter();
            let bounds = Bounds::around(corners.map(|n| topology.rest(n)));
            (bounds.grown(TIE.norm() * topology.model.spacing_m), None)
        };
        self.places.entry(cell).or_insert_with(derive).0
    }

    /// The weighted centre of a cell.
    fn centre(&mut self, cell: u32) -> Vec3 {
        let topology = self.topology;
        let derive = || weighted_centre(topology, cell) + TIE * topology.model.spacing_m;
        match self.places.get_mut(&cell) {
            Some((_, centre)) => *centre.get_or_insert_with(derive),
            None => derive(),
        }
    }

    /// Tests the three upper faces of a cell.
    fn meet(&mut self, cell: u32, ribbon: &Ribbon, met: &mut Met) {
        let topology = self.topology;
        let own = self.bounds(cell);
        for face in [1, 3, 5] {
            let other = topology.model.cells[cell as usize].neighbours[face];
            if other == NO_CELL || !ribbon.may_cross(&own.with(&self.bounds(other))) {
                continue;
            }
            if !ribbon.crosses(&self.centre(cell), &self.centre(other)) {
                continue;
            }
            let id = FaceId::new(cell, face);
            if topology.across(id) == NO_CELL {
                met.open = true;
            } else if is_bone(topology, cell) && is_bone(topology, other) {
                met.pinned = Some(topology.region(cell));
            } else {
                met.faces.insert(id);
            }
        }
    }
}

pub(crate) fn nodes_of(topology: &Topology, face: FaceId) -> [u32; 4] {
    FACES[face.face()].map(|c| topology.corners(face.cell())[c])
}

/// A component of fewer cells than this is a crumb: unattached, and too small to grasp.
const CRUMB_CELLS: usize = 8;

/// The sheet that is left of crossed faces; see the file's head.
pub(crate) fn sheet(topology: &Topology, mut faces: Vec<FaceId>) -> Vec<FaceId> {
    loop {
        let sheet = erode(topology, faces);
        let around = crumbs(topology, &sheet);
        if around.is_empty() {
            return sheet;
        }
        faces = sheet.into_iter().filter(|f| !around.contains(f)).collect();
    }
}

/// The faces of a sheet around the crumbs that it would leave.
fn crumbs(topology: &Topology, sheet: &[FaceId]) -> BTreeSet<FaceId> {
    let opening = Opening::new(topology, sheet);
    let mut around = BTreeSet::new();
    for start in sheet.iter().flat_map(|&f| [f, topology.behind(f)]) {
        let mut piece = vec![start.cell()];
        let mut next = 0;
        while next < piece.len() && piece.len() < CRUMB_CELLS {
            for face in 0..6 {
                let cell = opening.across(FaceId::new(piece[next], face));
                if cell != NO_CELL && !piece.contains(&cell) {
                    piece.push(cell);
                }
            }
            next += 1;
        }
        if piece.len() < CRUMB_CELLS {
            let faces = piece
                .iter()
                .flat_map(|&c| (0..6).map(move |f| FaceId::new(c, f)));
            around.extend(faces.filter(|&f| opening.is_new(f)).map(|f| {
                if f.face() % 2 == 1 {
                    f
                } else {
                    topology.behind(f)
                }
            }));
        }
    }
    around
}

/// Erodes crossed faces until opening them leaves a proper surface.
fn erode(topology: &Topology, faces: Vec<FaceId>) -> Vec<FaceId> {
    let mut erosion = Erosion {
        before: Opening::new(topology, &[]),
        opening: Opening::new(topology, &faces),
        fans: HashMap::new(),
        fans_before: HashMap::new(),
    };
    let mut sheet: BTreeSet<FaceId> = faces.iter().copied().collect();
    let mut suspects = faces;
    while !suspects.is_empty() {
        let mut leaving: BTreeSet<FaceId> = suspects
            .iter()
            .copied()
            .filter(|&face| erosion.separated(face) == 0)
            .collect();
        // Faces whose chords were not yet searched stay suspects.
        let mut around = BTreeSet::new();
        if leaving.is_empty() {
            for &face in &suspects {
                leaving.extend(erosion.victims(face));
            }
        } else {
            around.extend(suspects);
        }
        for &face in &leaving {
            sheet.remove(&face);
            erosion.opening.close(face);
            for node in nodes_of(topology, face) {
                erosion.fans.remove(&node);
                around.extend(erosion.new_faces_at(node));
            }
        }
        suspects = around.into_iter().filter(|f| sheet.contains(f)).collect();
    }
    sheet.into_iter().collect()
}

struct Erosion<'a> {
    before: Opening<'a>,
    opening: Opening<'a>,
    fans: HashMap<u32, Fans>,
    fans_before: HashMap<u32, Fans>,
}

impl Erosion<'_> {
    fn fans(&mut self, node: u32, before: bool) -> Fans {
        let (cache, opening) = if before {
            (&mut self.fans_before, &self.before)
        } else {
            (&mut self.fans, &self.opening)
        };
        *cache.entry(node).or_insert_with(|| opening.fans(node))
    }

    /// How many nodes of a face would be doubled between its two cells.
    fn separated(&mut self, face: FaceId) -> usize {
        let corners = FACES[face.face()];
        let nodes = nodes_of(self.opening.topology, face);
        let across = 1 << (face.face() / 2);
        (0..4)
            .filter(|&i| {
                let fans = self.fans(nodes[i], false);
                fans[corners[i]] != fans[corners[i] ^ across]
            })
            .count()
    }

    /// For each chord among the edges of a face, the face that should leave the sheet.
    fn victims(&mut self, face: FaceId) -> Vec<FaceId> {
        let corners = FACES[face.face()];
        let mut victims = Vec::new();
        for i in 0..4 {
            let (from, to) = (corners[i], corners[(i + 1) % 4]);
            let axis = (from ^ to).trailing_zeros() as usize;
            let node = self.opening.topology.corners(face.cell())[from];
            if self.is_chord(node, from, axis, false) && !self.is_chord(node, from, axis, true) {
                let victim = self
                    .new_faces_at_edge(node, from, axis)
                    .into_iter()
                    .map(|f| (self.separated(f), std::cmp::Reverse(f)))
                    .min();
                victims.extend(victim.map(|v| v.1.0));
            }
        }
        victims
    }

    /// Whether the edge from a node, which is corner `at` of some cell, along an axis would have
    /// more than two exposed faces between the same two new nodes.
    fn is_chord(&mut self, node: u32, at: usize, axis: usize, before: bool) -> bool {
        let topology = self.opening.topology;
        let cells = topology.node_cells[node as usize];
        let near = self.fans(node, before);
        let mut groups: [((u32, u8, u8), u32); 4] = [((NO_CELL, 0, 0), 0); 4];
        for s in (0..8).filter(|s| (s ^ at) >> axis & 1 == 0) {
            let cell = cells[s];
            if cell == NO_CELL {
                continue;
            }
            let far_slot = s ^ (1 << axis);
            let far = topology.corners(cell)[far_slot];
            let key = (far, near[s], self.fans(far, before)[far_slot]);
            let opening = if before { &self.before } else { &self.opening };
            let exposed = (0..3)
                .filter(|&b| b != axis)
                .filter(|&b| opening.across(FaceId::new(cell, 2 * b + (s >> b & 1))) == NO_CELL)
                .count() as u32;
            let slot = groups
                .iter()
                .position(|g| g.0 == key || g.0.0 == NO_CELL)
                .expect("at most four cells around an edge");
            groups[slot].0 = key;
            groups[slot].1 += exposed;
        }
        groups.iter().any(|g| g.1 > 2)
    }

    fn new_faces_at_edge(&self, node: u32, at: usize, axis: usize) -> Vec<FaceId> {
        let cells = self.opening.topology.node_cells[node as usize];
        let mut faces = Vec::new();
        for s in (0..8).filter(|s| (s ^ at) >> axis & 1 == 0) {
            for b in (0..3).filter(|&b| b != axis && s >> b & 1 == 1) {
                if cells[s] != NO_CELL && self.opening.is_new(FaceId::new(cells[s], 2 * b + 1)) {
                    faces.push(FaceId::new(cells[s], 2 * b + 1));
                }
            }
        }
        faces
    }

    fn new_faces_at(&self, node: u32) -> Vec<FaceId> {
        let cells = self.opening.topology.node_cells[node as usize];
        let mut faces = Vec::new();
        for (s, &cell) in cells.iter().enumerate().filter(|c| *c.1 != NO_CELL) {
            for axis in (0..3).filter(|axis| s >> axis & 1 == 1) {
                let face = FaceId::new(cell, 2 * axis + 1);
                if self.opening.is_new(face) {
                    faces.push(face);
                }
            }
        }
        faces
    }
}
