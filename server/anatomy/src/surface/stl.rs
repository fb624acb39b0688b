//! STL files, binary and ASCII.

use std::io::{Cursor, ErrorKind, Write};
use std::path::Path;

use palpate_tissue::file::{Staged, WriteError};
use stl_io::{Normal, Triangle, Vertex};

use super::read::{broken, not_a_surface, too_many_triangles};
use super::weld::Welder;
use super::{Surface, TRIANGLES_MAX, Unit};
use crate::InputError;

/// Bytes before the first triangle of a binary file: 80 of header, 4 of count.
const HEADER_BYTES: u64 = 84;

/// Bytes of one triangle in a binary file.
const TRIANGLE_BYTES: u64 = 50;

/// Size of a binary file with so many triangles.
pub(super) const fn binary_bytes(triangles: u64) -> u64 {
    HEADER_BYTES + TRIANGLE_BYTES * triangles
}

/// Reads either kind. The size decides, because many programs write binary files whose header begins with
/// "solid", like an ASCII file.
pub(super) fn read(path: &Path, bytes: &[u8], unit: Unit) -> Result<Surface, InputError> {
    let count = bytes
        .get(80..84)
        .and_then(|b| b.try_into().ok())
        .map(u32::from_le_bytes);
    let is_binary = count.is_some_and(|n| binary_bytes(u64::from(n)) == bytes.len() as u64);
    if is_binary {
        return collect(path, bytes, unit);
    }
    if let Some(text) = ascii(bytes) {
        return collect(path, &normalised(path, &text)?, unit);
    }
    match count {
        // Bytes after the last triangle are harmless; too few of them are not.
        Some(n) if binary_bytes(u64::from(n)) < bytes.len() as u64 && plausible(bytes) => {
            collect(path, bytes, unit)
        }
        Some(n) if plausible(bytes) => Err(broken(
            path,
            format!(
                "after {} triangles",
                (bytes.len() as u64 - HEADER_BYTES) / TRIANGLE_BYTES
            ),
            format!("the file is truncated: its header declares {n} triangles"),
        )),
        _ => Err(not_a_surface(path, "this is not an STL file")),
    }
}

/// Whether a file of wrong size still looks like a binary STL. The first triangle must be present, with
/// plausible coordinates.
fn plausible(bytes: &[u8]) -> bool {
    let first = bytes.get(HEADER_BYTES as usize..(HEADER_BYTES + 48) as usize);
    first.is_some_and(|b| {
        b.chunks_exact(4).all(|f| {
            let x = f32::from_le_bytes([f[0], f[1], f[2], f[3]]).abs();
            x == 0.0 || (1e-12..1e6).contains(&x)
        })
    })
}

/// The text of an ASCII file, in lower case; `None` when it does not begin like one.
fn ascii(bytes: &[u8]) -> Option<String> {
    let begin = bytes.trim_ascii_start();
    let word = begin.get(..5)?;
    (word.eq_ignore_ascii_case(b"solid") && begin.get(5).is_none_or(u8::is_ascii_whitespace))
        .then(|| String::from_utf8_lossy(bytes).to_lowercase())
}

/// One solid with plain headings, as the parser requires. Names, boundaries between several solids and the
/// written normals are dropped. Some programs write `nan` normals; the order of the corners defines the same
/// direction.
fn normalised(path: &Path, text: &str) -> Result<Vec<u8>, InputError> {
    let mut out = String::with_capacity(text.len() + 16);
    out.push_str("solid s\n");
    let (mut facets, mut ended) = (0_u64, false);
    for line in text.lines().map(str::trim) {
        match line.split_whitespace().next() {
            Some("solid") => ended = false,
            Some("endsolid") => ended = true,
            Some("facet") => {
                facets += 1;
                out.push_str("facet normal 0 0 0\n");
            }
            None => {}
            Some(_) => {
                out.push_str(line);
                out.push('\n');
            }
        }
    }
    if facets > TRIANGLES_MAX {
        return Err(too_many_triangles(path, facets));
    }
    if ended {
        out.push_str("endsolid s\n");
    }
    Ok(out.into_bytes())
}

/// Parses and welds.
fn collect(path: &Path, bytes: &[u8], unit: Unit) -> Result<Surface, InputError> {
    let mut welder = Welder::new(unit.metres());
    let broken = |triangles: usize, source: &std::io::Error| {
        broken(
            path,
            format!("triangle {}", triangles + 1),
            match source.kind() {
                ErrorKind::UnexpectedEof => "the file is truncated".to_owned(),
                _ => source.to_string(),
            },
        )
    };
    let mut cursor = Cursor::new(bytes);
    let reader = stl_io::create_stl_reader(&mut cursor).map_err(|e| broken(0, &e))?;
    for triangle in reader {
        let triangle = triangle.map_err(|e| broken(welder.triangles(), &e))?;
        welder.triangle(triangle.vertices.map(|v| v.0));
    }
    Ok(welder.finish())
}

impl Surface {
    /// Writes a binary STL in millimetres with outward normals, atomically.
    pub fn write_stl(&self, path: &Path) -> Result<(), WriteError> {
        Staged::write(path, |out| self.write_stl_to(out))?.put_in_place()
    }

    /// Writes a binary STL in millimetres with outward normals.
    pub(crate) fn write_stl_to(&self, out: &mut impl Write) -> std::io::Result<()> {
        let triangles: Vec<Triangle> = (0..self.triangles.len())
            .map(|t| {
                let [a, b, c] = self.corners(t);
                let normal = (b - a)
                    .cross(&(c - a))
                    .try_normalize(0.0)
                    .unwrap_or_default();
                Triangle {
                    normal: Normal::new([normal.x as f32, normal.y as f32, normal.z as f32]),
                    vertices: [a, b, c].map(|p| {
                        let p = p / Unit::Millimetre.metres();
                        Vertex::new([p.x as f32, p.y as f32, p.z as f32])
                    }),
                }
            })
            .collect();
        stl_io::write_stl(out, triangles.iter())?;
        out.flush()
    }
}
