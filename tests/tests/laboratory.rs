//! Experiments by the command line: recipe files, results, and errors.

#![allow(clippy::unwrap_used)]

mod table;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

use table::executable;

fn run(arguments: &[&str]) -> Output {
    Command::new(executable()).args(arguments).output().unwrap()
}

fn done(arguments: &[&str]) -> String {
    let out = run(arguments);
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{arguments:?}: {said}");
    String::from_utf8(out.stdout).unwrap()
}

/// Expects failure with all of `words` on standard error.
fn refused(arguments: &[&str], code: i32, words: &[&str]) {
    let out = run(arguments);
    let said = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(code), "{arguments:?}: {said}");
    assert!(!said.contains("panicked"), "{arguments:?}: {said}");
    for word in words {
        assert!(
            said.contains(word),
            "{arguments:?}: \"{word}\" is not in: {said}"
        );
    }
}

fn examples() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples")
}

/// Writes a file into a folder.
fn file(dir: &Path, name: &str, text: &str) -> String {
    let path = dir.join(name);
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn every_example_runs_and_every_profile_is_valid() {
    let mut runs = 0;
    for entry in std::fs::read_dir(examples()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "toml") {
            continue;
        }
        let name = path.display().to_string();
        let text = std::fs::read_to_string(&path).unwrap();
        if text.starts_with("format = \"palpate-script/") {
            palpate_device::Script::from_toml(&text).unwrap();
        } else if text.contains("\nexperiment =") {
            let figures: Value = serde_json::from_str(&done(&["run", &name, "--json"])).unwrap();
            assert!(figures.is_object(), "{name}");
            runs += 1;
        } else if text.contains("palpate-strokes/") {
            // `tests/cut.rs` cuts with it.
            assert!(text.contains("[[stroke]]"), "{name}");
        } else {
            done(&["profiles", &name]);
        }
    }
    assert!(runs >= 3);
}

#[test]
fn run_writes_figures_table_and_chart_and_prints_json() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out").display().to_string();
    let hand = examples().join("hand.csv").display().to_string();
    let line = [
        "run",
        "table-7-1",
        "--motion",
        &hand,
        "--json",
        "--out",
        &out,
    ];
    let figures: Value = serde_json::from_str(&done(&line)).unwrap();
    let rows = figures["rows"].as_array().unwrap();
    assert_eq!(rows.len(), (6 + 7) * 6 * 4);
    for row in rows {
        assert!(
            row["method"].is_string() && row["n"].as_u64().unwrap() > 0,
            "{row}"
        );
        assert!(["interpolation", "extrapolation"].contains(&row["kind"].as_str().unwrap()));
        for key in [
            "rate_hz",
            "gap_ms",
            "rms_mm",
            "max_mm",
            "rms_deg",
            "force_percent",
        ] {
            assert!(
                row[key].as_f64().is_some_and(f64::is_finite),
                "{key} of {row}"
            );
        }
    }
    let kept = std::fs::read_to_string(Path::new(&out).join("table-7-1.json")).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&kept).unwrap(), figures);
    for name in ["table-7-1.csv", "table-7-1-by-gap.csv", "table-7-1.svg"] {
        assert!(Path::new(&out).join(name).is_file(), "{name}");
    }
}

#[test]
fn pictures_of_cuts_are_files_with_a_table() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out").display().to_string();
    let line = ["run", "cut-gallery", "--json", "--out", &out];
    let figures: Value = serde_json::from_str(&done(&line)).unwrap();
    let pictures = figures["pictures"].as_array().unwrap();
    assert_eq!(pictures.len(), 7);
    for row in pictures {
        let name = row["picture"].as_str().unwrap();
        let file = Path::new(&out).join(format!("cut-gallery-{name}.png"));
        assert!(
            std::fs::read(file).unwrap().starts_with(b"\x89PNG"),
            "{row}"
        );
        assert!(row["faces"].as_u64().unwrap() > 20, "{row}");
    }
    let quality = figures["quality"].as_array().unwrap();
    let after = quality.iter().filter(|q| q["refinement"] == "after");
    assert!(after.clone().count() == 2 && after.clone().all(|q| q["inverted"] == 0));
    for name in ["cut-gallery.csv", "cut-gallery-quality.csv"] {
        assert!(Path::new(&out).join(name).is_file(), "{name}");
    }
}

#[test]
fn all_writes_one_page_and_continues_after_a_failure() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("report").display().to_string();
    let short = file(
        dir.path(),
        "short.csv",
        "time_s,x_m,y_m,z_m\n0,0,0,0\n0.05,0,0,0\n0.1,0,0,0\n",
    );
    let line = [
        "all",
        "--only",
        "missing-data,press-cube",
        "--motion",
        &short,
        "--json",
        "--out",
        &out,
    ];
    let output = run(&line);
    assert_eq!(output.status.code(), Some(1));
    let lines: Vec<Value> = String::from_utf8(output.stdout)
        .unwrap()
        .lines()
        .map(|l| serde_json::from_str(l).unwrap())
        .collect();
    assert_eq!(
        (&lines[0]["ok"], &lines[1]["ok"]),
        (&false.into(), &true.into())
    );
    assert!(
        lines[0]["error"]
            .as_str()
            .unwrap()
            .contains("the motion lasts 0.100 s")
    );
    let page = std::fs::read_to_string(Path::new(&out).join("index.html")).unwrap();
    for expected in [
        "Failed: <a href=\"#missing-data\">",
        "palpate-lab bench press-cube",
        "2 of 2 parts",
    ] {
        assert!(page.contains(expected), "{expected}");
    }
}

#[test]
fn invalid_recipes_are_rejected_with_their_error() {
    let dir = tempfile::tempdir().unwrap();
    let recipe = |name: &str, text: &str| file(dir.path(), name, text);
    let key = recipe("key.toml", "experiment = \"table-7-1\"\nsede = 7\n");
    refused(
        &["run", &key],
        1,
        &["key.toml", "line 2", "did you mean \"seed\"?"],
    );
    let name = recipe("name.toml", "experiment = \"table-71\"\n");
    refused(
        &["run", &name],
        1,
        &["name.toml", "did you mean \"table-7-1\"?"],
    );
    refused(
        &["run", "transmision"],
        2,
        &["did you mean \"transmission\"?"],
    );
    let empty = recipe("empty.toml", "");
    refused(&["run", &empty], 1, &["empty.toml", "experiment"]);
    refused(&["run", "absent.toml"], 1, &["absent.toml"]);
    let folder = dir.path().join("folder.toml");
    std::fs::create_dir(&folder).unwrap();
    refused(&["run", &folder.display().to_string()], 1, &["is a folder"]);
    recipe("back.toml", "name = \"back\"\n[both]\ndelay_ms = -3\n");
    let profile = recipe(
        "over.toml",
        "experiment = \"jitter\"\nprofile = \"back.toml\"\n",
    );
    refused(
        &["run", &profile],
        1,
        &["back.toml", "line 3", "from 0 to 60000"],
    );
    recipe("keys.toml", "name = \"keys\"\n[both]\ndeley_ms = 3\n");
    let profile = recipe(
        "keyed.toml",
        "experiment = \"jitter\"\nprofile = \"keys.toml\"\n",
    );
    refused(
        &["run", &profile],
        1,
        &["keys.toml", "did you mean \"delay_ms\"?"],
    );
    let idle = recipe(
        "idle.toml",
        "experiment = \"missing-data\"\nprofile = \"lan\"\n",
    );
    refused(&["run", &idle], 1, &["missing-data", "profile"]);
}

#[test]
fn invalid_motion_error_names_the_line() {
    let dir = tempfile::tempdir().unwrap();
    let head = "time_s,x_m,y_m,z_m\n";
    for (text, words) in [
        (
            format!("{head}0,0,0,0\n0.2,0,0,0\n0.1,0,0,0\n"),
            ["line 4", "is not later than the one before"],
        ),
        (
            format!("{head}0,0,0,0\n0.1,NaN,0,0\n"),
            ["line 3", "x_m is \"NaN\""],
        ),
        (String::new(), ["line 1 should name the columns", "time_s"]),
        (
            "time_s,x_m,y_m\n0,0,0\n".to_owned(),
            ["line 1 should name the columns", "z_m"],
        ),
        (
            format!("{head}0,0,0,0\n"),
            ["two moments or more", "here is 1"],
        ),
    ] {
        let motion = file(dir.path(), "motion.csv", &text);
        let line = ["run", "table-7-1", "--json", "--motion", &motion];
        refused(&line, 1, &[&["motion.csv"], &words[..]].concat());
    }
    let folder = dir.path().display().to_string();
    refused(
        &["run", "table-7-1", "--json", "--motion", &folder],
        1,
        &["it is a folder"],
    );
    refused(
        &["run", "table-7-1", "--json", "--motion", "absent.csv"],
        1,
        &["absent.csv"],
    );
    refused(&["hand", "--seconds", "nan"], 1, &["--seconds"]);
}

#[test]
fn written_hand_is_a_valid_motion() {
    let dir = tempfile::tempdir().unwrap();
    let text = done(&["hand", "--seed", "3", "--seconds", "2", "--rate-hz", "500"]);
    assert_eq!(
        text,
        done(&["hand", "--seed", "3", "--seconds", "2", "--rate-hz", "500"])
    );
    let motion = file(dir.path(), "hand.csv", &text);
    let figures = done(&["run", "missing-data", "--motion", &motion, "--json"]);
    let figures: Value = serde_json::from_str(&figures).unwrap();
    assert_eq!(figures["methods"].as_array().unwrap().len(), 13);
}
