use palpate_client::Summary;
use palpate_server::host::HostSummary;

use super::{Expected, INSERTION_APART_MS};
use crate::cpu::CpuRow;
use crate::delay_figures::DelayFigures;
use crate::dropout::Dropouts;
use crate::force_error::ForceError;
use crate::insertions::Insertions;
use crate::reference::Quality;
use crate::report::{CutLateness, ParticipantReport, ReferenceReport, Report};

const EXPECTED: Expected<'_> = Expected {
    trainees: &["holder", "cutter"],
    others: &["spectator"],
    strokes: 1,
    insertions: 0,
    delay_limit_ms: Some(20.0),
    is_covered: true,
};

fn participant(name: &str) -> ParticipantReport {
    let summary = Summary {
        name: name.to_owned(),
        topology_hash: "00000000000000aa".to_owned(),
        topology_version: 1,
        cuts: 1,
        force_max_n: 1.0,
        ticks: 20_000,
        ..Summary::default()
    };
    let error = ForceError {
        rms_percent: 2.0,
        ..ForceError::default()
    };
    ParticipantReport {
        dropouts: Some(Dropouts::default()),
        recording_gap_ms: Some(4.0),
        ..ParticipantReport::of(summary, Some(error))
    }
}

fn server() -> HostSummary {
    HostSummary {
        topology_hash: "00000000000000aa".to_owned(),
        topology_version: 1,
        ..HostSummary::default()
    }
}

/// A report that passes every criterion.
fn good() -> Report {
    let names = ["holder", "cutter", "spectator"];
    let cpu = names.iter().chain(&["server"]).map(|name| CpuRow {
        process: (*name).to_owned(),
        ..CpuRow::default()
    });
    let mut report = Report {
        participants: names.map(participant).into(),
        cpu: cpu.collect(),
        delay: Some(DelayFigures {
            median_ms: 5.0,
            max_ms: 12.0,
        }),
        reference: Some(ReferenceReport {
            quality: Quality {
                residual_max: 0.01,
                error_percent: [1.0, 1.5],
                ..Quality::default()
            },
            ..ReferenceReport::default()
        }),
        server: server(),
        ..Report::default()
    };
    report.cut.operations = 1;
    report.cut.boundary_closed = true;
    let late = |name: &str| CutLateness {
        participant: name.to_owned(),
        parts: 9,
        p50_ms: 40.0,
        ..CutLateness::default()
    };
    report.cut.late_ms = names.map(late).into();
    report
}

/// The criteria that fail.
fn failed(report: &mut Report) -> Vec<String> {
    report.judge(&EXPECTED);
    let failed: Vec<String> = report
        .criteria
        .iter()
        .filter(|c| !c.ok)
        .map(|c| c.criterion.clone())
        .collect();
    assert_eq!(report.ok, failed.is_empty());
    let text = report.to_string();
    for criterion in &report.criteria {
        assert_eq!(
            text.contains(&criterion.to_string()),
            !criterion.ok,
            "{criterion}\n{text}"
        );
    }
    failed
}

#[track_caller]
fn fails(spoil: impl FnOnce(&mut Report), criteria: &[&str]) {
    let mut report = good();
    spoil(&mut report);
    assert_eq!(failed(&mut report), criteria);
}

#[test]
fn good_report_passes_and_lists_every_criterion_in_json() {
    let mut report = good();
    assert_eq!(failed(&mut report), [""; 0]);
    let json = serde_json::to_value(&report).unwrap();
    let all = json["criteria"].as_array().unwrap();
    assert_eq!(all.len(), 22);
    for criterion in all {
        assert_eq!(criterion["ok"], true);
        assert!(criterion["value"].is_number() && criterion["limit"].is_number());
        assert!(criterion["criterion"].is_string());
    }
}

#[test]
fn lost_force_fails() {
    fails(
        |r| r.participants[1].force_error_rms = Some(10.2),
        &["force error of the cutter"],
    );
    fails(
        |r| r.participants[0].dropouts.as_mut().unwrap().longest_ms = 41.0,
        &["longest dropout of the holder"],
    );
    fails(
        |r| r.participants[0].summary.force_max_n = 0.0,
        &["largest force on the holder"],
    );
    fails(
        |r| r.participants[1].recording_gap_ms = Some(100.0),
        &["longest gap in the recorded force of the cutter"],
    );
}

#[test]
fn dropout_limit_under_stress_is_60_ms() {
    for (stress, longest_ms, ok) in [(0, 50.0, false), (2, 50.0, true), (2, 61.0, false)] {
        let mut report = good();
        report.stress = stress;
        report.participants[0].dropouts.as_mut().unwrap().longest_ms = longest_ms;
        assert_eq!(failed(&mut report).is_empty(), ok, "{stress} {longest_ms}");
    }
}

#[test]
fn large_delay_and_demotion_fail_if_judged() {
    let late = |r: &mut Report| r.delay.as_mut().unwrap().max_ms = 326.0;
    fails(late, &["largest playout delay D"]);
    fails(|r| r.server.demotions = 1, &["demotions to spectator"]);
    fails(
        |r| r.participants[1].summary.demotions = 1,
        &["demotions to spectator"],
    );
    let mut report = good();
    late(&mut report);
    report.server.demotions = 1;
    report.judge(&Expected {
        delay_limit_ms: None,
        is_covered: false,
        ..EXPECTED
    });
    assert!(report.ok, "{report}");
}

#[test]
fn missing_cut_fails() {
    fails(|r| r.cut.operations = 0, &["lost cuts"]);
    fails(|r| r.participants[2].summary.cuts = 0, &["lost cuts"]);
    fails(
        |r| r.participants[0].summary.topology_hash = "other".to_owned(),
        &["topologies that differ from the server's"],
    );
    fails(|r| r.cut.boundary_closed = false, &["open outer surfaces"]);
    let behind = ["cuts behind the blade, seen by the cutter"];
    fails(|r| r.cut.late_ms[1].p50_ms = 1000.0, &behind);
    fails(|r| r.cut.late_ms[1].parts = 0, &behind);
    fails(|r| drop(r.cut.late_ms.remove(1)), &behind);
}

#[test]
fn insertion_that_a_site_misses_fails() {
    let seen = |name: &str, count, apart_ms| Insertions {
        participant: name.to_owned(),
        count,
        apart_ms,
    };
    let failed = |holder: usize, cutter: Option<f64>| {
        let mut report = good();
        report.insertions = vec![
            seen("holder", holder, Some(0.0)),
            seen("cutter", 2, cutter),
            seen("spectator", 1, Some(20.0)),
        ];
        report.judge(&Expected {
            insertions: 2,
            ..EXPECTED
        });
        let failed = report.criteria.into_iter().filter(|c| !c.ok);
        failed.map(|c| c.criterion).collect::<Vec<_>>()
    };
    assert_eq!(failed(2, Some(INSERTION_APART_MS)), [""; 0]);
    assert_eq!(
        failed(1, Some(INSERTION_APART_MS)),
        ["insertions of the needle"]
    );
    for apart in [Some(INSERTION_APART_MS + 1.0), None] {
        let missed = "disagreement on the insertion, seen by the cutter";
        assert_eq!(failed(2, apart), [missed]);
    }
}

#[test]
fn dead_process_fails_with_all_its_missing_figures() {
    fails(
        |r| {
            r.problems.push("the client cutter ended early".to_owned());
            r.participants.remove(1);
            r.cpu.remove(1);
        },
        &[
            "force error of the cutter",
            "longest dropout of the cutter",
            "largest force on the cutter",
            "longest gap in the recorded force of the cutter",
            "processes that died",
            "participants without figures",
            "processes without CPU figures",
        ],
    );
}

#[test]
fn each_missing_figure_fails() {
    fails(
        |r| r.participants[0].force_error_rms = None,
        &["force error of the holder"],
    );
    fails(
        |r| r.participants[0].force_error_rms = Some(f64::NAN),
        &["force error of the holder"],
    );
    fails(
        |r| r.participants[1].dropouts = None,
        &["longest dropout of the cutter"],
    );
    fails(
        |r| r.participants[1].recording_gap_ms = None,
        &["longest gap in the recorded force of the cutter"],
    );
    fails(|r| r.delay = None, &["largest playout delay D"]);
    fails(
        |r| r.participants[2].records_dropped = 7,
        &["records dropped from full recordings"],
    );
    for process in 0..4 {
        fails(
            |r| drop(r.cpu.remove(process)),
            &["processes without CPU figures"],
        );
    }
    fails(
        |r| r.reference = None,
        &[
            "largest residual of the reference",
            "distance of a cut from the reference's",
            "estimated error of the reference",
        ],
    );
    fails(
        |r| r.reference.as_mut().unwrap().cut_apart_mm = 2.5,
        &["distance of a cut from the reference's"],
    );
    fails(
        |r| r.reference.as_mut().unwrap().quality.residual_max = 0.2,
        &["largest residual of the reference"],
    );
    fails(
        |r| r.reference.as_mut().unwrap().quality.error_percent[1] = 7.0,
        &["estimated error of the reference"],
    );
}

#[test]
fn empty_session_fails_nearly_every_criterion() {
    let mut report = Report {
        server: server(),
        ..Report::default()
    };
    let failed = failed(&mut report);
    assert!(failed.len() >= 15, "{failed:?}");
}

#[test]
fn failed_criterion_prints_value_and_limit() {
    let mut report = good();
    report.participants[0].force_error_rms = Some(47.25);
    report.participants[1].force_error_rms = None;
    report.judge(&EXPECTED);
    let text = report.to_string();
    for line in [
        "FAILED: force error of the holder, 47.2 %, limit at most 10 %",
        "FAILED: force error of the cutter, missing, limit at most 10 %",
    ] {
        assert!(text.lines().any(|l| l == line), "{text}");
    }
}
