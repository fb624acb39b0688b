//! Files that only their owner may read: the identity of a host, the seat of a participant.

use std::fs::{File, OpenOptions, Permissions};
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};

/// Names that are tried for the file beside its place.
const NAMES_MAX: u32 = 100;

/// The user's folder for the state of these programs: `$XDG_STATE_HOME/palpate`, or `~/.local/state/palpate`, or
/// `%LOCALAPPDATA%\palpate`. `None` where the environment names none of them.
pub fn state_folder() -> Option<PathBuf> {
    // The XDG specification has relative paths ignored.
    let absolute = |name: &str| {
        let path = PathBuf::from(std::env::var_os(name)?);
        path.is_absolute().then_some(path)
    };
    let base = absolute("XDG_STATE_HOME")
        .or_else(|| absolute("HOME").map(|home| home.join(".local/state")))
        .or_else(|| absolute("LOCALAPPDATA"))?;
    Some(base.join("palpate"))
}

/// Makes a folder that only its owner may enter, with the folders above it. A folder that is there stays as it is.
pub fn make_private_folder(path: &Path) -> io::Result<()> {
    let mut builder = std::fs::DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(path)
}

/// Opens a private file for reading and writing; makes it when it is not there.
pub fn open_private(path: &Path) -> io::Result<File> {
    let mut options = private();
    let file = options.read(true).create(true).truncate(false).open(path)?;
    check_private(&file)?;
    Ok(file)
}

/// Rejects a file that other users may read, and all but regular files.
pub fn check_private(file: &File) -> io::Result<()> {
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::new(
            ErrorKind::InvalidInput,
            "it is not a regular file",
        ));
    }
    if others_may_read(&metadata.permissions()) {
        return Err(io::Error::new(
            ErrorKind::PermissionDenied,
            "other users may read it; take that away with `chmod 600`",
        ));
    }
    Ok(())
}

#[cfg(unix)]
fn others_may_read(permissions: &Permissions) -> bool {
    use std::os::unix::fs::PermissionsExt as _;
    permissions.mode() & 0o077 != 0
}

#[cfg(not(unix))]
fn others_may_read(_permissions: &Permissions) -> bool {
    false
}

fn private() -> OpenOptions {
    let mut options = OpenOptions::new();
    options.write(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options
}

/// Writes a private file atomically. With `replace` it replaces an earlier file; without, an existing
/// file stays and the error is [`ErrorKind::AlreadyExists`]. A reader never sees a partial file.
pub fn write_private(path: &Path, content: &[u8], replace: bool) -> io::Result<()> {
    let (beside, mut file) = create_beside(path)?;
    let mut put = || {
        file.write_all(content)?;
        file.sync_all()?;
        if replace {
            std::fs::rename(&beside, path)
        } else {
            // Unlike a move, a second name never replaces a file.
            std::fs::hard_link(&beside, path)
        }
    };
    let done = put();
    // After a move it is gone already.
    let _ = std::fs::remove_file(&beside);
    done
}

/// Makes a new private file beside `path`, under a name that nothing has.
fn create_beside(path: &Path) -> io::Result<(PathBuf, File)> {
    let mut number = 0;
    loop {
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(format!(".{}.{number}.part", std::process::id()));
        let beside = path.with_file_name(name);
        match private().create_new(true).open(&beside) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists && number < NAMES_MAX => number += 1,
            made => return made.map(|file| (beside, file)),
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn folder() -> PathBuf {
        let number = std::thread::current().id();
        let name = format!("palpate-state-{}-{number:?}", std::process::id());
        let path = std::env::temp_dir().join(name);
        make_private_folder(&path).unwrap();
        path
    }

    #[test]
    fn private_files_are_owner_only_and_written_atomically() {
        let folder = folder();
        let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(&folder), 0o700);
        let path = folder.join("secret");
        write_private(&path, b"one", false).unwrap();
        assert_eq!(mode(&path), 0o600);
        let second = write_private(&path, b"two", false).unwrap_err();
        assert_eq!(second.kind(), ErrorKind::AlreadyExists);
        assert_eq!(std::fs::read(&path).unwrap(), b"one");
        write_private(&path, b"two", true).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"two");
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
        open_private(&path).unwrap();
        std::fs::set_permissions(&path, Permissions::from_mode(0o644)).unwrap();
        let said = open_private(&path).unwrap_err().to_string();
        assert!(said.contains("chmod 600"), "{said}");
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
