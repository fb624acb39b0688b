//! A snapshot: all cuts of a topology and the strokes to undo and redo them, as bytes.
//!
//! A late participant restores it instead of repeating every cut. It refers to the uncut topology of the model, and
//! holds only differences. The content, inside the same envelope as a model file:
//!
//! ```text
//! uncut      hash of the uncut topology, its node and cell counts
//! counts     version, nodes, rewired cells, opened faces (u32 each), hash of the topology
//! cells      number (as steps), eight columns of corners, cut bits of each rewired cell
//! opened     the opened faces, in order
//! diagonals  one byte per face of the surface: which diagonal splits it
//! rest       three columns of f64 bits, XOR those of the model's node (for a doubled node: its original)
//! strokes    the strokes in effect and those taken back, see `stroke_list.rs`
//! ```
//!
//! Masses, volumes and triangles are functions of these and are derived again.

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::cell::{FACES, NO_CELL};
use crate::cut::derive_around;
use crate::file::{Content, FileError, Reader, open_within, seal};
use crate::limits::NODES_MAX;
use crate::stroke_list::{read_strokes, write_strokes};
use crate::{CutHistory, FaceId, Model, Topology, Vec3};

const MAGIC: [u8; 8] = *b"palpsnap";
/// Version of the snapshot format that this program writes and reads.
pub const SNAPSHOT_FORMAT: u32 = 2;
/// Most bytes of content: those of a model of a million nodes that is cut everywhere.
const CONTENT_MAX_BYTES: u64 = 256 * 1024 * 1024;
/// Largest coordinate of a rest position, in m; a larger one means damage.
const POSITION_MAX_M: f64 = 1e5;

/// Identifies a model: equal hashes mean the same nodes, cells and materials, bit by bit. Names and sources of
/// materials are not hashed.
pub fn model_hash(model: &Model) -> u64 {
    let mut hasher = xxhash_rust::xxh3::Xxh3::new();
    for v in [model.spacing_m].iter().chain(&model.gravity) {
        hasher.update(&v.to_bits().to_le_bytes());
    }
    for region in &model.regions {
        let m = &region.material;
        hasher.update(&[u8::from(region.pinned) | (u8::from(m.bottoms_out) << 1)]);
        for v in m.numbers().into_iter().chain(region.fibre) {
            hasher.update(&v.to_bits().to_le_bytes());
        }
    }
    for (p, l) in model.nodes.iter().zip(&model.lattice) {
        for (v, i) in p.iter().zip(l) {
            hasher.update(&v.to_bits().to_le_bytes());
            hasher.update(&i.to_le_bytes());
        }
    }
    for cell in &model.cells {
        for n in cell.corners.iter().chain(&cell.neighbours) {
            hasher.update(&n.to_le_bytes());
        }
        hasher.update(&cell.region.0.to_le_bytes());
    }
    hasher.digest()
}

/// The cuts of a topology and their history.
pub fn snapshot(topology: &Topology, history: &CutHistory) -> Vec<u8> {
    let model = &topology.model;
    let rewired: Vec<u32> = (0..topology.cell_count() as u32)
        .filter(|&c| {
            let cell = c as usize;
            topology.cut[cell] != 0 || topology.corners[cell] != model.cells[cell].corners
        })
        .collect();
    let boundary = topology.boundary();
    let opened = topology.cut_index.opened;
    let mut out = Content::default();
    out.u64(history.uncut().hash().0);
    for count in [model.nodes.len(), model.cells.len()] {
        out.u32(count as u32);
    }
    for count in [
        topology.version as usize,
        topology.node_count(),
        rewired.len(),
        opened,
    ] {
        out.u32(count as u32);
    }
    out.u64(topology.hash().0);
    out.steps32(rewired.iter().copied());
    for corner in 0..8 {
        out.steps32(
            rewired
                .iter()
                .map(|&c| topology.corners[c as usize][corner]),
        );
    }
    for &cell in &rewired {
        out.u8(topology.cut[cell as usize]);
    }
    let built = boundary.faces.len() - opened;
    out.steps32(boundary.faces[built..].iter().map(|f| f.0));
    for pair in boundary.triangles.chunks(2) {
        out.u8(u8::from(pair[0][0] == pair[1][0]));
    }
    let originals: Vec<Vec3> = (0..topology.node_count() as u32)
        .map(|n| topology.original(n))
        .collect();
    for axis in 0..3 {
        let columns = topology.rest.iter().zip(&originals);
        out.plane64(&columns.map(|(p, o)| p[axis].to_bits() ^ o[axis].to_bits()));
    }
    write_strokes(&mut out, history);
    seal(MAGIC, SNAPSHOT_FORMAT, &out.0)
}

/// Restores a snapshot onto the uncut topology that it was taken of: all later cuts, undos and redos give the same
/// topologies as on the original.
pub fn restore(
    uncut: &Arc<Topology>,
    bytes: &[u8],
) -> Result<(Arc<Topology>, CutHistory), FileError> {
    let content = open_within(MAGIC, SNAPSHOT_FORMAT, bytes, CONTENT_MAX_BYTES)
        .map_err(|defect| FileError(format!("invalid snapshot: {defect}")))?;
    restore_content(uncut, &content).map_err(|defect| {
        FileError(format!(
            "inconsistent snapshot: it {defect}; request another"
        ))
    })
}

fn restore_content(
    uncut: &Arc<Topology>,
    content: &[u8],
) -> Result<(Arc<Topology>, CutHistory), String> {
    let mut reader = Reader(content);
    let (found, expected) = (reader.u64()?, uncut.hash().0);
    if found != expected {
        return Err(format!(
            "was taken of uncut topology {found:016x}, and this is {expected:016x}"
        ));
    }
    let built = uncut.node_count();
    if reader.u32()? as usize != built || reader.u32()? as usize != uncut.cell_count() {
        return Err("has other node or cell counts than the model".into());
    }
    let version = reader.u32()?;
    let nodes = reader.u32()? as usize;
    let rewired = reader.u32()? as usize;
    let opened = reader.u32()? as usize;
    let hash = reader.u64()?;
    let nodes_max = (8 * uncut.cell_count()).min(2 * NODES_MAX);
    if nodes < built || nodes > nodes_max || rewired > uncut.cell_count() {
        return Err("declares counts out of range".into());
    }
    let mut topology = uncut.as_ref().clone();
    let mut changed = rewire(&mut topology, &mut reader, nodes, rewired)?;
    changed.extend(built as u32..nodes as u32);
    let faces = reader.steps32(opened)?;
    let diagonals = reader.bytes(topology.exposed.faces.len() + opened)?;
    read_rest(&mut topology, &mut reader, &mut changed)?;
    let (done, undone) = read_strokes(&mut reader)?;
    if !reader.0.is_empty() {
        return Err("is followed by more".into());
    }
    reopen(&mut topology, &faces, diagonals)?;
    derive_around(&mut topology, &changed);
    topology.hash_anew();
    topology.version = version;
    if topology.hash().0 != hash {
        return Err(format!(
            "restores topology {} instead of {hash:016x}",
            topology.hash()
        ));
    }
    let history = CutHistory::of_strokes(Arc::clone(uncut), done, undone);
    Ok((Arc::new(topology), history))
}

/// Stores corners and cut bits, validates them, and makes room for the nodes. Returns the nodes around.
fn rewire(
    topology: &mut Topology,
    reader: &mut Reader<'_>,
    nodes: usize,
    rewired: usize,
) -> Result<BTreeSet<u32>, String> {
    let cells = reader.steps32(rewired)?;
    let mut corners = Vec::with_capacity(8);
    for _ in 0..8 {
        corners.push(reader.steps32(rewired)?);
    }
    let bits = reader.bytes(rewired)?;
    let mut changed = BTreeSet::new();
    for (i, &cell) in cells.iter().enumerate() {
        if cell as usize >= topology.cell_count() {
            return Err("rewires a cell that does not exist".into());
        }
        for (c, column) in corners.iter().enumerate() {
            if column[i] as usize >= nodes {
                return Err("wires a cell to a node that does not exist".into());
            }
            changed.insert(topology.corners[cell as usize][c]);
            changed.insert(column[i]);
            topology.corners[cell as usize][c] = column[i];
        }
        topology.cut[cell as usize] = bits[i];
    }
    for _ in topology.node_count()..nodes {
        topology.rest.push(Vec3::zeros());
        topology.mass.push(0.0);
        topology.pinned.push(false);
    }
    let mut node_cells = vec![[NO_CELL; 8]; nodes];
    for (cell, corners) in topology.corners.iter().enumerate() {
        for (slot, &node) in corners.iter().enumerate() {
            let place = &mut node_cells[node as usize][slot];
            if *place != NO_CELL {
                return Err("has two cells in one position".into());
            }
            *place = cell as u32;
        }
    }
    if node_cells.contains(&[NO_CELL; 8]) {
        return Err("has a node without a cell".into());
    }
    topology.node_cells = node_cells.into();
    for &cell in &cells {
        check_faces(topology, cell)?;
    }
    Ok(changed)
}

/// Faces are cut from both sides or none, and uncut neighbours share their nodes.
fn check_faces(topology: &Topology, cell: u32) -> Result<(), String> {
    if topology.cut[cell as usize] >> 6 != 0 {
        return Err("cuts a face that does not exist".into());
    }
    for (face, corners) in FACES.iter().enumerate() {
        let id = FaceId::new(cell, face);
        let cut = topology.cut[cell as usize] >> face & 1;
        if topology.model.cells[cell as usize].neighbours[face] == NO_CELL {
            if cut == 1 {
                return Err("cuts a face on the outside".into());
            }
            continue;
        }
        let behind = topology.behind(id);
        if topology.cut[behind.cell() as usize] >> behind.face() & 1 != cut {
            return Err("cuts a face from one side only".into());
        }
        let across = 1 << (face / 2);
        let [near, far] = [cell, behind.cell()].map(|c| topology.corners(c));
        if cut == 0 && corners.iter().any(|&c| near[c] != far[c ^ across]) {
            return Err("separates cells that are not cut apart".into());
        }
    }
    Ok(())
}

fn read_rest(
    topology: &mut Topology,
    reader: &mut Reader<'_>,
    changed: &mut BTreeSet<u32>,
) -> Result<(), String> {
    let rest = read_points(reader, topology.node_count(), |n| topology.original(n))?;
    for (node, p) in rest.iter().enumerate() {
        if *p != topology.rest[node] {
            changed.insert(node as u32);
        }
    }
    topology.rest = rest.into();
    Ok(())
}

fn read_points(
    reader: &mut Reader<'_>,
    count: usize,
    from: impl Fn(u32) -> Vec3,
) -> Result<Vec<Vec3>, String> {
    let (x, y, z) = (
        reader.plane64(count)?,
        reader.plane64(count)?,
        reader.plane64(count)?,
    );
    let bits = x.into_iter().zip(y).zip(z);
    bits.enumerate()
        .map(|(n, ((x, y), z))| {
            let start = from(n as u32);
            let restored = |bits: u64, axis: usize| f64::from_bits(bits ^ start[axis].to_bits());
            let p = Vec3::new(restored(x, 0), restored(y, 1), restored(z, 2));
            // Written so that a NaN fails.
            if p.iter().all(|v| v.abs() <= POSITION_MAX_M) {
                Ok(p)
            } else {
                Err("has a node position out of range".into())
            }
        })
        .collect()
}

/// Splits the surface as before, with the opened faces in their order.
fn reopen(topology: &mut Topology, faces: &[u32], diagonals: &[u8]) -> Result<(), String> {
    let bits: u32 = topology.cut.iter().map(|c| c.count_ones()).sum();
    for &face in faces {
        let id = FaceId(face);
        let is_known = (id.cell() as usize) < topology.cell_count();
        let cut = is_known.then(|| topology.cut[id.cell() as usize]);
        let position = topology.exposed.faces.len() as u32;
        let is_cut = cut.is_some_and(|bits| bits >> id.face() & 1 == 1);
        if !is_cut || !topology.cut_index.open(id, position) {
            return Err("lists an opened face that is not cut".into());
        }
        topology.exposed_mut().faces.push(id);
    }
    if bits as usize != faces.len() {
        return Err("leaves out a face that is cut".into());
    }
    let faces = topology.exposed.faces.iter().zip(diagonals);
    let triangles: Vec<_> = faces
        .map(|(&face, &along)| topology.split(face, along == 1))
        .collect();
    topology.exposed_mut().triangles = triangles.into();
    Ok(())
}
