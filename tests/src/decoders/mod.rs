//! All decoders of foreign input as functions of bytes: wire, files, links.
//!
//! Each accepts any bytes and returns an error or a valid value. It must not panic, must respect its memory
//! bound, and its values must be usable. A fuzzer drives them (`tests/fuzz`). The test suite runs each over its
//! examples, damaged examples, and the fuzzing corpus (`tests/fuzz/corpus`).

mod files;
mod wire;

#[derive(Debug, Clone, Copy)]
pub struct Decoder {
    /// Name of the fuzz target and of its corpus folder.
    pub name: &'static str,
    /// Decodes any bytes and returns whether they were valid; panics if a law fails.
    pub read: fn(&[u8]) -> bool,
    pub examples: fn() -> Vec<Vec<u8>>,
    /// Maximum memory in use, as a function of the input length.
    pub holds_max: fn(usize) -> usize,
}

/// A table of decoders: name, memory bound, reader, and examples.
macro_rules! decoders {
    ($($name:literal, $holds_max:expr, $read:expr, $examples:expr;)*) => {
        &[$($crate::decoders::Decoder {
            name: $name,
            read: $read,
            examples: || $examples,
            holds_max: $holds_max,
        }),*]
    };
}
use decoders;

pub fn all() -> impl Iterator<Item = &'static Decoder> {
    wire::ALL.iter().chain(files::ALL)
}

pub fn named(name: &str) -> Option<&'static Decoder> {
    all().find(|d| d.name == name)
}

/// Calls `read` on valid UTF-8 text; other bytes are rejected.
fn text(bytes: &[u8], read: impl FnOnce(&str) -> bool) -> bool {
    std::str::from_utf8(bytes).is_ok_and(read)
}
