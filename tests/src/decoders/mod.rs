//! All decoders of foreign input as functions of bytes: wire, files, links.
//!
//! Each accepts any bytes and returns an error or a valid value. It must not panic, must respect its memory
//! bound, and its values must be usable. A fuzzer drives them (`tests/fuzz`). The test suite runs each over its
//! examples, damaged examples, and the fuzzing corpus (`tests/fuzz/corpus`).

mod files;
mod wire;

/// A decoder.
#[derive(Debug, Clone, Copy)]
pub struct Decoder {
    /// Name of the fuzz target and of its corpus folder.
    pub name: &'static str,
    /// Decodes any bytes and returns whether they were valid; panics if a law fails.
    pub read: fn(&[u8]) -> bool,
    /// Valid examples.
    pub examples: fn() -> Vec<Vec<u8>>,
    /// Maximum memory in use, as a function of the input length.
    pub holds_max: fn(usize) -> usize,
}

/// All decoders.
pub const ALL: &[Decoder] = &[
    wire::DATAGRAMS,
    wire::CLIENT_STREAM,
    wire::SERVER_STREAM,
    wire::SERVER_SESSION,
    wire::CLIENT_SESSION,
    wire::JOIN_LINK,
    files::MODEL,
    files::MODEL_CONTENT,
    files::SURFACE_STL,
    files::SURFACE_OBJ,
    files::SURFACE_PLY,
    files::LABELS_NIFTI,
    files::LABELS_NRRD,
    files::SCENE,
    files::SCRIPT,
    files::MOTION_TABLE,
    files::MOTION_RECORDING,
    files::PROFILE,
    files::TRACE,
    files::RECIPE,
];

/// The decoder with this name.
pub fn named(name: &str) -> Option<&'static Decoder> {
    ALL.iter().find(|d| d.name == name)
}

/// Calls `read` on valid UTF-8 text; other bytes are rejected.
fn text(bytes: &[u8], read: impl FnOnce(&str) -> bool) -> bool {
    std::str::from_utf8(bytes).is_ok_and(read)
}
