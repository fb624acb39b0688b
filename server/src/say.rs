//! What the program prints for whoever reads its standard output.

use std::io::{ErrorKind, Write as _};

use crate::ServerError;

/// Prints a result, at once: who started us may wait for it. A reader that has seen enough and closed its end is no
/// mistake.
pub(crate) fn say(text: &str) -> Result<(), ServerError> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(source) if source.kind() != ErrorKind::BrokenPipe => Err(ServerError::Io {
            doing: "the result can not be printed".into(),
            source,
        }),
        _ => Ok(()),
    }
}
