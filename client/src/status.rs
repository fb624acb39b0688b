//! The status line while a session runs.

use std::io::{IsTerminal, Write};

use indicatif::{ProgressBar, ProgressStyle};
use palpate_protocol::{ClientTime, Span};

use crate::StatusKind;
use crate::network::Progress as FetchProgress;
use crate::solve::Part;

/// How often the line is rewritten on a terminal: often enough to see a force change.
const ON_TERMINAL: Span = Span::from_millis(250);

/// How often a line is written elsewhere: a log that can still be read after an hour.
const ELSEWHERE: Span = Span::from_millis(3000);

/// A model below this size arrives before a bar could be read, bytes.
const BAR_FROM_BYTES: u64 = 256 * 1024;

/// The figures of one moment.
#[derive(Debug, Clone, Default)]
pub(crate) struct Figures {
    pub(crate) seconds: f64,
    /// `None` for who only looks.
    pub(crate) hand: Option<HandFigures>,
    pub(crate) rtt_ms: Option<f64>,
    pub(crate) loss: f64,
    pub(crate) delay_ms: f64,
    pub(crate) here: usize,
    pub(crate) topology_version: u32,
    pub(crate) link_lost: bool,
    pub(crate) part: Part,
    /// Everything that comes from the server, kbit/s of UDP payload.
    pub(crate) down_kbit_s: f64,
    /// Nodes that wait for room at the server; `None` where the tissue is computed here.
    pub(crate) thin_waiting: Option<u32>,
}

/// The figures of the force loop.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct HandFigures {
    pub(crate) rate_hz: f64,
    pub(crate) lateness_p99_us: u64,
    pub(crate) force_n: f64,
}

impl Figures {
    fn line(&self) -> String {
        let hand = self.hand.map_or(String::new(), |h| {
            format!(
                "{:4.0} Hz, late {:3} µs | force {:5.2} N | ",
                h.rate_hz, h.lateness_p99_us, h.force_n
            )
        });
        let rtt = self
            .rtt_ms
            .map_or("   ?".to_owned(), |rtt| format!("{rtt:5.1} ms"));
        let link_lost = if self.link_lost {
            " | LINK LOST, no force"
        } else {
            ""
        };
        let part = match self.part {
            Part::Takes => "",
            Part::CatchesUp => " | catching up",
            Part::Resyncs => " | RESYNC, no force",
            Part::Watches => " | WATCHING, the network is too slow",
        };
        let subscription = match self.thin_waiting {
            None => format!("full {:.0} kbit/s", self.down_kbit_s),
            Some(n) => format!("thin {:.0} kbit/s, {n} nodes wait", self.down_kbit_s),
        };
        format!(
            "{:6.1} s | {hand}rtt {rtt}, loss {:4.1} %, D {:5.1} ms | {subscription} | {} here, {} cuts{link_lost}{part}",
            self.seconds,
            self.loss * 100.0,
            self.delay_ms,
            self.here,
            self.topology_version
        )
    }
}

/// Writes the status line.
pub(crate) struct Status {
    kind: StatusKind,
    on_terminal: bool,
    due: ClientTime,
    is_open: bool,
}

impl Status {
    pub(crate) fn new(kind: StatusKind, now: ClientTime) -> Self {
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

    /// A sentence on a line of its own.
    pub(crate) fn say(&mut self, sentence: &str) {
        let start = if self.is_open { "\r\x1b[2K" } else { "" };
        self.is_open = false;
        self.write(&format!("{start}{sentence}\n"));
    }

    /// Whether it is time for a line.
    pub(crate) fn is_due(&self, now: ClientTime) -> bool {
        self.kind != StatusKind::Quiet && now >= self.due
    }

    /// The line, in place on a terminal.
    pub(crate) fn show(&mut self, figures: &Figures, now: ClientTime) {
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

    /// Leaves the line behind.
    pub(crate) fn close(&mut self) {
        if std::mem::take(&mut self.is_open) {
            self.write("\n");
        }
    }

    fn write(&self, text: &str) {
        // A status that nobody reads any more is no reason to end a session.
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

/// A bar on standard error while the model comes; only on a terminal.
pub(crate) fn fetch_progress(kind: StatusKind) -> FetchProgress {
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
    use super::*;

    #[test]
    fn the_line_says_what_the_hand_wants_to_know_and_nothing_of_a_hand_that_is_not_there() {
        let mut figures = Figures {
            hand: Some(HandFigures {
                rate_hz: 1000.0,
                lateness_p99_us: 42,
                force_n: 1.25,
            }),
            rtt_ms: Some(120.0),
            loss: 0.05,
            delay_ms: 92.0,
            here: 2,
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
        figures.link_lost = true;
        (figures.thin_waiting, figures.down_kbit_s) = (Some(31), 812.4);
        let line = figures.line();
        assert!(line.contains("thin 812 kbit/s, 31 nodes wait"), "{line}");
        assert!(!line.contains("Hz") && line.contains("LINK LOST"), "{line}");
        for (part, word) in [(Part::Resyncs, "RESYNC"), (Part::Watches, "WATCHING")] {
            figures.part = part;
            assert!(figures.line().contains(word), "{}", figures.line());
        }
    }
}
