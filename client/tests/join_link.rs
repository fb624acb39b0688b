//! The join link as the program takes it, and its secret, which no other user and no output may show.
#![allow(clippy::unwrap_used)]

mod fake_server;

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::UdpSocket;
use std::process::{Child, Command, Stdio};

use fake_server::{Fake, Manner};
use palpate_client::LINK_VARIABLE;
use palpate_protocol::Role;

/// A grant in hexadecimal.
const SECRET: &str = "5ec75ec75ec75ec75ec75ec75ec75ec7";

/// A server that never answers.
struct Silent(UdpSocket);

impl Silent {
    fn new() -> Self {
        Self(UdpSocket::bind("127.0.0.1:0").unwrap())
    }

    fn link(&self) -> String {
        let address = self.0.local_addr().unwrap();
        let certificate = "0".repeat(64);
        format!("palpate://{address}/spectator?cert={certificate}&grant={SECRET}")
    }
}

fn join(words: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_palpate-client"));
    command
        .args(["join", "--forget-seat", "--name", "Ada"])
        .args(words)
        .env_remove(LINK_VARIABLE)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

/// Waits until the program has read the link of this server and tries to join.
fn assert_joins(child: &mut Child, silent: &Silent) {
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let line = lines.next().unwrap().unwrap();
    let address = silent.0.local_addr().unwrap();
    assert_eq!(line, format!("joining {address} as spectator"));
}

fn end(mut child: Child) -> String {
    child.kill().unwrap();
    let output = child.wait_with_output().unwrap();
    String::from_utf8(output.stderr).unwrap()
}

fn refused(command: &mut Command, phrase: &str) {
    let output = command.output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains(phrase), "{phrase}: {message}");
    assert!(!message.contains(SECRET), "{message}");
}

#[test]
fn link_comes_from_argument_file_standard_input_or_environment() {
    let silent = Silent::new();
    let link = silent.link();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("link.txt");
    std::fs::write(&file, format!("{link}\n")).unwrap();
    let path = file.to_str().unwrap();

    for mut command in [join(&[&link]), join(&["--link-file", path])] {
        let mut child = command.spawn().unwrap();
        assert_joins(&mut child, &silent);
        end(child);
    }
    let mut child = join(&[]).env(LINK_VARIABLE, &link).spawn().unwrap();
    assert_joins(&mut child, &silent);
    end(child);
    let mut child = join(&["-"]).stdin(Stdio::piped()).spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    writeln!(input, "{link}").unwrap();
    assert_joins(&mut child, &silent);
    end(child);
}

#[cfg(unix)]
#[test]
fn link_file_that_others_can_read_is_accepted_with_a_hint() {
    use std::os::unix::fs::PermissionsExt;

    let silent = Silent::new();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("link.txt");
    std::fs::write(&file, silent.link()).unwrap();
    for (mode, has_hint) in [(0o600, false), (0o640, true), (0o644, true)] {
        std::fs::set_permissions(&file, PermissionsExt::from_mode(mode)).unwrap();
        let mut child = join(&["--link-file", file.to_str().unwrap()])
            .spawn()
            .unwrap();
        assert_joins(&mut child, &silent);
        let message = end(child);
        assert_eq!(
            message.contains("chmod 600"),
            has_hint,
            "{mode:o}: {message}"
        );
    }
}

#[test]
fn absent_unreadable_empty_and_double_links_are_rejected() {
    let link = Silent::new().link();
    let folder = tempfile::tempdir().unwrap();
    let empty = folder.path().join("empty.txt");
    std::fs::write(&empty, "\n").unwrap();
    let empty = empty.to_str().unwrap();
    let absent = folder.path().join("absent.txt");
    let absent = absent.to_str().unwrap();

    for way in ["join 'palpate://", "--link-file", "join -", LINK_VARIABLE] {
        refused(&mut join(&[]), way);
    }
    refused(&mut join(&["--link-file", absent]), absent);
    refused(&mut join(&["--link-file", empty]), "first line is empty");
    refused(&mut join(&["-"]), "first line is empty");
    refused(&mut join(&[&link, "--link-file", empty]), "given twice");
    refused(join(&["-"]).env(LINK_VARIABLE, &link), "given twice");
    refused(join(&[&link]).env(LINK_VARIABLE, &link), "given twice");
    let damaged = link.replace("grant=", "grant=x");
    refused(&mut join(&[&damaged]), "32 hexadecimal digits");
}

/// The list of processes shows these bytes to every user.
#[cfg(target_os = "linux")]
#[test]
fn command_line_of_a_running_client_has_no_grant() {
    let silent = Silent::new();
    let link = silent.link();
    for words in [["--duration", "9", &link], [&link, "--duration", "9"]] {
        let mut child = join(&words).spawn().unwrap();
        assert_joins(&mut child, &silent);
        let line = std::fs::read(format!("/proc/{}/cmdline", child.id())).unwrap();
        let line = String::from_utf8(line).unwrap();
        assert!(
            !line.contains("palpate://") && !line.contains(SECRET),
            "{line}"
        );
        let rest = "join\0--forget-seat\0--name\0Ada\0--duration\09\0";
        assert!(line.ends_with(rest), "{line}");
        assert_eq!(end(child), "", "nothing is printed about it");
    }
}

/// The file of the program is removed between its start and its second start.
#[cfg(target_os = "linux")]
#[test]
fn client_that_cannot_start_again_joins_with_a_hint() {
    let silent = Silent::new();
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("client");
    std::fs::copy(env!("CARGO_BIN_EXE_palpate-client"), &program).unwrap();
    let script = "exec 3<\"$0\"; rm \"$0\"; exec /proc/self/fd/3 join \"$1\" --forget-seat";
    let mut child = Command::new("sh")
        .args(["-c", script])
        .arg(&program)
        .arg(silent.link())
        .env_remove(LINK_VARIABLE)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    assert_joins(&mut child, &silent);
    let message = end(child);
    assert!(
        message.contains("hint") && message.contains("--link-file"),
        "{message}"
    );
}

#[cfg(unix)]
fn files(folder: &std::path::Path, found: &mut Vec<(String, Vec<u8>)>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, found);
        } else {
            let bytes = std::fs::read(&path).unwrap();
            found.push((path.display().to_string(), bytes));
        }
    }
}

#[cfg(unix)]
#[test]
fn log_summary_recording_and_seat_file_have_no_grant() {
    let fake = Fake::start(Manner::Plays, false);
    let mut link = fake.link.clone();
    link.role = Role::Spectator;
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let mut child = Command::new(env!("CARGO_BIN_EXE_palpate-client"))
        .args([
            "join",
            &link.to_string(),
            "--json",
            "--name",
            "Ada",
            "--record",
        ])
        .arg(folder.path().join("run.json"))
        .env("PALPATE_LOG", "trace")
        .env("XDG_STATE_HOME", &state)
        .env_remove(LINK_VARIABLE)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // The seat file exists while the client runs.
    let mut log = BufReader::new(child.stderr.take().unwrap()).lines();
    let mut lines = Vec::new();
    while !lines
        .iter()
        .any(|l: &String| l.starts_with("joined as Ada"))
    {
        lines.push(log.next().unwrap().unwrap());
    }
    let mut found = Vec::new();
    files(&state, &mut found);
    assert_eq!(found.len(), 1, "one seat");
    let pid = child.id().to_string();
    let mut kill = Command::new("kill");
    assert!(kill.args(["-TERM", &pid]).status().unwrap().success());
    lines.extend(log.map(Result::unwrap));
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    files(folder.path(), &mut found);
    found.push(("standard output".to_owned(), output.stdout));
    found.push(("standard error".to_owned(), lines.join("\n").into_bytes()));
    assert!(found.iter().any(|(name, _)| name.ends_with("run.json")));
    let secrets = [link.grant.token(), format!("{:?}", link.grant.0)];
    for (name, bytes) in found {
        let text = format!("{name} {}", String::from_utf8_lossy(&bytes));
        for secret in &secrets {
            assert!(!text.contains(secret), "{name} has {secret}");
        }
    }
    fake.stop();
}

#[test]
fn client_that_is_refused_for_load_joins_later_and_shows_each_attempt() {
    let fake = Fake::start(Manner::WasFull, false);
    let mut link = fake.link.clone();
    link.role = Role::Spectator;
    let output = join(&[&link.to_string(), "--duration", "1"])
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}");
    let retries: Vec<&str> = text
        .lines()
        .filter(|l| l.starts_with("the server is busy (the session is full"))
        .collect();
    assert_eq!(retries.len(), 2, "{text}");
    for (retry, attempt) in retries.iter().zip(["attempt 2", "attempt 3"]) {
        assert!(
            retry.contains("trying again in ") && retry.ends_with(attempt),
            "{retry}"
        );
    }
    assert!(text.contains("joined as Ada"), "{text}");
    fake.stop();
}
