//! Writing a file whole: beside its place first, then moved there.

use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

/// Why a file could not be written. Whatever stood in its place before is untouched.
#[derive(Debug, thiserror::Error)]
#[error("{}: can not be written: {source}; {}", path.display(), advice(source))]
pub struct WriteError {
    /// The file.
    pub path: PathBuf,
    /// What the operating system said.
    pub source: io::Error,
}

fn advice(source: &io::Error) -> &'static str {
    match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
            "make room there or write elsewhere; nothing was changed"
        }
        ErrorKind::NotFound => "make its folder first",
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => {
            "write where you are allowed to"
        }
        _ => "check that its place is a file in a folder one can write to",
    }
}

/// A file that is complete on the disk but not yet in its place. Dropped, it leaves nothing behind;
/// so several files can be made sure of before the first of them is put in place.
#[derive(Debug)]
#[must_use = "the file is thrown away unless it is put in place"]
pub struct Staged {
    beside: PathBuf,
    path: PathBuf,
    in_place: bool,
}

impl Staged {
    /// Writes with `fill` what is to stand at `path`.
    pub fn write(
        path: &Path,
        fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
    ) -> Result<Self, WriteError> {
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(format!(".{}.part", std::process::id()));
        let staged = Self {
            beside: path.with_file_name(name),
            path: path.to_owned(),
            in_place: false,
        };
        let written = File::create(&staged.beside).and_then(|file| {
            let mut out = BufWriter::new(file);
            fill(&mut out)?;
            out.flush()?;
            // Some file systems find out only now that they are full.
            out.get_ref().sync_all()
        });
        written.map_err(|source| staged.error(source))?;
        Ok(staged)
    }

    /// The place that it is for.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Moves the file into its place; a reader finds the old file or the new one, never a part.
    pub fn put_in_place(mut self) -> Result<(), WriteError> {
        std::fs::rename(&self.beside, &self.path).map_err(|source| self.error(source))?;
        self.in_place = true;
        Ok(())
    }

    fn error(&self, source: io::Error) -> WriteError {
        WriteError {
            path: self.path.clone(),
            source,
        }
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        if !self.in_place {
            // That the rest of an attempt can not be removed either adds nothing to the error.
            let _ = std::fs::remove_file(&self.beside);
        }
    }
}
