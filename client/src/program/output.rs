//! Standard output and standard error of the commands.

use std::io::{ErrorKind, Write};

/// Writes to standard output; a closed pipe is no error, because a reader may stop early.
pub(crate) fn print(text: &str) -> Result<(), String> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(format!("cannot print the result: {e}")),
        _ => Ok(()),
    }
}

/// Writes an error to standard error; a closed one is ignored.
pub(crate) fn complain(sentence: &str) {
    let _ = writeln!(std::io::stderr(), "palpate-client: {sentence}");
}
