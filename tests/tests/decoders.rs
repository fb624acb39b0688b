//! Whatever stands in a file or comes over the wire, what reads it gives an error or something valid, and
//! takes no more memory than its bound.

#![allow(clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;

use palpate_lab::decoders::{ALL, Decoder};
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64;

/// Damaged inputs per decoder besides cut and flipped ones.
const MIXED: usize = 1500;

/// Examples that are longer are cut and flipped at every n-th place only.
const WHOLLY: usize = 1500;

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

/// Reads it, and whether it was good.
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

/// What a fuzzer found worth keeping.
fn corpus(decoder: &Decoder) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus");
    let Ok(entries) = std::fs::read_dir(folder.join(decoder.name)) else {
        return Vec::new();
    };
    let mut files: Vec<_> = entries.map(|e| e.unwrap().path()).collect();
    files.sort();
    files.iter().map(|f| std::fs::read(f).unwrap()).collect()
}

/// Two inputs mixed, and bytes overwritten, doubled or left out.
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
fn every_example_is_good() {
    let mut bad = Vec::new();
    for decoder in ALL {
        for (k, example) in (decoder.examples)().iter().enumerate() {
            if !check(decoder, example) {
                bad.push((decoder.name, k));
            }
        }
    }
    assert_eq!(bad, []);
}

#[test]
fn examples_cut_at_every_byte_and_with_every_bit_flipped_are_errors_or_valid() {
    for decoder in ALL {
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
fn what_a_fuzzer_found_and_mixtures_of_it_are_errors_or_valid() {
    for decoder in ALL {
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
