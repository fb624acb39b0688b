//! Everything of ours that reads what others wrote, as functions of bytes: the wire, files, links.
//!
//! Each takes any bytes, and gives an error or something valid; it must not panic, must not take more
//! memory than its bound, and what it accepted must be good for use. A fuzzer drives them
//! (`tests/fuzz`), and the suite runs each over its examples, damaged, and over what a fuzzer found
//! worth keeping (`tests/fuzz/corpus`).

mod files;
mod wire;

/// Something that reads bytes.
#[derive(Debug, Clone, Copy)]
pub struct Decoder {
    /// Its name: of the fuzz target, and of the folder of its corpus.
    pub name: &'static str,
    /// Reads any bytes, and says whether they were good; a law that does not hold panics.
    pub read: fn(&[u8]) -> bool,
    /// Bytes to begin with, all of them good.
    pub examples: fn() -> Vec<Vec<u8>>,
    /// The most bytes that reading may hold at a time, for so many bytes of input.
    pub holds_max: fn(usize) -> usize,
}

/// All of them.
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
    files::HAND_TABLE,
    files::PROFILE,
    files::TRACE,
    files::RECIPE,
];

/// The one of that name.
pub fn named(name: &str) -> Option<&'static Decoder> {
    ALL.iter().find(|d| d.name == name)
}

/// Calls `read` on the text, if it is one: other bytes are refused before any parser of text.
fn text(bytes: &[u8], read: impl FnOnce(&str) -> bool) -> bool {
    std::str::from_utf8(bytes).is_ok_and(read)
}
