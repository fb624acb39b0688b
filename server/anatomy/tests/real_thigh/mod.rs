//! A real thigh at 4 mm: skin, muscle and a pinned femur.

// Each test file uses a part of it.
#![allow(clippy::unwrap_used, dead_code)]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use palpate_anatomy::SceneInput;

/// The folder of its surfaces in `PALPATE_DATA`; `None` without that variable.
pub(crate) fn folder() -> Option<PathBuf> {
    let Some(data) = std::env::var_os("PALPATE_DATA") else {
        eprintln!("PALPATE_DATA is not set: skipped");
        return None;
    };
    Some(std::fs::canonicalize(Path::new(&data).join("leg_bp3d")).unwrap())
}

pub(crate) fn scene(folder: &Path) -> SceneInput {
    let mut scene =
        "format = \"palpate-scene/1\"\nspacing_mm = 4.0\npinned = [\"femur\"]\n".to_owned();
    for (name, part, material) in [
        ("subcutaneous", "skin", "fat"),
        ("muscle", "muscle", "muscle"),
        ("femur", "femur", "bone"),
    ] {
        let surface = folder.join(format!("thigh_{part}.stl"));
        let surface = surface.display();
        writeln!(
            scene,
            "[[region]]\nname = \"{name}\"\nsurface = \"{surface}\"\nmaterial = \"{material}\""
        )
        .unwrap();
    }
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("thigh.toml");
    std::fs::write(&path, scene).unwrap();
    SceneInput::load(&path).unwrap()
}
