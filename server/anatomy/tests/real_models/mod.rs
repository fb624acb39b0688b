//! Models of real surfaces: a thigh at 4 mm (skin, muscle and a pinned femur), and a torso at 6 mm (skin, organs and pinned
//! bones).

// Each test file uses a part of it.
#![allow(clippy::unwrap_used, dead_code)]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use palpate_anatomy::SceneInput;

/// `PALPATE_DATA` as an absolute path; `None` without that variable.
pub(crate) fn folder() -> Option<PathBuf> {
    let Some(data) = std::env::var_os("PALPATE_DATA") else {
        eprintln!("PALPATE_DATA is not set: skipped");
        return None;
    };
    Some(std::fs::canonicalize(data).unwrap())
}

pub(crate) fn thigh(data: &Path) -> SceneInput {
    let regions = [
        ("subcutaneous", "leg_bp3d/thigh_skin", "fat"),
        ("muscle", "leg_bp3d/thigh_muscle", "muscle"),
        ("femur", "leg_bp3d/thigh_femur", "bone"),
    ];
    scene(data, 4.0, "femur", &regions)
}

pub(crate) fn torso(data: &Path) -> SceneInput {
    let regions = [
        ("trunk", "abdomen_ct/torso_skin_outer", "fat"),
        ("liver", "abdomen_ct/slab_liver", "liver"),
        ("spleen", "abdomen_ct/slab_spleen", "liver"),
        ("bones", "abdomen_ct/torso_bone", "bone"),
    ];
    scene(data, 6.0, "bones", &regions)
}

/// Regions by name, surface and material, the outermost first.
fn scene(data: &Path, spacing_mm: f64, pinned: &str, regions: &[(&str, &str, &str)]) -> SceneInput {
    let mut scene = format!(
        "format = \"palpate-scene/1\"\nspacing_mm = {spacing_mm:.1}\npinned = [\"{pinned}\"]\n"
    );
    for (name, surface, material) in regions {
        let surface = data.join(format!("{surface}.stl"));
        let surface = surface.display();
        writeln!(
            scene,
            "[[region]]\nname = \"{name}\"\nsurface = \"{surface}\"\nmaterial = \"{material}\""
        )
        .unwrap();
    }
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("scene.toml");
    std::fs::write(&path, scene).unwrap();
    SceneInput::load(&path).unwrap()
}
