//! The model file: a [`Model`] with the report of how it was built.
//!
//! The content, inside the envelope of `container.rs`:
//!
//! ```text
//! counts     nodes, cells, regions (u32 each), spacing in m, gravity in m/s² (f64 bits)
//! regions    name, pinned, direction of the fibres, material
//! lattice    three columns of i32, as steps from node to node
//! origin     where lattice point (0, 0, 0) would stand in m
//! nodes      three columns of f64 bits, XOR the bits of origin + lattice · spacing
//! cells      eight columns of corners and one of regions as steps from cell to cell,
//!            one byte of neighbour bits per cell
//! report     text that the program which built the model left for a reader
//! ```
//!
//! Positions keep every bit; XOR with the lattice point they came from zeroes their leading bytes. The
//! neighbour behind a face follows from the corners. A node is corner `c` of at most one cell, so the neighbour
//! along an axis is the cell of which it is corner `c` with that axis flipped.

mod container;
mod model_check;
mod planes;
mod staged;

use std::io::Write;
use std::path::Path;

pub(crate) use container::{open, open_within, seal};
pub use model_check::{CELLS_MAX, NODES_MAX, POSITION_MAX_M, REGIONS_MAX};
use planes::Short;
pub(crate) use planes::{Content, Reader};
pub use staged::{Staged, WriteError, write_file};

use crate::cell::{FACES, NO_CELL};
use crate::{Cell, FibreAxis, Material, Model, Region, RegionId, Vec3};

const MAGIC: [u8; 8] = *b"palpmodl";
/// Version of the model format that this program writes and reads.
pub const MODEL_FORMAT: u32 = 4;
/// Flag bits of a material: it has a fibre direction, which follows; it bottoms out.
const GIVEN_AXIS: u8 = 1;
const BOTTOMS_OUT: u8 = 2;
/// Longest build report in bytes; a longer one is left out.
const REPORT_BYTES_MAX: usize = 16 << 20;

/// Why a model file or a snapshot cannot be read, with the remedy.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct FileError(pub(crate) String);

/// Content of a model file.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelFile {
    /// The model.
    pub model: Model,
    /// The report of the program that built it, as JSON text; empty when there is none.
    pub report_json: String,
}

impl ModelFile {
    /// The bytes of the file.
    pub fn encode(&self) -> Vec<u8> {
        encode_with(&self.model, &self.report_json)
    }

    /// Decodes a file and checks every number in it.
    pub fn decode(bytes: &[u8]) -> Result<Self, FileError> {
        let content = open(MAGIC, MODEL_FORMAT, bytes)
            .map_err(|defect| FileError(format!("invalid model file: {defect}")))?;
        Self::from_content(&content)
    }

    /// The decompressed content of the envelope.
    pub fn content(&self) -> Vec<u8> {
        content_of(&self.model, &self.report_json)
    }

    /// Decodes the content of a file and checks every number in it. The checksum keeps damage from
    /// [`decode`](Self::decode); crafted bytes arrive here.
    pub fn from_content(content: &[u8]) -> Result<Self, FileError> {
        Self::consistent(content).map_err(|defect| {
            FileError(format!(
                "inconsistent model file: the model {defect}; build it again"
            ))
        })
    }

    fn consistent(content: &[u8]) -> Result<Self, String> {
        let mut reader = Reader(content);
        let model = read_model(&mut reader)?;
        let report_json = reader.text()?;
        if !reader.0.is_empty() {
            return Err("is followed by more".into());
        }
        model_check::check(&model)?;
        Ok(Self { model, report_json })
    }

    /// Writes the file beside its path and then moves it there, so that a reader finds the old file or the new
    /// one, never half of one.
    pub fn write(&self, path: &Path) -> Result<(), WriteError> {
        self.stage(path)?.put_in_place()
    }

    /// Writes the file without moving it to its path yet.
    pub fn stage(&self, path: &Path) -> Result<Staged, WriteError> {
        Staged::write(path, |out| out.write_all(&self.encode()))
    }

    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let bytes = read_if(MAGIC, path).map_err(|e| {
            let path = path.display();
            FileError(format!("{path}: the model file could not be read: {e}"))
        })?;
        Self::decode(&bytes)
    }
}

/// The bytes of a file. A file with the wrong magic is read no further than that, because it may be endless.
fn read_if(magic: [u8; 8], path: &Path) -> std::io::Result<Vec<u8>> {
    use std::io::Read as _;
    let mut file = std::fs::File::open(path)?;
    let mut bytes = Vec::new();
    (&file).take(magic.len() as u64).read_to_end(&mut bytes)?;
    if bytes == magic {
        file.read_to_end(&mut bytes)?;
    }
    Ok(bytes)
}

/// Encodes a model alone as the bytes of a model file, for transmission.
pub fn encode_model(model: &Model) -> Vec<u8> {
    encode_with(model, "")
}

/// The model in the bytes of a model file; see [`ModelFile::decode`].
pub fn decode_model(bytes: &[u8]) -> Result<Model, FileError> {
    ModelFile::decode(bytes).map(|file| file.model)
}

fn encode_with(model: &Model, report_json: &str) -> Vec<u8> {
    seal(MAGIC, MODEL_FORMAT, &content_of(model, report_json))
}

fn content_of(model: &Model, report_json: &str) -> Vec<u8> {
    let mut out = Content::default();
    out.u32(model.nodes.len() as u32);
    out.u32(model.cells.len() as u32);
    out.u32(model.regions.len() as u32);
    out.f64(model.spacing_m);
    for component in model.gravity {
        out.f64(component);
    }
    for region in &model.regions {
        write_region(&mut out, region);
    }
    for axis in 0..3 {
        out.steps32(model.lattice.iter().map(|l| l[axis] as u32));
    }
    let origin = origin_of(model);
    for axis in 0..3 {
        out.f64(origin[axis]);
        let columns = model.nodes.iter().zip(&model.lattice);
        out.plane64(&columns.map(|(p, l)| {
            p[axis].to_bits() ^ predicted(origin[axis], l[axis], model.spacing_m).to_bits()
        }));
    }
    for corner in 0..8 {
        out.steps32(model.cells.iter().map(|c| c.corners[corner]));
    }
    out.steps32(model.cells.iter().map(|c| u32::from(c.region.0)));
    for cell in &model.cells {
        let bit = |face: usize| u8::from(cell.neighbours[face] != NO_CELL) << face;
        out.u8((0..6).map(bit).sum());
    }
    let fits = report_json.len() <= REPORT_BYTES_MAX;
    out.text(if fits { report_json } else { "" });
    out.0
}

/// The median over the nodes of the offset of a node from its lattice point.
fn origin_of(model: &Model) -> [f64; 3] {
    std::array::from_fn(|axis| {
        let mut offsets: Vec<f64> = model
            .nodes
            .iter()
            .zip(&model.lattice)
            .map(|(p, l)| p[axis] - f64::from(l[axis]) * model.spacing_m)
            .collect();
        if offsets.is_empty() {
            return 0.0;
        }
        let middle = offsets.len() / 2;
        *offsets.select_nth_unstable_by(middle, f64::total_cmp).1
    })
}

fn predicted(origin: f64, lattice: i32, spacing: f64) -> f64 {
    origin + f64::from(lattice) * spacing
}

fn write_region(out: &mut Content, region: &Region) {
    out.text(&region.name);
    out.u8(u8::from(region.pinned));
    for component in region.fibre {
        out.f64(component);
    }
    let m = &region.material;
    out.text(&m.name);
    let given = u8::from(m.fibre_axis != FibreAxis::Long);
    out.u8((given * GIVEN_AXIS) | (u8::from(m.bottoms_out) * BOTTOMS_OUT));
    if let FibreAxis::Given(axis) = m.fibre_axis {
        for component in axis {
            out.f64(component);
        }
    }
    for number in m.numbers() {
        out.f64(number);
    }
    out.text(&m.source);
}

fn read_region(reader: &mut Reader<'_>) -> Result<Region, Short> {
    Ok(Region {
        name: reader.text()?,
        pinned: reader.u8()? != 0,
        fibre: reader.point()?,
        material: read_material(reader)?,
    })
}

fn read_material(reader: &mut Reader<'_>) -> Result<Material, Short> {
    let name = reader.text()?;
    let flags = reader.u8()?;
    Ok(Material {
        name,
        bottoms_out: flags & BOTTOMS_OUT != 0,
        // The fields are read in the order of this literal.
        fibre_axis: match flags & GIVEN_AXIS {
            0 => FibreAxis::Long,
            _ => FibreAxis::Given(reader.point()?),
        },
        young_pa: reader.f64()?,
        poisson: reader.f64()?,
        stiffening: reader.f64()?,
        fibre_ratio: reader.f64()?,
        compress_limit: reader.f64()?,
        stretch_limit: reader.f64()?,
        density_kg_m3: reader.f64()?,
        friction_static: reader.f64()?,
        friction_dynamic: reader.f64()?,
        toughness_j_m2: reader.f64()?,
        source: reader.text()?,
    })
}

fn read_model(reader: &mut Reader<'_>) -> Result<Model, String> {
    let nodes = reader.u32()? as usize;
    let cells = reader.u32()? as usize;
    let regions = reader.u32()? as usize;
    for (what, count, max) in [
        ("nodes", nodes, NODES_MAX),
        ("cells", cells, CELLS_MAX),
        ("regions", regions, REGIONS_MAX),
    ] {
        if count > max {
            return Err(format!("declares {count} {what}; the limit is {max}"));
        }
    }
    let spacing_m = reader.f64()?;
    let gravity = [reader.f64()?, reader.f64()?, reader.f64()?];
    let regions = (0..regions)
        .map(|_| read_region(reader))
        .collect::<Result<_, _>>()?;
    let lattice: [Vec<u32>; 3] = read_columns(|| reader.steps32(nodes))?;
    let mut columns = [const { Vec::new() }; 3];
    let mut origin = [0.0; 3];
    for axis in 0..3 {
        origin[axis] = reader.f64()?;
        columns[axis] = reader.plane64(nodes)?;
    }
    let lattice: Vec<[i32; 3]> = (0..nodes)
        .map(|n| std::array::from_fn(|axis| lattice[axis][n] as i32))
        .collect();
    let nodes = (0..nodes)
        .map(|n| {
            Vec3::from_fn(|axis, _| {
                let from = predicted(origin[axis], lattice[n][axis], spacing_m);
                f64::from_bits(columns[axis][n] ^ from.to_bits())
            })
        })
        .collect::<Vec<_>>();
    let cells = read_cells(reader, nodes.len(), cells)?;
    Ok(Model {
        spacing_m,
        gravity,
        regions,
        nodes,
        lattice,
        cells,
    })
}

fn read_columns<T, const N: usize>(
    mut read: impl FnMut() -> Result<Vec<T>, Short>,
) -> Result<[Vec<T>; N], Short> {
    let mut columns = [const { Vec::new() }; N];
    for column in &mut columns {
        *column = read()?;
    }
    Ok(columns)
}

fn read_cells(reader: &mut Reader<'_>, nodes: usize, count: usize) -> Result<Vec<Cell>, String> {
    let corners: [Vec<u32>; 8] = read_columns(|| reader.steps32(count))?;
    let regions = reader.steps32(count)?;
    let bits = reader.bytes(count)?;
    let mut around = vec![[NO_CELL; 8]; nodes];
    for (c, column) in corners.iter().enumerate() {
        for (cell, &node) in column.iter().enumerate() {
            let slots = around
                .get_mut(node as usize)
                .ok_or_else(|| format!("has cell {cell} on node {node} of {nodes}"))?;
            slots[c] = cell as u32;
        }
    }
    let behind = |cell: usize, face: usize| {
        if bits[cell] >> face & 1 == 0 {
            return Ok(NO_CELL);
        }
        let corner = FACES[face][0];
        let node = corners[corner][cell];
        match around[node as usize][corner ^ (1 << (face / 2))] {
            NO_CELL => Err(format!(
                "declares a neighbour across face {face} of cell {cell}, but there is none"
            )),
            other => Ok(other),
        }
    };
    (0..count)
        .map(|cell| {
            let region = u16::try_from(regions[cell]).unwrap_or(u16::MAX);
            let mut neighbours = [NO_CELL; 6];
            for (face, slot) in neighbours.iter_mut().enumerate() {
                *slot = behind(cell, face)?;
            }
            Ok(Cell {
                corners: std::array::from_fn(|c| corners[c][cell]),
                neighbours,
                region: RegionId(region),
            })
        })
        .collect()
}
