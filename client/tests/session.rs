//! The whole client against a hand-written server over real quinn on the loopback interface.
//! Nothing here asserts how fast it is.
#![allow(clippy::unwrap_used)]

mod fake_server;
mod stand_in;

use std::path::Path;
use std::time::Duration;

use fake_server::{Fake, ME_AGAIN, Manner};
use palpate_client::{ClientError, DeviceKind, JoinOptions, Recording, Sources, Summary};
use palpate_protocol::{CertificateHash, Role};

fn read(path: &Path) -> Recording {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn a_session_is_joined_felt_recorded_and_left() {
    let fake = Fake::start(Manner::Plays, false);
    let record = fake.directory.path().join("run.json");
    let options = JoinOptions {
        record: Some(record.clone()),
        duration: Some(Duration::from_secs(3)),
        ..fake.options()
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!(
        (summary.operations, summary.cuts, summary.topology_version),
        (2, 1, 1)
    );
    assert!(summary.ticks > 0 && summary.haptic_solves > 0 && summary.view_solves > 0);
    // The press of the script is felt with 0.34 N; a tool that is stuck elsewhere with a millionth of that.
    assert!(
        summary.force_max_n > 0.1 && summary.rtt_ms.is_some(),
        "{summary}"
    );
    assert_eq!(summary.compensation_ms, 30.0);
    let recording = read(&record);
    assert_eq!((recording.name.as_str(), recording.participant), ("Ada", 1));
    assert!(recording.script_started_us.is_some());
    assert!(!recording.haptic.is_empty());
    let kinds: Vec<&str> = recording
        .operations
        .iter()
        .map(|o| o.kind.as_str())
        .collect();
    assert_eq!(kinds, ["started", "cut"]);
    assert_eq!(recording.operations[1].hash, summary.topology_hash);
    let last = recording.views.last().unwrap();
    assert_eq!((last.topology_version, last.delay_us), (1, 30_000));
    assert!(!last.nodes.is_empty() && last.tools[0].participant == 1);
    fake.stop();
}

#[test]
fn a_damaged_model_is_noticed_and_named() {
    let fake = Fake::start(Manner::Plays, true);
    let error = palpate_client::run(&fake.options()).unwrap_err();
    assert!(matches!(error, ClientError::ModelDamaged { .. }), "{error}");
    fake.stop();
}

#[test]
fn a_refusal_is_passed_on_with_its_sentence() {
    let fake = Fake::start(Manner::IsFull, false);
    let options = JoinOptions {
        reconnect: Duration::from_secs(1),
        ..fake.options()
    };
    let error = palpate_client::run(&options).unwrap_err();
    assert!(
        error.to_string().contains("all 1 seats for the role"),
        "{error}"
    );
    fake.stop();
}

#[test]
fn another_certificate_and_a_missing_script_are_refused_here() {
    let fake = Fake::start(Manner::Plays, false);
    let mut options = fake.options();
    options.script = None;
    let error = palpate_client::run(&options).unwrap_err();
    assert!(error.to_string().contains("--script"), "{error}");
    let mut link = fake.link.clone();
    link.certificate = CertificateHash([0; 32]);
    options = JoinOptions {
        link: link.to_string(),
        ..fake.options()
    };
    let error = palpate_client::run(&options).unwrap_err();
    assert!(error.to_string().contains("certificate"), "{error}");
    fake.stop();
}

#[test]
fn a_replica_that_differs_resyncs_in_the_same_seat() {
    let fake = Fake::start(Manner::Errs, false);
    let options = JoinOptions {
        duration: Some(Duration::from_secs(5)),
        ..fake.options()
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!((summary.resyncs, summary.reconnects), (1, 0));
    assert_eq!((summary.topology_version, summary.cuts), (1, 1));
    assert!(summary.events.link_lost > 0, "no force meanwhile");
    fake.stop();
}

#[test]
fn a_copy_that_differs_again_ends_the_session() {
    let fake = Fake::start(Manner::Lies, false);
    let error = palpate_client::run(&fake.options()).unwrap_err();
    assert!(matches!(error, ClientError::Diverged { .. }), "{error}");
    assert!(
        error
            .to_string()
            .contains("your replica differs from the server"),
        "{error}"
    );
    assert!(error.to_string().contains("differs again"), "{error}");
    assert_eq!(error.summary().unwrap().resyncs, 1);
    fake.stop();
}

#[test]
fn a_goodbye_is_a_normal_end() {
    let fake = Fake::start(Manner::SaysGoodbye, false);
    let summary = palpate_client::run(&fake.options()).unwrap();
    assert!(
        summary.ended.contains("that is all for today"),
        "{}",
        summary.ended
    );
    fake.stop();
}

#[test]
fn a_server_that_dies_is_said_and_the_figures_are_kept() {
    let fake = Fake::start(Manner::Dies, false);
    let options = JoinOptions {
        reconnect: Duration::from_secs(1),
        ..fake.options()
    };
    let error = palpate_client::run(&options).unwrap_err();
    assert!(matches!(error, ClientError::ServerLost { .. }), "{error}");
    assert!(error.summary().unwrap().ticks > 0);
    fake.stop();
}

#[test]
fn reconnect_keeps_seat_and_replica() {
    let fake = Fake::start(Manner::LosesIt, false);
    let options = JoinOptions {
        duration: Some(Duration::from_secs(5)),
        ..fake.options()
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!(summary.reconnects, 1);
    assert_eq!((summary.operations, summary.cuts), (3, 1));
    assert_eq!(summary.topology_version, 1);
    assert!(summary.events.link_lost > 0, "no force without a server");
    fake.stop();
}

#[test]
fn spectator_without_a_seat_joins_again() {
    let fake = Fake::start(Manner::LosesSeat, false);
    let mut link = fake.link.clone();
    link.role = Role::Spectator;
    let options = JoinOptions {
        duration: Some(Duration::from_secs(6)),
        ..JoinOptions::new(link.to_string(), "Eve")
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!(summary.participant, ME_AGAIN.0);
    assert_eq!((summary.reconnects, summary.resyncs), (1, 1));
    assert_eq!((summary.topology_version, summary.cuts), (1, 1));
    fake.stop();
}

#[test]
fn who_only_looks_needs_no_script_and_sees_the_cut() {
    let fake = Fake::start(Manner::Plays, false);
    let record = fake.directory.path().join("view.json");
    let mut link = fake.link.clone();
    link.role = Role::Spectator;
    let options = JoinOptions {
        record: Some(record.clone()),
        duration: Some(Duration::from_secs(2)),
        ..JoinOptions::new(link.to_string(), "Eve")
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!((summary.ticks, summary.haptic_solves), (0, 0));
    assert_eq!((summary.cuts, summary.device.as_str()), (1, "none"));
    assert!(!read(&record).views.is_empty());
    fake.stop();
}

/// The program itself, because signals go to a whole process.
#[cfg(unix)]
#[test]
fn a_signal_ends_the_program_politely_with_its_summary_as_json() {
    use std::io::{BufRead, BufReader};
    use std::process::{Command, Stdio};

    let fake = Fake::start(Manner::Plays, false);
    let mut child = Command::new(env!("CARGO_BIN_EXE_palpate-client"))
        .args([
            "join",
            &fake.link.to_string(),
            "--json",
            "--forget-seat",
            "--name",
            "Ada",
            "--script",
        ])
        .arg(fake.script())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut status = BufReader::new(child.stderr.take().unwrap()).lines();
    let joined = status.find(|line| line.as_ref().unwrap().starts_with("joined as Ada"));
    assert!(joined.is_some());
    let pid = child.id().to_string();
    assert!(
        Command::new("kill")
            .args(["-TERM", &pid])
            .status()
            .unwrap()
            .success()
    );
    // The rest of the status has to go somewhere.
    assert!(status.all(|line| line.is_ok()));
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let summary: Summary = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (summary.name.as_str(), summary.ended.as_str()),
        ("Ada", "you left")
    );
    fake.stop();
}

#[test]
fn a_device_in_use_joins_without_a_script() {
    for (kind, source, called) in [
        (DeviceKind::Dhd, "drd.rs", "omega.7"),
        (DeviceKind::OpenHaptics, "hd.rs", "Touch"),
        // Connected devices are found.
        (DeviceKind::Auto, "drd.rs", "omega.7"),
    ] {
        let fake = Fake::start(Manner::Plays, false);
        let library = stand_in::compiled(source, fake.directory.path());
        let options = JoinOptions {
            device: kind,
            sources: Sources {
                libhd: Some(library.clone()),
                libdrd: Some(library),
                ..Sources::default()
            },
            script: None,
            duration: Some(Duration::from_secs(1)),
            ..fake.options()
        };
        let summary = palpate_client::run(&options).unwrap();
        assert_eq!(summary.device, called);
        assert!(summary.ticks > 0, "{summary}");
        assert_eq!(
            (summary.events.faulted, summary.events.bad_samples),
            (0, 0),
            "{summary}"
        );
        fake.stop();
    }
}

#[test]
fn pointer_joins_with_a_view_only() {
    let fake = Fake::start(Manner::Plays, false);
    let pointer = |kind, view: Option<&str>| JoinOptions {
        device: kind,
        view: view.map(|address| address.parse().unwrap()),
        script: None,
        duration: Some(Duration::from_secs(1)),
        ..fake.options()
    };
    // Before the server is contacted: it would wait for this client.
    let error = palpate_client::run(&pointer(DeviceKind::Pointer, None)).unwrap_err();
    assert_eq!(error.exit_code(), 2);
    let message = error.to_string();
    assert!(
        message.contains("the device pointer needs --view"),
        "{message}"
    );
    let summary = palpate_client::run(&pointer(DeviceKind::Pointer, Some("127.0.0.1:0"))).unwrap();
    assert_eq!(summary.device, "pointer");
    assert!(summary.ticks > 0, "{summary}");
    // Without its handle the device would be unplugged.
    assert_eq!(
        (summary.events.faulted, summary.events.bad_samples),
        (0, 0),
        "{summary}"
    );
    fake.stop();
}
