//! Progress of an experiment on standard error, and interruption by the user.

use std::io::{IsTerminal, Write, stderr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Interval of progress lines if standard error is not a terminal: a log stays short.
const LINE_EVERY: Duration = Duration::from_secs(10);

#[derive(Debug)]
pub struct Progress {
    began: Instant,
    is_terminal: bool,
    shown: String,
    said: Instant,
}

impl Progress {
    pub fn new() -> Self {
        Self {
            began: Instant::now(),
            is_terminal: stderr().is_terminal(),
            shown: String::new(),
            said: Instant::now(),
        }
    }

    pub fn stage(&mut self, what: &str) {
        self.clear();
        self.said = Instant::now();
        Self::write(&format!(
            "[{:5.1} s] {what}\n",
            self.began.elapsed().as_secs_f64()
        ));
    }

    /// Progress within the stage; rewritten in place on a terminal, otherwise a line now and then.
    pub fn tick(&mut self, how_far: &str) {
        if !self.is_terminal {
            if self.said.elapsed() >= LINE_EVERY {
                self.stage(how_far);
            }
        } else if how_far != self.shown {
            self.clear();
            Self::write(&format!("          {how_far}"));
            how_far.clone_into(&mut self.shown);
        }
    }

    fn clear(&mut self) {
        if !self.shown.is_empty() {
            self.shown.clear();
            Self::write("\r\x1b[K");
        }
    }

    fn write(text: &str) {
        let mut err = stderr().lock();
        // A closed standard error is ignored.
        let _ = err.write_all(text.as_bytes()).and_then(|()| err.flush());
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.clear();
    }
}

/// Set when the user or the operating system requests termination.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Listens for SIGINT and SIGTERM, which then no longer end the process.
    pub fn listen() -> Result<Self, String> {
        let failed = |e: std::io::Error| format!("cannot install the signal handlers: {e}");
        let interrupt = Self::default();
        let flag = interrupt.clone();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .build()
            .map_err(failed)?;
        let thread = std::thread::Builder::new().name("signals".into());
        let listen = move || {
            runtime.block_on(wanted());
            flag.0.store(true, Ordering::Release);
        };
        thread.spawn(listen).map_err(failed)?;
        Ok(interrupt)
    }

    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

#[cfg(unix)]
async fn wanted() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else {
        return std::future::pending().await;
    };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = tokio::signal::ctrl_c() => {}
    }
}

#[cfg(not(unix))]
async fn wanted() {
    // Without a handler the signal ends the process.
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending::<()>().await;
    }
}
