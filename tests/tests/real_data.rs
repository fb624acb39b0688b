//! Real anatomy, when there is some: set `PALPATE_DATA` to a folder with `leg_bp3d` in it (closed
//! surfaces of a leg in millimetres: `thigh_skin.stl`, `thigh_muscle.stl`, `thigh_femur.stl`).
//! Without it these tests pass and say that they did nothing.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod table;

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::Command;

use table::executable;

fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("PALPATE_DATA").map(PathBuf::from);
    if folder.is_none() {
        println!("PALPATE_DATA is not set: nothing was tested");
    }
    folder.map(|f| f.join("leg_bp3d"))
}

fn build(regions: &[(&str, &str, PathBuf)], pinned: &str, spacing_mm: f64) -> serde_json::Value {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = format!(
        "format = \"palpate-scene/1\"\nspacing_mm = {spacing_mm}\npinned = [\"{pinned}\"]\n"
    );
    for (name, material, surface) in regions {
        write!(
            scene,
            "[[region]]\nname = \"{name}\"\nsurface = \"{}\"\nmaterial = \"{material}\"\n",
            surface.display()
        )
        .unwrap();
    }
    let file = dir.path().join("scene.toml");
    std::fs::write(&file, scene).unwrap();
    let out = Command::new(executable())
        .args(["server", "build", "--json"])
        .arg(&file)
        .arg("-o")
        .arg(dir.path().join("model.palp"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{said}");
    serde_json::from_slice(&out.stdout).unwrap()
}

fn assert_faithful(report: &serde_json::Value) {
    assert_eq!(report["outer_surface"]["closed"], true, "{report}");
    assert_eq!(report["outer_surface"]["components"], 1, "{report}");
    for region in report["regions"].as_array().unwrap() {
        let volume = region["volume_mm3"].as_f64().unwrap();
        let input = region["input_volume_mm3"].as_f64().unwrap();
        let error = 100.0 * (volume / input - 1.0);
        println!("{}: {error:+.2} %", region["name"]);
        assert!(error.abs() <= 2.0, "{region}");
    }
}

#[test]
fn a_real_thigh_keeps_its_volumes_and_closes() {
    let Some(folder) = data() else { return };
    let surface = |part: &str| folder.join(format!("thigh_{part}.stl"));
    let regions = [
        ("subcutaneous", "fat", surface("skin")),
        ("muscle", "muscle", surface("muscle")),
        ("femur", "bone", surface("femur")),
    ];
    assert_faithful(&build(&regions, "femur", 4.0));
}

#[test]
fn a_real_shank_keeps_its_volumes_and_closes() {
    let Some(folder) = data() else { return };
    let surface = |part: &str| folder.join(format!("shank_{part}.stl"));
    let regions = [
        ("subcutaneous", "fat", surface("skin")),
        ("muscle", "muscle", surface("muscle")),
        ("tibia", "bone", surface("tibia")),
    ];
    assert_faithful(&build(&regions, "tibia", 3.0));
}
