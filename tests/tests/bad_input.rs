//! Invalid command lines and files give an error message and an exit code, never a panic.

#![allow(clippy::unwrap_used)]

mod table;

use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use table::executable;

fn run(arguments: &[&str]) -> Output {
    Command::new(executable()).args(arguments).output().unwrap()
}

/// Runs the program and expects failure with all of `words` on standard error.
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

#[test]
fn unknown_profile_error_suggests_the_nearest() {
    refused(
        &["demo", "--profile", "transatlantik"],
        2,
        &["did you mean \"transatlantic\"?", "satellite"],
    );
}

#[test]
fn demo_without_a_model_is_rejected() {
    refused(
        &["demo", "--json", "--model", "tigh"],
        1,
        &["did you mean \"thigh\"?"],
    );
    refused(
        &["demo", "--json", "--model", "absent.palp"],
        1,
        &["absent.palp"],
    );
    refused(
        &["demo", "--json", "--model", "absent.toml"],
        1,
        &["absent.toml"],
    );
    refused(
        &["demo", "--json", "--seconds", "0"],
        1,
        &["between 4 and 600"],
    );
    refused(
        &["demo", "--json", "--seconds", "nan"],
        1,
        &["between 4 and 600"],
    );
}

fn scene(dir: &Path, surface: &str, extra: &str) -> String {
    let text = format!(
        "format = \"palpate-scene/1\"\nspacing_mm = 4.0\n{extra}\n[[region]]\nname = \"a\"\n\
         surface = \"{surface}\"\nmaterial = \"fat\"\n"
    );
    let path = dir.join("scene.toml");
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

/// The triangles of a box in mm, without the first `leave_out`.
fn box_stl(side: f64, leave_out: usize) -> String {
    let corner = |i: usize| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|b| b as f64 * side);
    let quads = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let triangles = quads
        .iter()
        .flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]);
    let mut text = "solid box\n".to_owned();
    for t in triangles.skip(leave_out) {
        text += "facet normal 0 0 0\nouter loop\n";
        for [x, y, z] in t.map(corner) {
            writeln!(text, "vertex {x} {y} {z}").unwrap();
        }
        text += "endloop\nendfacet\n";
    }
    text + "endsolid box\n"
}

#[test]
fn invalid_surfaces_are_rejected_with_their_error() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let out = dir.join("out.palp").display().to_string();
    let build = |surface: &str, extra: &str, words: &[&str]| {
        let scene = scene(dir, surface, extra);
        refused(&["server", "build", &scene, "-o", &out], 1, words);
    };
    build("absent.stl", "", &["absent.stl"]);
    std::fs::write(dir.join("text.stl"), "this is no surface").unwrap();
    build("text.stl", "", &["text.stl"]);
    std::fs::write(dir.join("empty.stl"), "").unwrap();
    build("empty.stl", "", &["empty.stl"]);
    std::fs::write(dir.join("open.stl"), box_stl(60.0, 2)).unwrap();
    build("open.stl", "", &["open.stl", "4 "]);
    std::fs::write(dir.join("box.stl"), box_stl(60.0, 0)).unwrap();
    build("box.stl", "pined = [\"a\"]", &["pined", "pinned"]);
    std::fs::write(dir.join("tiny.stl"), box_stl(1.0, 0)).unwrap();
    build("tiny.stl", "", &["coarse"]);
    refused(
        &["server", "build", "absent.toml", "-o", &out],
        1,
        &["absent.toml"],
    );
    // The complete box builds, and the demo could run on it.
    let good = scene(dir, "box.stl", "");
    let done = run(&["server", "build", &good, "-o", &out, "--json"]);
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let report: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!(report["outer_surface"]["closed"], true);
}

#[test]
fn strict_build_that_loses_a_region_fails_and_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    std::fs::write(dir.join("box.stl"), box_stl(60.0, 0)).unwrap();
    std::fs::write(dir.join("grain.stl"), box_stl(1.0, 0)).unwrap();
    let out = dir.join("out.palp").display().to_string();
    let scene = scene(dir, "box.stl", "");
    let build = ["server", "build", &scene, "-o", &out, "--json", "--strict"];
    assert!(run(&build).status.success());
    std::fs::remove_file(&out).unwrap();
    let grain = "[[region]]\nname = \"grain\"\nsurface = \"grain.stl\"\nmaterial = \"bone\"\n";
    let text = std::fs::read_to_string(&scene).unwrap();
    std::fs::write(&scene, text + grain).unwrap();
    refused(&build, 1, &["deviations", "--strict"]);
    assert!(!Path::new(&out).exists());
    let done = run(&build[..6]);
    assert!(done.status.success() && Path::new(&out).exists());
    let report: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert!(report["deviations"].as_u64() > Some(0), "{report}");
}

#[test]
fn damaged_model_is_rejected() {
    let table = table::Table::new();
    let bytes = std::fs::read(&table.subject.file).unwrap();
    for (name, bytes) in [
        ("cut.palp", bytes[..bytes.len() / 2].to_vec()),
        ("noise.palp", vec![0x5a; 4000]),
        ("empty.palp", Vec::new()),
    ] {
        let path = table.path(name);
        std::fs::write(&path, bytes).unwrap();
        let path = path.display().to_string();
        refused(&["server", "inspect", &path], 1, &["model file"]);
        refused(
            &["server", "host", &path, "--listen", "127.0.0.1:0"],
            1,
            &["model file"],
        );
    }
}

#[test]
fn invalid_links_and_scripts_are_rejected() {
    refused(
        &["client", "join", "http://example.org"],
        2,
        &["palpate://"],
    );
    let link = format!(
        "palpate://127.0.0.1:9/trainee?cert={}&grant={}",
        "0".repeat(64),
        "0".repeat(32)
    );
    refused(&["client", "join", &link], 2, &["--script"]);
    refused(
        &["client", "join", &link, "--script", "absent.toml"],
        2,
        &["absent.toml"],
    );
    let dir = tempfile::tempdir().unwrap();
    let script = dir.path().join("script.toml");
    std::fs::write(
        &script,
        "format = \"palpate-script/1\"\n[tool]\nkind = \"spoon\"\n",
    )
    .unwrap();
    let script = script.display().to_string();
    refused(
        &["client", "join", &link, "--script", &script],
        2,
        &["spoon"],
    );
}

#[test]
fn invalid_host_options_are_command_line_errors() {
    for (options, words) in [
        (&["--tick-hz", "0"][..], "between 1 and 500"),
        (&["--compensation", "magic"], "fixed:MS"),
        (&["--delay-cap", "0"], "--compensation none"),
        (&["--delay-cap", "2000"], "1000 ms"),
        (&["--seats", "2", "--start-when", "3"], "seats (2)"),
        (&["--duration", "0"], "above 0"),
        (&["--seats", "0"], "--seats"),
        (&["--seats", "4", "--spectators", "5"], "seats (4)"),
    ] {
        let arguments = [&["server", "host", "thigh"][..], options].concat();
        refused(&arguments, 2, &[words]);
    }
}

#[test]
fn relay_reports_its_packet_counts() {
    let out = run(&[
        "relay",
        "--listen",
        "127.0.0.1:0",
        "--to",
        "127.0.0.1:9",
        "--profile",
        "metro",
        "--seed",
        "5",
        "--duration",
        "0.2",
        "--json",
    ]);
    assert!(out.status.success());
    let text = String::from_utf8(out.stdout).unwrap();
    let lines: Vec<serde_json::Value> = text
        .lines()
        .map(|l| serde_json::from_str(l).unwrap())
        .collect();
    assert!(lines[0]["listening"].is_string(), "{text}");
    assert_eq!(
        (&lines[1]["profile"], &lines[1]["seed"]),
        (&"metro".into(), &5.into())
    );
    assert_eq!(lines[1]["sent"], 0);
}

#[test]
fn invalid_profile_error_names_the_line() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("mine.toml");
    let path = file.display().to_string();
    for (line, right) in [
        ("delay_ms = -5.0", "from 0 to 60000"),
        ("deley_ms = 5.0", "unknown field"),
        ("loss = nan", "from 0 to 1"),
    ] {
        std::fs::write(&file, format!("name = \"mine\"\n[both]\n{line}\n")).unwrap();
        let relay = ["relay", "--listen", "127.0.0.1:0", "--to", "127.0.0.1:9"];
        let arguments = [&relay[..], &["--profile", &path]].concat();
        refused(&arguments, 2, &["mine.toml", "line 3", right]);
        refused(&["profiles", &path], 1, &["mine.toml", "line 3", right]);
    }
    refused(&["profiles", "metr"], 1, &["did you mean \"metro\"?"]);
}

#[test]
fn printed_profile_reads_back() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("mine.toml");
    let printed = run(&["profiles", "wifi-bursts"]);
    assert!(printed.status.success());
    std::fs::write(&file, &printed.stdout).unwrap();
    let again = run(&["profiles", &file.display().to_string()]);
    assert!(again.status.success());
    assert_eq!(again.stdout, printed.stdout);
    let list = String::from_utf8(run(&["profiles"]).stdout).unwrap();
    assert!(list.contains("satellite") && list.contains("300 ms one way"));
}
