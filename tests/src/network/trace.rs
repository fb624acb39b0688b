//! Delays and losses recorded on a real network.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::input_file;

/// Maximum rows of a trace: 17 minutes at 1 kHz, and 24 MB.
pub const TRACE_ROWS_MAX: usize = 1_000_000;

/// Maximum size of a trace file: [`TRACE_ROWS_MAX`] rows of 64 bytes.
const TRACE_BYTES_MAX: u64 = 64_000_000;
const HEADER: &str = "time_ms,delay_ms,lost";

/// A recorded network. It repeats one row length after its last row. Each flow starts at a random row, or at
/// [`Link::trace_offset_s`](super::Link::trace_offset_s).
#[derive(Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "PathBuf", into = "PathBuf")]
pub struct Trace {
    /// Its file name in the profile.
    pub file: PathBuf,
    rows: Arc<[TraceRow]>,
}

/// Observation from a time on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TraceRow {
    pub time_ms: f64,
    pub delay_ms: f64,
    pub lost: bool,
}

impl From<PathBuf> for Trace {
    fn from(file: PathBuf) -> Self {
        let rows = Arc::default();
        Self { file, rows }
    }
}

impl From<Trace> for PathBuf {
    fn from(trace: Trace) -> Self {
        trace.file
    }
}

impl fmt::Debug for Trace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = self.rows.len();
        write!(f, "Trace({}, {rows} rows)", self.file.display())
    }
}

impl Trace {
    /// Reads a CSV file with the columns `time_ms,delay_ms,lost`; a relative path starts at `folder`. The delay
    /// of a lost packet may be empty.
    pub fn read(file: &Path, folder: &Path) -> Result<Self, String> {
        let mut trace = Self::from(file.to_owned());
        trace.load(folder)?;
        Ok(trace)
    }

    /// Reads the rows of a trace that a profile names.
    pub(super) fn load(&mut self, folder: &Path) -> Result<(), String> {
        let path = folder.join(&self.file);
        let text = input_file::read(&path, "trace", TRACE_BYTES_MAX, "cut it shorter")?;
        let rows = rows_of(&text);
        let rows = rows.map_err(|(line, why)| format!("{} line {line}: {why}", path.display()))?;
        self.rows = rows.into();
        Ok(())
    }

    pub fn rows(&self) -> &[TraceRow] {
        &self.rows
    }

    pub fn period_us(&self) -> u64 {
        match *self.rows {
            [ref first, .., ref before, ref last] => {
                (last.starts_us() - first.starts_us()) + (last.starts_us() - before.starts_us())
            }
            [ref first, ref last] => 2 * (last.starts_us() - first.starts_us()),
            // A single row lasts for ever; the length does not matter.
            _ => 1,
        }
    }

    /// The row of a packet sent at a time in microseconds after the start of the network: the last one not
    /// later.
    pub fn at(&self, at_us: u64) -> TraceRow {
        let at_us = self.rows[0].starts_us() + at_us % self.period_us().max(1);
        let passed = self.rows.partition_point(|row| row.starts_us() <= at_us);
        self.rows[passed.max(1) - 1]
    }
}

impl TraceRow {
    /// Its time in whole microseconds, so that a row begins exactly at the time in its file.
    fn starts_us(&self) -> u64 {
        (self.time_ms * 1e3).round() as u64
    }
}

/// The rows of a file, or the invalid line and its error.
fn rows_of(text: &str) -> Result<Vec<TraceRow>, (usize, String)> {
    // Spreadsheets write a byte-order mark.
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(n, line)| (n + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let header: Option<String> = lines
        .next()
        .map(|(_, line)| line.split_whitespace().collect());
    if header.as_deref() != Some(HEADER) {
        return Err((1, format!("a trace begins with the line {HEADER}")));
    }
    let mut rows: Vec<TraceRow> = Vec::new();
    for (n, line) in lines {
        let row = row_of(line).map_err(|why| (n, why))?;
        if let Some(last) = rows.last()
            && row.starts_us() <= last.starts_us()
        {
            let why = format!(
                "the time {} ms is not a microsecond after {} ms of the row before: sort the rows by time",
                row.time_ms, last.time_ms
            );
            return Err((n, why));
        }
        if rows.len() == TRACE_ROWS_MAX {
            return Err((
                n,
                format!("more than {TRACE_ROWS_MAX} rows: cut it shorter"),
            ));
        }
        rows.push(row);
    }
    if rows.is_empty() {
        return Err((1, "a trace needs at least one row".to_owned()));
    }
    Ok(rows)
}

fn row_of(line: &str) -> Result<TraceRow, String> {
    let cells: Vec<&str> = line.split(',').map(str::trim).collect();
    let [time, delay, lost] = cells[..] else {
        return Err(format!("{} cells, but {HEADER} are three", cells.len()));
    };
    let lost = match lost {
        "0" | "false" => false,
        "1" | "true" => true,
        other => return Err(format!("lost is \"{other}\": write 0 or 1")),
    };
    let number = |name: &str, cell: &str, max: f64| {
        let x: f64 = cell
            .parse()
            .map_err(|_| format!("{name} is \"{cell}\": write a number"))?;
        if (0.0..=max).contains(&x) {
            Ok(x)
        } else {
            Err(format!("{name} is {x}: write a number from 0 to {max}"))
        }
    };
    let delay_ms = if lost && delay.is_empty() {
        0.0
    } else {
        number("delay_ms", delay, super::path::DELAY_MAX_MS)?
    };
    Ok(TraceRow {
        time_ms: number("time_ms", time, 1e12)?,
        delay_ms,
        lost,
    })
}
