//! All targets: the one whose name the program has. Input that was good or not is all the same; panics, leaks and
//! more memory than `-rss_limit_mb` are not.

#![no_main]

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use palpate_lab::decoders::{self, Decoder};

static DECODER: LazyLock<&Decoder> =
    LazyLock::new(|| decoders::named(env!("CARGO_BIN_NAME")).expect("a decoder of this name"));

fuzz_target!(|bytes: &[u8]| {
    (DECODER.read)(bytes);
});
