//! Damaged bytes decode to an error or a valid message, and take no more memory than the limit.

#![allow(clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use palpate_protocol::codec::{self, Message};
use palpate_protocol::datagram::{Datagram, Memory};
use palpate_protocol::examples;
use palpate_protocol::request::{ClientMessage, ServerMessage};

/// The memory limit for reading one frame in bytes: the frame's own limit for its content, the same
/// again for a growing list, and the text of an error.
const FRAME_HELD_MAX: usize = 3 * codec::FRAME_MAX_BYTES;

/// The most bytes that reading one datagram may hold: twice 1024 nodes of 20 B, once for memory, and 64
/// tools of eight samples of 96 B.
const DATAGRAM_HELD_MAX: usize = 100_000;

thread_local! {
    /// Bytes that this thread holds now, and the most since the last look.
    static HELD: Cell<(isize, isize)> = const { Cell::new((0, 0)) };
}

fn note(bytes: isize) {
    // A thread that is being torn down has no counter any more, and none is needed.
    let _ = HELD.try_with(|held| {
        let (now, most) = held.get();
        held.set((now + bytes, most.max(now + bytes)));
    });
}

struct Counting;

// SAFETY: every call is handed to the system's allocator with the caller's own arguments, so its
// contract holds unchanged; `note` allocates nothing (a const thread-local without a destructor).
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(layout.size() as isize);
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        note(-(layout.size() as isize));
        // SAFETY: the caller's block and layout, unchanged.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The peak memory of `run` in bytes, and its result.
fn held<T>(run: impl FnOnce() -> T) -> (usize, T) {
    let before = HELD.with(|held| {
        let (now, _) = held.get();
        held.set((now, now));
        now
    });
    let out = run();
    let most = HELD.with(Cell::get).1 - before;
    (most.max(0) as usize, out)
}

/// All small damages of some bytes: each prefix, each single bit flipped, and
/// each byte at its two extremes.
fn damages(good: &[u8]) -> impl Iterator<Item = Vec<u8>> {
    let begun = (0..good.len()).map(|len| good[..len].to_vec());
    let turned = (0..good.len() * 8).map(|bit| {
        let mut bytes = good.to_vec();
        bytes[bit / 8] ^= 1 << (bit % 8);
        bytes
    });
    let ends = (0..good.len() * 2).map(|i| {
        let mut bytes = good.to_vec();
        bytes[i / 2] = if i % 2 == 0 { 0 } else { 0xff };
        bytes
    });
    begun.chain(turned).chain(ends)
}

/// A decoded message is encoded again, and decodes to the same message.
fn check_frame<M: Message + PartialEq + std::fmt::Debug>(name: &str, body: &[u8]) -> bool {
    let (most, read) = held(|| codec::decode_body::<M>(body));
    assert!(most <= FRAME_HELD_MAX, "{name}: {most} bytes held");
    let Ok(message) = read else {
        return false;
    };
    let again = codec::encode_frame(&message).unwrap();
    let back = codec::decode_body::<M>(&again[codec::PREFIX_BYTES..]).unwrap();
    // NaN is not equal to itself, but has the same bytes.
    assert_eq!(codec::encode_frame(&back).unwrap(), again, "{name}");
    true
}

#[test]
fn damaged_frame_decodes_to_an_error_or_a_message_within_the_memory_limit() {
    let [client, server] = examples::frames().unwrap();
    for example in client {
        let body = &example.message[codec::PREFIX_BYTES..];
        assert!(check_frame::<ClientMessage>(example.name, body));
        for damaged in damages(body) {
            check_frame::<ClientMessage>(example.name, &damaged);
        }
    }
    for example in server {
        let body = &example.message[codec::PREFIX_BYTES..];
        assert!(check_frame::<ServerMessage>(example.name, body));
        for damaged in damages(body) {
            check_frame::<ServerMessage>(example.name, &damaged);
        }
    }
}

#[test]
fn truncated_frame_is_an_error() {
    let [client, server] = examples::frames().unwrap();
    for example in client.iter().chain(&server) {
        let body = &example.message[codec::PREFIX_BYTES..];
        for len in 0..body.len() {
            let both = (
                codec::decode_body::<ClientMessage>(&body[..len]).is_ok(),
                codec::decode_body::<ServerMessage>(&body[..len]).is_ok(),
            );
            // A truncated frame must not decode to the original message.
            let was_client = client.iter().any(|c| c.name == example.name);
            assert!(
                !if was_client { both.0 } else { both.1 },
                "{}",
                example.name
            );
        }
    }
}

/// The memory of a receiver that has the first `count` examples.
fn memory_after(all: &[examples::Example<Vec<u8>>], count: usize) -> Memory {
    let mut memory = Memory::default();
    for example in &all[..count] {
        Datagram::decode(&example.message, &examples::expected(), &mut memory).unwrap();
    }
    memory
}

#[test]
fn damaged_datagram_decodes_to_an_error_or_a_message_within_the_memory_limit() {
    let all = examples::datagram_bytes().unwrap();
    for (i, example) in all.iter().enumerate() {
        for damaged in damages(&example.message) {
            let mut memory = memory_after(&all, i);
            let (most, read) =
                held(|| Datagram::decode(&damaged, &examples::expected(), &mut memory));
            assert!(
                most <= DATAGRAM_HELD_MAX,
                "{}: {most} bytes held",
                example.name
            );
            if let Ok(datagram) = read {
                // It can be encoded again: every value is in the range of the wire format.
                let again = datagram.encode(&mut Memory::default());
                assert!(again.is_ok(), "{}: {again:?}", example.name);
            }
        }
    }
}
