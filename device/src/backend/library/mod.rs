//! Libraries of device makers: found and loaded when a device is opened, never built in.
//!
//! Every error is one sentence with the file, the cause, and the remedy.

mod machine;
pub(super) mod sys;

use std::io::Read;
use std::path::Path;

use crate::OpenError;

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
    pub(super) fn load(self, file: Option<&Path>) -> Result<Library, OpenError> {
        match file {
            Some(file) => self.load_file(file),
            None => self.load_by_name(),
        }
    }

    fn load_file(self, file: &Path) -> Result<Library, OpenError> {
        fits(file)?;
        Library::open(file, self.how).map_err(|why| refused(file, &why))
    }

    fn load_by_name(self) -> Result<Library, OpenError> {
        let mut unusable = None;
        for name in self.names {
            match Library::open(Path::new(name), self.how) {
                Ok(library) => return Ok(library),
                Err(why) if is_absent(name, &why) => {}
                Err(why) => unusable = unusable.or(Some(refused(Path::new(name), &why))),
            }
        }
        if let Some(unusable) = unusable {
            return Err(unusable);
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
        let (what, names, how) = (self.what, self.names.join(", "), self.how);
        Err(OpenError::new(format_args!(
            "{what} is not installed: the system finds none of {names}. {how}"
        )))
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
fn fits(file: &Path) -> Result<(), OpenError> {
    let mut head = Vec::new();
    std::fs::File::open(file)
        .and_then(|opened| opened.take(machine::HEAD_BYTES).read_to_end(&mut head))
        .map_err(|e| about(file, &format!("can not be read: {e}")))?;
    match machine::of(&head) {
        Some(is) if is != std::env::consts::ARCH => {
            let needs = std::env::consts::ARCH;
            let why = format!(
                "is built for {is}, and this program for {needs}: install the maker's edition for \
                 {needs}"
            );
            Err(about(file, &why))
        }
        _ => Ok(()),
    }
}

/// An error of the loader: a library that it depends on is missing, or the file is not a library.
fn refused(file: &Path, why: &str) -> OpenError {
    about(file, &format!("can not be loaded: {why}"))
}

fn about(file: &Path, what: &str) -> OpenError {
    OpenError::new(format_args!("the library {} {what}", file.display()))
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
