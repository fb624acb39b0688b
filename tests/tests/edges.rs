//! Edge cases of the programs: invalid paths, closed pipes, full disks, values out of range. Each gives an
//! error message and an exit code, if possible before the work begins.

#![allow(clippy::unwrap_used)]

mod table;

use std::path::Path;
use std::process::{Command, Output, Stdio};

use table::executable;

fn run(arguments: &[&str]) -> Output {
    Command::new(executable()).args(arguments).output().unwrap()
}

/// Expects failure with all of `words` on standard error.
fn refused(out: &Output, what: &str, words: &[&str]) {
    let said = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(1), "{what}: {said}");
    assert!(!said.contains("panicked"), "{what}: {said}");
    for word in words {
        assert!(said.contains(word), "{what}: \"{word}\" is not in: {said}");
    }
}

fn file(dir: &Path, name: &str, text: &str) -> String {
    let path = dir.join(name);
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn network_without_arrivals_gives_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let gone = file(
        dir.path(),
        "gone.toml",
        "name = \"gone\"\n[both]\nloss = 1.0\n",
    );
    let late = file(
        dir.path(),
        "late.toml",
        "name = \"late\"\n[both]\ndelay_ms = 20000\n",
    );
    for (experiment, profile, name) in [
        ("atc-adaptive", &gone, "gone"),
        ("atc-fixed", &late, "late"),
        ("transmission", &gone, "gone"),
        ("jitter", &late, "late"),
    ] {
        let out = run(&["run", experiment, "--json", "--profile", profile]);
        let said = format!("0 of 140000 samples arrived on {name}, too few to compare the sites");
        refused(&out, experiment, &[&said]);
        assert!(out.stdout.is_empty(), "{experiment} gave figures");
    }
}

#[test]
fn recipe_and_command_line_have_equal_ranges() {
    let dir = tempfile::tempdir().unwrap();
    for line in ["seeds = 0", "seeds = 99999999999999", "real = 0"] {
        let text = format!("experiment = \"replicas\"\n{line}\n");
        let recipe = file(dir.path(), "mine.toml", &text);
        refused(
            &run(&["run", &recipe]),
            line,
            &["mine.toml", "line 2", "from 1 to"],
        );
    }
}

#[test]
fn file_in_place_of_the_folder_is_rejected_early() {
    let dir = tempfile::tempdir().unwrap();
    let taken = file(dir.path(), "taken", "");
    for line in [
        &["run", "replicas", "--out", &taken][..],
        &["all", "--only", "replicas", "--out", &taken],
    ] {
        refused(&run(line), line[0], &["is a file; choose a directory"]);
    }
}

#[cfg(unix)]
#[test]
fn non_regular_files_are_rejected() {
    let dir = tempfile::tempdir().unwrap();
    let device = dir.path().join("endless.toml");
    std::os::unix::fs::symlink("/dev/zero", &device).unwrap();
    let device = device.display().to_string();
    for line in [
        &["run", "table-7-1", "--motion", &device][..],
        &["run", "jitter", "--profile", &device],
        &["run", &device],
    ] {
        refused(&run(line), line[1], &["is not a file"]);
    }
}

#[cfg(unix)]
#[test]
fn closed_pipe_is_not_an_error() {
    let host = [
        "server",
        "host",
        "handle",
        "--identity",
        "new",
        "--listen",
        "127.0.0.1:0",
        "--duration",
        "0.5",
    ];
    for line in [&["hand", "--seconds", "20"][..], &["list"], &host] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let mut program = Command::new(executable());
        // Standard error is closed too, as behind `2>&1 | head -1`.
        let said = writer.try_clone().unwrap();
        let status = program.args(line).stdout(writer).stderr(said).status();
        assert_eq!(status.unwrap().code(), Some(0), "{line:?}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn full_disk_is_reported() {
    let host = [
        "server",
        "host",
        "handle",
        "--identity",
        "new",
        "--listen",
        "127.0.0.1:0",
        "--duration",
        "0.5",
    ];
    for line in [&["hand", "--seconds", "20"][..], &["list"], &host] {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full");
        let mut program = Command::new(executable());
        let program = program
            .args(line)
            .stdout(full.unwrap())
            .stderr(Stdio::piped());
        let out = program.output().unwrap();
        refused(&out, line[0], &["cannot print the result", "No space left"]);
    }
}
