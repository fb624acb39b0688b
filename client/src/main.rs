//! `palpate-client`: joins a session with a device. Everything is in the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    palpate_client::cli::run(std::env::args_os())
}
