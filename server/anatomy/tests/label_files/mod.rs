//! Label volumes written byte by byte, according to the format definitions.

#![allow(clippy::unwrap_used)]
// Each test file uses a part of it.
#![allow(dead_code)]

use std::io::Write;
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::GzEncoder;

/// A folder that is removed at the end, for files of one test.
pub(crate) struct Folder(tempfile::TempDir);

impl Folder {
    pub(crate) fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    pub(crate) fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }
}

pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// A NIfTI-1 file of 3 x 2 x 2 voxels that hold 0, 1, 2 ... 11, with an sform of 2, 3 and 4 mm.
#[derive(Clone)]
pub(crate) struct Nifti {
    pub(crate) header: Vec<u8>,
    pub(crate) data: Vec<u8>,
    pub(crate) big_endian: bool,
}

pub(crate) const VOXELS: usize = 12;

impl Nifti {
    /// `code` is the datatype; `sample` gives a value's little-endian bytes.
    pub(crate) fn new(code: i16, sample: impl Fn(u8) -> Vec<u8>) -> Self {
        Self::in_order(code, false, sample)
    }

    pub(crate) fn in_order(code: i16, big_endian: bool, sample: impl Fn(u8) -> Vec<u8>) -> Self {
        let mut this = Self {
            header: vec![0; 352],
            data: Vec::new(),
            big_endian,
        };
        for v in 0..VOXELS as u8 {
            let mut bytes = sample(v);
            if big_endian {
                bytes.reverse();
            }
            this.data.extend(bytes);
        }
        let bits = (this.data.len() / VOXELS * 8) as i16;
        this.put(0, &348_i32.to_le_bytes());
        this.header[344..348].copy_from_slice(b"n+1\0");
        this.dims(&[3, 3, 2, 2, 1, 1, 1, 1]);
        this.put(70, &code.to_le_bytes());
        this.put(72, &bits.to_le_bytes());
        for (i, x) in [1.0, 2.0, 3.0, 4.0].into_iter().enumerate() {
            this.float(76 + 4 * i, x);
        }
        this.float(108, 352.0);
        this.header[123] = 2;
        this.put(254, &1_i16.to_le_bytes());
        let rows = [
            [2.0, 0.0, 0.0, 50.0],
            [0.0, 3.0, 0.0, -60.0],
            [0.0, 0.0, 4.0, 70.0],
        ];
        for (r, row) in rows.iter().enumerate() {
            for (c, x) in row.iter().enumerate() {
                this.float(280 + 16 * r + 4 * c, *x);
            }
        }
        this
    }

    /// With unsigned bytes.
    pub(crate) fn bytes() -> Self {
        Self::new(2, |v| vec![v])
    }

    /// Writes little-endian bytes in the file's order.
    pub(crate) fn put(&mut self, at: usize, le: &[u8]) -> &mut Self {
        let mut bytes = le.to_vec();
        if self.big_endian {
            bytes.reverse();
        }
        self.header[at..at + bytes.len()].copy_from_slice(&bytes);
        self
    }

    pub(crate) fn float(&mut self, at: usize, x: f32) -> &mut Self {
        self.put(at, &x.to_le_bytes())
    }

    pub(crate) fn short(&mut self, at: usize, x: i16) -> &mut Self {
        self.put(at, &x.to_le_bytes())
    }

    pub(crate) fn dims(&mut self, dims: &[i16; 8]) -> &mut Self {
        for (i, d) in dims.iter().enumerate() {
            self.short(40 + 2 * i, *d);
        }
        self
    }

    pub(crate) fn file(&self) -> Vec<u8> {
        [self.header.as_slice(), &self.data].concat()
    }
}

/// An NRRD of the same voxels in bytes; `fields` are added to type, dimension, sizes and encoding.
pub(crate) fn nrrd(encoding: &str, fields: &str, data: &[u8]) -> Vec<u8> {
    let head = format!(
        "NRRD0004\n# a comment\ntype: uchar\ndimension: 3\nsizes: 3 2 2\nencoding: {encoding}\n\
         {fields}Segment0_Name:=liver\n\n"
    );
    [head.as_bytes(), data].concat()
}

/// A space of 2, 3 and 4 mm with the origin at (50, -60, 70), in the axes of `space`.
pub(crate) fn space(space: &str) -> String {
    format!(
        "space: {space}\nspace directions: (2,0,0) (0,3,0) (0,0,4)\nspace origin: (50,-60,70)\n"
    )
}

pub(crate) fn ramp() -> Vec<u8> {
    (0..VOXELS as u8).collect()
}
