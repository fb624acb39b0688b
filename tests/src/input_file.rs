//! Text files of a user, of bounded size.

use std::io::ErrorKind;
use std::path::Path;

use palpate_device::text_file;

/// The text of a file of at most `bytes_max` bytes. Errors name the kind of file, and say what to do with a larger one.
pub(crate) fn read(
    path: &Path,
    kind: &str,
    bytes_max: u64,
    remedy: &str,
) -> Result<String, String> {
    text_file::read(path, bytes_max).map_err(|e| {
        let shown = path.display();
        if e.kind() == ErrorKind::FileTooLarge {
            format!("the {kind} {shown} is too large: {e}; {remedy}")
        } else {
            format!("the {kind} {shown} can not be read: {e}")
        }
    })
}
