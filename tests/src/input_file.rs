//! Text files of a user, of bounded size.

use std::path::Path;

use palpate_device::text_file::{self, TextFileError};

/// The text of a file of at most `bytes_max` bytes. Errors name the kind of file, and say what to do with a larger one.
pub(crate) fn read(
    path: &Path,
    kind: &str,
    bytes_max: u64,
    remedy: &str,
) -> Result<String, String> {
    let shown = path.display();
    text_file::read(path, bytes_max).map_err(|e| match e {
        TextFileError::Read(why) => format!("the {kind} {shown} can not be read: {why}"),
        TextFileError::TooLarge { bytes } => {
            format!("the {kind} {shown} has {bytes} bytes, more than {bytes_max}: {remedy}")
        }
    })
}
