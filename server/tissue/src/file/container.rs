//! The common envelope of all files: magic, version, sizes, checksum, compressed content.
//!
//! ```text
//! offset  bytes  little-endian
//!      0      8  magic, which kind of file this is
//!      8      4  format version
//!     12      8  size of the content before compression
//!     20      8  size of the content as stored
//!     28      4  CRC-32 over bytes 12..28 and the stored content
//!     32      …  content, raw deflate
//! ```

use std::io::{Read, Write};

use flate2::Compression;
use flate2::read::DeflateDecoder;
use flate2::write::DeflateEncoder;
use rayon::prelude::*;

pub(crate) const HEADER_BYTES: usize = 32;
/// Largest content before compression, in bytes: 16 million nodes with their cells come to 1.3 GiB.
/// A file that declares more is rejected before anything is allocated.
pub(crate) const CONTENT_BYTES_MAX: u64 = 2 << 30;
/// Deflate cannot compress better than 1032 to one. A file that declares more is rejected before anything is
/// allocated.
const SHRINKAGE_MAX: u64 = 1032;
/// Deflate level. Byte planes of coordinates gain little beyond it, and it is four times as fast as the
/// default.
const LEVEL: u32 = 3;
/// Bytes of content that are compressed independently, each on a thread. Parts that shared history would be a
/// hundredth of a percent smaller.
const PART: usize = 512 << 10;

/// Wraps content in an envelope.
pub(crate) fn seal(magic: [u8; 8], version: u32, content: &[u8]) -> Vec<u8> {
    let count = content.len().div_ceil(PART).max(1);
    let part = |i: usize| &content[i * PART..((i + 1) * PART).min(content.len())];
    let packed: Vec<Vec<u8>> = (0..count)
        .into_par_iter()
        .map(|i| pack(part(i), i + 1 == count).expect("writing to memory does not fail"))
        .collect();
    let mut out = vec![0; HEADER_BYTES];
    for part in &packed {
        out.extend_from_slice(part);
    }
    let stored = (out.len() - HEADER_BYTES) as u64;
    out[..8].copy_from_slice(&magic);
    out[8..12].copy_from_slice(&version.to_le_bytes());
    out[12..20].copy_from_slice(&(content.len() as u64).to_le_bytes());
    out[20..28].copy_from_slice(&stored.to_le_bytes());
    let sum = checksum(&out);
    out[28..32].copy_from_slice(&sum.to_le_bytes());
    out
}

/// A part of a deflate stream. Each part except the last ends with an empty block on a byte boundary, where the
/// next part continues.
fn pack(part: &[u8], last: bool) -> std::io::Result<Vec<u8>> {
    let out = Vec::with_capacity(part.len() / 3);
    let mut encoder = DeflateEncoder::new(out, Compression::new(LEVEL));
    encoder.write_all(part)?;
    if last {
        return encoder.finish();
    }
    encoder.flush()?;
    Ok(std::mem::take(encoder.get_mut()))
}

/// Takes content out of its envelope, after every check that the envelope allows.
pub(crate) fn open(magic: [u8; 8], version: u32, bytes: &[u8]) -> Result<Vec<u8>, String> {
    open_within(magic, version, bytes, CONTENT_BYTES_MAX)
}

/// The same for content of at most `content_max` bytes.
pub(crate) fn open_within(
    magic: [u8; 8],
    version: u32,
    bytes: &[u8],
    content_max: u64,
) -> Result<Vec<u8>, String> {
    if bytes.len() < 8 || bytes[..8] != magic {
        return Err("wrong file type; check that the right file was given".into());
    }
    let found = bytes.len() as u64;
    let wrong_length = |expected: u64| {
        Err(format!(
            "{found} bytes instead of {expected}; the file is incomplete or damaged, copy it again"
        ))
    };
    if bytes.len() < HEADER_BYTES {
        return wrong_length(HEADER_BYTES as u64);
    }
    let written = u32_at(bytes, 8);
    if written != version {
        let (word, remedy) = if written < version {
            (
                "older",
                "build it again from its scene, or use the program that wrote it",
            )
        } else {
            (
                "newer",
                "use a newer program, or build it again from its scene with this one",
            )
        };
        return Err(format!(
            "it has format version {written}, {word} than version {version}, which this program reads; {remedy}"
        ));
    }
    let declared = u64_at(bytes, 12);
    let stored = u64_at(bytes, 20);
    let expected = stored.saturating_add(HEADER_BYTES as u64);
    if found != expected {
        return wrong_length(expected);
    }
    if checksum(bytes) != u32_at(bytes, 28) {
        return Err("checksum mismatch; the file is damaged, copy it again".into());
    }
    let max = content_max.min(stored.saturating_mul(SHRINKAGE_MAX));
    if declared > max {
        return Err(format!(
            "{declared} bytes of content declared, at most {max} possible; the file is damaged"
        ));
    }
    let mut content = Vec::with_capacity(declared as usize);
    let read = DeflateDecoder::new(&bytes[HEADER_BYTES..])
        .take(declared + 1)
        .read_to_end(&mut content);
    if read.is_err() || content.len() as u64 != declared {
        return Err("the content cannot be decompressed; the file is damaged".into());
    }
    Ok(content)
}

fn checksum(sealed: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&sealed[12..28]);
    hasher.update(&sealed[HEADER_BYTES..]);
    hasher.finalize()
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(std::array::from_fn(|i| bytes[at + i]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn multi_part_content_round_trip() {
        for len in [0, 1, PART - 1, PART, PART + 1, 3 * PART + 17] {
            let content: Vec<u8> = (0..len).map(|i| ((i * i) >> 7) as u8).collect();
            let sealed = seal(*b"testtest", 1, &content);
            assert!(
                open(*b"testtest", 1, &sealed).unwrap() == content,
                "{len} bytes"
            );
        }
    }
}
