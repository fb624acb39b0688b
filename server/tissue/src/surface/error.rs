//! What can be wrong with a surface.

use std::path::PathBuf;

use thiserror::Error;

use super::{FILE_BYTES_MAX, TRIANGLES_MAX};

/// Why a surface was refused. Lengths in the messages are millimetres.
#[derive(Debug, Error)]
pub enum SurfaceError {
    /// The file could not be opened or read.
    #[error("{}: {source}; check the path and that the file is readable", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Neither STL nor OBJ nor PLY.
    #[error("{}: {what}; give an STL (.stl), a Wavefront OBJ (.obj) or a PLY (.ply)", path.display())]
    NotASurface {
        /// The file.
        path: PathBuf,
        /// What was found instead.
        what: String,
    },
    /// The format is right and the content is broken.
    #[error("{}: {place}: {what}; export the surface again", path.display())]
    Broken {
        /// The file.
        path: PathBuf,
        /// Line or triangle.
        place: String,
        /// What is wrong there.
        what: String,
    },
    /// More bytes than are read.
    #[error("{}: {bytes} bytes, the limit is {FILE_BYTES_MAX}; simplify the surface", path.display())]
    TooManyBytes {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
    /// More triangles than are read.
    #[error("{}: {triangles} triangles, the limit is {TRIANGLES_MAX}; simplify the surface", path.display())]
    TooManyTriangles {
        /// The file.
        path: PathBuf,
        /// How many it says it has.
        triangles: u64,
    },
    /// No triangle at all.
    #[error("the surface is empty: it has no triangle; export it again")]
    Empty,
    /// A triangle names a vertex that is not there.
    #[error("triangle {triangle} names vertex {vertex} of {vertices}; export the surface again")]
    NoSuchVertex {
        /// Which triangle.
        triangle: usize,
        /// The index it holds.
        vertex: u32,
        /// How many vertices there are.
        vertices: usize,
    },
    /// A coordinate that is no number.
    #[error(
        "{count} vertices have a coordinate that is infinite or not a number, the first is \
         vertex {first}; export the surface again"
    )]
    NotFinite {
        /// How many vertices.
        count: usize,
        /// The first of them.
        first: usize,
    },
    /// Every triangle has zero area.
    #[error(
        "all {triangles} triangles have zero area (the surface is {extent}): it encloses \
         nothing; was it scaled to zero on some axis?"
    )]
    ZeroArea {
        /// How many triangles.
        triangles: usize,
        /// Size of the surface in words.
        extent: String,
    },
    /// The surface has holes.
    #[error(
        "the surface is open: {edges} boundary edges in {loops} {}; {largest}{}; close the \
         {} (\"fill holes\" or \"make manifold\" in a mesh tool) and export again",
        if *loops == 1 { "hole" } else { "holes" },
        if *odd_edges > 0 {
            format!("; {odd_edges} more edges join three or another odd number of triangles")
        } else { String::new() },
        if *loops == 1 { "hole" } else { "holes" }
    )]
    Open {
        /// Edges that belong to one triangle only.
        edges: usize,
        /// Edges with three, five... triangles.
        odd_edges: usize,
        /// In how many separate holes.
        loops: usize,
        /// Where the largest is, in words.
        largest: String,
    },
    /// A one-sided surface such as a Klein bottle.
    #[error(
        "the surface is one-sided near {place}: its triangles cannot all face outward; \
         export the surface again"
    )]
    OneSided {
        /// Where it was noticed.
        place: String,
    },
    /// The triangles cancel: no volume.
    #[error(
        "the surface encloses no volume ({volume_mm3:.3} mm³ inside {area_mm2:.1} mm² of area); \
         it is folded flat or its parts cancel; export it again"
    )]
    NoVolume {
        /// Signed volume in mm³.
        volume_mm3: f64,
        /// Area in mm².
        area_mm2: f64,
    },
}
