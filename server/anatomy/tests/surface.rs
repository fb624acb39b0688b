//! Surfaces: accepted, repaired and rejected input, with the text of each error.

#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use palpate_anatomy::{CheckReport, InputError, Surface, Unit};
use palpate_tissue::Vec3;
use proptest::prelude::*;

/// A box from `low` to `high` in mm, outward.
fn cuboid(low: [f64; 3], high: [f64; 3]) -> Surface {
    let vertices = (0..8)
        .map(|i| {
            let pick = |k: usize| if i >> k & 1 == 1 { high[k] } else { low[k] };
            Vec3::new(pick(0), pick(1), pick(2)) * 1e-3
        })
        .collect();
    let quads: [[u32; 4]; 6] = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let triangles = quads
        .iter()
        .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
        .collect();
    Surface {
        vertices,
        triangles,
    }
}

fn cube() -> Surface {
    cuboid([0.0; 3], [20.0; 3])
}

/// Both in one surface, without shared vertices.
fn together(a: Surface, b: &Surface) -> Surface {
    let mut both = a;
    let n = both.vertices.len() as u32;
    both.vertices.extend(&b.vertices);
    both.triangles
        .extend(b.triangles.iter().map(|t| t.map(|v| v + n)));
    both
}

fn turned(mut surface: Surface) -> Surface {
    surface.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    surface
}

fn ascii_stl(surface: &Surface, newline: &str) -> String {
    let mut out = format!("solid a name{newline}");
    for t in 0..surface.triangles.len() {
        write!(out, " facet normal nan 0 0{newline}  outer loop{newline}").unwrap();
        for p in surface.corners(t) {
            write!(
                out,
                "   vertex {} {:e} {}{newline}",
                p.x * 1e3,
                p.y * 1e3,
                p.z * 1e3
            )
            .unwrap();
        }
        write!(out, "  endloop{newline} endfacet{newline}").unwrap();
    }
    write!(out, "endsolid a name{newline}").unwrap();
    out
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }
    fn file(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }
    fn read(&self, name: &str, bytes: impl AsRef<[u8]>) -> Result<Surface, InputError> {
        Surface::read(&self.file(name, bytes), Unit::Millimetre)
    }
}

fn binary_stl(surface: &Surface) -> Vec<u8> {
    let folder = Folder::new();
    let path = folder.0.path().join("x.stl");
    surface.write_stl(&path).unwrap();
    std::fs::read(path).unwrap()
}

fn accepted(mut surface: Surface) -> CheckReport {
    let report = surface.check().unwrap();
    assert!(report.volume_m3 > 0.0);
    let again = surface.clone().check().unwrap();
    assert_eq!(
        again.components_turned + again.winding_repaired,
        0,
        "a second check turns nothing"
    );
    report
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-6 * b.abs()
}

#[test]
fn written_surface_reads_back_the_same() {
    let folder = Folder::new();
    let surface = folder.read("cube.stl", binary_stl(&cube())).unwrap();
    assert_eq!(surface.vertices.len(), 8, "corners are welded");
    let report = accepted(surface);
    assert!(near(report.volume_m3, 8e-6) && near(report.area_m2, 24e-4));
    assert!(near(report.aabb.extent().x, 0.02));
    assert_eq!((report.components, report.warnings), (1, vec![]));
}

#[test]
fn unit_scales_coordinates() {
    let folder = Folder::new();
    let path = folder.file("cube.stl", binary_stl(&cube()));
    let surface = Surface::read(&path, Unit::Metre).unwrap();
    assert!(near(surface.aabb().unwrap().extent().y, 20.0));
}

#[test]
fn binary_stl_with_solid_header_is_read_as_binary() {
    let folder = Folder::new();
    let mut bytes = binary_stl(&cube());
    bytes[..16].copy_from_slice(b"solid by someone");
    assert_eq!(folder.read("cube.stl", &bytes).unwrap().triangles.len(), 12);
    bytes.extend(b"\n\n");
    bytes[..5].copy_from_slice(b"hello");
    assert_eq!(
        folder.read("cube.stl", &bytes).unwrap().triangles.len(),
        12,
        "trailing bytes"
    );
}

#[test]
fn ascii_stl_accepts_any_line_ending_case_and_solid_count() {
    let folder = Folder::new();
    let unix = ascii_stl(&cube(), "\n");
    let nameless = unix.replace(" a name", "");
    let two = unix.clone() + &ascii_stl(&cuboid([40.0; 3], [60.0; 3]), "\n");
    let cases = [
        (unix.clone(), 12),
        (ascii_stl(&cube(), "\r\n"), 12),
        (unix.to_uppercase(), 12),
        (nameless, 12),
        (two, 24),
    ];
    for (text, triangles) in cases {
        let surface = folder.read("cube.stl", text).unwrap();
        assert_eq!(surface.triangles.len(), triangles);
        accepted(surface);
    }
}

#[test]
fn minus_zero_equals_zero() {
    let folder = Folder::new();
    let text = ascii_stl(&cube(), "\n").replacen("vertex 0 0e0 0\n", "vertex -0 -0e0 -0\n", 1);
    assert_eq!(folder.read("cube.stl", text).unwrap().vertices.len(), 8);
}

#[test]
fn obj_accepts_polygons_objects_and_negative_indices() {
    let folder = Folder::new();
    let mut text = "# a cube\nmtllib none.mtl\no first\nusemtl skin\n".to_owned();
    for p in &cube().vertices {
        writeln!(text, "v {} {} {} 1.0", p.x * 1e3, p.y * 1e3, p.z * 1e3).unwrap();
    }
    text += "vt 0 0\nvn 0 0 1\nf 1/1/1 3/1/1 4/1/1 2/1/1\nf 5//1 6//1 8//1 7//1\no second\n\
             f 1 2 6 5\nf 3 7 8 4\nf 1 5 \\\n 7 3\nf -7 -5 -1 -3\n";
    let surface = folder.read("cube.OBJ", text).unwrap();
    assert_eq!((surface.vertices.len(), surface.triangles.len()), (8, 12));
    assert!(near(accepted(surface).volume_m3, 8e-6));
}

#[test]
fn invalid_surface_error_names_the_file() {
    let folder = Folder::new();
    let truncated = &binary_stl(&cube())[..400];
    let ascii = ascii_stl(&cube(), "\n");
    let cases: [(&str, Vec<u8>, &str); 10] = [
        ("empty.stl", vec![], "the file is empty"),
        (
            "text.stl",
            b"Dear reader, this is a letter.".to_vec(),
            "not an STL",
        ),
        (
            "noise.stl",
            (0..5000_u32).map(|i| (i * i % 251) as u8).collect(),
            "not an STL",
        ),
        ("short.stl", truncated.to_vec(), "declares 12 triangles"),
        ("cut.stl", ascii.as_bytes()[..700].to_vec(), "triangle "),
        (
            "word.stl",
            ascii
                .replacen("1e1", "abc", 1)
                .replacen("2e1", "abc", 1)
                .into(),
            "triangle 1: invalid float",
        ),
        ("scan.ply", b"ply".to_vec(), ".ply"),
        (
            "none.obj",
            b"o nothing\n".to_vec(),
            "neither vertices nor faces",
        ),
        (
            "bad.obj",
            b"v 0 0 0\nv 1 x 0\n".to_vec(),
            "line 2: y of a vertex is \"x\"",
        ),
        ("far.obj", b"v 0 0 0\nf 1 2 9\n".to_vec(), "vertex 2 of 1"),
    ];
    for (name, bytes, words) in cases {
        let message = folder.read(name, bytes).unwrap_err().to_string();
        assert!(
            message.contains(name) && message.contains(words),
            "{message}"
        );
    }
    let missing = Surface::read(Path::new("nowhere/thigh.stl"), Unit::Millimetre).unwrap_err();
    assert!(
        missing.to_string().contains("nowhere/thigh.stl"),
        "{missing}"
    );
    assert!(Surface::read(folder.0.path(), Unit::Millimetre).is_err());
}

#[test]
fn empty_flat_and_broken_surfaces_are_rejected() {
    let mut stray = cube();
    stray.triangles[3][1] = 99;
    let mut nan = cube();
    nan.vertices[5].y = f64::NAN;
    for (mut surface, why) in [
        (Surface::default(), "the surface is empty"),
        (
            cuboid([0.0; 3], [0.0, 0.0, 20.0]),
            "all 12 triangles have zero area",
        ),
        (
            cuboid([0.0; 3], [0.0, 20.0, 20.0]),
            "the surface encloses no volume",
        ),
        (stray, "triangle 3 names vertex 99 of 8"),
        (nan, "1 vertices have a coordinate that is infinite"),
    ] {
        let message = surface.check().unwrap_err().to_string();
        assert!(message.starts_with(why), "{message}");
    }
}

#[test]
fn hole_error_gives_edges_loops_and_position() {
    let mut open = cube();
    open.triangles.drain(2..4); // the top
    let message = open.check().unwrap_err().to_string();
    for words in [
        "4 boundary edges",
        "1 hole",
        "20.000 x 20.000 x 0.000 mm",
        "(10.0, 10.0, 20.0) mm",
    ] {
        assert!(message.contains(words), "{message}");
    }
    let mut two = cube();
    two.triangles.drain(2..4);
    two.triangles.remove(0); // half of the bottom
    let message = two.check().unwrap_err().to_string();
    assert!(message.contains("7 boundary edges in 2 holes"), "{message}");
}

#[test]
fn repairs_are_named_with_their_place() {
    let far = cuboid([100.0; 3], [110.0; 3]);
    let mut doubled = cube();
    doubled.triangles.push(doubled.triangles[2]); // a triangle of the top, from (0, 0) to (20, 20)
    let mut degenerate = cube();
    degenerate.triangles.push([7, 7, 7]);
    let mut wound = cube();
    wound.triangles[2].swap(0, 1);
    for (surface, what, place) in [
        (turned(cube()), "1 components were inside out", "at ("),
        (
            together(cube(), &turned(far)),
            "1 components were inside out",
            "at (10",
        ),
        (doubled, "1 duplicate triangles", "20.0) mm"),
        (degenerate, "1 degenerate", "(20.0, 20.0, 20.0) mm"),
        (wound, "1 triangles were wound against", "20.0) mm"),
        (
            touching_cubes(),
            "1 edges join four or more",
            "(20.0, 20.0, 10.0) mm",
        ),
    ] {
        let warnings = accepted(surface).warnings;
        assert!(
            warnings[0].starts_with(what) && warnings[0].contains(place),
            "{warnings:?}"
        );
    }
}

#[test]
fn edge_of_three_triangles_and_strip_of_one_side_are_rejected_with_their_place() {
    // A fin on an edge of the cube.
    let mut fin = cube();
    fin.vertices.push(Vec3::new(0.03, 0.03, 0.01));
    fin.triangles.push([3, 7, 8]);
    let message = fin.check().unwrap_err().to_string();
    assert!(
        message.contains("1 more edges join three") && message.contains("centred at (25.0, 25.0,"),
        "{message}"
    );
    // A Moebius strip of twelve quads around the z axis.
    let n = 12_u32;
    let mut strip = Surface::default();
    for i in 0..n {
        let turn = std::f64::consts::TAU * f64::from(i) / f64::from(n);
        for half in [-0.5, 0.5] {
            let (out, up) = (half * (turn / 2.0).cos(), half * (turn / 2.0).sin());
            let radius = 3.0 + out;
            strip
                .vertices
                .push(Vec3::new(radius * turn.cos(), radius * turn.sin(), up) * 0.01);
        }
        let [a, b] = [2 * i, 2 * i + 1];
        let [c, d] = if i + 1 == n { [1, 0] } else { [a + 2, b + 2] };
        strip.triangles.extend([[a, b, c], [b, d, c]]);
    }
    let message = strip.check().unwrap_err().to_string();
    assert!(
        message.contains("24 boundary edges in 1 hole") && message.contains("centred at ("),
        "{message}"
    );
}

#[test]
fn winding_is_repaired_and_inverted_surface_is_turned() {
    let mut mixed = cube();
    for t in [1, 4, 7] {
        mixed.triangles[t].swap(0, 1);
    }
    let report = accepted(mixed);
    assert_eq!((report.winding_repaired, report.components_turned), (3, 0));
    let report = accepted(turned(cube()));
    assert_eq!((report.winding_repaired, report.components_turned), (0, 1));
    assert!(near(report.volume_m3, 8e-6));
    assert!(report.warnings[0].contains("inside out"));
}

#[test]
fn cavities_stay_cavities_in_an_inverted_surface() {
    let shell = together(cube(), &turned(cuboid([5.0; 3], [15.0; 3])));
    for surface in [shell.clone(), turned(shell)] {
        let report = accepted(surface);
        assert_eq!((report.components, report.cavities), (2, 1));
        assert!(near(report.volume_m3, 7e-6));
    }
    let nested = accepted(together(cube(), &cuboid([5.0; 3], [15.0; 3])));
    assert!(
        nested.warnings.iter().any(|w| w.contains("inside another")),
        "{:?}",
        nested.warnings
    );
}

#[test]
fn separate_parts_are_counted_and_turned_independently() {
    let far = cuboid([100.0; 3], [110.0; 3]);
    let report = accepted(together(cube(), &turned(far)));
    assert_eq!((report.components, report.components_turned), (2, 1));
    assert!(near(report.volume_m3, 9e-6));
}

/// Two cubes that share the vertical edge at x = y = 20 mm.
fn touching_cubes() -> Surface {
    let mut touching = together(cube(), &cuboid([20.0, 20.0, 0.0], [40.0, 40.0, 20.0]));
    for v in touching.triangles[12..].iter_mut().flatten() {
        *v = match *v {
            8 => 3,
            12 => 7,
            other => other,
        };
    }
    touching
}

#[test]
fn parts_touching_along_an_edge_are_accepted() {
    let report = accepted(touching_cubes());
    assert_eq!((report.non_manifold_edges, report.components), (1, 2));
    assert!(near(report.volume_m3, 16e-6));
}

#[test]
fn duplicates_and_degenerate_triangles_are_dropped() {
    let mut surface = cube();
    let t = surface.triangles[0];
    surface.triangles.push([t[1], t[2], t[0]]); // once more
    surface.triangles.extend([[0, 3, 7], [0, 7, 3]]); // a fold without thickness
    surface.triangles.push([4, 4, 5]);
    let report = accepted(surface);
    assert_eq!(
        (report.duplicates_dropped, report.degenerate_dropped),
        (3, 1)
    );
    assert!(near(report.volume_m3, 8e-6));
}

#[test]
fn needle_triangle_that_closes_a_seam_is_kept() {
    // The edge 0-1 gets a vertex in its middle on one side only; a triangle without area closes
    // the seam.
    let mut surface = cube();
    surface.vertices.push(Vec3::new(0.01, 0.0, 0.0));
    let t = surface
        .triangles
        .iter()
        .position(|t| t == &[0, 1, 5])
        .unwrap();
    surface.triangles[t] = [0, 8, 5];
    surface.triangles.extend([[8, 1, 5], [0, 1, 8]]);
    let report = accepted(surface);
    assert_eq!(report.needles_kept, 1);
    assert!(near(report.volume_m3, 8e-6));
}

#[test]
fn likely_wrong_unit_gives_a_warning() {
    for (scale, word) in [(1e-3, "metres"), (1e3, "millimetres")] {
        let mut surface = cube();
        surface.vertices.iter_mut().for_each(|p| *p *= scale);
        let report = accepted(surface);
        assert!(
            report.warnings.iter().any(|w| w.contains(word)),
            "{:?}",
            report.warnings
        );
    }
}

#[test]
fn one_sided_surface_is_rejected() {
    // A Klein bottle on a 6 x 6 grid: around j the strip closes, around i it closes mirrored.
    let n = 6_u32;
    let vertex = |i: u32, j: u32| {
        if i < n {
            i * n + j % n
        } else {
            (n - j % n) % n
        }
    };
    let mut surface = Surface::default();
    for i in 0..n {
        for j in 0..n {
            let (x, y) = (f64::from(i), f64::from(j));
            surface
                .vertices
                .push(Vec3::new(x, y, x * y * 0.3 + (x - y).sin()) * 0.01);
            let [a, b, c, d] = [
                vertex(i, j),
                vertex(i + 1, j),
                vertex(i + 1, j + 1),
                vertex(i, j + 1),
            ];
            surface.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    let message = surface.check().unwrap_err().to_string();
    assert!(message.contains("one-sided"), "{message}");
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(64) })]

    /// The check finds the same outward surface for any set of inverted triangles.
    #[test]
    fn repaired_winding_is_independent_of_the_damage(flips in proptest::collection::vec(any::<bool>(), 12)) {
        let mut surface = cube();
        for (t, flip) in surface.triangles.iter_mut().zip(&flips) {
            if *flip {
                t.swap(1, 2);
            }
        }
        surface.check().unwrap();
        prop_assert!(near(surface.volume(), 8e-6));
    }

    /// No bytes cause a panic in the reader or the check.
    #[test]
    fn noise_never_panics(
        noise in proptest::collection::vec(any::<u8>(), 0..600),
        at in 0_usize..2000,
        kind in 0..4,
    ) {
        let folder = Folder::new();
        let mut bytes = match kind {
            0 => Vec::new(),
            1 => binary_stl(&cube()),
            2 => ascii_stl(&cube(), "\n").into_bytes(),
            _ => b"v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n".to_vec(),
        };
        let at = at.min(bytes.len());
        let end = (at + noise.len() / 20).min(bytes.len());
        bytes.splice(at..end, noise.iter().copied().take(if kind == 0 { 600 } else { 8 }));
        let name = if kind == 3 { "noise.obj" } else { "noise.stl" };
        if let Ok(mut surface) = folder.read(name, &bytes) {
            let _ = surface.check();
        }
    }
}

/// Real surfaces, when `PALPATE_DATA` names the folder that holds them.
#[test]
fn real_anatomy_is_accepted() {
    let Some(data) = std::env::var_os("PALPATE_DATA") else {
        eprintln!("PALPATE_DATA is not set: skipped");
        return;
    };
    // A relative path is relative to the root of the repository.
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut surfaces = 0;
    for folder in std::fs::read_dir(root.join(data))
        .unwrap()
        .map(|e| e.unwrap().path())
    {
        for path in std::fs::read_dir(&folder)
            .into_iter()
            .flatten()
            .map(|e| e.unwrap().path())
        {
            if path.extension().is_none_or(|e| e != "stl") {
                continue;
            }
            let mut surface = Surface::read(&path, Unit::Millimetre).unwrap();
            let report = surface
                .check()
                .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            eprintln!(
                "{}: {} triangles, {} components, {} cavities, {:.3} cm3, {:?}",
                path.display(),
                surface.triangles.len(),
                report.components,
                report.cavities,
                report.volume_m3 * 1e6,
                report.warnings
            );
            surfaces += 1;
        }
    }
    assert!(surfaces > 0, "no .stl under PALPATE_DATA");
}
