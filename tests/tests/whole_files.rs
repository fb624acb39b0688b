//! A file is written completely or not at all, even on a full disk.

#![allow(clippy::unwrap_used)]

mod table;

use std::path::Path;
use std::process::{Command, Output};

use table::executable;

fn server(arguments: &[&str]) -> Output {
    let mut command = Command::new(executable());
    command.arg("server").args(arguments).output().unwrap()
}

/// A small sample's scene.
fn scene(dir: &Path) -> String {
    let folder = dir.join("in").display().to_string();
    let out = server(&["sample", "handle", "-o", &folder]);
    assert!(out.status.success());
    String::from_utf8(out.stdout).unwrap().trim().to_owned()
}

/// A disk of a few kB, emulated by a file size limit.
#[cfg(unix)]
#[test]
fn full_disk_is_reported_and_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let scene = scene(dir.path());
    let out = dir.path().join("out");
    std::fs::create_dir(&out).unwrap();
    let model = out.join("m.palp");
    std::fs::write(&model, "old").unwrap();
    let limited = "trap '' XFSZ; ulimit -f 8; exec \"$0\" server build \"$@\"";
    let done = Command::new("sh")
        .args(["-c", limited])
        .arg(executable())
        .arg(&scene)
        .arg("-o")
        .arg(&model)
        .arg("--vtu")
        .arg(out.join("m.vtu"))
        .arg("--stl")
        .arg(&out)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{said}");
    assert!(
        said.contains("can not be written") && said.contains("m.vtu"),
        "{said}"
    );
    assert!(said.contains("free disk space"), "{said}");
    let left: Vec<_> = std::fs::read_dir(&out).unwrap().collect();
    assert_eq!(left.len(), 1, "{left:?}");
    assert_eq!(std::fs::read_to_string(&model).unwrap(), "old");
}

#[test]
fn missing_folder_is_reported_before_any_write() {
    let dir = tempfile::tempdir().unwrap();
    let scene = scene(dir.path());
    let path = |name: &str| dir.path().join(name).display().to_string();
    let (model, grid) = (path("absent/m.palp"), path("m.vtu"));
    let done = server(&["build", &scene, "-o", &model, "--vtu", &grid]);
    let said = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{said}");
    assert!(
        said.contains("absent") && said.contains("make its folder first"),
        "{said}"
    );
    assert!(!Path::new(&grid).exists());
}

#[test]
fn slice_is_drawn_and_slice_outside_the_model_is_an_error() {
    let table = table::Table::new();
    let model = table.subject.file.display().to_string();
    let png = table.path("m.png");
    let picture = png.display().to_string();
    let inspect = |slice: &str| {
        let done = server(&["inspect", &model, "--png", &picture, "--slice", slice]);
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        (done.status.code(), said)
    };
    let (code, said) = inspect("z=900");
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("z = 0.0 to 40.0 mm"), "{said}");
    let (code, said) = inspect("w=3");
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("z=100"), "{said}");
    assert!(!png.exists());
    for slice in ["x=20", "y", "z=17.5"] {
        assert_eq!(inspect(slice), (Some(0), String::new()));
        assert!(std::fs::read(&png).unwrap().starts_with(b"\x89PNG"));
    }
}
