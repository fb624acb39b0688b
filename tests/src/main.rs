//! `palpate-lab`: the laboratory. Everything is in the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    palpate_lab::cli::run(std::env::args_os())
}
