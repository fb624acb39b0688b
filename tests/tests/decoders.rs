//! Decoders return an error or a valid value for any input, within their memory bound.

#![allow(clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;

use palpate_lab::decoders::{self, Decoder};
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64;

/// Mixed inputs per decoder, in addition to truncated and bit-flipped ones.
const MIXED: usize = 1500;

/// Longer examples are truncated and flipped at every n-th position only.
const WHOLLY: usize = 1500;

thread_local! {
    /// Bytes allocated by this thread, and the maximum since the last reset.
    static HELD: Cell<(isize, isize)> = const { Cell::new((0, 0)) };
}

fn note(bytes: isize) {
    // A thread that is being destroyed has no counter.
    let _ = HELD.try_with(|held| {
        let (now, most) = held.get();
        held.set((now + bytes, most.max(now + bytes)));
    });
}

struct Counting;

// SAFETY: every call forwards the caller's arguments to the system allocator, so its contract holds unchanged.
// `note` does not allocate (a const thread-local without a destructor).
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

/// Decodes the input; returns whether it was valid.
fn check(decoder: &Decoder, bytes: &[u8]) -> bool {
    let before = HELD.with(|held| {
        let (now, _) = held.get();
        held.set((now, now));
        now
    });
    let good = (decoder.read)(bytes);
    let most = (HELD.with(Cell::get).1 - before).max(0) as usize;
    let limit = (decoder.holds_max)(bytes.len());
    assert!(
        most <= limit,
        "{} holds {most} bytes for {} of input; at most {limit} are allowed: {bytes:?}",
        decoder.name,
        bytes.len()
    );
    good
}

/// The fuzzing corpus of a decoder.
fn corpus(decoder: &Decoder) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus");
    let Ok(entries) = std::fs::read_dir(folder.join(decoder.name)) else {
        return Vec::new();
    };
    let mut files: Vec<_> = entries.map(|e| e.unwrap().path()).collect();
    files.sort();
    files.iter().map(|f| std::fs::read(f).unwrap()).collect()
}

/// A mixture of two inputs, with bytes overwritten, doubled or removed.
fn mixed(rng: &mut impl Rng, all: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = all[rng.random_range(0..all.len())].clone();
    for _ in 0..rng.random_range(1..6) {
        let at = rng.random_range(0..=bytes.len());
        match rng.random_range(0..5) {
            0 => bytes.truncate(at),
            1 => bytes.insert(at, rng.random()),
            2 if at < bytes.len() => bytes[at] = rng.random(),
            3 if at < bytes.len() => {
                bytes.remove(at);
            }
            _ => {
                let other = &all[rng.random_range(0..all.len())];
                let from = rng.random_range(0..=other.len());
                let until = rng.random_range(from..=other.len());
                let piece = other[from..until].to_vec();
                bytes.splice(at..at, piece);
            }
        }
    }
    bytes
}

#[test]
fn every_example_is_valid() {
    let mut bad = Vec::new();
    for decoder in decoders::all() {
        for (k, example) in (decoder.examples)().iter().enumerate() {
            if !check(decoder, example) {
                bad.push((decoder.name, k));
            }
        }
    }
    assert_eq!(bad, []);
}

#[test]
fn truncated_and_bit_flipped_examples_are_errors_or_valid() {
    for decoder in decoders::all() {
        for example in (decoder.examples)() {
            let step = example.len().div_ceil(WHOLLY).max(1);
            for at in (0..example.len()).step_by(step) {
                check(decoder, &example[..at]);
                let mut flipped = example.clone();
                for bit in 0..8 {
                    flipped[at] = example[at] ^ (1 << bit);
                    check(decoder, &flipped);
                }
            }
        }
    }
}

#[test]
fn corpus_and_its_mixtures_are_errors_or_valid() {
    for decoder in decoders::all() {
        let mut all = (decoder.examples)();
        all.extend(corpus(decoder));
        for bytes in &all {
            check(decoder, bytes);
        }
        let mut rng = Pcg64::seed_from_u64(7);
        for _ in 0..MIXED {
            check(decoder, &mixed(&mut rng, &all));
        }
    }
}
