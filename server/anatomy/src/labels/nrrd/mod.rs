//! NRRD, attached (`.nrrd`) and detached (`.nhdr` with a data file beside it); raw, gzip and ascii.
//!
//! Fields are those of the format's definition (teem.sourceforge.net/nrrd/format.html).

mod header;

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use flate2::bufread::MultiGzDecoder;

use super::LabelVolume;
use super::samples::{Coding, Gather};
use super::volume::{broken, drain, open, surplus};
use crate::InputError;
use header::{Encoding, Header};

/// Longest number of an ascii data file in bytes. Reason: a double written in full has 25.
const WORD_MAX: usize = 64;

/// Reads a file.
pub(super) fn read(path: &Path) -> Result<LabelVolume, InputError> {
    let (file, _) = open(path)?;
    let mut attached = BufReader::new(file);
    let header = Header::read(path, &mut attached)?;
    let size = header.size()?;
    let (to_world, mut warnings) = header.to_world()?;
    let labels = match &header.data_file {
        None => read_data(path, &header, size, attached, &mut warnings)?,
        Some(name) => {
            let beside = path.parent().unwrap_or(Path::new("")).join(name);
            let (file, _) = open(&beside)?;
            let from = BufReader::new(file);
            read_data(&beside, &header, size, from, &mut warnings)?
        }
    };
    Ok(LabelVolume {
        size,
        labels,
        to_world,
        warnings,
    })
}

fn read_data(
    path: &Path,
    header: &Header,
    size: [usize; 3],
    mut from: BufReader<File>,
    warnings: &mut Vec<String>,
) -> Result<Vec<u16>, InputError> {
    let mut gather = Gather::new(path, size);
    let voxels: usize = size.iter().product();
    skip_lines(&mut from, header.line_skip).map_err(|e| gather.stream_error(e))?;
    match header.encoding {
        Encoding::Raw => {
            let bytes = (voxels * header.sample.bytes()) as u64;
            let skip = match header.byte_skip {
                // -1: the samples are the last bytes of the file, after any other content except a header.
                None => from.stream_position().and_then(|start| {
                    let end = from.seek(SeekFrom::End(0))?;
                    let at = end.checked_sub(bytes).filter(|at| *at >= start);
                    from.seek(SeekFrom::Start(at.unwrap_or(start)))?;
                    Ok(at.is_some())
                }),
                Some(n) => skip_bytes(&mut from, n),
            };
            if !skip.map_err(|e| gather.stream_error(e))? {
                return Err(gather.truncated());
            }
            let coding = Coding::plain(header.sample, header.big_endian);
            gather.read(&mut from, coding, voxels)?;
            let left = from
                .stream_position()
                .and_then(|at| Ok(from.seek(SeekFrom::End(0))?.saturating_sub(at)));
            match left.map_err(|e| gather.stream_error(e))? {
                0 => {}
                left => warnings.push(surplus(path, left)),
            }
        }
        Encoding::Gzip => {
            let mut from = MultiGzDecoder::new(from);
            let skipped = skip_bytes(&mut from, header.byte_skip.unwrap_or(0));
            if !skipped.map_err(|e| gather.stream_error(e))? {
                return Err(gather.truncated());
            }
            let coding = Coding::plain(header.sample, header.big_endian);
            gather.read(&mut from, coding, voxels)?;
            drain(&mut from).map_err(|e| gather.stream_error(e))?;
        }
        Encoding::Ascii => {
            let skipped = skip_bytes(&mut from, header.byte_skip.unwrap_or(0));
            if !skipped.map_err(|e| gather.stream_error(e))? {
                return Err(gather.truncated());
            }
            read_words(path, &mut from, &mut gather)?;
        }
    }
    gather.finish()
}

/// Skips bytes; `false` when the stream ends first.
fn skip_bytes(from: &mut impl Read, count: u64) -> std::io::Result<bool> {
    std::io::copy(&mut from.take(count), &mut std::io::sink()).map(|n| n == count)
}

fn skip_lines(from: &mut impl BufRead, lines: u64) -> std::io::Result<()> {
    for _ in 0..lines {
        loop {
            let chunk = from.fill_buf()?;
            if chunk.is_empty() {
                return Ok(());
            }
            let end = chunk.iter().position(|b| *b == b'\n');
            let used = end.map_or(chunk.len(), |at| at + 1);
            from.consume(used);
            if end.is_some() {
                break;
            }
        }
    }
    Ok(())
}

/// Numbers between white space (or commas), word by word.
fn read_words(path: &Path, from: &mut impl BufRead, gather: &mut Gather) -> Result<(), InputError> {
    let mut word = Vec::with_capacity(WORD_MAX);
    let mut count = 0_u64;
    while !gather.is_full() {
        let chunk = from.fill_buf().map_err(|e| gather.stream_error(e))?;
        let (used, at_end) = (chunk.len(), chunk.is_empty());
        for &byte in chunk {
            if !(byte.is_ascii_whitespace() || byte == b',') {
                word.push(byte);
                if word.len() > WORD_MAX {
                    return Err(not_a_number(path, count, &word));
                }
                continue;
            }
            push_word(path, &mut word, &mut count, gather)?;
            if gather.is_full() {
                return Ok(());
            }
        }
        from.consume(used);
        if at_end {
            return push_word(path, &mut word, &mut count, gather);
        }
    }
    Ok(())
}

fn push_word(
    path: &Path,
    word: &mut Vec<u8>,
    count: &mut u64,
    gather: &mut Gather,
) -> Result<(), InputError> {
    if word.is_empty() {
        return Ok(());
    }
    let number = std::str::from_utf8(word).ok().and_then(|w| w.parse().ok());
    let number = number.ok_or_else(|| not_a_number(path, *count, word))?;
    word.clear();
    *count += 1;
    gather.push(number)
}

fn not_a_number(path: &Path, count: u64, word: &[u8]) -> InputError {
    broken(
        path,
        format!("number {}", count + 1),
        format!("\"{}\" is not a number", String::from_utf8_lossy(word)),
    )
}
