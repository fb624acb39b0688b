//! Reads a text file of bounded size.
//!
//! Only regular files are opened: a pipe would wait for a writer, and a device has no length to check before
//! reading. A file that grows meanwhile is also cut off at the bound.

use std::fs::{File, metadata};
use std::io::{Error, ErrorKind, Read as _};
use std::path::Path;

/// The text of a regular file of at most `bytes_max` bytes. The caller adds the file's name to an error.
pub fn read(path: &Path, bytes_max: u64) -> Result<String, Error> {
    let too_large = |bytes: u64| {
        let why = format!("it has {bytes} bytes; {bytes_max} are the most");
        Error::new(ErrorKind::FileTooLarge, why)
    };
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
        return Err(too_large(said.len()));
    }
    let mut text = Vec::new();
    let read = File::open(path)?
        .take(bytes_max.saturating_add(1))
        .read_to_end(&mut text)?;
    if read as u64 > bytes_max {
        return Err(too_large(metadata(path)?.len().max(read as u64)));
    }
    String::from_utf8(text).map_err(|e| {
        let valid = &e.as_bytes()[..e.utf8_error().valid_up_to()];
        let line = valid.split(|b| *b == b'\n').count();
        no_file(&format!("line {line} is not UTF-8 text"))
    })
}

fn no_file(why: &str) -> Error {
    Error::new(ErrorKind::InvalidInput, why)
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
        let said = read(&path, 4).unwrap_err().to_string();
        assert!(said.contains("it has 5 bytes"), "{said}");
        std::fs::write(&path, b"a\nb\xff").unwrap();
        let said = read(&path, 5).unwrap_err().to_string();
        assert!(said.contains("line 2"), "{said}");
    }

    #[test]
    fn only_regular_files_are_opened() {
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
