//! The main use case through the program: a short demo on a small model.
//!
//! Criteria that depend on machine load are not asserted here; a demo that runs alone is judged by them.

#![allow(clippy::unwrap_used)]

mod table;

use std::process::Command;

use palpate_lab::report::Report;

use table::{Table, executable};

/// Prefixes of the criteria that depend on machine load.
///
/// The distance of a cut is judged where the demo runs alone.
const TIMED: [&str; 7] = [
    "force error",
    "longest dropout",
    "longest gap",
    "largest playout delay",
    "demotions",
    "cuts behind the blade",
    "distance of a cut",
];

fn demo(table: &Table, profile: &str, seconds: &str, stress: u16) -> Report {
    let report_dir = table.path("report");
    let out = Command::new(executable())
        .args(["demo", "--json", "--seconds", seconds, "--profile", profile])
        .args(["--seed", "3", "--late-join", "0.65"])
        .args(["--stress", &stress.to_string(), "--model"])
        .arg(&table.subject.file)
        .arg("--report")
        .arg(&report_dir)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    let text = String::from_utf8_lossy(&out.stdout);
    let report: Report =
        serde_json::from_str(&text).unwrap_or_else(|e| panic!("{e}: {text}\n{said}"));
    assert_eq!(report.ok, out.status.success(), "{report}\n{said}");
    for criterion in &report.criteria {
        let is_timed = TIMED.iter().any(|t| criterion.criterion.starts_with(t));
        assert!(
            criterion.ok || is_timed && criterion.value.is_some(),
            "{report}\n{said}"
        );
    }
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
fn trainees_and_late_spectator_share_one_cut_tissue() {
    let table = Table::new();
    let report = demo(&table, "lan", "6", 1);
    let names: Vec<&str> = report
        .participants
        .iter()
        .map(|p| p.summary.name.as_str())
        .collect();
    assert_eq!(names, ["holder", "cutter", "spectator"]);
    for p in &report.participants {
        let p = &p.summary;
        assert_eq!(p.topology_hash, report.server.topology_hash, "{}", p.name);
        assert_eq!(p.topology_version, report.server.topology_version);
    }
    assert!(report.cut.operations >= 1 && report.cut.boundary_closed);
    assert!(
        report.participants[..2]
            .iter()
            .all(|p| p.force_error_rms.is_some())
    );
    assert!(
        report.participants[..2]
            .iter()
            .all(|p| p.dropouts.as_ref().is_some_and(|d| d.contact_s > 0.5))
    );
    assert_eq!(report.stress, 1);
    assert!(report.view_disagreement_mm.count > 0);
    assert_eq!(
        (report.network.total.dropped, report.network.total.reordered),
        (0, 0)
    );
}

#[test]
fn topologies_are_equal_after_a_lossy_session() {
    let table = Table::new();
    let report = demo(&table, "lossy", "5", 0);
    assert!(report.network.total.dropped > 0 && report.network.total.reordered > 0);
}

/// A busy process must not outlive the laboratory.
#[test]
fn busy_process_ends_with_its_parent() {
    let busy = |parent: u32| {
        Command::new(executable())
            .args(["busy", &parent.to_string()])
            .spawn()
            .unwrap()
    };
    // The id of another process, and no id.
    for parent in [1, 0] {
        assert!(busy(parent).wait().unwrap().success());
    }
    let mut of_this_process = busy(std::process::id());
    assert!(of_this_process.try_wait().unwrap().is_none());
    of_this_process.kill().unwrap();
    of_this_process.wait().unwrap();
}
