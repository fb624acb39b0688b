//! Every command in the README works as printed.
//!
//! Its lines run in a shell, in order, in an empty folder with the project's `tests` folder. Exceptions:
//!
//! - A line with "minutes" or "seconds" in its comment gets `--help`, which still parses all arguments before
//!   it.
//! - `cargo demo` starts the program under test; other `cargo` lines are skipped.
//! - `host` runs in the background with `--listen 127.0.0.1:0 --identity new`.
//! - A join uses the printed link instead of 'palpate://...', with `--duration 5 --forget-seat`. A join without
//!   script and motion must name the missing device.

#![allow(clippy::unwrap_used)]
#![cfg(unix)]

mod table;

use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use palpate_client::Summary;
use palpate_lab::program::Program;
use palpate_server::host::Listening;

use table::executable;

/// Timeout for the unoptimised build of a sample.
const LISTEN: Duration = Duration::from_secs(120);

/// Placeholder of the printed link.
const LINK: &str = "'palpate://...'";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

/// Lines of all code blocks of a language.
fn blocks(readme: &str, language: &str) -> Vec<String> {
    let fence = format!("```{language}\n");
    let blocks = readme.split(&fence).skip(1);
    blocks
        .filter_map(|rest| rest.split("```").next())
        .map(str::to_owned)
        .collect()
}

struct Shell {
    dir: tempfile::TempDir,
}

impl Shell {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let bin = dir.path().join("bin");
        std::fs::create_dir(&bin).unwrap();
        let lab = executable().display().to_string();
        let programs = [
            ("palpate-server", format!("exec '{lab}' server \"$@\"")),
            ("palpate-client", format!("exec '{lab}' client \"$@\"")),
            ("palpate-lab", format!("exec '{lab}' \"$@\"")),
            (
                "cargo",
                format!("[ \"$1\" = demo ] || exit 0; exec '{lab}' \"$@\""),
            ),
        ];
        for (name, text) in programs {
            let path = bin.join(name);
            std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
            std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).unwrap();
        }
        symlink(root().join("tests"), dir.path().join("tests")).unwrap();
        Self { dir }
    }

    fn environment(&self) -> [String; 2] {
        let path = std::env::var("PATH").unwrap();
        let here = self.dir.path().display();
        [
            format!("PATH={here}/bin:{path}"),
            format!("XDG_STATE_HOME={here}/state"),
        ]
    }

    fn run(&self, line: &str) -> Output {
        let mut command = Command::new("/usr/bin/env");
        command.args(self.environment()).args(["sh", "-c", line]);
        command.current_dir(self.dir.path()).output().unwrap()
    }

    fn host(&self, line: &str) -> (Program, Listening) {
        let line = format!("cd '{}' && exec {line} --json", self.dir.path().display());
        let words = self.environment().into_iter();
        let words = words.chain(["sh".to_owned(), "-c".to_owned(), line]);
        let mut host = Program::start("host", Path::new("/usr/bin/env"), words).unwrap();
        let listening = host.json("listen", LISTEN).unwrap();
        (host, listening)
    }
}

#[test]
fn every_command_works_as_printed() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let shell = Shell::new();
    let mut session: Option<(Program, Listening)> = None;
    let (mut run, mut felt) = (0, 0);
    for line in blocks(&readme, "sh").iter().flat_map(|block| block.lines()) {
        let (command, comment) = line.split_once(" #").unwrap_or((line, ""));
        let command = command.trim();
        if command.is_empty() {
            continue;
        }
        run += 1;
        if command.starts_with("palpate-server host") {
            session = Some(shell.host(&format!("{command} --listen 127.0.0.1:0 --identity new")));
            continue;
        }
        let is_join = command.contains(LINK);
        let mut typed = command.to_owned();
        if is_join {
            let (_, listening) = session.as_ref().expect("a host comes before a join");
            let link = format!("'{}'", listening.links["trainee"]);
            typed = format!(
                "{} --json --duration 5 --forget-seat --name n{run}",
                typed.replace(LINK, &link)
            );
        } else if ["minutes", "seconds"]
            .iter()
            .any(|unit| comment.contains(unit))
        {
            typed.push_str(" --help");
        }
        let out = shell.run(&typed);
        let said = String::from_utf8_lossy(&out.stderr);
        if is_join && !command.contains("--script") && !command.contains("--motion") {
            assert!(
                said.contains("no haptic device is connected"),
                "{typed}: {said}"
            );
            continue;
        }
        assert!(out.status.success(), "{typed}: {said}");
        if is_join {
            let summary: Summary = serde_json::from_slice(&out.stdout).unwrap();
            assert!(summary.force_max_n > 0.2, "{typed}: {summary}");
            felt += 1;
        }
    }
    assert!(run > 25 && felt >= 3, "{run} commands, {felt} of them felt");
}

#[test]
fn scene_is_valid_and_readme_is_short() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let shell = Shell::new();
    assert!(
        shell
            .run("palpate-server sample thigh -o .")
            .status
            .success()
    );
    let scenes = blocks(&readme, "toml");
    assert!(!scenes.is_empty());
    for scene in scenes {
        std::fs::write(shell.dir.path().join("mine.toml"), scene).unwrap();
        let out = shell.run("palpate-server build mine.toml -o mine.palp");
        assert!(
            out.status.success(),
            "{}",
            String::from_utf8_lossy(&out.stderr)
        );
    }
    let opening = readme.find("cargo demo").unwrap();
    assert!(
        opening < 40
            && readme[opening..]
                .lines()
                .nth(1)
                .unwrap()
                .starts_with("cargo test")
    );
    let words = readme.split_whitespace().count();
    assert!(words <= 1200, "{words} words");
}
