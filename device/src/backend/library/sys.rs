//! The system's loader.

use std::ffi::{CStr, c_char};
use std::path::{Path, PathBuf};

use super::about;
use crate::OpenError;

/// A loaded library. Functions that were taken from it may be called for as long as it lives.
#[derive(Debug)]
pub(in crate::backend) struct Library {
    loaded: libloading::Library,
    file: PathBuf,
    how: &'static str,
}

impl Library {
    /// Loads `file`: a path, or a name that the loader looks for. The error is the loader's own sentence.
    pub(super) fn open(file: &Path, how: &'static str) -> Result<Self, String> {
        // SAFETY: loading runs the library's initialisers. It is the library that the owner of a device installed for
        // it, or named, and other programs load it in the same way.
        let loaded = unsafe { libloading::Library::new(file) };
        let loaded = loaded.map_err(|e| match std::error::Error::source(&e) {
            Some(source) => source.to_string(),
            None => e.to_string(),
        })?;
        Ok(Self {
            loaded,
            file: file.to_owned(),
            how,
        })
    }

    /// The function `symbol`.
    ///
    /// # Safety
    ///
    /// `F` is a function pointer with the types of that function, and it is not called after `self` is dropped.
    pub(in crate::backend) unsafe fn function<F: Copy>(
        &self,
        symbol: &'static str,
    ) -> Result<F, OpenError> {
        // SAFETY: the caller vouches for the type.
        let found = unsafe { self.loaded.get::<F>(symbol) };
        found.map(|f| *f).map_err(|_| {
            let how = self.how;
            let why = format!(
                "has no function {symbol}: it is too old, or another library of that name. {how}"
            );
            about(&self.file, &why)
        })
    }
}

/// The functions of a maker's library that a driver calls: field, type, and name in the library.
///
/// Each type has to be that of the function in the maker's public headers. The library lives as long as the table.
macro_rules! functions {
    ($wanted:expr; $($field:ident: $type:ty = $name:literal,)*) => {
        /// The used functions, and the library that contains them.
        #[derive(Debug)]
        pub(super) struct Api {
            $($field: $type,)*
            // The last field: the fields above point into it.
            _library: Library,
        }

        impl Api {
            /// Loads the library and resolves all functions.
            pub(super) fn load(file: Option<&Path>) -> Result<Self, OpenError> {
                let library = $wanted.load(file)?;
                Ok(Self {
                    // SAFETY: the type is that of the function, and the library is a field of the same table.
                    $($field: unsafe { library.function($name)? },)*
                    _library: library,
                })
            }
        }
    };
}

pub(in crate::backend) use functions;

/// A text of a library's own; empty for null.
///
/// # Safety
///
/// `words` is null, or a constant text of the library that ends with a zero.
pub(in crate::backend) unsafe fn text(words: *const c_char) -> String {
    if words.is_null() {
        return String::new();
    }
    // SAFETY: not null, and the caller vouches for the rest.
    let words = unsafe { CStr::from_ptr(words) };
    words.to_string_lossy().into_owned()
}
