//! Exported files, read back by independent Python packages: meshio, trimesh and nibabel; and the comparison of models
//! with their input, repeated by these and by scipy on the real anatomy in `PALPATE_DATA`.
//!
//! `PALPATE_PYTHON` names a Python with these packages (`bash .ci/readers` creates one and prints its path;
//! `.ci/run` sets the variable). Without it these tests pass and print that they were skipped.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

fn executable() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_palpate-lab"))
}

/// Result of the reader script; `None` without Python.
fn readers(command: &str, paths: &[&Path]) -> Option<Value> {
    let paths = paths.iter().map(|p| p.display().to_string());
    let arguments: Vec<String> = std::iter::once(command.to_owned()).chain(paths).collect();
    script("check.py", &arguments)
}

/// Result of a script with these arguments; `None` without Python.
fn script(name: &str, arguments: &[String]) -> Option<Value> {
    let Some(python) = std::env::var_os("PALPATE_PYTHON") else {
        println!("PALPATE_PYTHON is not set: nothing was tested");
        return None;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("readers")
        .join(name);
    let out = Command::new(&python).arg(script).args(arguments).output();
    let out = out.unwrap_or_else(|e| panic!("PALPATE_PYTHON = {}: {e}", python.display()));
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{arguments:?}: {said}");
    Some(serde_json::from_slice(&out.stdout).unwrap())
}

/// Runs a server command with `--json` and returns its output.
fn server(arguments: &[&str]) -> Value {
    let mut command = Command::new(executable());
    let out = command.arg("server").args(arguments).output().unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{arguments:?}: {said}");
    serde_json::from_slice(&out.stdout).unwrap_or_default()
}

/// Exports a sample; returns its build report and the folder.
fn exported(sample: &str) -> (Value, tempfile::TempDir) {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).display().to_string();
    let mut command = Command::new(executable());
    command.args(["server", "sample", sample, "-o", &path("in")]);
    assert!(command.output().unwrap().status.success());
    let scene = path(&format!("in/{sample}.toml"));
    let report = server(&[
        "build",
        &scene,
        "-o",
        &path("m.palp"),
        "--vtu",
        &path("m.vtu"),
        "--stl",
        &path("stl"),
        "--json",
    ]);
    (report, dir)
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value}"))
}

fn assert_near(a: f64, b: f64, part: f64, what: &str) {
    assert!((a - b).abs() <= part * b.abs(), "{what}: {a} and {b}");
}

#[test]
fn meshio_reads_the_reported_nodes_cells_and_volumes() {
    if readers("versions", &[]).is_none() {
        return;
    }
    for sample in ["handle", "abdominal-wall"] {
        let (report, dir) = exported(sample);
        let Some(grid) = readers("vtu", &[&dir.path().join("m.vtu")]) else {
            return;
        };
        assert_eq!(grid["points"], report["nodes"], "{sample}");
        assert_eq!(grid["cells"], report["cells"], "{sample}");
        assert_eq!(grid["kinds"], serde_json::json!(["hexahedron"]));
        assert_eq!(grid["unused_points"], 0);
        assert_eq!(grid["largest_displacement_mm"], 0.0);
        let cell_data = serde_json::json!([
            "material",
            "region",
            "scaled_jacobian",
            "volume_mm3",
            "young_kpa"
        ]);
        assert_eq!(grid["cell_data"], cell_data);
        assert!(
            number(&grid["worst_volume_difference_mm3"]) < 1e-6,
            "{grid}"
        );
        let regions = report["regions"].as_array().unwrap();
        for (r, region) in regions.iter().enumerate() {
            let theirs = number(&grid["region_volumes_mm3"][r]);
            assert_near(theirs, number(&region["volume_mm3"]), 1e-9, sample);
        }
    }
}

#[test]
fn trimesh_reads_closed_surfaces_of_equal_volume() {
    if readers("versions", &[]).is_none() {
        return;
    }
    let (report, dir) = exported("handle");
    let mut files: Vec<PathBuf> = std::fs::read_dir(dir.path().join("stl"))
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    files.sort();
    let paths: Vec<&Path> = files.iter().map(PathBuf::as_path).collect();
    let Some(surfaces) = readers("stl", &paths) else {
        return;
    };
    let regions = report["regions"].as_array().unwrap();
    let mut whole = 0.0;
    for region in regions {
        let name = format!("region-{}.stl", region["name"].as_str().unwrap());
        let surface = &surfaces[&name];
        assert_eq!(surface["watertight"], true, "{name}: {surface}");
        assert_eq!(surface["wound_alike"], true, "{name}: {surface}");
        let volume = number(&region["volume_mm3"]);
        // Cell faces are curved and triangles flat; over a surface the difference nearly cancels.
        assert_near(number(&surface["volume_mm3"]), volume, 2e-3, &name);
        whole += number(&surface["volume_mm3"]);
    }
    let outer = &surfaces["outer.stl"];
    assert_eq!(outer["watertight"], true, "{outer}");
    for (name, surface) in surfaces.as_object().unwrap() {
        assert_eq!(surface["self_intersections"], 0, "{name}");
    }
    assert_eq!(outer["triangles"], report["outer_surface"]["triangles"]);
    assert_near(number(&outer["volume_mm3"]), whole, 1e-6, "outer");
    let sheet = surfaces.as_object().unwrap().keys();
    assert!(
        sheet.clone().any(|n| n.starts_with("interface-")),
        "{surfaces}"
    );
}

/// Two strokes that lean against each other and cross in the depth, where their walls intersect.
const LEANING: &str = r#"
format = "palpate-strokes/1"
[[stroke]]
points_mm = [[-28.0, 67.6, 97.2], [-14.0, 71.8, 98.6], [0.0, 73.2, 100.0], [14.0, 71.8, 101.4], [28.0, 67.6, 102.8]]
depth_mm = 25.0
direction = [0.05, -1.0, -0.5]
[[stroke]]
points_mm = [[4.1, 73.1, 72.1], [2.7, 73.1, 86.1], [1.3, 73.2, 100.0], [-0.1, 73.2, 113.9], [-1.5, 73.2, 127.9]]
depth_mm = 25.0
direction = [-0.5, -1.0, -0.05]
"#;

#[test]
fn cut_surface_is_watertight_and_has_the_reported_intersections() {
    if readers("versions", &[]).is_none() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).display().to_string();
    std::fs::write(path("leaning.toml"), LEANING).unwrap();
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/strokes.toml");
    for (strokes, intersects) in [
        (example.display().to_string(), false),
        (path("leaning.toml"), true),
    ] {
        let [model, stl] = ["m.palp", "outer.stl"].map(path);
        let report = server(&[
            "cut",
            "thigh",
            "--strokes",
            &strokes,
            "-o",
            &model,
            "--stl",
            &stl,
            "--json",
        ]);
        let Some(surfaces) = readers("stl", &[Path::new(&stl)]) else {
            return;
        };
        let (outer, figures) = (&surfaces["outer.stl"], &report["stl"]);
        assert_eq!(outer["watertight"], true, "{outer}");
        assert_eq!(outer["wound_alike"], true, "{outer}");
        assert_eq!(outer["self_intersections"], figures["self_intersections"]);
        assert_eq!(number(&figures["self_intersections"]) > 0.0, intersects);
        assert_eq!(
            figures["places_mm"].as_array().unwrap().is_empty(),
            !intersects
        );
        // 0.02 of 5 mm, and the gap between the walls of a closed wound.
        assert!(number(&figures["moved_max_mm"]) < 0.13, "{figures}");
    }
}

#[test]
fn nibabel_label_volume_builds_to_its_voxel_volumes() {
    let dir = tempfile::tempdir().unwrap();
    let volume = dir.path().join("labels.nii.gz");
    let Some(labels) = readers("make-labels", &[&volume]) else {
        return;
    };
    let mut scene =
        "format = \"palpate-scene/1\"\nspacing_mm = 4.0\nlabels = \"labels.nii.gz\"\n".to_owned();
    for (name, label) in [("box", 1), ("ball", 2)] {
        writeln!(
            scene,
            "[[region]]\nname = \"{name}\"\nlabel = {label}\nmaterial = \"fat\""
        )
        .unwrap();
    }
    let file = dir.path().join("scene.toml");
    std::fs::write(&file, scene).unwrap();
    let [file, model, grid] = [file, dir.path().join("m.palp"), dir.path().join("m.vtu")];
    let text = [&file, &model, &grid].map(|p| p.display().to_string());
    server(&[
        "build", &text[0], "-o", &text[1], "--vtu", &text[2], "--json",
    ]);
    let Some(built) = readers("vtu", &[&grid]) else {
        return;
    };
    for (r, label) in ["1", "2"].iter().enumerate() {
        let counted = number(&labels[label]["volume_mm3"]);
        let volume = number(&built["region_volumes_mm3"][r]);
        assert_near(volume, counted, 0.01, label);
    }
    for axis in 0..3 {
        // The outer box and its contents are concentric, and so is the built model.
        let [low, high] = ["low_mm", "high_mm"].map(|k| number(&built[k][axis]));
        let centre = number(&labels["2"]["centre_mm"][axis]);
        assert!((0.5 * (low + high) - centre).abs() < 2.0, "axis {axis}");
    }
}

/// Largest difference of two Dice coefficients. Reason: random lines that run along a skin of one voxel scatter by a hundredth.
const DICE: f64 = 0.015;

/// Builds regions, each with the lines of its source, and compares the report with that of independent packages.
/// Returns both.
fn compared(kind: &str, head: &str, regions: &[(&str, String, String)]) -> Option<(Value, Value)> {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).display().to_string();
    let mut scene = format!("format = \"palpate-scene/1\"\nspacing_mm = 4.0\n{head}\n");
    for (name, source, _) in regions {
        writeln!(
            scene,
            "[[region]]\nname = \"{name}\"\n{source}\nmaterial = \"fat\""
        )
        .unwrap();
    }
    std::fs::write(dir.path().join("scene.toml"), scene).unwrap();
    let [scene, model, stl] = ["scene.toml", "m.palp", "stl"].map(path);
    let report = server(&["build", &scene, "-o", &model, "--stl", &stl, "--json"]);
    let mut arguments = vec![kind.to_owned(), stl];
    if kind == "labels" {
        arguments.push(head.split('"').nth(1).unwrap().to_owned());
    }
    arguments.extend(
        regions
            .iter()
            .map(|(name, _, value)| format!("{name}={value}")),
    );
    let theirs = script("overlap.py", &arguments)?;
    for region in report["regions"].as_array().unwrap() {
        let name = region["name"].as_str().unwrap();
        let [ours, found] = [&region["dice"], &theirs[name]["dice"]].map(number);
        println!("{name}: Dice {ours:.4}, {found:.4} by independent packages");
        assert!((ours - found).abs() < DICE, "{name}: {ours} {found}");
    }
    Some((report, theirs))
}

/// The real data, if they and Python are there.
fn data() -> Option<PathBuf> {
    readers("versions", &[])?;
    let data = std::env::var_os("PALPATE_DATA").map(PathBuf::from);
    if data.is_none() {
        println!("PALPATE_DATA is not set: nothing was tested");
    }
    data
}

#[test]
fn dice_of_real_surfaces_agrees_with_independent_packages() {
    let Some(data) = data() else { return };
    let regions = ["skin", "muscle", "femur"].map(|part| {
        let file = data.join(format!("leg_bp3d/thigh_{part}.stl"));
        let file = file.display().to_string();
        (part, format!("surface = \"{file}\""), file)
    });
    compared("surfaces", "", &regions);
}

#[test]
fn dice_and_lost_components_of_real_labels_agree_with_independent_packages() {
    /// Smallest component to compare in mm³: few enough that the report lists all.
    const LEAST: f64 = 400.0;
    let Some(data) = data() else { return };
    let thigh: &[&str] = &["fat", "muscle", "bone"];
    let abdomen: &[&str] = &[
        "skin",
        "fat",
        "muscle",
        "bone",
        "gas",
        "liver",
        "spleen",
        "kidneys",
        "vessels",
        "gallbladder",
    ];
    for (file, names) in [
        ("leg_bp3d/thigh_labels_2mm.nii.gz", thigh),
        ("abdomen_ct/abdomen_slab_organs_3mm.nii.gz", abdomen),
    ] {
        let volume = data.join(file).display().to_string();
        let regions: Vec<(&str, String, String)> = (1..)
            .zip(names)
            .map(|(label, name)| (*name, format!("label = {label}"), label.to_string()))
            .collect();
        let head = format!("labels = \"{volume}\"\nreport.component_mm3 = {LEAST}");
        let Some((report, theirs)) = compared("labels", &head, &regions) else {
            return;
        };
        assert_eq!(report["component_loss"]["lost_more"], 0, "{file}");
        let listed = report["component_loss"]["lost"].as_array().unwrap();
        let mut lost = 0;
        for region in report["regions"].as_array().unwrap() {
            let name = region["name"].as_str().unwrap();
            let components = &theirs[name]["components"];
            assert_eq!(
                region["input_components"], components["count"],
                "{file}, {name}"
            );
            for found in components["largest"].as_array().unwrap() {
                let [size, kept] = [&found["volume_mm3"], &found["kept"]].map(number);
                let is_it = |l: &&Value| {
                    l["region"] == name && (number(&l["volume_mm3"]) / size - 1.0).abs() < 1e-6
                };
                let is_listed = listed.iter().any(|l| is_it(&l));
                // Sixty points decide on a component: only clear cases are compared.
                if size > LEAST && kept <= 0.25 {
                    assert!(
                        is_listed,
                        "{file}, {name}: {found} is lost and not in {listed:?}"
                    );
                    lost += 1;
                }
            }
            for own in listed.iter().filter(|l| l["region"] == name) {
                let same = |f: &&Value| {
                    (number(&f["volume_mm3"]) / number(&own["volume_mm3"]) - 1.0).abs() < 1e-6
                };
                let largest = components["largest"].as_array().unwrap();
                let gone = largest
                    .iter()
                    .filter(same)
                    .any(|f| number(&f["kept"]) <= 0.75);
                assert!(gone, "{file}, {name}: {own} is listed and not lost");
            }
        }
        println!(
            "{file}: {lost} lost components agree, {} are listed",
            listed.len()
        );
    }
}
