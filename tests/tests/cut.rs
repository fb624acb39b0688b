//! Offline cutting through the command line: what it writes, and how it refuses.

#![allow(clippy::unwrap_used)]

mod table;

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::Command;

use palpate_lab::test_model::soft_block;
use palpate_tissue::file::ModelFile;
use palpate_tissue::snapshot::model_hash;
use palpate_tissue::{Model, RegionId, Topology};
use serde_json::Value;

use table::executable;

/// A folder with a block of 100 x 80 x 40 mm, cells of 5 mm, on a pinned base.
struct Bench {
    dir: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        Self::on(soft_block([20, 16, 8], 5e-3))
    }

    fn on(model: Model) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let report_json = r#"{"note": "kept"}"#.to_owned();
        let file = ModelFile { model, report_json };
        file.write(&dir.path().join("block.palp")).unwrap();
        Self { dir }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn server(&self, words: &[&str]) -> Result<Value, String> {
        let mut command = Command::new(executable());
        command.current_dir(self.dir.path()).arg("server");
        let out = command.args(words).output().unwrap();
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(!said.contains("panicked"), "{said}");
        if !out.status.success() {
            return Err(said);
        }
        Ok(serde_json::from_slice(&out.stdout).unwrap())
    }

    /// Cuts `from` to `to`, with the exports in `words`.
    fn cut(&self, from: &str, to: &str, strokes: &str, words: &[&str]) -> Result<Value, String> {
        std::fs::write(self.path("strokes.toml"), strokes).unwrap();
        let command = ["cut", from, "--strokes", "strokes.toml", "-o", to, "--json"];
        self.server(&[&command[..], words].concat())
    }

    fn uncut(&self) -> Topology {
        let file = ModelFile::read(&self.path("block.palp")).unwrap();
        Topology::new(file.model.into())
    }
}

/// A stroke over the top of the block, from front to back.
fn across(x: f64, depth: f64) -> String {
    let points: Vec<String> = (-1..=17)
        .map(|i| format!("[{x:?}, {:?}, 40.0]", 5.0 * f64::from(i)))
        .collect();
    format!(
        "[[stroke]]\npoints_mm = [{}]\ndepth_mm = {depth:?}\ndirection = [0, 0, -1]\n",
        points.join(", ")
    )
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value}"))
}

#[test]
fn figures_agree_with_the_written_model() {
    let bench = Bench::new();
    let strokes = across(52.3, 21.0) + &across(31.0, 12.0);
    let exports = ["--stl", "c.stl", "--vtu", "c.vtu", "--png", "c.png"];
    let report = bench
        .cut("block.palp", "c.palp", &strokes, &exports)
        .unwrap();
    assert_eq!(
        (&report["operations"], &report["applied"]),
        (&2.into(), &2.into())
    );
    assert_eq!(report["refused"], serde_json::json!([]));
    assert_eq!(report["boundary"]["closed"], true);
    assert_eq!(report["boundary"]["edges_not_two"], 0);
    assert_eq!(report["boundary"]["self_intersections"], 0);
    assert_eq!(report["stl"]["self_intersections"], 0);
    assert_eq!(report["inverted_cells"], 0);
    assert!(number(&report["shortest_spring_mm"]) >= 0.3 * 5.0);
    assert!(number(&report["interface_drift_max_mm"]) <= 0.1 * 5.0);
    assert!(
        (number(&report["volume_after_mm3"]) - 320_000.0).abs() < 1.0,
        "{report}"
    );
    let [before, after] = ["mass_before_kg", "mass_after_kg"].map(|m| number(&report[m]));
    assert!((before / after - 1.0).abs() < 1e-12, "{report}");
    assert!(
        number(&report["wound_triangles"]["body"]) > 100.0,
        "{report}"
    );
    assert_eq!(report["sample_ms"]["per"], "stroke");
    assert!(number(&report["sample_ms"]["max"]) > 0.0);
    let file = ModelFile::read(&bench.path("c.palp")).unwrap();
    let hash = format!("{:016x}", model_hash(&file.model));
    assert_eq!(report["model_hash"], hash);
    let topology = Topology::new(file.model.into());
    assert!(topology.boundary().is_closed());
    assert_eq!(
        report["components"].as_array().unwrap().len(),
        topology.components()
    );
    assert_eq!(report["components"][0]["nodes"], topology.node_count());
    let shown = bench.server(&["inspect", "c.palp", "--json"]).unwrap();
    assert_eq!(shown["model_hash"], hash);
    assert_eq!(shown["cuts"][0]["topology_hash"], report["topology_hash"]);
    assert_eq!(shown["note"], "kept");
    let png = std::fs::read(bench.path("c.png")).unwrap();
    assert!(
        png.starts_with(b"\x89PNG") && bench.path("c.stl").exists() && bench.path("c.vtu").exists()
    );
}

#[test]
fn cut_through_gives_two_halves_and_a_cut_model_is_cut_again() {
    let bench = Bench::on(soft_block([20, 16, 8], 5e-3));
    // Bone at the bottom would hold both halves together.
    let mut file = ModelFile::read(&bench.path("block.palp")).unwrap();
    for region in &mut file.model.regions {
        region.pinned = false;
    }
    file.write(&bench.path("block.palp")).unwrap();
    let report = bench
        .cut("block.palp", "two.palp", &across(60.2, 60.0), &[])
        .unwrap();
    let components = report["components"].as_array().unwrap();
    assert_eq!(components.len(), 2, "{report}");
    let volumes = [60.2, 39.8].map(|x| x * 80.0 * 40.0);
    for (component, exact) in components.iter().zip(volumes) {
        let volume = number(&component["volume_mm3"]);
        assert!((volume / exact - 1.0).abs() < 0.01, "{volume} of {exact}");
    }
    assert!(number(&report["path_distance_max_mm"]) < 1e-5, "{report}");
    let again = bench
        .cut("two.palp", "three.palp", &across(20.4, 60.0), &[])
        .unwrap();
    assert_eq!(again["components"].as_array().unwrap().len(), 3, "{again}");
    let shown = bench.server(&["inspect", "three.palp", "--json"]).unwrap();
    assert_eq!(shown["cuts"].as_array().unwrap().len(), 2);
}

#[test]
fn session_is_hosted_on_a_cut_model() {
    let bench = Bench::new();
    let report = bench
        .cut("block.palp", "c.palp", &across(52.3, 21.0), &[])
        .unwrap();
    let mut host = Command::new(executable());
    host.current_dir(bench.dir.path())
        .args(["server", "host", "c.palp", "--json"]);
    host.args([
        "--listen",
        "127.0.0.1:0",
        "--identity",
        "new",
        "--duration",
        "0.5",
    ]);
    let out = host.output().unwrap();
    assert!(
        out.status.success(),
        "{}",
        String::from_utf8_lossy(&out.stderr)
    );
    let text = String::from_utf8(out.stdout).unwrap();
    let listening: Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
    assert_eq!(
        listening["model"]["nodes"],
        report["components"][0]["nodes"]
    );
    assert!(number(&listening["model"]["nodes"]) > f64::from(21 * 17 * 9));
}

#[test]
fn impossible_strokes_are_refused_and_leave_the_model_unchanged() {
    let mut model = soft_block([20, 16, 8], 5e-3);
    // A pinned block in the middle, which reaches the top.
    model.regions.push(model.regions[0].clone());
    let bone = RegionId(u16::try_from(model.regions.len() - 1).unwrap());
    model.regions[bone.index()].name = "bone".to_owned();
    model.regions[bone.index()].pinned = true;
    for cell in &mut model.cells {
        let [x, y, _] = model.lattice[cell.corners[0] as usize];
        if (8..12).contains(&x) && (6..10).contains(&y) {
            cell.region = bone;
        }
    }
    let bench = Bench::on(model);
    let line =
        |a: &str, b: &str, rest: &str| format!("[[stroke]]\npoints_mm = [{a}, {b}]\n{rest}\n");
    let deep = "depth_mm = 10.0";
    let [a, b] = ["[10.0, 10.0, 40.0]", "[10.0, 60.0, 40.0]"];
    let mut many = "[[stroke]]\ndepth_mm = 3\npoints_mm = [".to_owned();
    for i in 0..100_000 {
        write!(many, "[{}.0, 20.0, 40.0],", i % 90).unwrap();
    }
    many.push_str("]\n");
    let refused = [
        (
            line("[10.0, 10.0, 900.0]", "[10.0, 60.0, 900.0]", deep),
            "from the surface",
        ),
        (
            line(
                "[10.0, 10.0, 900.0]",
                "[10.0, 60.0, 900.0]",
                "depth_mm = 10\ndirection = [0, 0, -1]",
            ),
            "no tissue",
        ),
        (
            format!("[[stroke]]\npoints_mm = [{a}]\n{deep}\n"),
            "this one has 1",
        ),
        (line(a, a, deep), "does not move"),
        (line(a, b, "depth_mm = 0"), "above 0"),
        (line(a, b, "depth_mm = nan"), "NaN"),
        (line(a, "[nan, 60.0, 40.0]", deep), "NaN"),
        (line(a, b, "depth_mm = 10\nwidth_mm = -1"), "wide"),
        (
            line("[49.0, 35.0, 40.0]", "[49.0, 45.0, 40.0]", deep),
            "pinned region `bone`",
        ),
        (many, "has 100000"),
    ];
    let all: String = refused.iter().map(|r| r.0.as_str()).collect();
    let report = bench
        .cut("block.palp", "c.palp", &all, &["--png", "c.png"])
        .unwrap();
    assert_eq!(report["applied"], 0, "{report}");
    for (index, (_, why)) in refused.iter().enumerate() {
        let entry = &report["refused"][index];
        assert_eq!(entry["index"], index);
        assert!(
            entry["why"].as_str().unwrap().contains(why),
            "{why}: {entry}"
        );
    }
    assert_eq!(report["topology_hash"], bench.uncut().hash().to_string());
    let [before, after] = ["block.palp", "c.palp"]
        .map(|f| model_hash(&ModelFile::read(&bench.path(f)).unwrap().model));
    assert_eq!(before, after);
    // Along an existing cut, the second time is refused, and the result is that of the first.
    let once = bench
        .cut("block.palp", "once.palp", &line(a, b, deep), &[])
        .unwrap();
    let both = line(a, b, deep) + &line(a, b, deep);
    let twice = bench.cut("block.palp", "twice.palp", &both, &[]).unwrap();
    assert_eq!(
        (&once["applied"], &twice["applied"]),
        (&1.into(), &1.into())
    );
    assert!(
        twice["refused"][0]["why"]
            .as_str()
            .unwrap()
            .contains("already parted")
    );
    assert_eq!(once["topology_hash"], twice["topology_hash"]);
    // So is it on the stored result, whose wound does not turn the direction of the stroke.
    let stored = bench
        .cut("once.palp", "again.palp", &line(a, b, deep), &[])
        .unwrap();
    assert_eq!(stored["applied"], 0, "{stored}");
    assert_eq!(stored["wound_triangles"], once["wound_triangles"]);
}

#[test]
fn errors_write_no_file_and_name_cause_and_remedy() {
    let bench = Bench::new();
    for (strokes, words) in [
        ("", "no stroke"),
        ("[[stroke]]\npoints_mm = [[0, 0]]\ndepth_mm = 1", "line 2"),
        ("[[stroke]]\npoint_mm = []\ndepth_mm = 1", "point_mm"),
    ] {
        let said = bench
            .cut("block.palp", "c.palp", strokes, &["--png", "c.png"])
            .unwrap_err();
        assert!(
            said.contains(words) && said.contains("strokes.toml"),
            "{said}"
        );
    }
    let one = across(50.0, 10.0);
    let said = bench.cut("absent.palp", "c.palp", &one, &[]).unwrap_err();
    assert!(said.contains("absent.palp"), "{said}");
    let said = bench
        .cut("block.palp", "block.palp", &one, &[])
        .unwrap_err();
    assert!(said.contains("overwritten"), "{said}");
    let said = bench
        .cut("block.palp", "c.palp", &one, &["--stl", "none/c.stl"])
        .unwrap_err();
    assert!(said.contains("make its folder first"), "{said}");
    let names = std::fs::read_dir(bench.dir.path()).unwrap();
    let mut names: Vec<String> = names
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(names, ["block.palp", "strokes.toml"]);
}

#[test]
fn strokes_of_the_help_and_of_the_examples_cut_the_thigh() {
    let bench = Bench::new();
    let help = Command::new(executable())
        .args(["server", "cut", "--help"])
        .output()
        .unwrap();
    let help = String::from_utf8(help.stdout).unwrap();
    let from = help.find("  [[stroke]]").unwrap();
    let taught = &help[from..from + help[from..].find("\n\n").unwrap()];
    let example = std::fs::read_to_string(
        std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/strokes.toml"),
    );
    for strokes in [taught, &example.unwrap()] {
        let report = bench
            .cut("thigh", "cut.palp", strokes, &["--stl", "cut.stl"])
            .unwrap();
        assert_eq!(report["applied"], report["operations"], "{report}");
        assert_eq!(report["boundary"]["closed"], true);
        assert_eq!(report["stl"]["self_intersections"], 0);
        let of = |region: &str| report["wound_triangles"][region].as_u64().unwrap_or(0);
        assert!(of("subcutaneous") > 50 && of("quadriceps") > 10, "{report}");
    }
}
