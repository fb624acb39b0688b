//! `palpate-server`: see `palpate-server --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    palpate_server::cli::run(std::env::args_os())
}
