//! First use: scripts that start at joining, host restarts, program crashes.

#![allow(clippy::unwrap_used)]
#![cfg(unix)]

mod table;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use palpate_client::Summary;
use palpate_lab::program::Program;
use palpate_server::host::{HostSummary, Listening};

use table::{Table, alone, executable};

/// Timeout for every program.
const SOON: Duration = Duration::from_secs(60);

/// A session with a state folder per user.
struct UserTable {
    table: Table,
}

impl UserTable {
    fn new() -> Self {
        Self {
            table: Table::new(),
        }
    }

    /// Starts a program of a user.
    fn start(&self, user: &str, words: &[&str]) -> Program {
        let state = self.table.path(&format!("state-of-{user}"));
        let state = format!("XDG_STATE_HOME={}", state.display());
        let executable = executable().display().to_string();
        let line = [&[state.as_str(), executable.as_str()], words].concat();
        Program::start(user, Path::new("/usr/bin/env"), line).unwrap()
    }

    fn host(&self, options: &[&str]) -> (Program, Listening) {
        let model = self.table.subject.file.display().to_string();
        let words = [&["server", "host", &model, "--json"], options].concat();
        let mut host = self.start("host", &words);
        let listening = host.json("listen", SOON).unwrap();
        (host, listening)
    }

    /// A participant that stays until it is asked to leave.
    fn join(&self, user: &str, link: &str, options: &[&str]) -> Program {
        let words = ["client", "join", link, "--json", "--no-realtime"];
        self.start(user, &[&words, options].concat())
    }

    /// A script of a probe of 5 mm that moves between two heights above the block, which is 40 mm high.
    fn script(&self, from_mm: f64, to_mm: f64) -> String {
        let path = self.table.path(&format!("script-{from_mm}-{to_mm}.toml"));
        let way = |t: f64, z: f64| format!("[[way]]\nt_s = {t:?}\nat_mm = [50.0, 50.0, {z:?}]\n");
        let waypoints = [
            way(0.0, from_mm),
            way(0.5, to_mm),
            way(1.0, to_mm),
            way(1.5, from_mm),
        ];
        let head = "format = \"palpate-script/1\"\n[tool]\nkind = \"probe\"\nradius_mm = 5.0\n";
        std::fs::write(&path, format!("{head}{}", waypoints.concat())).unwrap();
        path.display().to_string()
    }
}

fn says(program: &mut Program, phrase: &str) {
    let began = Instant::now();
    while !program.has_said(phrase) {
        program.check_alive().unwrap();
        assert!(
            began.elapsed() < SOON,
            "no \"{phrase}\": {}",
            program.tail()
        );
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Waits for a program to fail; returns its last lines.
fn failed(mut program: Program) -> String {
    let status = program.wait(SOON).unwrap();
    std::thread::sleep(Duration::from_millis(200));
    assert!(!status.success(), "{}", program.tail());
    program.tail()
}

fn left(mut program: Program) -> Summary {
    program.wait_for_success(SOON).unwrap();
    program.last_json("a summary").unwrap()
}

#[test]
fn script_starts_at_joining() {
    let _alone = alone();
    let users = UserTable::new();
    let (_host, listening) = users.host(&["--listen", "127.0.0.1:0"]);
    let link = &listening.links["trainee"];
    let script = users.script(60.0, 36.0);
    let mut first = users.join("ann", link, &["--name", "ann", "--script", &script]);
    says(&mut first, "joined as ann");
    // The session runs for longer than the script.
    std::thread::sleep(Duration::from_secs(3));
    let options = ["--name", "bob", "--duration", "6", "--script", &script];
    let late = left(users.join("bob", link, &options));
    assert!(late.force_max_n > 0.05, "{late}");
    assert_eq!(late.nearest_mm, None);
    let together = [&options[..], &["--at", "session"]].concat();
    let over = left(users.join("bob", link, &together));
    assert_eq!(over.force_max_n, 0.0, "the session's script is over");
}

#[test]
fn tool_without_contact_is_reported_with_its_distance() {
    let _alone = alone();
    let users = UserTable::new();
    let (_host, listening) = users.host(&["--listen", "127.0.0.1:0"]);
    let script = users.script(70.0, 57.0);
    let options = ["--name", "ann", "--duration", "5", "--script", &script];
    let summary = left(users.join("ann", &listening.links["trainee"], &options));
    let nearest = summary.nearest_mm.unwrap();
    // 17 mm above the block minus the radius; the hand follows the script through a spring.
    assert!((nearest - 12.0).abs() < 1.5, "{nearest}");
    let text = summary.to_string();
    assert!(
        text.contains("touched nothing") && text.contains(" mm"),
        "{text}"
    );
}

#[test]
fn host_restart_keeps_identity_and_links() {
    let _alone = alone();
    let users = UserTable::new();
    let (mut host, first) = users.host(&["--listen", "127.0.0.1:0"]);
    says(&mut host, "preparing the model");
    host.kill();
    let port = first.listening.port().to_string();
    let at = format!("127.0.0.1:{port}");
    let (mut host, second) = users.host(&["--listen", &at]);
    assert_eq!(first.links, second.links);
    let spectator = &first.links["spectator"];
    left(users.join("eve", spectator, &["--duration", "1"]));
    let mut stays = users.join("eve", spectator, &["--reconnect", "3600"]);
    says(&mut stays, "joined as");
    host.kill();
    let (_other, _) = users.host(&["--listen", &at, "--identity", "new"]);
    let said = failed(stays);
    assert!(
        said.contains("certificate") && said.contains("link"),
        "{said}"
    );
}

#[test]
fn killed_host_continues_with_its_cuts_and_its_client_joins_again() {
    let _alone = alone();
    let users = UserTable::new();
    let file = users.table.path("lesson.cuts").display().to_string();
    let (mut host, first) = users.host(&["--listen", "127.0.0.1:0", "--session", &file]);
    let [_, script] = users
        .table
        .scripts(6.0)
        .map(|path| path.display().to_string());
    let options = ["--name", "ann", "--script", &script];
    let mut ann = users.join("ann", &first.links["trainee"], &options);
    says(&mut host, "made a cut");
    // The file is written some milliseconds later.
    std::thread::sleep(Duration::from_millis(300));
    host.kill();
    let said = host.tail();
    assert!(!said.contains("continuing"), "{said}");
    let at = format!("127.0.0.1:{}", first.listening.port());
    let options = ["--listen", &at, "--session", &file];
    let (mut host, _) = users.host(&options);
    assert!(
        host.has_said("continuing with the 1 cuts"),
        "{}",
        host.tail()
    );
    says(&mut host, "ann joined");
    says(&mut ann, "joining again");
    // Longer than her replica and the rest of her script take.
    std::thread::sleep(Duration::from_secs(8));
    ann.ask_to_end();
    let ann = left(ann);
    host.ask_to_end();
    host.wait_for_success(SOON).unwrap();
    let summary: HostSummary = host.last_json("a summary").unwrap();
    assert_eq!(summary.are_cuts_kept, Some(true));
    assert!(summary.topology_version > 0);
    assert_eq!(ann.topology_hash, summary.topology_hash);
    let (mut host, _) = users.host(&[&options[..], &["--duration", "1"]].concat());
    host.wait_for_success(SOON).unwrap();
    let again: HostSummary = host.last_json("a summary").unwrap();
    let state = |s: &HostSummary| (s.topology_version, s.topology_hash.clone());
    assert_eq!(state(&again), state(&summary));
}

#[test]
fn rejoin_after_crash_keeps_the_seat_of_the_same_user_only() {
    let _alone = alone();
    let users = UserTable::new();
    let (_host, listening) = users.host(&["--listen", "127.0.0.1:0"]);
    let link = &listening.links["spectator"];
    let mut first = users.join("ann", link, &["--name", "ann"]);
    says(&mut first, "joined as ann");
    // Of two simultaneous programs the second one gets no seat.
    let said = failed(users.join("ann", link, &["--name", "ann"]));
    assert!(said.contains("already in the session"), "{said}");
    let number = |summary: &Summary| summary.participant;
    first.kill();
    let said = failed(users.join("eve", link, &["--name", "ann"]));
    assert!(said.contains("\"ann\""), "{said}");
    let again = left(users.join("ann", link, &["--name", "ann", "--duration", "1"]));
    assert_eq!(number(&again), 1, "the seat of the run that crashed");
    let seats: PathBuf = users.table.path("state-of-ann").join("palpate/seats");
    assert_eq!(std::fs::read_dir(seats).unwrap().count(), 0, "it left");
    let next = left(users.join("eve", link, &["--name", "ann", "--duration", "1"]));
    assert_eq!(number(&next), 2, "the name is free");
}

#[test]
fn slice_outside_the_model_error_names_the_range() {
    let users = UserTable::new();
    let model = users.table.subject.file.display().to_string();
    let png = users.table.path("m.png").display().to_string();
    let words = [
        "server", "inspect", &model, "--png", &png, "--slice", "z=580",
    ];
    let said = failed(users.start("ann", &words));
    assert!(said.contains("0.0 to 40.0 mm"), "{said}");
}
