//! Validation of element lengths before a file is parsed.
//!
//! The parser allocates an element of the declared length before it reads it, and a length has 32 bits: one
//! flipped bit would cost gigabytes. Sequences and items are entered, so that all elements form one list.

use std::fs::File;
use std::io::{BufReader, Error, ErrorKind, Read, Result};
use std::path::Path;

/// Bytes before the first element.
const PREAMBLE: i64 = 132;
/// The length of a value that ends with a delimiter.
const UNDEFINED: u32 = u32::MAX;
/// Value representations with a length of 16 bits; all others, known or not, have 32.
const SHORT: [&[u8; 2]; 21] = [
    b"AE", b"AS", b"AT", b"CS", b"DA", b"DS", b"DT", b"FD", b"FL", b"IS", b"LO", b"LT", b"PN",
    b"SH", b"SL", b"SS", b"ST", b"TM", b"UI", b"UL", b"US",
];
const ITEM_GROUP: u16 = 0xfffe;
const PIXEL_DATA: (u16, u16) = (0x7fe0, 0x0010);

/// How elements of the data set are written.
#[derive(Clone, Copy)]
struct Syntax {
    explicit: bool,
    big_endian: bool,
}

struct Scan {
    file: BufReader<File>,
    left: u64,
}

/// Rejects a file in which an element declares more bytes than follow it.
pub(super) fn check(path: &Path) -> Result<()> {
    let file = File::open(path)?;
    let bytes = file.metadata()?.len();
    let mut scan = Scan {
        file: BufReader::new(file),
        left: bytes.saturating_sub(PREAMBLE as u64),
    };
    scan.file.seek_relative(PREAMBLE)?;
    let mut syntax = Syntax {
        explicit: true,
        big_endian: false,
    };
    while scan.left >= 8 {
        // Elements after group 2 may have a different encoding, which is known by then.
        let group = u16::from_le_bytes(scan.peek()?);
        let own = if group == 2 {
            Syntax {
                explicit: true,
                big_endian: false,
            }
        } else {
            syntax
        };
        if !scan.element(own, &mut syntax)? {
            return Ok(());
        }
    }
    Ok(())
}

impl Scan {
    fn peek(&mut self) -> Result<[u8; 2]> {
        let b: [u8; 2] = self.take()?;
        self.file.seek_relative(-2)?;
        self.left += 2;
        Ok(b)
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes)?;
        self.left = self.left.saturating_sub(N as u64);
        Ok(bytes)
    }

    fn short(&mut self, syntax: Syntax) -> Result<u16> {
        let b = self.take()?;
        Ok(if syntax.big_endian {
            u16::from_be_bytes(b)
        } else {
            u16::from_le_bytes(b)
        })
    }

    fn long(&mut self, syntax: Syntax) -> Result<u32> {
        let b = self.take()?;
        Ok(if syntax.big_endian {
            u32::from_be_bytes(b)
        } else {
            u32::from_le_bytes(b)
        })
    }

    /// Passes one element; `false` at the end of the elements to check.
    fn element(&mut self, syntax: Syntax, of_data: &mut Syntax) -> Result<bool> {
        let tag = (self.short(syntax)?, self.short(syntax)?);
        let mut kind = *b"  ";
        let length = if tag.0 == ITEM_GROUP || !syntax.explicit {
            self.long(syntax)?
        } else {
            kind = self.take()?;
            if SHORT.contains(&&kind) {
                u32::from(self.short(syntax)?)
            } else {
                self.short(syntax)?;
                self.long(syntax)?
            }
        };
        if length == UNDEFINED {
            // A sequence of unknown representation has its own encoding; the rest is not checked.
            return Ok(&kind != b"UN" && tag != PIXEL_DATA);
        }
        if u64::from(length) > self.left {
            return Err(Error::new(
                ErrorKind::InvalidData,
                format!(
                    "element ({:04x},{:04x}) claims {length} bytes, the file has {} left",
                    tag.0, tag.1, self.left
                ),
            ));
        }
        if tag == PIXEL_DATA {
            return Ok(false);
        }
        let walks = tag.0 == ITEM_GROUP || &kind == b"SQ" || self.holds_items(syntax, length)?;
        if walks {
            return Ok(true);
        }
        if tag == (2, 0x10) {
            let mut text = vec![0; length as usize];
            self.file.read_exact(&mut text)?;
            let text = String::from_utf8_lossy(&text);
            of_data.explicit = text.trim_end_matches(['\0', ' ']) != "1.2.840.10008.1.2";
            of_data.big_endian = text.starts_with("1.2.840.10008.1.2.2");
        } else {
            self.file.seek_relative(i64::from(length))?;
        }
        self.left -= u64::from(length);
        Ok(true)
    }

    /// Whether a value without a representation begins like a sequence.
    fn holds_items(&mut self, syntax: Syntax, length: u32) -> Result<bool> {
        Ok(!syntax.explicit && length >= 8 && self.peek()? == ITEM_GROUP.to_le_bytes())
    }
}
