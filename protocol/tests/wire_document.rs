//! Checks WIRE.md: every example matches the code, every message has an example, and every kind is in
//! its tables.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;

use palpate_protocol::codec::{self, Message};
use palpate_protocol::control::Control;
use palpate_protocol::datagram::{Body, Datagram, Memory};
use palpate_protocol::examples::{self, Example};
use palpate_protocol::handshake::{PROTOCOL_VERSION, Preamble};
use palpate_protocol::operation::OperationKind;
use palpate_protocol::request::{ClientMessage, RequestKind, ServerMessage};

const DOCUMENT: &str = include_str!("../WIRE.md");

/// The prefix of example lines.
const MARK: &str = "example ";

fn hex(bytes: &[u8]) -> String {
    let bytes: Vec<String> = bytes.iter().map(|b| format!("{b:02x}")).collect();
    bytes.join(" ")
}

/// The examples in the document by their name.
fn documented() -> BTreeMap<&'static str, Vec<u8>> {
    let lines = DOCUMENT.lines().filter_map(|l| l.strip_prefix(MARK));
    let read = |line: &'static str| {
        let (name, bytes) = line.split_once(": ").unwrap();
        let bytes = bytes.split(' ').map(|b| u8::from_str_radix(b, 16).unwrap());
        (name, bytes.collect())
    };
    lines.map(read).collect()
}

/// All examples as the code writes them.
fn written() -> Vec<Example<Vec<u8>>> {
    let preamble = Example {
        name: "preamble",
        message: Preamble::OURS.to_bytes().to_vec(),
    };
    let [client, server] = examples::frames().unwrap();
    let datagrams = examples::datagram_bytes().unwrap();
    let all = [vec![preamble], client, server, datagrams];
    all.into_iter().flatten().collect()
}

#[test]
fn every_message_has_its_bytes_in_the_document() {
    let documented = documented();
    let all = written();
    let wrong: Vec<String> = all
        .iter()
        .filter(|e| documented.get(e.name) != Some(&e.message))
        .map(|e| format!("{MARK}{}: {}", e.name, hex(&e.message)))
        .collect();
    assert!(
        wrong.is_empty(),
        "the document should say:\n{}",
        wrong.join("\n")
    );
    assert_eq!(
        documented.len(),
        all.len(),
        "the document has examples of messages that do not exist"
    );
}

fn check_frames<M: Message + PartialEq + std::fmt::Debug>(messages: Vec<Example<M>>) {
    let documented = documented();
    for Example { name, message } in messages {
        let frame = &documented[name];
        let (prefix, body) = frame.split_first_chunk::<4>().unwrap();
        assert_eq!(u32::from_le_bytes(*prefix) as usize, body.len(), "{name}");
        let read: M = codec::decode_body(body).unwrap();
        assert_eq!(read, message, "{name}");
        assert_eq!(&codec::encode_frame(&read).unwrap(), frame, "{name}");
    }
}

#[test]
fn documented_frames_decode_and_encode_exactly() {
    check_frames(examples::client_messages());
    check_frames(examples::server_messages());
}

#[test]
fn documented_datagrams_decode_in_order_and_encode_exactly() {
    let documented = documented();
    let (mut theirs, mut ours) = (Memory::default(), Memory::default());
    for Example { name, message } in examples::datagrams() {
        let bytes = &documented[name];
        let read = Datagram::decode(bytes, &examples::expected(), &mut theirs).unwrap();
        assert_eq!(read.header, message.header, "{name}");
        assert_eq!(&read.encode(&mut ours).unwrap(), bytes, "{name}");
        ours.acknowledge(read.header.sequence);
    }
}

/// A row of a table of the document: a number and a name.
fn assert_row(number: usize, name: &str) {
    let row = format!("| {number} | {name} |");
    assert!(DOCUMENT.contains(&row), "the document has no row {row}");
}

/// Rows for the variants, which the examples have in their order; `count` of them.
fn assert_rows(variants: impl Iterator<Item = (usize, &'static str)>, count: usize) {
    let mut seen = vec![false; count];
    for (number, name) in variants {
        assert_row(number, name);
        seen[number] = true;
    }
    assert!(seen.iter().all(|s| *s), "no example: {seen:?}");
}

// The matches below do not compile when a message is added: it needs a number here, which is that on
// the wire, and a name in the document.

#[test]
fn every_kind_of_datagram_is_in_the_document() {
    let kind = |d: Example<Datagram>| match d.message.body {
        Body::Motion(_) => (0, "motion"),
        Body::Corrections(_) => (1, "corrections"),
        Body::Probe(_) => (2, "probe"),
        Body::Reply(_) => (3, "reply"),
        Body::Delays(_) => (4, "delays"),
        Body::Copy(_) => (6, "copy"),
        Body::Displacements(_) => (5, "displacements"),
    };
    let mut seen = [false; 7];
    for (index, name) in examples::datagrams().into_iter().map(kind) {
        assert_row(index + 1, name);
        seen[index] = true;
    }
    assert_eq!(seen, [true; 7]);
    for (example, bytes) in examples::datagrams()
        .into_iter()
        .zip(examples::datagram_bytes().unwrap())
    {
        let (index, _) = kind(example);
        assert_eq!(usize::from(bytes.message[0] & 7), index + 1);
    }
}

#[test]
fn every_client_message_and_request_is_in_the_document() {
    let messages = examples::client_messages();
    let message = |m: &Example<ClientMessage>| match m.message {
        ClientMessage::Hello(_) => (0, "Hello"),
        ClientMessage::Request(_) => (1, "Request"),
    };
    assert_rows(messages.iter().map(message), 2);
    let request = |m: &Example<ClientMessage>| match &m.message {
        ClientMessage::Hello(_) => None,
        ClientMessage::Request(r) => Some(match r.kind {
            RequestKind::Cut(_) => (0, "Cut"),
            RequestKind::Leave => (1, "Leave"),
            RequestKind::TopologyReport { .. } => (2, "TopologyReport"),
            RequestKind::SetTool(_) => (3, "SetTool"),
            RequestKind::Control(_) => (4, "Control"),
        }),
    };
    assert_rows(messages.iter().filter_map(request), 5);
    let control = |m: &Example<ClientMessage>| match &m.message {
        ClientMessage::Request(r) => match &r.kind {
            RequestKind::Control(control) => Some(match control {
                Control::Mute { .. } => (0, "Mute"),
                Control::HandOver { .. } => (1, "HandOver"),
                Control::Freeze { .. } => (2, "Freeze"),
                Control::Reset => (3, "Reset"),
                Control::Undo => (4, "Undo"),
                Control::Redo => (5, "Redo"),
                Control::ForceLimit { .. } => (6, "ForceLimit"),
                Control::Kick { .. } => (7, "Kick"),
                Control::Ban { .. } => (8, "Ban"),
                Control::Lock { .. } => (9, "Lock"),
                Control::Capacity { .. } => (10, "Capacity"),
                Control::Compensation { .. } => (11, "Compensation"),
                Control::Annotate(_) => (12, "Annotate"),
                Control::RemoveAnnotation { .. } => (13, "RemoveAnnotation"),
                Control::ShowCamera(_) => (14, "ShowCamera"),
                Control::Invite { .. } => (15, "Invite"),
                Control::RevokeInvitation { .. } => (16, "RevokeInvitation"),
                Control::Emulate { .. } => (17, "Emulate"),
            }),
            _ => None,
        },
        ClientMessage::Hello(_) => None,
    };
    assert_rows(messages.iter().filter_map(control), 18);
}

#[test]
fn every_server_message_and_operation_is_in_the_document() {
    let messages = examples::server_messages();
    let message = |m: &Example<ServerMessage>| match m.message {
        ServerMessage::Welcome(_) => (0, "Welcome"),
        ServerMessage::Refused(_) => (1, "Refused"),
        ServerMessage::Operation(_) => (2, "Operation"),
        ServerMessage::RequestRefused(_) => (3, "RequestRefused"),
        ServerMessage::Goodbye { .. } => (4, "Goodbye"),
        ServerMessage::Invitation(_) => (5, "Invitation"),
        ServerMessage::Snapshot(_) => (6, "Snapshot"),
    };
    assert_rows(messages.iter().map(message), 7);
    let operation = |m: &Example<ServerMessage>| match &m.message {
        ServerMessage::Operation(o) => Some(match o.kind {
            OperationKind::Cut(_) => (0, "Cut"),
            OperationKind::Joined { .. } => (1, "Joined"),
            OperationKind::Left { .. } => (2, "Left"),
            OperationKind::Disconnected { .. } => (3, "Disconnected"),
            OperationKind::Reconnected { .. } => (4, "Reconnected"),
            OperationKind::ToolChanged { .. } => (5, "ToolChanged"),
            OperationKind::Started { .. } => (6, "Started"),
            OperationKind::Compensation { .. } => (7, "Compensation"),
            OperationKind::Demoted { .. } => (8, "Demoted"),
            OperationKind::Restored { .. } => (9, "Restored"),
            OperationKind::Muted { .. } => (10, "Muted"),
            OperationKind::Frozen { .. } => (11, "Frozen"),
            OperationKind::Reset => (12, "Reset"),
            OperationKind::Undone => (13, "Undone"),
            OperationKind::Redone => (14, "Redone"),
            OperationKind::ForceLimit { .. } => (15, "ForceLimit"),
            OperationKind::Access { .. } => (16, "Access"),
            OperationKind::CompensationMode { .. } => (17, "CompensationMode"),
            OperationKind::Annotated(_) => (18, "Annotated"),
            OperationKind::AnnotationRemoved { .. } => (19, "AnnotationRemoved"),
            OperationKind::CameraShown(_) => (20, "CameraShown"),
            OperationKind::Invited { .. } => (21, "Invited"),
            OperationKind::InvitationUsed { .. } => (22, "InvitationUsed"),
            OperationKind::InvitationRevoked { .. } => (23, "InvitationRevoked"),
            OperationKind::Emulated { .. } => (24, "Emulated"),
        }),
        _ => None,
    };
    assert_rows(messages.iter().filter_map(operation), 25);
}

#[test]
fn the_document_is_of_this_version() {
    let title = format!("# Wire format of version {PROTOCOL_VERSION}");
    assert!(DOCUMENT.starts_with(&title), "it should begin with {title}");
}
