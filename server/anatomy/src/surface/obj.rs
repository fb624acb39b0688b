//! Wavefront OBJ files: positions and faces; objects and groups are merged, polygons become fans.

use std::fmt::Write;
use std::path::Path;

use super::weld::Welder;
use super::{Surface, TRIANGLES_MAX, Unit};
use crate::InputError;

/// Reads a file.
pub(super) fn read(path: &Path, bytes: &[u8], unit: Unit) -> Result<Surface, InputError> {
    let text = String::from_utf8_lossy(bytes);
    let plain = plain(path, &text)?;
    let options = tobj::LoadOptions {
        triangulate: true,
        single_index: true,
        ..Default::default()
    };
    let (models, _) =
        tobj::load_obj_buf(&mut plain.as_bytes(), &options, |_| Ok(Default::default()))
            .map_err(|e| broken(path, "faces", e.to_string()))?;
    let mut welder = Welder::new(unit.metres());
    for mesh in models.iter().map(|m| &m.mesh) {
        let at = |i: u32| [0, 1, 2].map(|k| mesh.positions[3 * i as usize + k]);
        for t in mesh.indices.chunks_exact(3) {
            welder.triangle([at(t[0]), at(t[1]), at(t[2])]);
        }
    }
    Ok(welder.finish())
}

/// The file reduced to surface data, with every number validated: `v` lines with three coordinates and `f`
/// lines with position indices. Without objects, materials, texture and normals nothing remains that could
/// split the surface or fail to load.
fn plain(path: &Path, text: &str) -> Result<String, InputError> {
    let mut out = String::with_capacity(text.len());
    let (mut triangles, mut vertices) = (0_u64, 0_i64);
    // A backslash at the end joins a line with the next one.
    let text = text.replace("\\\r\n", " ").replace("\\\n", " ");
    for (n, line) in text.lines().enumerate() {
        let place = || format!("line {}", n + 1);
        let mut words = line
            .split('#')
            .next()
            .unwrap_or_default()
            .split_whitespace();
        match words.next() {
            Some("v") => {
                vertices += 1;
                out.push('v');
                for axis in ["x", "y", "z"] {
                    let word = words.next().unwrap_or_default();
                    if !word.parse::<f32>().is_ok_and(f32::is_finite) {
                        let what = format!("{axis} of a vertex is \"{word}\", not a number");
                        return Err(broken(path, &place(), what));
                    }
                    write!(out, " {word}").expect("a string takes all");
                }
                out.push('\n');
            }
            Some("f") => {
                let corners: Vec<&str> = words.collect();
                if corners.len() < 3 {
                    let what = format!("a face with {} corners", corners.len());
                    return Err(broken(path, &place(), what));
                }
                triangles += corners.len() as u64 - 2;
                out.push('f');
                for corner in corners {
                    let index = corner.split('/').next().unwrap_or_default().parse::<i64>();
                    // Negative indices count back from the last vertex.
                    let absolute = index.map(|i| {
                        if i < 0 {
                            i.saturating_add(vertices + 1)
                        } else {
                            i
                        }
                    });
                    match absolute {
                        Ok(i) if i >= 1 => write!(out, " {i}").expect("a string takes all"),
                        _ => {
                            let what = format!("a face names vertex \"{corner}\"");
                            return Err(broken(path, &place(), what));
                        }
                    }
                }
                out.push('\n');
            }
            _ => {}
        }
    }
    if vertices == 0 && triangles == 0 {
        return Err(not_a_surface(
            path,
            "this OBJ file has neither vertices nor faces",
        ));
    }
    if triangles > TRIANGLES_MAX {
        return Err(too_many_triangles(path, triangles));
    }
    Ok(out)
}

fn broken(path: &Path, place: &str, what: String) -> InputError {
    broken(path, place, what)
}
