//! The log of every program, on standard error.
//!
//! Spans give each line its context: `session`, `participant` and `connection`. They have the level
//! `error`, because a filter drops a span of a lower level also from the lines of errors.

use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

/// Starts the log with the directives in `PALPATE_LOG`, else `RUST_LOG`, else `default`. Directives are
/// those of [`Targets`], such as `debug` or `warn,palpate_room=trace`; without effect where a log has
/// been started already.
pub fn start_log(default: LevelFilter) {
    let wish = |name: &str| std::env::var(name).ok()?.parse::<Targets>().ok();
    let filter = wish("PALPATE_LOG")
        .or_else(|| wish("RUST_LOG"))
        .unwrap_or_else(|| Targets::new().with_default(default));
    let _ = tracing_subscriber::registry()
        .with(tracing_subscriber::fmt::layer().with_writer(std::io::stderr))
        .with(filter)
        .try_init();
}
