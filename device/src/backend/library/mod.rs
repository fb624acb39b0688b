//! Libraries of device makers: found and loaded when a device is opened, never built in.
//!
//! Every error is one sentence with the file, the cause, and the remedy.

mod machine;
pub(super) mod sys;

use std::io::Read;
use std::path::{Path, PathBuf};

use thiserror::Error;

pub(super) use sys::Library;

/// Library folders of systems. The loader has its own list; these are searched to explain its failure.
const FOLDERS: [&str; 7] = [
    "/usr/lib",
    "/usr/lib64",
    "/usr/lib32",
    "/usr/local/lib",
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib/i386-linux-gnu",
];

/// Reason why a maker's library can not be used.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum LibraryError {
    /// The loader finds none of its names.
    #[error("{what} is not installed: the system finds none of {names}. {how}")]
    NotInstalled {
        /// The maker's software.
        what: &'static str,
        /// The names that were tried.
        names: String,
        /// How to install it.
        how: &'static str,
    },
    /// The named file does not exist, or can not be read.
    #[error("the library {} can not be read: {why}", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// The system's error.
        why: String,
    },
    /// It was built for another processor.
    #[error(
        "the library {} is built for {is}, and this program for {needs}: install the maker's edition for {needs}",
        file.display()
    )]
    OtherMachine {
        /// The file.
        file: PathBuf,
        /// The processor it is for.
        is: &'static str,
        /// The processor of this program.
        needs: &'static str,
    },
    /// The loader rejected it.
    #[error("the library {} can not be loaded: {why}", file.display())]
    Refused {
        /// The file.
        file: PathBuf,
        /// The loader's error: a library that it depends on is missing, or the file is not a library.
        why: String,
    },
    /// It lacks a function.
    #[error(
        "the library {} has no function {symbol}: it is too old, or another library of that name. {how}",
        file.display()
    )]
    NoFunction {
        /// The file.
        file: PathBuf,
        /// The function.
        symbol: &'static str,
        /// How to install a newer one.
        how: &'static str,
    },
}

/// A library of a maker.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted {
    /// The maker's software, as its owner knows it.
    pub(super) what: &'static str,
    /// The library's names on this system, the newest first.
    pub(super) names: &'static [&'static str],
    /// How to install it: a whole sentence.
    pub(super) how: &'static str,
}

impl Wanted {
    /// Loads it from `file`, or by the loader's search path.
    pub(super) fn load(self, file: Option<&Path>) -> Result<Library, LibraryError> {
        match file {
            Some(file) => self.load_file(file),
            None => self.load_by_name(),
        }
    }

    fn load_file(self, file: &Path) -> Result<Library, LibraryError> {
        fits(file)?;
        Library::open(file, self.how).map_err(|why| LibraryError::Refused {
            file: file.to_owned(),
            why,
        })
    }

    fn load_by_name(self) -> Result<Library, LibraryError> {
        let mut refused = None;
        for name in self.names {
            match Library::open(Path::new(name), self.how) {
                Ok(library) => return Ok(library),
                Err(why) if is_absent(name, &why) => {}
                Err(why) => refused = refused.or(Some((PathBuf::from(name), why))),
            }
        }
        if let Some((file, why)) = refused {
            return Err(LibraryError::Refused { file, why });
        }
        // A loader skips files for another processor without an error.
        for folder in FOLDERS {
            for name in self.names {
                let file = Path::new(folder).join(name);
                if file.is_file() {
                    fits(&file)?;
                }
            }
        }
        Err(LibraryError::NotInstalled {
            what: self.what,
            names: self.names.join(", "),
            how: self.how,
        })
    }
}

/// Whether a loader's error means that the library `name` is missing, rather than present but broken.
fn is_absent(name: &str, why: &str) -> bool {
    let says_so = ["No such file", "no such file", "not found", "not be found"];
    // The missing file stands before the first colon, and may be a newer dependency of the same name. Some loaders
    // put their own words before it: `dlopen(NAME, flags)`, `Error loading shared library NAME`.
    let missing = why.split([':', ',']).next().unwrap_or(why);
    let is_it = missing.rsplit(['/', '(', ' ']).next() == name.rsplit('/').next();
    let about_it = is_it || !why.contains(".so") && !why.contains(".dylib");
    about_it && says_so.iter().any(|words| why.contains(words))
}

/// Whether `file` exists and is not for another processor.
fn fits(file: &Path) -> Result<(), LibraryError> {
    let mut head = Vec::new();
    std::fs::File::open(file)
        .and_then(|opened| opened.take(machine::HEAD_BYTES).read_to_end(&mut head))
        .map_err(|why| LibraryError::Unreadable {
            file: file.to_owned(),
            why: why.to_string(),
        })?;
    match machine::of(&head) {
        Some(is) if is != std::env::consts::ARCH => Err(LibraryError::OtherMachine {
            file: file.to_owned(),
            is,
            needs: std::env::consts::ARCH,
        }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::is_absent;

    #[test]
    fn a_missing_library_is_distinguished_from_a_broken_one() {
        let absent = "libHD.so: cannot open shared object file: No such file or directory";
        assert!(is_absent("libHD.so", absent));
        let needs = "libdrd.so.3: cannot open shared object file: No such file or directory";
        assert!(!is_absent("libdrd.so", needs));
        let lacks =
            "libPhantomIOLib42.so: cannot open shared object file: No such file or directory";
        assert!(!is_absent("libHD.so", lacks));
        assert!(!is_absent("libHD.so", "libHD.so: file too short"));
        let mac = "dlopen(libHD.dylib, 0x0005): tried: 'libHD.dylib' (no such file)";
        assert!(is_absent("libHD.dylib", mac));
        assert!(is_absent(
            "HD.dll",
            "The specified module could not be found. (os error 126)"
        ));
    }
}
