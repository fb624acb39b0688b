//! Decoders of files.

use std::io::Write;
use std::path::Path;

use palpate_anatomy::{LabelVolume, Scene, Surface, Unit};
use palpate_device::Script;
use palpate_device::backend::replay::Motion;
use palpate_tissue::file::ModelFile;
use palpate_tissue::{Material, block};

use super::{Decoder, decoders, text};
use crate::experiments::recipe::Recipe;
use crate::network::{Profile, Trace};

macro_rules! examples {
    ($($file:literal),*) => {
        vec![$(include_bytes!(concat!("examples/", $file)).to_vec()),*]
    };
}

pub(super) const ALL: &[Decoder] = decoders! {
    "model", of_packed, read_model, vec![small_model().encode()];
    "model-content", of_content, read_content, vec![small_model().content()];
    "surface-stl", of_text, |b| read_surface("stl", b), examples!["ascii.stl", "binary.stl"];
    "surface-obj", of_text, |b| read_surface("obj", b), examples!["surface.obj"];
    "surface-ply", of_text, |b| read_surface("ply", b), examples!["surface.ply"];
    "labels-nifti", of_text, |b| read_labels("nii", b), examples!["labels.nii"];
    "labels-nrrd", of_packed, |b| read_labels("nrrd", b), examples!["labels.nrrd"];
    "scene", of_text, read_scene, examples!["scene.toml"];
    "script", of_text, read_script, examples!["script.toml"];
    "motion-table", of_text, read_table, examples!["motion.csv", "hand.csv"];
    "motion-recording", of_text, read_recording, examples!["recording.json"];
    "profile", of_text, read_profile, examples!["lan.toml", "transatlantic.toml", "steps.toml"];
    "trace", of_text, read_trace, examples!["trace.csv"];
    "recipe", of_text, |b| text(b, |recipe| Recipe::parse(recipe).is_ok()), examples!["recipe.toml"];
};

/// Memory per byte of a text: number tables take several times their text size.
const TEXT_SHARE: usize = 128;

/// Additional memory of a reader, bytes.
const BESIDES: usize = 8 << 20;

/// Memory per compressed byte: maximum zlib ratio, times several copies of each number.
const UNPACKED_SHARE: usize = 8 * 1032;

const fn of_text(len: usize) -> usize {
    BESIDES + TEXT_SHARE * len
}

/// Memory per byte of a model: a cell has about forty bytes in the file, and one to two hundred in memory with
/// its connectivity.
const CONTENT_SHARE: usize = 64;

const fn of_content(len: usize) -> usize {
    BESIDES + CONTENT_SHARE * len
}

const fn of_packed(len: usize) -> usize {
    BESIDES + UNPACKED_SHARE * len
}

fn read_model(bytes: &[u8]) -> bool {
    let Ok(file) = ModelFile::decode(bytes) else {
        return false;
    };
    let again = ModelFile::decode(&file.encode());
    assert_eq!(again.expect("what was written can be read"), file);
    true
}

/// The content of a model file without its envelope, so that the checksum does not stop a fuzzer.
fn read_content(bytes: &[u8]) -> bool {
    let Ok(file) = ModelFile::from_content(bytes) else {
        return false;
    };
    let again = ModelFile::from_content(&file.content());
    assert_eq!(again.expect("what was written can be read"), file);
    true
}

fn small_model() -> ModelFile {
    let soft = Material {
        name: "soft".into(),
        young_pa: 1e4,
        density_kg_m3: 1000.0,
        source: "an example".into(),
        ..Material::default()
    };
    ModelFile {
        model: block([3, 2, 2], 0.01, &soft, 1),
        report_json: "{}".to_owned(),
    }
}

fn read_scene(bytes: &[u8]) -> bool {
    let folder = Path::new("nowhere");
    text(bytes, |scene| Scene::parse(scene, folder).is_ok())
}

fn read_script(bytes: &[u8]) -> bool {
    text(bytes, |script| {
        let Ok(script) = Script::from_toml(script) else {
            return false;
        };
        Script::from_toml(&script.to_toml()).expect("what was written can be read");
        true
    })
}

fn read_profile(bytes: &[u8]) -> bool {
    text(bytes, |profile| {
        let path = Path::new("any.toml");
        let Ok(profile) = Profile::from_toml(profile, path) else {
            return false;
        };
        let again = Profile::from_toml(&profile.to_toml(), path);
        assert_eq!(again.expect("what was written can be read"), profile);
        true
    })
}

fn read_trace(bytes: &[u8]) -> bool {
    with_file("csv", bytes, |path| {
        let Ok(trace) = Trace::read(path, Path::new("")) else {
            return false;
        };
        for at_us in [0, 1, 1_000_000, u64::MAX / 2] {
            let _ = trace.at(at_us);
        }
        true
    })
}

fn read_table(bytes: &[u8]) -> bool {
    text(bytes, |table| {
        Motion::from_table(table).inspect(look_at).is_ok()
    })
}

fn read_recording(bytes: &[u8]) -> bool {
    text(bytes, |json| {
        Motion::from_recording(json).inspect(look_at).is_ok()
    })
}

fn look_at(motion: &Motion) {
    let mut near = 0;
    for k in 0..8 {
        let (moment, velocity, spin) = motion.at(motion.length_s() * f64::from(k) / 7.0, &mut near);
        assert!(moment.pose.is_finite(), "{moment:?}");
        assert!(velocity.iter().chain(spin.iter()).all(|x| x.is_finite()));
    }
}

/// Writes the bytes to a temporary file for readers of files.
fn with_file(extension: &str, bytes: &[u8], read: impl FnOnce(&Path) -> bool) -> bool {
    let file = tempfile::Builder::new()
        .suffix(&format!(".{extension}"))
        .tempfile();
    // A full disk is not an error of the reader.
    let Ok(mut file) = file else { return false };
    file.write_all(bytes).is_ok() && read(file.path())
}

fn read_surface(extension: &str, bytes: &[u8]) -> bool {
    with_file(extension, bytes, |path| {
        Surface::read(path, Unit::Millimetre).is_ok()
    })
}

fn read_labels(extension: &str, bytes: &[u8]) -> bool {
    with_file(extension, bytes, |path| {
        let Ok(volume) = LabelVolume::read(path) else {
            return false;
        };
        assert_eq!(volume.labels.len(), volume.size.iter().product::<usize>());
        true
    })
}
