//! Decoders of files.

use std::io::Write;
use std::path::Path;

use palpate_anatomy::{LabelVolume, Scene, Surface, Unit};
use palpate_device::Script;
use palpate_device::backend::replay::Motion;
use palpate_tissue::{Material, ModelFile, block};

use super::{Decoder, text};
use crate::experiments::recipe::Recipe;
use crate::network::{Profile, Trace};

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

pub(super) const MODEL: Decoder = Decoder {
    name: "model",
    read: |bytes| {
        let Ok(file) = ModelFile::decode(bytes) else {
            return false;
        };
        let again = ModelFile::decode(&file.encode());
        assert_eq!(again.expect("what was written can be read"), file);
        true
    },
    examples: || vec![small_model().encode()],
    holds_max: of_packed,
};

/// The content of a model file without its envelope, so that the checksum does not stop a fuzzer.
pub(super) const MODEL_CONTENT: Decoder = Decoder {
    name: "model-content",
    read: |bytes| {
        let Ok(file) = ModelFile::from_content(bytes) else {
            return false;
        };
        let again = ModelFile::from_content(&file.content());
        assert_eq!(again.expect("what was written can be read"), file);
        true
    },
    examples: || vec![small_model().content()],
    holds_max: of_content,
};

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

const TETRAHEDRON: [[u8; 3]; 4] = [[1, 3, 2], [1, 2, 4], [2, 3, 4], [3, 1, 4]];

pub(super) const SURFACE_STL: Decoder = Decoder {
    name: "surface-stl",
    read: |bytes| read_surface("stl", bytes),
    examples: || {
        let mut ascii = String::from("solid t\n");
        let corner = ["0 0 0", "10 0 0", "0 10 0", "0 0 10"];
        for face in TETRAHEDRON {
            ascii.push_str("facet normal 0 0 0\nouter loop\n");
            for v in face {
                ascii.extend(["vertex ", corner[usize::from(v) - 1], "\n"]);
            }
            ascii.push_str("endloop\nendfacet\n");
        }
        ascii.push_str("endsolid t\n");
        let mut binary = vec![0; 80];
        binary.extend(4_u32.to_le_bytes());
        for face in TETRAHEDRON {
            binary.extend([0; 12]);
            for v in face {
                for axis in 2..5 {
                    let x = if v == axis { 10.0_f32 } else { 0.0 };
                    binary.extend(x.to_le_bytes());
                }
            }
            binary.extend([0; 2]);
        }
        vec![ascii.into_bytes(), binary]
    },
    holds_max: of_text,
};

pub(super) const SURFACE_OBJ: Decoder = Decoder {
    name: "surface-obj",
    read: |bytes| read_surface("obj", bytes),
    examples: || {
        let text = "v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
        vec![text.as_bytes().to_vec()]
    },
    holds_max: of_text,
};

pub(super) const SURFACE_PLY: Decoder = Decoder {
    name: "surface-ply",
    read: |bytes| read_surface("ply", bytes),
    examples: || {
        let text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
                    element face 4\nproperty list uchar int vertex_indices\nend_header\n\
                    0 0 0\n10 0 0\n0 10 0\n0 0 10\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 2 0 3\n";
        vec![text.as_bytes().to_vec()]
    },
    holds_max: of_text,
};

pub(super) const LABELS_NIFTI: Decoder = Decoder {
    name: "labels-nifti",
    read: |bytes| read_labels("nii", bytes),
    examples: || {
        let mut nii = vec![0; 352];
        nii[..4].copy_from_slice(&348_i32.to_le_bytes());
        for (at, value) in [
            (40, 3_i16),
            (42, 2),
            (44, 2),
            (46, 2),
            (48, 1),
            (70, 2),
            (72, 8),
        ] {
            nii[at..at + 2].copy_from_slice(&value.to_le_bytes());
        }
        for (at, value) in [
            (76, 1.0_f32),
            (80, 20.0),
            (84, 20.0),
            (88, 20.0),
            (108, 352.0),
            (112, 1.0),
        ] {
            nii[at..at + 4].copy_from_slice(&value.to_le_bytes());
        }
        // Units: millimetres.
        nii[123] = 2;
        // The sform (voxel to world); its rows begin at byte 280.
        nii[254] = 1;
        for at in [280, 300, 320] {
            nii[at..at + 4].copy_from_slice(&20.0_f32.to_le_bytes());
        }
        nii[344..348].copy_from_slice(b"n+1\0");
        nii.extend([0, 1, 0, 1, 2, 1, 0, 0]);
        vec![nii]
    },
    holds_max: of_text,
};

pub(super) const LABELS_NRRD: Decoder = Decoder {
    name: "labels-nrrd",
    read: |bytes| read_labels("nrrd", bytes),
    examples: || {
        let mut nrrd =
            b"NRRD0004\ntype: uint8\ndimension: 3\nspace: left-posterior-superior\nsizes: 2 2 2\n\
            space directions: (20,0,0) (0,20,0) (0,0,20)\nkinds: domain domain domain\nencoding: raw\n\
            space origin: (0,0,0)\n\n"
                .to_vec();
        nrrd.extend([0, 1, 0, 1, 2, 1, 0, 0]);
        vec![nrrd]
    },
    holds_max: of_packed,
};

pub(super) const SCENE: Decoder = Decoder {
    name: "scene",
    read: |bytes| {
        text(bytes, |scene| {
            Scene::parse(scene, Path::new("nowhere")).is_ok()
        })
    },
    examples: || {
        let scene = "format = \"palpate-scene/1\"\nspacing_mm = 4.0\npinned = [\"bone\"]\ngravity_m_s2 = [0.0, 0.0, -9.81]\n\n\
                     [[region]]\nname = \"fat\"\nsurface = \"skin.stl\"\nmaterial = \"fat\"\n[[region]]\nname = \"bone\"\n\
                     surface = \"bone.stl\"\nmaterial = \"bone\"\npoisson = 0.3\n\n[material.fat]\nyoung_kpa = 10.0\n";
        vec![scene.as_bytes().to_vec()]
    },
    holds_max: of_text,
};

pub(super) const SCRIPT: Decoder = Decoder {
    name: "script",
    read: |bytes| {
        text(bytes, |script| {
            let Ok(script) = Script::from_toml(script) else {
                return false;
            };
            Script::from_toml(&script.to_toml()).expect("what was written can be read");
            true
        })
    },
    examples: || {
        let script = "format = \"palpate-script/1\"\n\n[tool]\nkind = \"probe\"\nradius_mm = 8.0\n\n[[way]]\nt_s = 0.0\n\
                      at_mm = [0.0, 0.0, 50.0]\n\n[[way]]\nt_s = 1.0\nat_mm = [0.0, 0.0, 20.0]\nbutton = true\n";
        vec![script.as_bytes().to_vec()]
    },
    holds_max: of_text,
};

pub(super) const MOTION_TABLE: Decoder = Decoder {
    name: "motion-table",
    read: |bytes| {
        text(bytes, |table| {
            Motion::from_table(table).inspect(look_at).is_ok()
        })
    },
    examples: || {
        let table = "t_s,x_m,y_m,z_m,qw,qx,qy,qz,buttons\n0,0,0,0.1,1,0,0,0,0\n0.01,0,0,0.1,1,0,0,0,1\n0.02,0,0.001,0.1,1,0,0,0,1\n";
        let hand =
            "time_s,x_m,y_m,z_m\n0,0,0,0\n0.05,0.001,0,0\n0.1,0,0,0.002\n0.15,0,0,0\n0.2,0,0,0\n";
        [table, hand].map(|table| table.as_bytes().to_vec()).into()
    },
    holds_max: of_text,
};

pub(super) const MOTION_RECORDING: Decoder = Decoder {
    name: "motion-recording",
    read: |bytes| {
        text(bytes, |json| {
            Motion::from_recording(json).inspect(look_at).is_ok()
        })
    },
    examples: || {
        let json = "{\"script_started_us\":1000,\"haptic\":[{\"t_us\":1000,\"position_m\":[0,0,0.1],\"force_n\":[0,0,0]},\
                    {\"t_us\":5000,\"position_m\":[0,0,0.09],\"orientation\":[0,0,0,1],\"buttons\":1,\"force_n\":[0,0,1]}]}";
        vec![json.as_bytes().to_vec()]
    },
    holds_max: of_text,
};

pub(super) const PROFILE: Decoder = Decoder {
    name: "profile",
    read: |bytes| {
        text(bytes, |profile| {
            let path = Path::new("any.toml");
            let Ok(profile) = Profile::from_toml(profile, path) else {
                return false;
            };
            let again = Profile::from_toml(&profile.to_toml(), path);
            assert_eq!(again.expect("what was written can be read"), profile);
            true
        })
    },
    examples: || {
        let text = |name| {
            Profile::named(name)
                .expect("a named profile")
                .to_toml()
                .into_bytes()
        };
        ["lan", "transatlantic", "steps"].map(text).into()
    },
    holds_max: of_text,
};

pub(super) const TRACE: Decoder = Decoder {
    name: "trace",
    read: |bytes| {
        with_file("csv", bytes, |path| {
            let Ok(trace) = Trace::read(path, Path::new("")) else {
                return false;
            };
            for at_us in [0, 1, 1_000_000, u64::MAX / 2] {
                let _ = trace.at(at_us);
            }
            true
        })
    },
    examples: || {
        let table = "time_ms,delay_ms,lost\n0,40,0\n20,45.5,0\n40,,1\n60,41,0\n";
        vec![table.as_bytes().to_vec()]
    },
    holds_max: of_text,
};

pub(super) const RECIPE: Decoder = Decoder {
    name: "recipe",
    read: |bytes| text(bytes, |recipe| Recipe::parse(recipe).is_ok()),
    examples: || {
        let recipe = "experiment = \"table-7-1\"\nseed = 7\nmotion = \"hand.csv\"\n";
        vec![recipe.as_bytes().to_vec()]
    },
    holds_max: of_text,
};

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
