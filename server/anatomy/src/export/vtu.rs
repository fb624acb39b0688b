//! The model as a VTK unstructured grid (`.vtu`), which programs such as `ParaView` open.
//!
//! The file is the XML head that names the arrays, followed by the arrays as binary data, each in blocks
//! compressed by zlib:
//!
//! ```text
//! array   number of blocks, bytes of a block, bytes of the last block (0: a whole one), packed bytes
//!         of each block (u64 each); the blocks
//! ```
//!
//! Source: VTK file formats, "XML file formats" (Kitware, vtk.org/wp-content/uploads/2015/04/
//! file-formats.pdf) and the reader of VTK itself.

use std::io::{self, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::ZlibEncoder;
use rayon::prelude::*;

use palpate_tissue::cell::{NO_CELL, cell_volume, scaled_jacobian};
use palpate_tissue::file::{Staged, WriteError};
use palpate_tissue::{Model, Shape, Topology, Vec3};

/// Bytes per compressed block: small enough to occupy all cores, large enough to compress well.
const BLOCK_BYTES: usize = 1 << 18;
/// Deflate level, as in the model file: coordinates gain little beyond it.
const LEVEL: u32 = 3;
/// Corners of a cell in the order of `VTK_HEXAHEDRON`: around the lower face, then the upper.
const HEXAHEDRON: [usize; 8] = [0, 1, 3, 2, 4, 5, 7, 6];
/// Number of that kind of cell.
const VTK_HEXAHEDRON: u8 = 12;
const MM: f64 = 1e3;

/// Writes the cells of a model in its current state. Lengths in mm.
///
/// | of | array | |
/// | --- | --- | --- |
/// | point | `displacement_mm` | displacement from rest |
/// | point | `lattice` | lattice coordinates (of doubled nodes: of the original node) |
/// | point | `pinned` | 1 for pinned nodes |
/// | cell | `region` | number of its region in scene order |
/// | cell | `material` | number of its material, by first occurrence in scene order |
/// | cell | `young_kpa` | Young's modulus |
/// | cell | `volume_mm3` | its current volume |
/// | cell | `scaled_jacobian` | its current shape, see [`scaled_jacobian`] |
///
/// Names of regions and materials stand in a comment at the head of the file.
pub fn write_vtu(topology: &Topology, shape: &Shape, out: &mut impl Write) -> io::Result<()> {
    let arrays = [
        points(topology, shape),
        cells(topology),
        point_data(topology, shape),
        cell_data(topology, shape),
    ];
    let mut offset = 0;
    let mut packed = Vec::new();
    write_head(topology.model(), out)?;
    writeln!(
        out,
        "<UnstructuredGrid>\n<Piece NumberOfPoints=\"{}\" NumberOfCells=\"{}\">",
        topology.node_count(),
        topology.cell_count()
    )?;
    for (section, arrays) in ["Points", "Cells", "PointData", "CellData"]
        .iter()
        .zip(arrays)
    {
        writeln!(out, "<{section}>")?;
        for array in arrays {
            let components = match array.components {
                // The default value; some readers handle only this form of a missing list.
                1 => String::new(),
                n => format!(" NumberOfComponents=\"{n}\""),
            };
            writeln!(
                out,
                "<DataArray type=\"{}\" Name=\"{}\"{components} format=\"appended\" \
                 offset=\"{offset}\"/>",
                array.kind, array.name
            )?;
            let blocks = pack(&array.bytes)?;
            offset += blocks.len();
            packed.push(blocks);
        }
        writeln!(out, "</{section}>")?;
    }
    out.write_all(b"</Piece>\n</UnstructuredGrid>\n<AppendedData encoding=\"raw\">\n_")?;
    for blocks in &packed {
        out.write_all(blocks)?;
    }
    out.write_all(b"\n</AppendedData>\n</VTKFile>\n")
}

/// Writes a `.vtu` file, which appears at its path only after [`Staged::put_in_place`].
pub fn stage_vtu(topology: &Topology, shape: &Shape, path: &Path) -> Result<Staged, WriteError> {
    Staged::write(path, |out| write_vtu(topology, shape, out))
}

fn write_head(model: &Model, out: &mut impl Write) -> io::Result<()> {
    writeln!(
        out,
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<VTKFile type=\"UnstructuredGrid\" \
         version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\" \
         compressor=\"vtkZLibDataCompressor\">"
    )?;
    let materials = materials(model);
    writeln!(out, "<!-- lengths in mm")?;
    for (number, region) in model.regions.iter().enumerate() {
        let (name, material) = (plain(&region.name), plain(&region.material.name));
        writeln!(
            out,
            "region {number}: {name}, material {}: {material}",
            materials[number]
        )?;
    }
    writeln!(out, "-->")
}

/// A name without text that would end an XML comment and without characters that XML forbids.
fn plain(name: &str) -> String {
    let visible = name.chars().filter(|c| !c.is_control());
    visible.collect::<String>().replace('-', "_")
}

fn materials(model: &Model) -> Vec<i32> {
    let mut names: Vec<&str> = Vec::new();
    let number = |name| {
        names.iter().position(|n| *n == name).unwrap_or_else(|| {
            names.push(name);
            names.len() - 1
        }) as i32
    };
    let of_regions = model.regions.iter().map(|r| r.material.name.as_str());
    of_regions.map(number).collect()
}

/// Numbers with their name and type in the file.
struct Array {
    kind: &'static str,
    name: &'static str,
    components: usize,
    bytes: Vec<u8>,
}

impl Array {
    fn new<T, const N: usize>(name: &'static str, values: impl Iterator<Item = [T; N]>) -> Self
    where
        T: Number,
    {
        let mut bytes = Vec::new();
        for value in values.flatten() {
            value.append(&mut bytes);
        }
        Self {
            kind: T::KIND,
            name,
            components: N,
            bytes,
        }
    }
}

/// The VTK name and bytes of a number.
trait Number {
    const KIND: &'static str;
    fn append(self, bytes: &mut Vec<u8>);
}

macro_rules! numbers {
    ($($number:ty: $kind:literal),*) => {$(
        impl Number for $number {
            const KIND: &'static str = $kind;
            fn append(self, bytes: &mut Vec<u8>) {
                bytes.extend(self.to_le_bytes());
            }
        }
    )*};
}

numbers!(u8: "UInt8", i32: "Int32", i64: "Int64", f32: "Float32", f64: "Float64");

fn mm(v: Vec3) -> [f64; 3] {
    (v * MM).into()
}

fn points(topology: &Topology, shape: &Shape) -> Vec<Array> {
    let nodes = 0..topology.node_count() as u32;
    vec![Array::new(
        "Points",
        nodes.map(|n| mm(shape.position(topology, n))),
    )]
}

fn cells(topology: &Topology) -> Vec<Array> {
    let cells = 0..topology.cell_count() as u32;
    vec![
        Array::new(
            "connectivity",
            cells.clone().flat_map(|cell| {
                let corners = topology.corners(cell);
                HEXAHEDRON.map(|c| [i64::from(corners[c])])
            }),
        ),
        Array::new("offsets", cells.clone().map(|c| [8 * (i64::from(c) + 1)])),
        Array::new("types", cells.map(|_| [VTK_HEXAHEDRON])),
    ]
}

fn point_data(topology: &Topology, shape: &Shape) -> Vec<Array> {
    let nodes = 0..topology.node_count() as u32;
    vec![
        Array::new("displacement_mm", shape.displacement.iter().map(|d| mm(*d))),
        Array::new("lattice", nodes.clone().map(|n| lattice(topology, n))),
        Array::new("pinned", nodes.map(|n| [u8::from(topology.is_pinned(n))])),
    ]
}

/// Lattice coordinates of a node; a doubled node has those of its original.
fn lattice(topology: &Topology, node: u32) -> [i32; 3] {
    let model = topology.model();
    let cells = topology.cells_around(node);
    let slot = cells.iter().position(|&c| c != NO_CELL);
    slot.map_or([0; 3], |s| {
        model.lattice[model.cells[cells[s] as usize].corners[s] as usize]
    })
}

fn cell_data(topology: &Topology, shape: &Shape) -> Vec<Array> {
    let model = topology.model();
    let materials = materials(model);
    let regions = || (0..topology.cell_count() as u32).map(|c| topology.region(c).index());
    let shapes: Vec<(f64, f64)> = (0..topology.cell_count() as u32)
        .into_par_iter()
        .map(|cell| {
            let corners = topology.corners(cell);
            let corners = corners.map(|n| shape.position(topology, n) * MM);
            (cell_volume(&corners), scaled_jacobian(&corners))
        })
        .collect();
    vec![
        Array::new("region", regions().map(|r| [r as i32])),
        Array::new("material", regions().map(|r| [materials[r]])),
        Array::new(
            "young_kpa",
            regions().map(|r| [(model.regions[r].material.young_pa * 1e-3) as f32]),
        ),
        Array::new("volume_mm3", shapes.iter().map(|s| [s.0])),
        Array::new("scaled_jacobian", shapes.iter().map(|s| [s.1 as f32])),
    ]
}

/// An array as stored in the file.
fn pack(bytes: &[u8]) -> io::Result<Vec<u8>> {
    let blocks: Vec<Vec<u8>> = bytes
        .par_chunks(BLOCK_BYTES)
        .map(|block| {
            let mut encoder = ZlibEncoder::new(Vec::new(), Compression::new(LEVEL));
            encoder.write_all(block)?;
            encoder.finish()
        })
        .collect::<io::Result<_>>()?;
    let mut out = Vec::new();
    let head = [blocks.len(), BLOCK_BYTES, bytes.len() % BLOCK_BYTES];
    for number in head.into_iter().chain(blocks.iter().map(Vec::len)) {
        out.extend((number as u64).to_le_bytes());
    }
    out.extend(blocks.into_iter().flatten());
    Ok(out)
}
