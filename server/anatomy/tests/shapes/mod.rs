//! Closed surfaces of simple shapes, and scenes made of them.

#![allow(clippy::unwrap_used, dead_code)]

use std::f64::consts::PI;
use std::fmt::Write as _;

use nalgebra::Rotation3;
use palpate_anatomy::{InputError, Scene, SceneInput, Surface};
use palpate_tissue::Vec3;

/// A closed body of revolution about z with the given profile of (radius, z), capped flat.
pub(crate) fn turned(profile: &[(f64, f64)], sides: usize) -> Surface {
    let mut surface = Surface::default();
    let ring = |at: usize, s: usize| (at * sides + s % sides) as u32;
    for &(r, z) in profile {
        for s in 0..sides {
            let angle = 2.0 * PI * s as f64 / sides as f64;
            surface
                .vertices
                .push(Vec3::new(r * angle.cos(), r * angle.sin(), z));
        }
    }
    for at in 0..profile.len() - 1 {
        for s in 0..sides {
            let [a, b] = [ring(at, s), ring(at, s + 1)];
            let [c, d] = [ring(at + 1, s + 1), ring(at + 1, s)];
            surface.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    for (at, up) in [(0, false), (profile.len() - 1, true)] {
        let middle = surface.vertices.len() as u32;
        surface.vertices.push(Vec3::new(0.0, 0.0, profile[at].1));
        for s in 0..sides {
            let (a, b) = (ring(at, s), ring(at, s + 1));
            let triangle = if up { [a, b, middle] } else { [b, a, middle] };
            surface.triangles.push(triangle);
        }
    }
    surface
}

pub(crate) fn ball(radius: f64) -> Surface {
    let profile: Vec<(f64, f64)> = (1..24)
        .map(|i| PI * f64::from(i) / 24.0)
        .map(|a| (radius * a.sin(), -radius * a.cos()))
        .collect();
    turned(&profile, 48)
}

pub(crate) fn cylinder(radius: f64, half_height: f64) -> Surface {
    turned(&[(radius, -half_height), (radius, half_height)], 48)
}

/// A box between two corners, two triangles per face.
pub(crate) fn cuboid(low: Vec3, high: Vec3) -> Surface {
    let vertices = (0..8)
        .map(|c| Vec3::from_fn(|a, _| if c >> a & 1 == 1 { high[a] } else { low[a] }))
        .collect();
    let quads = [
        [0, 4, 6, 2],
        [1, 3, 7, 5],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 2, 3, 1],
        [4, 5, 7, 6],
    ];
    let triangles = quads
        .iter()
        .flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
    Surface {
        vertices,
        triangles: triangles.collect(),
    }
}

/// The shape rotated by Euler angles and translated.
pub(crate) fn placed(mut surface: Surface, angles: [f64; 3], at: Vec3) -> Surface {
    let turn = Rotation3::from_euler_angles(angles[0], angles[1], angles[2]);
    for v in &mut surface.vertices {
        *v = turn * *v + at;
    }
    surface
}

/// All triangles of several surfaces as one.
pub(crate) fn together(surfaces: &[Surface]) -> Surface {
    let mut all = Surface::default();
    for surface in surfaces {
        let base = all.vertices.len() as u32;
        all.vertices.extend(&surface.vertices);
        let moved = surface.triangles.iter().map(|t| t.map(|v| v + base));
        all.triangles.extend(moved);
    }
    all
}

/// A scene of the surfaces in this order; each region is named by its number.
pub(crate) fn scene(spacing: &str, surfaces: &[Surface]) -> Result<SceneInput, InputError> {
    let mut text = format!("format = \"palpate-scene/1\"\nspacing_mm = {spacing}\n");
    for r in 0..surfaces.len() {
        write!(
            text,
            "[[region]]\nname = \"r{r}\"\nsurface = \"r{r}.stl\"\nmaterial = \"fat\"\n"
        )
        .unwrap();
    }
    let scene = Scene::parse(&text, std::path::Path::new(".")).unwrap();
    SceneInput::new(scene, surfaces.to_vec())
}
