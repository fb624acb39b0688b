//! Atomic file writes: a temporary file beside the path, then a rename.
//!
//! Every output of the programs uses this module. A rename would replace anything of that name, so only regular
//! files are ever replaced:
//!
//! ```text
//! no file, regular file         written beside it, then renamed
//! link to a regular file        replaces its target; the link stays
//! device, pipe                  written into, when the content is complete
//! folder, socket, dead link     rejected
//! ```

use std::fs::{File, FileType, OpenOptions};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

/// Names that are tried for the temporary file.
const NAMES_MAX: u32 = 100;

/// The reason why a file could not be written. The previous content of the path is untouched.
#[derive(Debug, thiserror::Error)]
#[error("{}: can not be written: {source}; {}", path.display(), advice(source))]
pub struct WriteError {
    /// The file.
    pub path: PathBuf,
    /// The error of the operating system.
    pub source: io::Error,
}

fn advice(source: &io::Error) -> &'static str {
    match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
            "free disk space or write elsewhere; nothing was changed"
        }
        ErrorKind::NotFound => "make its folder first",
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => {
            "write where you are allowed to"
        }
        ErrorKind::InvalidInput => "name a regular file, or a new one",
        _ => "check that its folder can be written",
    }
}

/// Method of writing to a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PublishMethod {
    /// Replaces the existing file.
    Move,
    /// Keeps the existing device or pipe and writes into it.
    Into,
}

/// A file that is complete on the disk but not yet at its path. Dropping it removes the temporary file. So
/// several files can be completed before the first of them is put in place.
#[derive(Debug)]
#[must_use = "the file is thrown away unless it is put in place"]
pub struct Staged {
    beside: PathBuf,
    /// The path as given.
    path: PathBuf,
    /// The path with links resolved.
    place: PathBuf,
    way: PublishMethod,
    in_place: bool,
}

impl Staged {
    /// Writes the content for `path` with `fill`.
    pub fn write(
        path: &Path,
        fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
    ) -> Result<Self, WriteError> {
        let (staged, file) = Self::begin(path)?;
        let mut out = BufWriter::new(file);
        let written = fill(&mut out).and_then(|()| {
            out.flush()?;
            // Some file systems report only now that they are full.
            out.get_ref().sync_all()
        });
        written.map_err(|source| staged.error(source))?;
        Ok(staged)
    }

    /// Checks that a file can be put at `path` by starting one. Existing files stay unchanged, and the
    /// temporary file is removed.
    pub fn check(path: &Path) -> Result<(), WriteError> {
        Self::begin(path).map(|_| ())
    }

    /// Makes an empty temporary file.
    fn begin(path: &Path) -> Result<(Self, File), WriteError> {
        let error = |source| WriteError {
            path: path.to_owned(),
            source,
        };
        let (place, way) = place_of(path).map_err(error)?;
        let base = match way {
            PublishMethod::Move => place.clone(),
            PublishMethod::Into => std::env::temp_dir().join(place.file_name().unwrap_or_default()),
        };
        let (beside, file) = create_beside(&base).map_err(error)?;
        let staged = Self {
            beside,
            path: path.to_owned(),
            place,
            way,
            in_place: false,
        };
        if way == PublishMethod::Move
            && let Ok(before) = std::fs::metadata(&staged.place)
        {
            // The attributes of another owner's file cannot be kept.
            let _ = file.set_permissions(before.permissions());
        }
        Ok((staged, file))
    }

    /// Its final path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Renames the file to its path; a reader finds the old file or the new one, never a part.
    pub fn put_in_place(mut self) -> Result<(), WriteError> {
        match self.way {
            PublishMethod::Move => {
                std::fs::rename(&self.beside, &self.place).map_err(|source| self.error(source))?;
                self.in_place = true;
            }
            PublishMethod::Into => self.pour().map_err(|source| self.error(source))?,
        }
        Ok(())
    }

    /// Writes the file into the device or pipe at its path.
    fn pour(&self) -> io::Result<()> {
        let mut out = OpenOptions::new().write(true).open(&self.place)?;
        match io::copy(&mut File::open(&self.beside)?, &mut out) {
            // A reader that closes its end early is not an error.
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
            done => done.map(|_| ()),
        }
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
            // A failure to remove the temporary file adds nothing to the error.
            let _ = std::fs::remove_file(&self.beside);
        }
    }
}

/// Writes a file atomically.
pub fn write_file(path: &Path, content: impl AsRef<[u8]>) -> Result<(), WriteError> {
    Staged::write(path, |out| out.write_all(content.as_ref()))?.put_in_place()
}

/// The path with links resolved, and the method of writing to it.
fn place_of(path: &Path) -> io::Result<(PathBuf, PublishMethod)> {
    let refused = |why: &str| Err(io::Error::new(ErrorKind::InvalidInput, why));
    let metadata = match std::fs::metadata(path) {
        Ok(metadata) => metadata,
        Err(error) if error.kind() == ErrorKind::NotFound => {
            if path.symlink_metadata().is_ok() {
                return refused("it is a dangling symbolic link");
            }
            return Ok((path.to_owned(), PublishMethod::Move));
        }
        Err(error) => return Err(error),
    };
    if metadata.is_dir() {
        return refused("it is a folder");
    }
    if !metadata.is_file() {
        return if is_socket(metadata.file_type()) {
            refused("it is a socket")
        } else {
            Ok((path.to_owned(), PublishMethod::Into))
        };
    }
    if names_open_file(path) {
        // The position of the open file would be lost, and later output would overwrite the content.
        return refused("it names a file that is open already");
    }
    Ok((path.canonicalize()?, PublishMethod::Move))
}

#[cfg(unix)]
fn is_socket(kind: FileType) -> bool {
    std::os::unix::fs::FileTypeExt::is_socket(&kind)
}

#[cfg(not(unix))]
fn is_socket(_kind: FileType) -> bool {
    false
}

/// Whether a path names an open file of a process, as `/dev/stdout` does.
fn names_open_file(path: &Path) -> bool {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new(".")).canonicalize();
    let target = std::fs::read_link(path);
    [folder, target]
        .into_iter()
        .flatten()
        .any(|p| p.starts_with("/proc"))
}

/// Makes a new file beside `place`, under an unused name.
fn create_beside(place: &Path) -> io::Result<(PathBuf, File)> {
    let mut number = 0;
    loop {
        let mut name = place.file_name().unwrap_or_default().to_owned();
        name.push(format!(".{}.{number}.part", std::process::id()));
        let beside = place.with_file_name(name);
        match File::create_new(&beside) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists && number < NAMES_MAX => number += 1,
            made => return made.map(|file| (beside, file)),
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::io::Read as _;
    use std::os::unix::fs::{FileTypeExt as _, PermissionsExt, symlink};
    use std::os::unix::net::UnixListener;
    use std::process::Command;

    use super::*;

    fn names(folder: &Path) -> usize {
        std::fs::read_dir(folder).unwrap().count()
    }

    #[test]
    fn devices_and_pipes_are_written_and_never_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let null = dir.path().join("null");
        symlink("/dev/null", &null).unwrap();
        for device in [Path::new("/dev/null"), &null] {
            Staged::check(device).unwrap();
            write_file(device, "gone").unwrap();
            let kind = std::fs::metadata(device).unwrap().file_type();
            assert!(kind.is_char_device());
        }
        assert!(null.symlink_metadata().unwrap().is_symlink());
        let pipe = dir.path().join("pipe");
        assert!(
            Command::new("mkfifo")
                .arg(&pipe)
                .status()
                .unwrap()
                .success()
        );
        let from = pipe.clone();
        let reader = std::thread::spawn(move || {
            let mut text = String::new();
            File::open(from).unwrap().read_to_string(&mut text).unwrap();
            text
        });
        write_file(&pipe, "through").unwrap();
        assert_eq!(reader.join().unwrap(), "through");
        assert!(std::fs::metadata(&pipe).unwrap().file_type().is_fifo());
        assert_eq!(names(dir.path()), 2);
    }

    #[test]
    fn write_through_a_link_replaces_its_target() {
        let dir = tempfile::tempdir().unwrap();
        let (file, link) = (dir.path().join("file"), dir.path().join("link"));
        std::fs::write(&file, "old").unwrap();
        std::fs::set_permissions(&file, PermissionsExt::from_mode(0o600)).unwrap();
        symlink("file", &link).unwrap();
        write_file(&link, "new").unwrap();
        assert!(link.symlink_metadata().unwrap().is_symlink());
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "new");
        let mode = std::fs::metadata(&file).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "it stays private");
    }

    #[test]
    fn folders_sockets_and_dangling_links_are_rejected_with_the_reason() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        symlink("absent", at("dead")).unwrap();
        let _listener = UnixListener::bind(at("socket")).unwrap();
        std::fs::create_dir(at("folder")).unwrap();
        for (name, why) in [
            ("dead", "dangling symbolic link"),
            ("socket", "a socket"),
            ("folder", "a folder"),
        ] {
            let said = write_file(&at(name), "x").unwrap_err().to_string();
            assert!(said.contains(name) && said.contains(why), "{said}");
            assert!(Staged::check(&at(name)).is_err());
        }
        assert_eq!(names(dir.path()), 3);
        assert!(
            at("socket")
                .symlink_metadata()
                .unwrap()
                .file_type()
                .is_socket()
        );
    }

    #[test]
    fn check_changes_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let old = dir.path().join("old");
        std::fs::write(&old, "kept").unwrap();
        Staged::check(&old).unwrap();
        Staged::check(&dir.path().join("new")).unwrap();
        assert!(Staged::check(&dir.path().join("absent/new")).is_err());
        assert_eq!(std::fs::read_to_string(&old).unwrap(), "kept");
        assert_eq!(names(dir.path()), 1);
    }
}
