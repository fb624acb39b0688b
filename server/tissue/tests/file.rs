//! The model file keeps every bit, and damaged files are rejected.

#![allow(clippy::unwrap_used)]

use std::io::{Read, Write};
use std::sync::Arc;

use palpate_tissue::file::MODEL_FORMAT;
use palpate_tissue::file::ModelFile;
use palpate_tissue::{FibreAxis, Material, Model, Topology, Vec3, block};
use proptest::prelude::*;

fn rubber() -> Material {
    Material {
        name: "rubber".into(),
        young_pa: 1e5,
        density_kg_m3: 1100.0,
        friction_static: 0.5,
        friction_dynamic: 0.4,
        toughness_j_m2: 700.0,
        fibre_ratio: 2.5,
        fibre_axis: FibreAxis::Given([1.0, 2.0, -2.0]),
        stiffening: 4.0,
        poisson: 0.3,
        compress_limit: 0.4,
        stretch_limit: 2.0,
        bottoms_out: false,
        source: "made up for this test".into(),
    }
}

/// A block with full-precision nodes, whose lattice does not begin at zero.
fn crooked() -> Model {
    let mut model = block([7, 5, 4], 0.004, &rubber(), 1);
    for (i, p) in model.nodes.iter_mut().enumerate() {
        let t = i as f64;
        *p += Vec3::new(t.sin(), (1.7 * t).cos(), (0.3 * t).sin()) * 3e-4 + Vec3::repeat(0.123);
    }
    model.gravity = [0.1, -9.81, 2.5];
    for l in &mut model.lattice {
        *l = [l[0] - 40, l[1] + 3, l[2]];
    }
    model
}

fn file() -> ModelFile {
    ModelFile {
        model: crooked(),
        report_json: "{\"seconds\": 1.5}".into(),
    }
}

#[test]
fn model_round_trip_keeps_every_bit() {
    let file = file();
    let back = ModelFile::decode(&file.encode()).unwrap();
    assert_eq!(back, file);
    for (a, b) in back.model.nodes.iter().zip(&file.model.nodes) {
        assert_eq!(a.map(f64::to_bits), b.map(f64::to_bits));
    }
}

#[test]
fn same_model_gives_same_bytes() {
    assert_eq!(file().encode(), file().encode());
}

#[test]
fn disk_round_trip_leaves_no_temporary_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.palp");
    file().write(&path).unwrap();
    file().write(&path).unwrap();
    assert_eq!(ModelFile::read(&path).unwrap(), file());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn missing_folder_is_named() {
    let error = file().write("/nowhere/at/all/m.palp".as_ref()).unwrap_err();
    assert!(error.to_string().contains("/nowhere/at/all/m.palp"));
    let error = ModelFile::read("/nowhere/m.palp".as_ref()).unwrap_err();
    assert!(error.to_string().contains("/nowhere/m.palp"));
}

#[test]
fn each_kind_of_damage_has_its_own_error() {
    let good = file().encode();
    let text = |bytes: &[u8]| ModelFile::decode(bytes).unwrap_err().to_string();
    assert!(text(b"solid thigh").contains("wrong file type"));
    assert!(text(b"").contains("wrong file type"));
    let mut newer = good.clone();
    for (found, word) in [(1, "older"), (9, "newer")] {
        newer[8] = found;
        let expected = format!("version {found}, {word} than version {MODEL_FORMAT}");
        assert!(text(&newer).contains(&expected), "{}", text(&newer));
    }
    for short in [&good[..good.len() - 1], &good[..20]] {
        let expected = format!("{} bytes instead of", short.len());
        assert!(text(short).contains(&expected), "{}", text(short));
    }
    let mut flipped = good.clone();
    *flipped.last_mut().unwrap() ^= 1;
    assert!(text(&flipped).contains("checksum mismatch"));
}

#[test]
fn flipped_bytes_and_truncations_are_rejected() {
    let good = file().encode();
    for at in 0..good.len() {
        let mut bad = good.clone();
        bad[at] ^= 0x41;
        assert!(ModelFile::decode(&bad).is_err(), "byte {at}");
        assert!(ModelFile::decode(&good[..at]).is_err(), "length {at}");
    }
}

#[test]
fn inconsistent_model_is_rejected() {
    type Harm = fn(&mut Model);
    let harms: [(&str, Harm); 11] = [
        ("fibres", |m| m.regions[0].fibre = [0.0; 3]),
        ("fibres", |m| m.regions[0].fibre = [0.0, f64::NAN, 1.0]),
        ("material", |m| m.regions[1].material.poisson = 0.5),
        ("region", |m| m.cells[3].region.0 = 7),
        ("node", |m| m.cells[3].corners[2] = 9999),
        ("there is none", |m| m.cells[3].corners = m.cells[4].corners),
        ("from the origin", |m| m.nodes[5].y = f64::NAN),
        ("spacing", |m| m.spacing_m = 0.0),
        ("material", |m| m.regions[0].material.young_pa = -1.0),
        ("lattice", |m| m.lattice[8][1] += 1),
        ("there is none", |m| m.cells[0].neighbours[0] = 1),
    ];
    for (word, harm) in harms {
        let mut file = file();
        harm(&mut file.model);
        let error = ModelFile::decode(&file.encode()).unwrap_err().to_string();
        assert!(error.contains(word), "{word}: {error}");
    }
}

/// The decompressed content of a file.
fn content(file: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut inflate = flate2::read::DeflateDecoder::new(&file[32..]);
    inflate.read_to_end(&mut out).unwrap();
    out
}

/// Other content in the same envelope, with a checksum that matches.
fn forged(file: &[u8], content: &[u8]) -> Vec<u8> {
    let head = file[..32].to_vec();
    let mut deflate = flate2::write::DeflateEncoder::new(head, flate2::Compression::none());
    deflate.write_all(content).unwrap();
    let mut bytes = deflate.finish().unwrap();
    let stored = bytes.len() as u64 - 32;
    bytes[12..20].copy_from_slice(&(content.len() as u64).to_le_bytes());
    bytes[20..28].copy_from_slice(&stored.to_le_bytes());
    let mut sum = crc32fast::Hasher::new();
    sum.update(&bytes[12..28]);
    sum.update(&bytes[32..]);
    bytes[28..32].copy_from_slice(&sum.finalize().to_le_bytes());
    bytes
}

#[test]
fn flipped_bytes_with_forged_checksum_give_an_error_or_a_valid_model() {
    let good = ModelFile {
        model: block([3, 2, 2], 0.004, &rubber(), 1),
        report_json: "{}".into(),
    };
    let good = good.encode();
    let content = content(&good);
    assert!(ModelFile::decode(&forged(&good, &content)).is_ok());
    let mut accepted = 0;
    for at in 0..content.len() {
        for flip in [0x01, 0x80, 0xff] {
            let mut bad = content.clone();
            bad[at] ^= flip;
            // A forged checksum may give another model, but never an invalid one.
            if let Ok(file) = ModelFile::decode(&forged(&good, &bad)) {
                accepted += 1;
                let topology = Topology::new(Arc::new(file.model.clone()));
                assert_eq!(topology.node_count(), file.model.nodes.len());
                let again = ModelFile::decode(&file.encode()).unwrap();
                assert_eq!(again, file, "byte {at}");
            }
        }
    }
    assert!(accepted > 0 && accepted < 3 * content.len());
}

proptest! {
    /// A forged envelope causes at most an error.
    #[test]
    fn noise_after_a_valid_header_is_an_error(noise in proptest::collection::vec(any::<u8>(), 0..200)) {
        let mut bytes = file().encode();
        bytes.truncate(32);
        bytes.extend(&noise);
        bytes[20..28].copy_from_slice(&(noise.len() as u64).to_le_bytes());
        let mut sum = crc32fast::Hasher::new();
        sum.update(&bytes[12..28]);
        sum.update(&noise);
        bytes[28..32].copy_from_slice(&sum.finalize().to_le_bytes());
        prop_assert!(ModelFile::decode(&bytes).is_err());
    }
}
