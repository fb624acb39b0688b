//! The status line of a running session.

use std::io::{IsTerminal, Write};

use indicatif::{ProgressBar, ProgressStyle};
use palpate_protocol::{ClientTime, Span};

use crate::StatusKind;
use crate::network::{FetchProgress, RetryReport};
use crate::realtime::{LoopStats, monotonic_now};
use crate::replica::{Part, Progress};

/// Update period on a terminal: short enough to see force changes.
const ON_TERMINAL: Span = Span::from_millis(250);

/// Output period elsewhere: a log stays readable after an hour.
const ELSEWHERE: Span = Span::from_millis(3000);

/// Minimum model size for a progress bar, bytes; smaller models arrive too soon.
const BAR_FROM_BYTES: u64 = 256 * 1024;

/// Figures of one status line.
#[derive(Debug, Clone, Default)]
pub(super) struct Figures {
    pub(super) seconds: f64,
    /// `None` for spectators.
    pub(super) hand: Option<LoopStats>,
    pub(super) rtt_ms: Option<f64>,
    pub(super) loss: f64,
    /// Received data, kbit/s of UDP payload.
    pub(super) down_kbit_s: f64,
    pub(super) replica: Progress,
}

impl Figures {
    fn line(&self) -> String {
        let hand = self.hand.map_or(String::new(), |h| {
            format!(
                "{:4.0} Hz, late {:3} µs | force {:5.2} N | ",
                h.rate_hz, h.lateness_us.p99, h.force_n
            )
        });
        let rtt = self
            .rtt_ms
            .map_or("   ?".to_owned(), |rtt| format!("{rtt:5.1} ms"));
        let link_lost = if self.replica.link_lost {
            " | LINK LOST, no force"
        } else {
            ""
        };
        let part = match self.replica.part {
            Part::Participating => "",
            Part::CatchingUp => " | catching up",
            Part::Resyncing => " | RESYNC, no force",
            Part::Demoted => " | WATCHING, the network is too slow",
            Part::Muted => " | MUTED by the instructor, no force",
            Part::Frozen => " | FROZEN by the instructor, no force",
        };
        let subscription = match self.replica.thin.map(|t| t.waiting) {
            None => format!("full {:.0} kbit/s", self.down_kbit_s),
            Some(n) => format!("thin {:.0} kbit/s, {n} nodes wait", self.down_kbit_s),
        };
        format!(
            "{:6.1} s | {hand}rtt {rtt}, loss {:4.1} %, D {:5.1} ms | {subscription} | {} here, tissue version {}{link_lost}{part}",
            self.seconds,
            self.loss * 100.0,
            self.replica.delay.as_millis_f64(),
            self.replica.here,
            self.replica.topology_version
        )
    }
}

/// Writes the status line.
pub(super) struct Status {
    kind: StatusKind,
    on_terminal: bool,
    due: ClientTime,
    is_open: bool,
}

impl Status {
    pub(super) fn new(kind: StatusKind, now: ClientTime) -> Self {
        let on_terminal = match kind {
            StatusKind::Quiet => false,
            StatusKind::Stdout => std::io::stdout().is_terminal(),
            StatusKind::Stderr => std::io::stderr().is_terminal(),
        };
        Self {
            kind,
            on_terminal,
            due: now,
            is_open: false,
        }
    }

    /// Prints a message on its own line.
    pub(super) fn print(&mut self, sentence: &str) {
        let start = if self.is_open { "\r\x1b[2K" } else { "" };
        self.is_open = false;
        self.write(&format!("{start}{sentence}\n"));
    }

    /// Whether the next line is due.
    pub(super) fn is_due(&self, now: ClientTime) -> bool {
        self.kind != StatusKind::Quiet && now >= self.due
    }

    /// Prints the line, in place on a terminal.
    pub(super) fn show(&mut self, figures: &Figures, now: ClientTime) {
        let period = if self.on_terminal {
            ON_TERMINAL
        } else {
            ELSEWHERE
        };
        self.due = now + period;
        if self.on_terminal {
            self.is_open = true;
            self.write(&format!("\r\x1b[2K{}", figures.line()));
        } else {
            self.write(&format!("{}\n", figures.line()));
        }
    }

    /// Ends the line.
    pub(super) fn close(&mut self) {
        if std::mem::take(&mut self.is_open) {
            self.write("\n");
        }
    }

    fn write(&self, text: &str) {
        // A closed output stream does not end the session.
        match self.kind {
            StatusKind::Quiet => {}
            StatusKind::Stdout => {
                let mut out = std::io::stdout().lock();
                let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
            }
            StatusKind::Stderr => {
                let _ = std::io::stderr().write_all(text.as_bytes());
            }
        }
    }
}

/// Prints the failed attempts of a client that has not joined yet.
pub(super) fn retry_lines(kind: StatusKind) -> RetryReport {
    let mut status = Status::new(kind, monotonic_now());
    Box::new(move |retry| status.print(&retry.to_string()))
}

/// Progress bar of the model on standard error; only on a terminal.
pub(super) fn fetch_progress(kind: StatusKind) -> FetchProgress {
    if kind == StatusKind::Quiet {
        return Box::new(|_, _| {});
    }
    let mut bar: Option<ProgressBar> = None;
    Box::new(move |done, total| {
        if total < BAR_FROM_BYTES {
            return;
        }
        let bar = bar.get_or_insert_with(|| {
            let template = "model {bar:30} {bytes}/{total_bytes} {bytes_per_sec}";
            let style = ProgressStyle::with_template(template)
                .unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::new(total).with_style(style)
        });
        bar.set_position(done);
        if done >= total {
            bar.finish_and_clear();
        }
    })
}

#[cfg(test)]
mod tests {
    use palpate_site::ThinCounters;

    use super::*;
    use crate::realtime::Lateness;

    #[test]
    fn status_line_shows_hand_figures_only_with_a_hand() {
        let mut figures = Figures {
            hand: Some(LoopStats {
                rate_hz: 1000.0,
                lateness_us: Lateness {
                    p99: 42,
                    ..Lateness::default()
                },
                force_n: 1.25,
                ..LoopStats::default()
            }),
            rtt_ms: Some(120.0),
            loss: 0.05,
            replica: Progress {
                delay: Span::from_millis(92),
                here: 2,
                ..Progress::default()
            },
            ..Figures::default()
        };
        let line = figures.line();
        for part in [
            "1000 Hz", "42 µs", "1.25 N", "120.0 ms", "5.0 %", "92.0 ms", "2 here",
        ] {
            assert!(line.contains(part), "{line}");
        }
        assert!(line.contains("full") && !line.contains("wait"), "{line}");
        figures.hand = None;
        figures.replica.link_lost = true;
        figures.replica.thin = Some(ThinCounters {
            waiting: 31,
            ..ThinCounters::default()
        });
        figures.down_kbit_s = 812.4;
        let line = figures.line();
        assert!(line.contains("thin 812 kbit/s, 31 nodes wait"), "{line}");
        assert!(!line.contains("Hz") && line.contains("LINK LOST"), "{line}");
        for (part, word) in [(Part::Resyncing, "RESYNC"), (Part::Demoted, "WATCHING")] {
            figures.replica.part = part;
            assert!(figures.line().contains(word), "{}", figures.line());
        }
    }
}
