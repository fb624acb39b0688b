//! Output of results to standard output.

use std::io::{ErrorKind, Write as _};

use crate::ServerError;

/// Prints a result and flushes, because a parent process may wait for it. A closed pipe is no error.
pub(crate) fn print_result(text: &str) -> Result<(), ServerError> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(source) if source.kind() != ErrorKind::BrokenPipe => Err(ServerError::Io {
            doing: "cannot print the result".into(),
            source,
        }),
        _ => Ok(()),
    }
}
