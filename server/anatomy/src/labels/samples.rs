//! Reading samples as labels: any number type, either byte order, bounded memory.

use std::io::{ErrorKind, Read};
use std::path::Path;

use super::volume::{broken, truncated};
use crate::InputError;

/// Bytes decoded at a time; a multiple of every sample's size.
const BLOCK_BYTES: usize = 1 << 16;

/// Labels reserved before the first one has been read. Reason: a header may declare more than the file holds;
/// beyond this the memory grows with the actual data.
const RESERVED: usize = 1 << 20;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SampleType {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl SampleType {
    /// Bytes of one sample.
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// The value of a sample in little-endian bytes. Integers beyond 2^53 lose digits, but are not labels in
    /// any case.
    fn value(self, b: &[u8]) -> f64 {
        let mut eight = [0_u8; 8];
        eight[..b.len()].copy_from_slice(b);
        let word = u64::from_le_bytes(eight);
        match self {
            Self::U8 | Self::U16 | Self::U32 | Self::U64 => word as f64,
            Self::I8 => f64::from(word as i8),
            Self::I16 => f64::from(word as i16),
            Self::I32 => f64::from(word as i32),
            Self::I64 => word as i64 as f64,
            Self::F32 => f64::from(f32::from_bits(word as u32)),
            Self::F64 => f64::from_bits(word),
        }
    }
}

/// Conversion from the samples of a file to labels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Coding {
    pub(super) sample: SampleType,
    pub(super) big_endian: bool,
    /// label = sample · slope + intercept.
    pub(super) slope: f64,
    pub(super) intercept: f64,
}

impl Coding {
    /// Samples that are labels without conversion.
    pub(super) fn plain(sample: SampleType, big_endian: bool) -> Self {
        Self {
            sample,
            big_endian,
            slope: 1.0,
            intercept: 0.0,
        }
    }
}

/// Collects labels and tracks the next voxel.
pub(super) struct Gather<'a> {
    path: &'a Path,
    size: [usize; 3],
    labels: Vec<u16>,
}

impl<'a> Gather<'a> {
    /// For a volume of a size that has been checked against the limit.
    pub(super) fn new(path: &'a Path, size: [usize; 3]) -> Self {
        let voxels: usize = size.iter().product();
        Self {
            path,
            size,
            labels: Vec::with_capacity(voxels.min(RESERVED)),
        }
    }

    fn voxels(&self) -> usize {
        self.size.iter().product()
    }

    /// Whether every voxel has its label.
    pub(super) fn is_full(&self) -> bool {
        self.labels.len() == self.voxels()
    }

    /// Adds the next voxel's value.
    pub(super) fn push(&mut self, value: f64) -> Result<(), InputError> {
        if value >= 0.0 && value <= f64::from(u16::MAX) && value.trunc() == value {
            self.labels.push(value as u16);
            return Ok(());
        }
        let [nx, ny, _] = self.size;
        let at = self.labels.len();
        let (x, y, z) = (at % nx, at / nx % ny, at / (nx * ny));
        let what = format!(
            "voxel ({x}, {y}, {z}) holds {value}, which is no label; labels are whole numbers from 0 to \
             65535; export the segmentation, not the image"
        );
        Err(InputError::of(self.path, what))
    }

    /// Adds `count` samples from a stream.
    pub(super) fn read(
        &mut self,
        from: &mut impl Read,
        coding: Coding,
        count: usize,
    ) -> Result<(), InputError> {
        let each = coding.sample.bytes();
        let mut block = vec![0; BLOCK_BYTES.min(count.max(1) * each)];
        let mut left = count * each;
        while left > 0 {
            let wanted = left.min(block.len());
            let got = read_fully(from, &mut block[..wanted]).map_err(|e| self.stream_error(e))?;
            for sample in block[..got - got % each].chunks_exact_mut(each) {
                if coding.big_endian {
                    sample.reverse();
                }
                self.push(coding.sample.value(sample) * coding.slope + coding.intercept)?;
            }
            if got < wanted {
                return Err(self.truncated());
            }
            left -= wanted;
        }
        Ok(())
    }

    /// The labels, if none is missing.
    pub(super) fn finish(self) -> Result<Vec<u16>, InputError> {
        if self.is_full() {
            Ok(self.labels)
        } else {
            Err(self.truncated())
        }
    }

    /// Marks the end of the data.
    pub(super) fn truncated(&self) -> InputError {
        truncated(self.path, self.voxels() as u64, self.labels.len() as u64)
    }

    /// An error of the stream, with the number of voxels read.
    pub(super) fn stream_error(&self, source: std::io::Error) -> InputError {
        match source.kind() {
            ErrorKind::UnexpectedEof => self.truncated(),
            ErrorKind::InvalidData | ErrorKind::InvalidInput => broken(
                self.path,
                format!(
                    "compressed data after {} of {} voxels",
                    self.labels.len(),
                    self.voxels()
                ),
                source.to_string(),
            ),
            _ => InputError::io(self.path)(source),
        }
    }
}

/// Fills the buffer as far as the stream goes.
pub(super) fn read_fully(from: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match from.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}
