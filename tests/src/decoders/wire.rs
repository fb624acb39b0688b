//! Decoders of network input and of join links.

use palpate_protocol::codec::{FRAME_MAX_BYTES, FrameDecoder, Message, PREFIX_BYTES, encode_frame};
use palpate_protocol::datagram::{DATAGRAM_MAX_BYTES, Datagram, Memory};
use palpate_protocol::examples;
use palpate_protocol::handshake::{Hello, Preamble, Subscription, Welcome};
use palpate_protocol::operation::Operation;
use palpate_protocol::request::{ClientMessage, ServerMessage};
use palpate_protocol::session::{ClientSession, PeerEvent, PeerMessage, ServerPeer};
use palpate_protocol::{
    CertificateHash, ClientTime, Grant, JoinLink, OperationId, Role, ServerTime,
};

use super::{Decoder, decoders, text};

/// Memory bound of a datagram receiver: the current datagram and its history.
const DATAGRAMS_HOLD_MAX: usize = 4 << 20;

/// Memory bound of a session endpoint: a frame, pending events, and the datagram history.
const SESSION_HOLDS_MAX: usize = 16 << 20;

/// Memory bound of a frame receiver.
const fn of_frames(len: usize) -> usize {
    4 * FRAME_MAX_BYTES + 2 * len
}

const fn of_session(len: usize) -> usize {
    SESSION_HOLDS_MAX + 4 * len
}

pub(super) const ALL: &[Decoder] = decoders! {
    "datagrams", |len| DATAGRAMS_HOLD_MAX + 2 * len, read_datagrams, datagram_sequences();
    "client-stream", of_frames, read_frames::<ClientMessage>, frames(0);
    "server-stream", of_frames, read_frames::<ServerMessage>, frames(1);
    "server-session", of_session, read_as_server, as_a_client();
    "client-session", of_session, read_as_client, as_a_server();
    "join-link", |len| (64 << 10) + 8 * len, read_link, links();
};

fn read_link(bytes: &[u8]) -> bool {
    text(bytes, |link| {
        let Ok(link) = link.parse::<JoinLink>() else {
            return false;
        };
        let again: JoinLink = link.to_string().parse().expect("a link that was written");
        assert_eq!(again, link);
        true
    })
}

fn links() -> Vec<Vec<u8>> {
    let link = JoinLink {
        host: "example.org".to_owned(),
        port: 4433,
        role: Role::Trainee,
        certificate: CertificateHash([7; 32]),
        grant: Grant([9; 16]),
    };
    let near = JoinLink {
        host: "::1".to_owned(),
        ..link.clone()
    };
    [link, near].map(|l| l.to_string().into_bytes()).into()
}

/// Length-prefixed pieces: two bytes with the length and, in the highest bit, the datagram flag, followed by
/// the piece.
fn pieces(all: &[(bool, &[u8])]) -> Vec<u8> {
    let mut out = Vec::new();
    for (is_datagram, piece) in all {
        let head = (piece.len() as u16 & 0x7fff) | (u16::from(*is_datagram) << 15);
        out.extend(head.to_le_bytes());
        out.extend(*piece);
    }
    out
}

/// Splits any bytes into pieces; the last one takes the remaining bytes.
fn each_piece(mut bytes: &[u8], mut take: impl FnMut(bool, &[u8])) {
    while let [low, high, rest @ ..] = bytes {
        let head = u16::from_le_bytes([*low, *high]);
        let len = usize::from(head & 0x7fff).min(rest.len());
        let (piece, after) = rest.split_at(len);
        take(head >> 15 == 1, piece);
        bytes = after;
    }
}

/// Growing sequences, in which each datagram differs from the previous one.
fn datagram_sequences() -> Vec<Vec<u8>> {
    let all = datagrams();
    let all: Vec<_> = all.iter().map(|d| (true, &d[..])).collect();
    (1..=all.len()).map(|n| pieces(&all[..n])).collect()
}

fn datagrams() -> Vec<Vec<u8>> {
    let all = examples::datagram_bytes().expect("examples can be written");
    all.into_iter().map(|d| d.message).collect()
}

/// Frames of the client (0) or the server (1).
fn frames(side: usize) -> Vec<Vec<u8>> {
    let all = examples::frames().expect("examples can be written");
    all[side].iter().map(|f| f.message.clone()).collect()
}

fn read_datagrams(bytes: &[u8]) -> bool {
    let mut all_good = true;
    let (mut memory, expected) = (Memory::default(), examples::expected());
    each_piece(bytes, |_, piece| {
        if piece.len() > DATAGRAM_MAX_BYTES {
            all_good = false;
        } else if let Ok(datagram) = Datagram::decode(piece, &expected, &mut memory) {
            let again = datagram.encode(&mut Memory::default());
            let again = again.expect("what was read can be sent");
            assert!(!again.is_empty());
        } else {
            all_good = false;
        }
    });
    all_good
}

fn read_frames<M: Message + PartialEq + std::fmt::Debug>(bytes: &[u8]) -> bool {
    let mut decoder = FrameDecoder::<M>::new(FRAME_MAX_BYTES);
    // In uneven chunks, as a stream delivers them.
    for piece in bytes.chunks(977) {
        decoder.push(piece);
        loop {
            match decoder.next() {
                Ok(Some(message)) => {
                    let again = encode_frame(&message).expect("what was read can be written");
                    assert!(again.len() > PREFIX_BYTES);
                }
                Ok(None) => break,
                Err(_) => return false,
            }
        }
    }
    true
}

fn as_a_client() -> Vec<Vec<u8>> {
    let all = examples::client_messages().into_iter();
    let stays = |name: &str| !matches!(name, "Hello again" | "Leave");
    let messages = all.filter(|m| stays(m.name)).map(|m| m.message);
    session(messages)
}

fn as_a_server() -> Vec<Vec<u8>> {
    let mut next = 0;
    let mut messages = Vec::new();
    for example in examples::server_messages() {
        match example.message {
            ServerMessage::Refused(_) | ServerMessage::Goodbye { .. } => {}
            // One welcome, whose snapshot follows.
            ServerMessage::Welcome(welcome) if welcome.snapshot.is_none() => {}
            ServerMessage::Operation(operation) => {
                let id = OperationId(next);
                next += 1;
                messages.push(ServerMessage::Operation(Operation { id, ..operation }));
            }
            other => messages.push(other),
        }
    }
    session(messages.into_iter())
}

/// The preamble with the first message; and all messages with every kind of datagram.
fn session<M: Message>(messages: impl Iterator<Item = M>) -> Vec<Vec<u8>> {
    let frames: Vec<_> = messages
        .map(|m| encode_frame(&m).expect("examples can be written"))
        .collect();
    let mut stream = Preamble::OURS.to_bytes().to_vec();
    let (first, rest) = frames.split_first().expect("there are examples");
    stream.extend(first);
    let datagrams = datagrams();
    let mut whole: Vec<(bool, &[u8])> = vec![(false, &stream)];
    whole.extend(rest.iter().map(|f| (false, &f[..])));
    whole.extend(datagrams.iter().map(|d| (true, &d[..])));
    vec![pieces(&[(false, &stream)]), pieces(&whole)]
}

/// Pieces arrive 1 ms apart, with a clock tick now and then.
fn read_as_server(bytes: &[u8]) -> bool {
    let mut now = ServerTime::ZERO;
    let mut peer = ServerPeer::new(now);
    each_piece(bytes, |is_datagram, piece| {
        now = ServerTime::from_micros(now.as_micros() + 1000);
        if is_datagram {
            peer.handle_datagram(piece, now);
        } else {
            peer.handle_stream(piece, now);
        }
        peer.handle_timeout(now);
        while let Some(event) = peer.poll_event() {
            if let PeerEvent::Hello(_) = event {
                // The peer is admitted, as by a room with a free seat.
                let _ = peer.send(&PeerMessage::Welcome(Box::new(welcome())), now);
            }
        }
        while peer.poll_stream().is_some() {}
        while peer.poll_datagram(now).is_some() {}
    });
    !peer.is_closed()
}

fn welcome() -> Welcome {
    let all = examples::server_messages().into_iter();
    let mut welcomes = all.filter_map(|m| match m.message {
        ServerMessage::Welcome(welcome) => Some(*welcome),
        _ => None,
    });
    welcomes.next().expect("there is an example of a welcome")
}

fn read_as_client(bytes: &[u8]) -> bool {
    let mut now = ClientTime::from_micros(0);
    let hello = Hello {
        name: "Ann".to_owned(),
        role: Role::Spectator,
        grant: Grant([0x11; 16]),
        tool: None,
        resume: None,
        subscription: Subscription::Thin,
    };
    let mut session = ClientSession::new(hello, now).expect("a plain hello");
    each_piece(bytes, |is_datagram, piece| {
        now = ClientTime::from_micros(now.as_micros() + 1000);
        if is_datagram {
            session.handle_datagram(piece, now);
        } else {
            session.handle_stream(piece, now);
        }
        session.handle_timeout(now);
        while session.poll_event().is_some() {}
        while session.poll_stream().is_some() {}
        while session.poll_datagram(now).is_some() {}
    });
    !session.is_closed()
}
