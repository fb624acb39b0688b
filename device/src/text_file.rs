//! A text file that somebody names, read within a bound.
//!
//! What is no regular file is not opened: a pipe would wait for a writer that may never come, and a device has no
//! length to be looked at before it fills the memory. A file that grows while it is read ends at the bound too.

use std::fs::{File, metadata};
use std::io::{Error, ErrorKind, Read as _};
use std::path::Path;

use thiserror::Error as ThisError;

/// Why a text was not read. Who shows it says which file, and what it should have been.
#[derive(Debug, ThisError)]
pub enum TextFileError {
    /// It is no file, or the system does not give it.
    #[error(transparent)]
    Read(#[from] Error),
    /// It has more bytes than are taken.
    #[error("it has {bytes} bytes")]
    TooLarge {
        /// Its size, or how many were read of one that says none.
        bytes: u64,
    },
}

/// The text of a regular file of at most `bytes_max` bytes.
pub fn read(path: &Path, bytes_max: u64) -> Result<String, TextFileError> {
    let said = metadata(path)?;
    if said.is_dir() {
        return Err(no_file("it is a folder; name the file in it"));
    }
    if !said.is_file() {
        return Err(no_file(
            "it is not a file but a device or a pipe; write it into a file first",
        ));
    }
    if said.len() > bytes_max {
        return Err(TextFileError::TooLarge { bytes: said.len() });
    }
    let mut text = Vec::new();
    let read = File::open(path)?
        .take(bytes_max.saturating_add(1))
        .read_to_end(&mut text)?;
    if read as u64 > bytes_max {
        let bytes = metadata(path)?.len().max(read as u64);
        return Err(TextFileError::TooLarge { bytes });
    }
    String::from_utf8(text).map_err(|e| {
        let valid = &e.as_bytes()[..e.utf8_error().valid_up_to()];
        let line = valid.split(|b| *b == b'\n').count();
        no_file(&format!("line {line} is no text in UTF-8"))
    })
}

fn no_file(why: &str) -> TextFileError {
    TextFileError::Read(Error::new(ErrorKind::InvalidInput, why))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_read_to_its_bound_and_not_beyond() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.csv");
        std::fs::write(&path, "12345").unwrap();
        assert_eq!(read(&path, 5).unwrap(), "12345");
        assert!(matches!(
            read(&path, 4),
            Err(TextFileError::TooLarge { bytes: 5 })
        ));
        std::fs::write(&path, b"a\nb\xff").unwrap();
        let said = read(&path, 5).unwrap_err().to_string();
        assert!(said.contains("line 2"), "{said}");
    }

    #[test]
    fn what_is_no_file_is_not_opened() {
        let dir = tempfile::tempdir().unwrap();
        let said = read(dir.path(), 5).unwrap_err().to_string();
        assert!(said.contains("is a folder"), "{said}");
        assert!(read(&dir.path().join("absent"), 5).is_err());
        #[cfg(unix)]
        {
            let said = read(Path::new("/dev/zero"), 5).unwrap_err().to_string();
            assert!(said.contains("is not a file"), "{said}");
        }
    }
}
