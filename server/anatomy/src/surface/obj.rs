//! Wavefront OBJ files: positions and faces; objects and groups are merged, polygons become fans. Materials,
//! textures and normals are skipped.

use std::path::Path;

use super::read::{broken, not_a_surface, too_many_triangles};
use super::weld::Welder;
use super::{Surface, TRIANGLES_MAX, Unit};
use crate::InputError;

/// Reads a file.
pub(super) fn read(path: &Path, bytes: &[u8], unit: Unit) -> Result<Surface, InputError> {
    let text = String::from_utf8_lossy(bytes);
    // A backslash at the end joins a line with the next one.
    let text = text.replace("\\\r\n", " ").replace("\\\n", " ");
    let mut vertices: Vec<[f32; 3]> = Vec::new();
    let mut triangles: Vec<[usize; 3]> = Vec::new();
    for (n, line) in text.lines().enumerate() {
        let wrong = |what: String| broken(path, format!("line {}", n + 1), what);
        let content = line.split('#').next().unwrap_or_default();
        let mut words = content.split_whitespace();
        match words.next() {
            Some("v") => {
                let mut at = [0.0; 3];
                for (value, axis) in at.iter_mut().zip(["x", "y", "z"]) {
                    let word = words.next().unwrap_or_default();
                    let number = word.parse().ok().filter(|v: &f32| v.is_finite());
                    *value = number.ok_or_else(|| {
                        wrong(format!("{axis} of a vertex is \"{word}\", not a number"))
                    })?;
                }
                vertices.push(at);
            }
            Some("f") => {
                let corner = |word: &str| {
                    let found = index(word, vertices.len());
                    found.ok_or_else(|| wrong(format!("a face names vertex \"{word}\"")))
                };
                let corners: Vec<usize> = words.map(corner).collect::<Result<_, _>>()?;
                if corners.len() < 3 {
                    return Err(wrong(format!("a face with {} corners", corners.len())));
                }
                triangles.extend(corners[1..].windows(2).map(|p| [corners[0], p[0], p[1]]));
            }
            _ => {}
        }
    }
    if vertices.is_empty() && triangles.is_empty() {
        let what = "this OBJ file has neither vertices nor faces";
        return Err(not_a_surface(path, what));
    }
    if triangles.len() as u64 > TRIANGLES_MAX {
        return Err(too_many_triangles(path, triangles.len() as u64));
    }
    let at = |i: usize| {
        let found = vertices.get(i).copied();
        let what = format_args!("a face names vertex {} of {}", i + 1, vertices.len());
        found.ok_or_else(|| broken(path, "faces", what))
    };
    let mut welder = Welder::new(unit.metres());
    for [a, b, c] in triangles {
        welder.triangle([at(a)?, at(b)?, at(c)?]);
    }
    Ok(welder.finish())
}

/// The vertex that a corner such as `7/1/3` names, from 0. A negative number counts back from the last of the
/// vertices so far.
fn index(corner: &str, so_far: usize) -> Option<usize> {
    let number: i64 = corner.split('/').next()?.parse().ok()?;
    let from_one = match number {
        ..0 => number.saturating_add(so_far as i64 + 1),
        _ => number,
    };
    usize::try_from(from_one.checked_sub(1)?).ok()
}
