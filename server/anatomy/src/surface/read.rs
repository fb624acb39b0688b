//! Reading a surface file: choice of the format, and limit of the size.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::{Surface, SurfaceError, Unit, obj, ply, stl};

/// Most triangles in one file. Reason: 20 million are finer than any scan of a limb (0.1 mm) and take 2 GB
/// during welding. Beyond the bound the file is rejected.
pub const TRIANGLES_MAX: u64 = 20_000_000;

/// Largest file in bytes. Reason: a binary STL of [`TRIANGLES_MAX`] triangles. Beyond the bound the file is
/// rejected unread.
pub const FILE_BYTES_MAX: u64 = stl::binary_bytes(TRIANGLES_MAX);

impl Surface {
    /// Reads a closed surface from an STL (binary or ASCII), OBJ or PLY (any kind) file whose coordinates are
    /// in `unit`. The extension selects STL, OBJ or PLY; the content selects the kind of STL or PLY. The
    /// surface is welded and not yet checked.
    pub fn read(path: &Path, unit: Unit) -> Result<Self, SurfaceError> {
        let bytes = read_bounded(path)?;
        if bytes.is_empty() {
            return Err(SurfaceError::NotASurface {
                path: path.to_owned(),
                what: "the file is empty".to_owned(),
            });
        }
        let extension = path
            .extension()
            .unwrap_or_default()
            .to_string_lossy()
            .to_lowercase();
        match extension.as_str() {
            "obj" => obj::read(path, &bytes, unit),
            "ply" => ply::read(path, &bytes, unit),
            "stl" | "stla" | "stlb" | "" => stl::read(path, &bytes, unit),
            other => Err(SurfaceError::NotASurface {
                path: path.to_owned(),
                what: format!("\".{other}\" is not a format this version reads"),
            }),
        }
    }
}

/// The whole file, rejected unread if it exceeds the limit.
fn read_bounded(path: &Path) -> Result<Vec<u8>, SurfaceError> {
    let io = |source| SurfaceError::Io {
        path: path.to_owned(),
        source,
    };
    let file = File::open(path).map_err(io)?;
    let metadata = file.metadata().map_err(io)?;
    if metadata.is_dir() {
        return Err(SurfaceError::NotASurface {
            path: path.to_owned(),
            what: "this is a folder".to_owned(),
        });
    }
    let too_many = |bytes| SurfaceError::TooManyBytes {
        path: path.to_owned(),
        bytes,
    };
    if metadata.len() > FILE_BYTES_MAX {
        return Err(too_many(metadata.len()));
    }
    // A pipe has no known length, and a file may grow: the reader is bounded too.
    let mut bytes = Vec::with_capacity(metadata.len() as usize);
    file.take(FILE_BYTES_MAX + 1)
        .read_to_end(&mut bytes)
        .map_err(io)?;
    if bytes.len() as u64 > FILE_BYTES_MAX {
        return Err(too_many(bytes.len() as u64));
    }
    Ok(bytes)
}
