//! What stands at the edges of the programs: files that are none, folders that are files, pipes that close, disks that
//! are full, and limits that are not kept. A sentence and an exit code, before the work where that can be.

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
fn over_a_network_that_lets_nothing_through_nothing_is_compared() {
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
        let said = format!("0 of 140000 samples arrived on {name}: nothing can be compared");
        refused(&out, experiment, &[&said]);
        assert!(out.stdout.is_empty(), "{experiment} gave figures");
    }
}

#[test]
fn a_recipe_has_the_ranges_of_the_command_line() {
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
fn a_file_in_the_place_of_the_folder_is_refused_before_the_work() {
    let dir = tempfile::tempdir().unwrap();
    let taken = file(dir.path(), "taken", "");
    for line in [
        &["run", "replicas", "--out", &taken][..],
        &["all", "--only", "replicas", "--out", &taken],
    ] {
        refused(&run(line), line[0], &["is a file, name a folder"]);
    }
}

#[cfg(unix)]
#[test]
fn what_is_no_file_is_not_read() {
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
fn a_reader_that_has_seen_enough_is_no_mistake() {
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
        // Standard error is gone as well, as behind `2>&1 | head -1`.
        let said = writer.try_clone().unwrap();
        let status = program.args(line).stdout(writer).stderr(said).status();
        assert_eq!(status.unwrap().code(), Some(0), "{line:?}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_said() {
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
        refused(&out, line[0], &["can not be", "No space left"]);
    }
}
