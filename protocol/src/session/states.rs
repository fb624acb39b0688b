//! Checks STATES.md against the state machines.

use super::client::ClientSession;
use super::preamble::refusing;
use super::tests::{hello, operation_at, welcome};
use super::*;
use crate::codec::{HELLO_MAX_BYTES, encode_frame};
use crate::handshake::{PROTOCOL_VERSION, Preamble, RefusalReason};
use crate::request::{ClientMessage, CutRequest, RequestKind, ServerMessage};
use crate::{ClientTime, RequestId, ServerTime, TopologyHash};

const DOCUMENT: &str = include_str!("../../STATES.md");

/// State, event, next state.
type Row = [String; 3];

/// The rows of the table below a heading.
fn table(heading: &str) -> Vec<Row> {
    let title = format!("## {heading}\n");
    let section = DOCUMENT.split(&title).nth(1).unwrap();
    let section = section.split("\n## ").next().unwrap();
    let cells = |line: &str| -> Row {
        let cells: Vec<String> = line.split('|').map(|c| c.trim().to_owned()).collect();
        cells[1..4].to_vec().try_into().unwrap()
    };
    let lines = section.lines().filter(|l| l.starts_with('|'));
    lines.skip(2).map(cells).collect()
}

fn check(heading: &str, states: &[&str], run: impl Fn(&str, &str) -> &'static str) {
    let rows = table(heading);
    for state in states {
        let is_named = |i: usize| rows.iter().any(|row| row[i] == *state);
        assert!(
            is_named(0),
            "nothing happens in the state {state} of {heading}"
        );
        assert!(
            is_named(2) || *state == states[0],
            "nothing leads to {state}"
        );
    }
    for [from, what, to] in &rows {
        assert!(
            states.contains(&from.as_str()),
            "{heading} has no state {from}"
        );
        assert_eq!(run(from, what), to, "{heading}: {from}, {what}");
    }
}

fn other_version() -> Vec<u8> {
    let other = Preamble {
        version: PROTOCOL_VERSION + 1,
        status: 0,
    };
    other.to_bytes().to_vec()
}

fn later(ms: i64) -> (ClientTime, ServerTime) {
    (
        ClientTime::from_micros(ms * 1000),
        ServerTime::from_micros(ms * 1000),
    )
}

fn client_in(state: &str) -> ClientSession {
    let mut client = ClientSession::new(hello(), ClientTime::ZERO).unwrap();
    let stages = ["Preamble", "Hello", "Joined", "Closed"];
    let stage = stages.iter().position(|s| *s == state).unwrap();
    if stage >= 1 {
        client.handle_stream(&Preamble::OURS.to_bytes(), ClientTime::ZERO);
    }
    if stage >= 2 {
        let welcome = ServerMessage::Welcome(Box::new(welcome(0, 0)));
        client.handle_stream(&encode_frame(&welcome).unwrap(), ClientTime::ZERO);
    }
    if stage == 3 {
        client.request(RequestKind::Leave).unwrap();
    }
    assert_eq!(client.state_name(), state);
    client
}

fn run_client(from: &str, what: &str) -> &'static str {
    let mut client = client_in(from);
    let now = ClientTime::ZERO;
    let message = match what {
        "a welcome" | "a second welcome" => ServerMessage::Welcome(Box::new(welcome(0, 0))),
        "a refusal" => ServerMessage::Refused(Refused::because(RefusalReason::Closing)),
        "a goodbye" => ServerMessage::Goodbye {
            sentence: "a test".into(),
        },
        "a piece of no snapshot" => ServerMessage::Snapshot(vec![1]),
        "an operation" | "the next operation" => ServerMessage::Operation(operation_at(0)),
        "a repeated operation" => {
            let first = ServerMessage::Operation(operation_at(0));
            client.handle_stream(&encode_frame(&first).unwrap(), now);
            first
        }
        _ => {
            match what {
                "the server's preamble" => client.handle_stream(&Preamble::OURS.to_bytes(), now),
                "a preamble that refuses" => client.handle_stream(&refusing("no"), now),
                "a preamble of another version" => client.handle_stream(&other_version(), now),
                "other bytes" => client.handle_stream(b"HTTP/1.1 400", now),
                "10 s pass" => client.handle_timeout(later(10_000).0),
                "1 s of silence" => client.handle_timeout(later(1000).0),
                "it leaves" => drop(client.request(RequestKind::Leave).unwrap()),
                "the connection is lost" => client.handle_disconnect("a test".into()),
                other => panic!("no test for \"{other}\" of the client"),
            }
            return client.state_name();
        }
    };
    client.handle_stream(&encode_frame(&message).unwrap(), now);
    client.state_name()
}

fn hello_of(name: &str) -> Vec<u8> {
    let hello = Hello {
        name: name.to_owned(),
        ..hello()
    };
    let frame = encode_frame(&ClientMessage::Hello(hello)).unwrap();
    assert!(frame.len() <= HELLO_MAX_BYTES);
    frame
}

fn request(kind: RequestKind) -> Vec<u8> {
    let id = RequestId(1);
    encode_frame(&ClientMessage::Request(Request { id, kind })).unwrap()
}

fn peer_in(state: &str) -> ServerPeer {
    let mut peer = ServerPeer::new(ServerTime::ZERO);
    let stages = ["Preamble", "Hello", "AwaitsRoom", "Joined", "Closed"];
    let stage = stages.iter().position(|s| *s == state).unwrap();
    if stage >= 1 {
        peer.handle_stream(&Preamble::OURS.to_bytes(), ServerTime::ZERO);
    }
    if stage >= 2 {
        peer.handle_stream(&hello_of("ann"), ServerTime::ZERO);
    }
    if stage >= 3 {
        let welcome = PeerMessage::Welcome(Box::new(welcome(0, 0)));
        peer.send(&welcome, ServerTime::ZERO).unwrap();
    }
    if stage == 4 {
        peer.handle_disconnect("a test".into());
    }
    assert_eq!(peer.state_name(), state);
    peer
}

fn run_peer(from: &str, what: &str) -> &'static str {
    let mut peer = peer_in(from);
    let now = ServerTime::ZERO;
    let fine = RequestKind::TopologyReport {
        version: 0,
        hash: TopologyHash(0),
    };
    let odd = RequestKind::Cut(CutRequest::whole(Vec::new(), f64::NAN));
    let sent = match what {
        "the room welcomes" => peer.send(&PeerMessage::Welcome(Box::new(welcome(0, 0))), now),
        "the room refuses" => {
            let refused = Refused::because(RefusalReason::Closing);
            peer.send(&PeerMessage::Refused(refused), now)
        }
        "the room says goodbye" => peer.send(&PeerMessage::Goodbye("a test".into()), now),
        _ => Ok(()),
    };
    sent.unwrap();
    match what {
        "the room welcomes" | "the room refuses" | "the room says goodbye" => {}
        "the client's preamble" => peer.handle_stream(&Preamble::OURS.to_bytes(), now),
        "a preamble of another version" => peer.handle_stream(&other_version(), now),
        "other bytes" => peer.handle_stream(b"GET / HTTP/1.1", now),
        "10 s pass" => peer.handle_timeout(later(10_000).1),
        "2 s of silence" => peer.handle_timeout(later(2000).1),
        "a hello" | "a second hello" => peer.handle_stream(&hello_of("ann"), now),
        "a hello without a name" => peer.handle_stream(&hello_of(" "), now),
        "a request" => peer.handle_stream(&request(fine), now),
        "a request out of range" => peer.handle_stream(&request(odd), now),
        "it leaves" => peer.handle_stream(&request(RequestKind::Leave), now),
        "the room sends too much" => peer.handle_overflow(),
        "nothing is taken from the stream for 10 s" => {
            let (_, late) = later(10_000);
            peer.handle_stream(&[], late);
            peer.handle_timeout(late);
        }
        "a flood of requests" => {
            for _ in 0..=REQUESTS_BURST_MAX + REFUSALS_BURST_MAX {
                peer.handle_stream(&request(fine.clone()), now);
            }
        }
        "the connection is lost" => peer.handle_disconnect("a test".into()),
        other => panic!("no test for \"{other}\" of the peer"),
    }
    peer.state_name()
}

#[test]
fn client_session_follows_the_state_document() {
    check("Client session", &ClientSession::STATES, run_client);
}

#[test]
fn server_peer_follows_the_state_document() {
    check("Server peer", &ServerPeer::STATES, run_peer);
}
