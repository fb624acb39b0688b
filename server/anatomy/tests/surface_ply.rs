//! PLY surfaces: every encoding gives the same body, and errors name the position.

#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;

use palpate_anatomy::{InputError, Surface, Unit};
use proptest::prelude::*;

const QUADS: [[i32; 4]; 6] = [
    [0, 2, 3, 1],
    [4, 5, 7, 6],
    [0, 1, 5, 4],
    [2, 6, 7, 3],
    [0, 4, 6, 2],
    [1, 3, 7, 5],
];

fn corner(c: usize) -> [f32; 3] {
    [0, 1, 2].map(|a| if c >> a & 1 == 1 { 20.0 } else { 0.0 })
}

fn header(format: &str) -> String {
    format!(
        "ply\nformat {format} 1.0\ncomment a cube of 20 mm\nelement vertex 8\nproperty float x\n\
         property float y\nproperty float z\nproperty uchar red\nelement face 6\n\
         property list uchar int vertex_indices\nend_header\n"
    )
}

fn ascii() -> String {
    let mut text = header("ascii");
    for c in 0..8 {
        let [x, y, z] = corner(c);
        writeln!(text, "{x} {y} {z} 255").unwrap();
    }
    for [a, b, c, d] in QUADS {
        writeln!(text, "4 {a} {b} {c} {d}").unwrap();
    }
    text
}

/// From little-endian bytes to those of the file's byte order.
type Order = fn([u8; 4]) -> [u8; 4];

fn binary(big: bool) -> Vec<u8> {
    let (name, order): (_, Order) = if big {
        ("binary_big_endian", |mut b| {
            b.reverse();
            b
        })
    } else {
        ("binary_little_endian", |b| b)
    };
    let mut bytes = header(name).into_bytes();
    for c in 0..8 {
        for x in corner(c) {
            bytes.extend(order(x.to_le_bytes()));
        }
        bytes.push(255);
    }
    for quad in QUADS {
        bytes.push(4);
        for v in quad {
            bytes.extend(order(v.to_le_bytes()));
        }
    }
    bytes
}

fn read(bytes: &[u8]) -> Result<Surface, InputError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ply");
    std::fs::write(&path, bytes).unwrap();
    Surface::read(&path, Unit::Millimetre)
}

#[test]
fn every_encoding_gives_the_same_body() {
    let doubles = ascii()
        .replace("float", "double")
        .replace("uchar int vertex_indices", "uint16 uint vertex_index");
    let doubles = doubles.replace("uint16", "ushort");
    let mut surfaces = Vec::new();
    let windows = ascii().replace('\n', "\r\n");
    for bytes in [
        ascii().into_bytes(),
        windows.into_bytes(),
        doubles.into_bytes(),
        binary(false),
        binary(true),
    ] {
        let mut surface = read(&bytes).unwrap();
        let report = surface.check().unwrap();
        assert!((report.volume_m3 - 8e-6).abs() < 1e-15);
        assert_eq!((surface.vertices.len(), surface.triangles.len()), (8, 12));
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
        surfaces.push(surface);
    }
    assert!(surfaces.iter().all(|s| *s == surfaces[0]));
}

#[test]
fn unknown_elements_are_skipped() {
    let text = ascii().replace(
        "element face",
        "element edge 2\nproperty int vertex1\nproperty list uchar float more\nelement face",
    );
    let first_face = text.find("4 0 2 3 1").unwrap();
    let text = format!(
        "{}7 2 0.5 0.5\n8 0\n{}",
        &text[..first_face],
        &text[first_face..]
    );
    assert!((read(text.as_bytes()).unwrap().volume() - 8e-6).abs() < 1e-15);
}

#[test]
fn ply_errors_name_the_position() {
    let mistakes: [(&str, &str, &[&str]); 11] = [
        ("ply\n", "plx\n", &["not a PLY file", ".stl"]),
        ("end_header\n", "", &["header"]),
        (
            "element vertex 8",
            "element vertex 8000000",
            &["8000000 of \"vertex\"", "bytes left"],
        ),
        ("element face 6", "element face 99999999", &["99999999"]),
        (
            "element vertex 8",
            "element nothing 4000000000\nelement vertex 8",
            &["\"nothing\""],
        ),
        ("property float z\n", "", &["x, y and z"]),
        (
            "property list uchar int vertex_indices",
            "property int v",
            &["list vertex_indices"],
        ),
        ("4 0 2 3 1", "4 0 2 3 8", &["face 1", "vertex 8 of 8"]),
        ("4 0 2 3 1", "4 0 2 3 -1", &["face 1", "vertex -1"]),
        ("4 4 5 7 6", "2 4 5", &["face 2", "2 corners"]),
        ("20 0 0 255", "20 zero 0 255", &["vertex", "line", "zero"]),
    ];
    for (from, to, words) in mistakes {
        let text = ascii().replacen(from, to, 1);
        assert_ne!(text, ascii(), "{from}");
        let message = read(text.as_bytes()).unwrap_err().to_string();
        for word in words {
            assert!(
                message.contains(word),
                "{from} -> {to}: {message} (no {word})"
            );
        }
        assert!(message.contains("a.ply"), "{message}");
    }
    let whole = binary(false);
    let message = read(&whole[..whole.len() - 3]).unwrap_err().to_string();
    assert!(
        message.contains("\"face\" 1 to 6") && message.contains("truncated"),
        "{message}"
    );
}

#[test]
fn nan_coordinate_is_rejected_by_the_check() {
    let mut surface = read(ascii().replacen("20 0 0", "nan 0 0", 1).as_bytes());
    if let Ok(surface) = &mut surface {
        assert!(surface.check().is_err());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn flipped_bits_and_cuts_never_panic(
        which in 0_usize..3,
        flips in prop::collection::vec((any::<prop::sample::Index>(), 0_u8..8), 0..8),
        cut in prop::option::of(any::<prop::sample::Index>()),
    ) {
        let mut bytes = match which {
            0 => ascii().into_bytes(),
            w => binary(w == 1),
        };
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        if let Some(at) = cut {
            bytes.truncate(at.index(bytes.len()));
        }
        if let Ok(mut surface) = read(&bytes) {
            let _ = surface.check();
        }
    }
}
