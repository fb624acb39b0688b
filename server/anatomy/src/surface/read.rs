//! Reading a surface file: choice of the format, and limit of the size.

use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::{Surface, Unit, obj, ply, stl};
use crate::InputError;

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
    pub fn read(path: &Path, unit: Unit) -> Result<Self, InputError> {
        let bytes = read_bounded(path)?;
        if bytes.is_empty() {
            return Err(not_a_surface(path, "the file is empty"));
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
            other => Err(not_a_surface(
                path,
                format!("\".{other}\" is not a format this version reads"),
            )),
        }
    }
}

/// The whole file, rejected unread if it exceeds the limit.
fn read_bounded(path: &Path) -> Result<Vec<u8>, InputError> {
    let file = File::open(path).map_err(InputError::io(path))?;
    let metadata = file.metadata().map_err(InputError::io(path))?;
    if metadata.is_dir() {
        return Err(not_a_surface(path, "this is a folder"));
    }
    let too_many = |bytes: u64| {
        let limit = FILE_BYTES_MAX;
        let what = format_args!("{bytes} bytes, the limit is {limit}; simplify the surface");
        InputError::of(path, what)
    };
    if metadata.len() > FILE_BYTES_MAX {
        return Err(too_many(metadata.len()));
    }
    // A pipe has no known length, and a file may grow: the reader is bounded too.
    let mut bytes = Vec::with_capacity(metadata.len() as usize);
    file.take(FILE_BYTES_MAX + 1)
        .read_to_end(&mut bytes)
        .map_err(InputError::io(path))?;
    if bytes.len() as u64 > FILE_BYTES_MAX {
        return Err(too_many(bytes.len() as u64));
    }
    Ok(bytes)
}

/// A file that is neither STL nor OBJ nor PLY.
pub(super) fn not_a_surface(path: &Path, what: impl Display) -> InputError {
    let give = "give an STL (.stl), a Wavefront OBJ (.obj) or a PLY (.ply)";
    InputError::of(path, format_args!("{what}; {give}"))
}

/// Invalid content at a line or triangle.
pub(super) fn broken(path: &Path, place: impl Display, what: impl Display) -> InputError {
    InputError::of(
        path,
        format_args!("{place}: {what}; export the surface again"),
    )
}

/// More triangles than the limit.
pub(super) fn too_many_triangles(path: &Path, triangles: u64) -> InputError {
    let limit = TRIANGLES_MAX;
    let what = format_args!("{triangles} triangles, the limit is {limit}; simplify the surface");
    InputError::of(path, what)
}
