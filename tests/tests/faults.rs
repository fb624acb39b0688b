//! Faults in a running session stay local.

#![allow(clippy::unwrap_used)]

mod table;

use std::net::{SocketAddr, UdpSocket};
use std::process::Command;
use std::time::Duration;

use palpate_client::realtime::{RealtimeConfig, monotonic_now};
use palpate_client::recording::HapticPoint;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{HapticDevice, Script};
use palpate_haptics::{Chain, ChainConfig};
use palpate_lab::program::Program;
use palpate_lab::scripts::STROKE_SHARES;
use palpate_tissue::Vec3;

use table::{Table, alone, executable};

const SOON: Duration = Duration::from_secs(30);

fn sleep(seconds: f64) {
    std::thread::sleep(Duration::from_secs_f64(seconds));
}

/// Time from both trainees being in the session until the middle of the stroke, s.
fn until_stroke(seconds: f64) -> f64 {
    1.0 + seconds * f64::midpoint(STROKE_SHARES.0, STROKE_SHARES.1)
}

#[test]
fn client_killed_mid_stroke_leaves_within_two_seconds() {
    let _alone = alone();
    let table = Table::new();
    let session = table.host("metro", 2);
    let [holder, mut cutter] = table.trainees(&session, 6.0);
    sleep(until_stroke(6.0));
    cutter.program.kill();
    let killed_us = monotonic_now().as_micros();
    sleep(3.5);
    holder.program.ask_to_end();
    let left = holder.leave().unwrap();
    let (host, _) = session.end().unwrap();
    let me = left.recording.participant;
    let views = &left.recording.views;
    let shows_other = |since_s: f64, until_s: f64| {
        let from = killed_us + (since_s * 1e6) as i64;
        let until = killed_us + (until_s * 1e6) as i64;
        let within = views.iter().filter(|v| (from..until).contains(&v.shown_us));
        let counts = within.map(|v| v.tools.iter().filter(|t| t.participant != me && !t.stale));
        counts.map(Iterator::count).collect::<Vec<_>>()
    };
    assert!(shows_other(-1.0, 0.0).contains(&1), "it was there before");
    let after = shows_other(2.2, 3.5);
    assert!(after.len() > 10, "views went on: {}", after.len());
    assert!(after.iter().all(|n| *n == 0), "{after:?}");
    assert_eq!(left.summary.topology_hash, host.topology_hash);
    assert!(
        left.summary.ticks > 3000,
        "the hand went on: {}",
        left.summary.ticks
    );
}

/// Maximum force change per tick of a client chain with a simulated hand, N.
fn slew_step_n() -> f64 {
    let script = Script::resting_probe(Vec3::zeros(), 0.004).unwrap();
    let hand = SimHand::new(script, ScriptStart::not_yet());
    Chain::new(ChainConfig::default(), hand.caps()).slew_step_n()
}

#[test]
fn client_stopped_in_contact_continues_without_a_force_step() {
    let _alone = alone();
    let table = Table::new();
    let session = table.host("lan", 1);
    let [script, _] = table.scripts(6.0);
    let dir = table.dir.path();
    let mut holder = session
        .join("holder", "trainee", Some(&script), dir)
        .unwrap();
    holder.wait_until_in(&|| false).unwrap();
    // The first press lasts from 2.2 to 4.6 s; the second one begins at 5.5 s.
    sleep(3.2);
    holder.program.stand_still();
    sleep(0.3);
    holder.program.go_on();
    let went_on_us = monotonic_now().as_micros();
    sleep(4.0);
    holder.program.ask_to_end();
    let left = holder.leave().unwrap();
    let (host, _) = session.end().unwrap();

    let (events, step_n) = (left.summary.events, slew_step_n());
    let largest = events.max_delta_force_n;
    assert!(
        largest > 0.0 && largest <= step_n * (1.0 + 1e-9),
        "a step of {largest} N"
    );
    assert!(left.summary.missed >= 250, "{} missed", left.summary.missed);
    // The recording has every few ticks; they obey the limit too, also across the pause.
    let hand = &left.recording.haptic;
    let between_n = step_n * f64::from(RealtimeConfig::default().trace_every) * (1.0 + 1e-9);
    for pair in hand.windows(2) {
        let step = (Vec3::from(pair[1].force_n) - Vec3::from(pair[0].force_n)).norm();
        assert!(step <= between_n, "{step} N between {pair:?}");
    }
    let is_pause = |w: &[HapticPoint]| w[1].t_us - w[0].t_us > 250_000 && w[0].t_us < went_on_us;
    assert!(hand.windows(2).any(is_pause), "nothing ran meanwhile");
    let largest_n = |since_us: i64, until_us: i64| {
        let within = hand
            .iter()
            .filter(|p| (since_us..until_us).contains(&p.t_us));
        within
            .map(|p| Vec3::from(p.force_n).norm())
            .fold(0.0, f64::max)
    };
    assert!(
        largest_n(i64::MIN, went_on_us - 250_000) > 0.1,
        "it pressed before"
    );
    assert!(
        largest_n(went_on_us + 250_000, i64::MAX) > 0.1,
        "and presses again"
    );
    assert_eq!(left.summary.topology_hash, host.topology_hash);
}

#[test]
fn clients_remove_the_force_after_a_server_crash() {
    let _alone = alone();
    let table = Table::new();
    let mut session = table.host("lan", 2);
    let link = session.link("trainee").unwrap().to_string();
    let [holder, cutter] = table.scripts(6.0);
    let trainees = [("holder", holder), ("cutter", cutter)].map(|(name, script)| {
        let (link, script) = (&link, script.to_str().unwrap());
        let words = ["client", "join", link, "--name", name, "--reconnect", "3"];
        let together = ["--forget-seat", "--at", "session"];
        let arguments = words
            .into_iter()
            .chain(together)
            .chain(["--json", "--script", script]);
        Program::start(name, executable(), arguments).unwrap()
    });
    sleep(4.5);
    session.server.kill();
    for mut trainee in trainees {
        let status = trainee.wait(SOON).unwrap();
        sleep(0.1);
        let said = trainee.tail();
        assert!(!status.success(), "{said}");
        assert!(said.contains("LINK LOST, no force"), "{said}");
        assert!(said.contains("trying to reconnect for 3 s"), "{said}");
        assert!(said.contains("lost the connection to the server"), "{said}");
        assert!(!said.contains("panicked"), "{said}");
    }
}

#[test]
fn server_with_another_certificate_is_rejected() {
    let _alone = alone();
    let table = Table::new();
    let session = table.host("none", 1);
    let mut link = session.link("spectator").unwrap();
    link.certificate.0[0] ^= 1;
    let link = link.to_string();
    let arguments = ["client", "join", &link, "--json", "--forget-seat"];
    let mut client = Program::start("client", executable(), arguments).unwrap();
    let status = client.wait(SOON).unwrap();
    sleep(0.1);
    let said = client.tail();
    assert!(!status.success(), "{said}");
    assert!(
        said.contains("certificate") && !said.contains("panicked"),
        "{said}"
    );
}

#[test]
fn noise_at_the_port_does_not_affect_a_session() {
    let _alone = alone();
    let table = Table::new();
    let session = table.host("lan", 2);
    let [holder, cutter] = table.trainees(&session, 5.0);
    let noise = UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut x = 0x9e37_79b9_u32;
    for i in 0..3000_usize {
        let bytes: Vec<u8> = (0..i % 1400)
            .map(|_| {
                x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (x >> 24) as u8
            })
            .collect();
        // Directly to the server: the relay would give every sender an own address.
        let _ = noise.send_to(&bytes, session.listening.listening);
        std::thread::sleep(Duration::from_millis(1));
    }
    sleep(1.5);
    for participant in [&holder, &cutter] {
        participant.program.ask_to_end();
    }
    let hashes = [holder, cutter].map(|p| p.leave().unwrap().summary.topology_hash);
    let (host, _) = session.end().unwrap();
    assert_eq!(host.participants, 2);
    assert_eq!(hashes, [host.topology_hash.clone(), host.topology_hash]);
    assert_eq!(host.cuts, 1);
}

#[test]
fn occupied_port_gives_an_error_message() {
    let table = Table::new();
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address: SocketAddr = taken.local_addr().unwrap();
    let (port, there) = (address.port().to_string(), address.to_string());
    let host = Command::new(executable())
        .args(["server", "host"])
        .arg(&table.subject.file)
        .args(["--json", "--identity", "new", "--listen", &there])
        .output()
        .unwrap();
    let relay = Command::new(executable())
        .args(["relay", "--listen", &there, "--to", "127.0.0.1:9"])
        .output()
        .unwrap();
    for out in [host, relay] {
        let said = String::from_utf8_lossy(&out.stderr);
        assert_eq!(out.status.code(), Some(1), "{said}");
        assert!(said.contains(&port) && !said.contains("panicked"), "{said}");
    }
}

#[test]
fn interrupted_demo_ends_its_processes() {
    let _alone = alone();
    let table = Table::new();
    let model = table.subject.file.display().to_string();
    let arguments = [
        "demo",
        "--json",
        "--seconds",
        "60",
        "--profile",
        "lan",
        "--model",
        &model,
    ];
    let mut demo = Program::start("demo", executable(), arguments).unwrap();
    let began = std::time::Instant::now();
    while !demo.has_said("the scripts run") {
        demo.check_alive().unwrap();
        assert!(began.elapsed() < SOON, "{}", demo.tail());
        sleep(0.05);
    }
    let children = children_of(demo.id());
    assert_eq!(children.len(), 3, "a server and two trainees");
    demo.ask_to_end();
    let status = demo.wait(SOON).unwrap();
    assert_eq!(status.code(), Some(1), "{}", demo.tail());
    for child in children {
        assert!(!std::path::Path::new(&format!("/proc/{child}")).exists());
    }
}

/// Child process ids of a process.
fn children_of(parent: u32) -> Vec<u32> {
    let mut children = Vec::new();
    for task in std::fs::read_dir(format!("/proc/{parent}/task")).unwrap() {
        let list = task.unwrap().path().join("children");
        let text = std::fs::read_to_string(list).unwrap_or_default();
        children.extend(text.split_whitespace().map(|n| n.parse::<u32>().unwrap()));
    }
    children
}
