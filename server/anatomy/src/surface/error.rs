//! Errors of surfaces.

use std::path::PathBuf;

use thiserror::Error;

use super::{FILE_BYTES_MAX, TRIANGLES_MAX};

/// The reason why a surface was rejected. Lengths in the messages are millimetres.
#[derive(Debug, Error)]
pub enum SurfaceError {
    /// The file could not be opened or read.
    #[error("{}: {source}; check the path and that the file is readable", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// Neither STL nor OBJ nor PLY.
    #[error("{}: {what}; give an STL (.stl), a Wavefront OBJ (.obj) or a PLY (.ply)", path.display())]
    NotASurface {
        /// The file.
        path: PathBuf,
        /// Description of the file.
        what: String,
    },
    /// The format is right but the content is invalid.
    #[error("{}: {place}: {what}; export the surface again", path.display())]
    Broken {
        /// The file.
        path: PathBuf,
        /// Line or triangle.
        place: String,
        /// The defect.
        what: String,
    },
    /// More bytes than the limit.
    #[error("{}: {bytes} bytes, the limit is {FILE_BYTES_MAX}; simplify the surface", path.display())]
    TooManyBytes {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
    /// More triangles than the limit.
    #[error("{}: {triangles} triangles, the limit is {TRIANGLES_MAX}; simplify the surface", path.display())]
    TooManyTriangles {
        /// The file.
        path: PathBuf,
        /// Its declared number of triangles.
        triangles: u64,
    },
    /// No triangle at all.
    #[error("the surface is empty: it has no triangle; export it again")]
    Empty,
    /// A triangle names a vertex that does not exist.
    #[error("triangle {triangle} names vertex {vertex} of {vertices}; export the surface again")]
    NoSuchVertex {
        /// Which triangle.
        triangle: usize,
        /// The index it holds.
        vertex: u32,
        /// How many vertices there are.
        vertices: usize,
    },
    /// A coordinate that is not finite.
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
        /// Edges of exactly one triangle.
        edges: usize,
        /// Edges with three, five... triangles.
        odd_edges: usize,
        /// Number of separate holes.
        loops: usize,
        /// Position of the largest hole, in words.
        largest: String,
    },
    /// A one-sided surface such as a Klein bottle.
    #[error(
        "the surface is one-sided near {place}: its triangles cannot all face outward; \
         export the surface again"
    )]
    OneSided {
        /// Position of the contradiction.
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
