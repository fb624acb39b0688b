//! The main job, through the program: a short demo on a small model.

#![allow(clippy::unwrap_used)]

mod table;

use std::process::Command;

use palpate_lab::report::Report;

use table::{Table, executable};

fn demo(table: &Table, profile: &str, seconds: &str) -> Report {
    let report_dir = table.path("report");
    let out = Command::new(executable())
        .args(["demo", "--json", "--seconds", seconds, "--profile", profile])
        .args(["--seed", "3", "--late-join", "0.65", "--model"])
        .arg(&table.subject.file)
        .arg("--report")
        .arg(&report_dir)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    let text = String::from_utf8_lossy(&out.stdout);
    let report: Report =
        serde_json::from_str(&text).unwrap_or_else(|e| panic!("{e}: {text}\n{said}"));
    assert!(report.ok && out.status.success(), "{report}\n{said}");
    for file in [
        "report.json",
        "report.txt",
        "report.html",
        "force.svg",
        "view_disagreement.svg",
    ] {
        let size = std::fs::metadata(report_dir.join(file)).unwrap().len();
        assert!(size > 300, "{file} has {size} B");
    }
    report
}

#[test]
fn two_trainees_and_a_late_spectator_share_one_cut_tissue() {
    let table = Table::new();
    let report = demo(&table, "lan", "6");
    let names: Vec<&str> = report
        .participants
        .iter()
        .map(|p| p.name.as_str())
        .collect();
    assert_eq!(names, ["holder", "cutter", "spectator"]);
    for p in &report.participants {
        assert_eq!(p.topology_hash, report.server.topology_hash, "{}", p.name);
        assert_eq!(p.topology_version, report.server.topology_version);
    }
    assert!(report.cut.operations >= 1 && report.cut.boundary_closed);
    assert!(
        report.participants[..2]
            .iter()
            .all(|p| p.force_error_rms.is_some())
    );
    assert!(report.view_disagreement_mm.count > 0);
    assert_eq!((report.network.dropped, report.network.reordered), (0, 0));
}

#[test]
fn over_a_lossy_network_everybody_has_the_same_tissue_in_the_end() {
    let table = Table::new();
    let report = demo(&table, "lossy", "5");
    assert!(report.network.dropped > 0 && report.network.reordered > 0);
}
