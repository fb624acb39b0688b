//! All targets: the program name selects the decoder. Valid and invalid input are both fine; panics, leaks and
//! memory above `-rss_limit_mb` are failures.

#![no_main]

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use palpate_lab::decoders::{self, Decoder};

static DECODER: LazyLock<&Decoder> =
    LazyLock::new(|| decoders::named(env!("CARGO_BIN_NAME")).expect("a decoder of this name"));

fuzz_target!(|bytes: &[u8]| {
    (DECODER.read)(bytes);
});
