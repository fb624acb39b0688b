//! Attacks through the program, short and on a small model.
//!
//! Criteria that depend on machine load are not asserted here.

#![allow(clippy::unwrap_used)]

mod table;

use std::process::Command;

use serde_json::Value;

use table::{Table, alone, executable};

#[test]
fn an_attack_reports_every_figure_and_its_verdict() {
    let _alone = alone();
    let table = Table::new();
    let out = Command::new(executable())
        .args(["attack", "names", "handshakes", "--seconds", "4", "--json"])
        .arg("--model")
        .arg(&table.subject.file)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    let report: Value =
        serde_json::from_slice(&out.stdout).unwrap_or_else(|e| panic!("{e}: {said}"));
    assert_eq!(report["ok"], out.status.success(), "{said}");
    let run = &report["runs"][0];
    assert_eq!(run["problems"], Value::Array(Vec::new()), "{said}");
    for figure in [
        &run["hands"][0]["force_error_percent"],
        &run["hands"][1]["longest_dropout_ms"],
        &run["delay"]["median_ms"],
        &run["memory"]["largest_mb"],
        &run["recovery"]["delay_s"],
        &run["recovery"]["newcomer_s"],
    ] {
        assert!(figure.is_number(), "{run:#}");
    }
    assert_eq!(run["newcomers"]["attempts"], 2);
    let [names, handshakes] = [0, 1].map(|i| &run["achieved"][i][1]);
    let of = |counts: &Value, what: &str| counts[what].as_u64().unwrap_or(0);
    let tried = of(names, "false names accepted") + of(names, "false names refused");
    assert!(tried > 0, "{names}");
    let begun =
        of(handshakes, "handshakes begun") + of(handshakes, "handshakes with a proven address");
    assert!(begun > 10, "{handshakes}");
    // The session without attack has no attackers.
    assert_eq!(report["base"]["achieved"], Value::Array(Vec::new()));
}

#[test]
fn bad_pages_are_ended_or_refused_beside_an_honest_page() {
    let _alone = alone();
    let table = Table::new();
    let out = Command::new(executable())
        .args(["attack", "bad-pages", "--seconds", "4", "--json"])
        .arg("--model")
        .arg(&table.subject.file)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    let report: Value =
        serde_json::from_slice(&out.stdout).unwrap_or_else(|e| panic!("{e}: {said}"));
    let counts = &report["runs"][0]["achieved"][0][1];
    let of = |what: &str| counts[what].as_u64().unwrap_or(0);
    for what in [
        "joined",
        "full shapes",
        "pongs",
        "pages ended by the server",
        "foreign origins refused",
        "states with markup as text",
    ] {
        assert!(of(what) > 0, "{what}: {counts}");
    }
    for what in [
        "broken shapes",
        "foreign origins accepted",
        "annotations of a spectator shown",
        "honest pages ended by the server",
    ] {
        assert_eq!(of(what), 0, "{what}: {counts}");
    }
}

#[test]
fn list_names_every_attack_and_unknown_names_are_rejected() {
    let run = |line: &[&str]| Command::new(executable()).args(line).output().unwrap();
    let list = run(&["attack", "--list"]);
    assert!(list.status.success());
    let text = String::from_utf8_lossy(&list.stdout).into_owned();
    for attack in palpate_lab::attack::kinds::ALL {
        assert!(text.contains(attack.about), "{text}");
    }
    let unknown = run(&["attack", "handshake"]);
    assert_eq!(unknown.status.code(), Some(2));
    let said = String::from_utf8_lossy(&unknown.stderr);
    assert!(said.contains("did you mean \"handshakes\"?"), "{said}");
}
