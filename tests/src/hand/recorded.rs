//! A recorded hand motion, from a table.
//!
//! ```text
//! time_s,x_m,y_m,z_m[,qw,qx,qy,qz]
//! 0.000,0.0101,0.0200,0.1503
//! 0.001,0.0102,0.0200,0.1503
//! ```
//!
//! Between rows the motion is the cubic of a replayed device; with rows 1 ms apart its error is below a
//! micrometre for any hand.

use std::path::Path;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use palpate_device::Buttons;
use palpate_device::backend::replay::{Moment, Motion, MotionError};
use palpate_device::text_file::{self, TextFileError};
use palpate_protocol::Pose;
use thiserror::Error;

use super::{Hand, pose};

/// Maximum file size: three hours at 1 kHz.
const BYTES_MAX: u64 = 1 << 29;

/// Minimum rows, for an acceleration.
const ROWS_MIN: usize = 3;

/// Columns: time and position (required), and rotation (optional).
const COLUMNS: [&str; 8] = ["time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"];

/// Alternative name of the time column, as in tables of a replayed device.
const TIME_ALSO: &str = "t_s";

/// Optional last column of those tables.
const BUTTONS: &str = "buttons";

/// A recorded motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded {
    motion: Motion,
}

/// Failure to load a motion. The caller adds the file name.
#[derive(Debug, Error)]
pub enum MotionFileError {
    /// Unreadable file.
    #[error("it can not be read: {source}")]
    Read {
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// File too large.
    #[error(
        "it has {bytes} bytes, and a motion at most {BYTES_MAX}; leave rows out, or give a part of it"
    )]
    TooLarge {
        /// Its size.
        bytes: u64,
    },
    /// Empty file.
    #[error("it is empty; its first line names the columns: time_s,x_m,y_m,z_m[,qw,qx,qy,qz]")]
    Empty,
    /// Unknown columns.
    #[error(
        "line 1: the columns should be time_s,x_m,y_m,z_m (time_s may be called t_s), and where turns are known also \
         qw,qx,qy,qz; {0}"
    )]
    Columns(String),
    /// Invalid row.
    #[error("line {line}: {what}")]
    Row {
        /// Line number, from 1.
        line: usize,
        /// Error and remedy.
        what: String,
    },
    /// Too few rows.
    #[error("there are {0} rows of numbers; a motion needs at least {ROWS_MIN}")]
    TooFew(usize),
    /// Invalid motion as a whole.
    #[error(transparent)]
    Motion(#[from] MotionError),
}

impl Recorded {
    /// Reads a table.
    pub fn load(path: &Path) -> Result<Self, MotionFileError> {
        let text = text_file::read(path, BYTES_MAX).map_err(|e| match e {
            TextFileError::Read(source) => MotionFileError::Read { source },
            TextFileError::TooLarge { bytes } => MotionFileError::TooLarge { bytes },
        })?;
        Self::parse(&text)
    }

    /// Parses a table.
    pub fn parse(text: &str) -> Result<Self, MotionFileError> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        if text.trim().is_empty() {
            return Err(MotionFileError::Empty);
        }
        let mut lines = text.lines().enumerate();
        let columns = columns(lines.next().map_or("", |(_, line)| line))?;
        let mut moments: Vec<Moment> = Vec::new();
        for (k, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
            let wrong = |what| MotionFileError::Row { line: k + 1, what };
            let moment = moment(line, columns).map_err(wrong)?;
            if let Some(last) = moments.last().filter(|m| m.t_s >= moment.t_s) {
                return Err(wrong(format!(
                    "its time {} s is not after {} s, the one before it; rows go forward in time",
                    moment.t_s, last.t_s
                )));
            }
            moments.push(moment);
        }
        if moments.len() < ROWS_MIN {
            return Err(MotionFileError::TooFew(moments.len()));
        }
        let motion = Motion::new(moments)?;
        Ok(Self { motion })
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.motion.moments().len()
    }
}

impl Hand for Recorded {
    fn at(&self, t_s: f64) -> Pose {
        // The search begins at the row before that time, so that random access is cheap.
        let mut near = (self.motion.moments())
            .partition_point(|m| m.t_s <= t_s)
            .saturating_sub(1);
        pose(&self.motion.at(t_s, &mut near).0.pose)
    }

    fn length_s(&self) -> f64 {
        self.motion.length_s()
    }
}

/// Columns of a table.
#[derive(Debug, Clone, Copy)]
struct Columns {
    /// Total number.
    all: usize,
    /// Number of leading columns with time and pose.
    of_pose: usize,
}

/// Parses the header; columns must have their order.
fn columns(line: &str) -> Result<Columns, MotionFileError> {
    let mut names: Vec<&str> = line.trim().split(',').map(str::trim).collect();
    let wrong = |what: String| MotionFileError::Columns(what);
    let all = names.len();
    // A motion for a replayed device may have buttons; they are ignored.
    names.pop_if(|name| *name == BUTTONS && all > 1);
    for (k, name) in names.iter().enumerate() {
        let name: String = name.chars().take(40).collect();
        match COLUMNS.get(k) {
            Some(known) if **known == name || k == 0 && name == TIME_ALSO => {}
            Some(known) => {
                return Err(wrong(format!(
                    "number {} is \"{name}\" in place of {known}",
                    k + 1
                )));
            }
            None => return Err(wrong(format!("\"{name}\" is not known"))),
        }
    }
    if names.len() == 4 || names.len() == 8 {
        let of_pose = names.len();
        return Ok(Columns { all, of_pose });
    }
    let missing = COLUMNS[names.len()];
    Err(wrong(format!("{missing} is missing")))
}

fn moment(line: &str, columns: Columns) -> Result<Moment, String> {
    let mut row = [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
    let cells: Vec<&str> = line.split(',').map(str::trim).collect();
    if cells.len() != columns.all {
        let (has, asked) = (cells.len(), columns.all);
        return Err(format!("{has} numbers in {asked} columns"));
    }
    let cells = &cells[..columns.of_pose];
    for ((cell, value), name) in cells.iter().zip(&mut row).zip(COLUMNS) {
        let short: String = cell.chars().take(40).collect();
        *value = match cell.parse::<f64>() {
            Ok(v) if v.is_finite() => v,
            Ok(_) => {
                return Err(format!(
                    "{name} is {short}, which is not finite; leave the row out"
                ));
            }
            Err(_) => return Err(format!("{name} is \"{short}\", which is not a number")),
        };
    }
    let [t_s, x, y, z, qw, qx, qy, qz] = row;
    let q = Quaternion::new(qw, qx, qy, qz);
    if !(0.5..=2.0).contains(&q.norm()) {
        return Err(format!(
            "the quaternion has the length {:.3}; it should be 1",
            q.norm()
        ));
    }
    Ok(Moment {
        t_s,
        pose: palpate_device::Pose {
            position: Vector3::new(x, y, z),
            orientation: UnitQuaternion::new_normalize(q),
        },
        buttons: Buttons::NONE,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str =
        "time_s,x_m,y_m,z_m\n5.0,0.0,0,0\n5.1,0.01,0,0\n5.2,0.02,0,0\n5.3,0.03,0,0\n";

    #[test]
    fn replayed_device_table_is_the_same_motion() {
        let hand = Recorded::parse(GOOD).unwrap();
        let theirs = GOOD.replace("time_s", "t_s");
        assert_eq!(Recorded::parse(&theirs).unwrap(), hand);
        let held: Vec<String> = (theirs.lines().enumerate())
            .map(|(k, line)| format!("{line},{}", if k == 0 { "buttons" } else { "1" }))
            .collect();
        assert_eq!(Recorded::parse(&held.join("\n")).unwrap(), hand);
    }

    #[test]
    fn motion_starts_with_the_first_row() {
        let hand = Recorded::parse(GOOD).unwrap();
        assert_eq!((hand.rows(), hand.at(-1.0).position_m[0]), (4, 0.0));
        assert!((hand.length_s() - 0.3).abs() < 1e-12);
        for (t, x) in [(0.1, 0.01), (0.15, 0.015), (0.2, 0.02), (9.0, 0.03)] {
            assert!((hand.at(t).position_m[0] - x).abs() < 1e-12, "{t}");
        }
    }

    #[test]
    fn rotation_columns_are_read() {
        let text = "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,0,0,0,0.8,0.6,0,0\n2,0,0,0,1,0,0,0\n";
        let q = Recorded::parse(text).unwrap().at(1.0).orientation;
        assert!((q[0] - 0.6).abs() < 1e-12 && (q[3] - 0.8).abs() < 1e-12);
    }

    #[test]
    fn invalid_motion_error_names_line_and_cause() {
        let bad = [
            (
                GOOD.replace("5.2", "5.05"),
                "line 4: its time 5.05 s is not after 5.1 s",
            ),
            (GOOD.replace("0.02", "NaN"), "line 4: x_m is NaN"),
            (GOOD.replace("0.02", "inf"), "line 4: x_m is inf"),
            (
                GOOD.replace("0.02", "two"),
                "line 4: x_m is \"two\", which is not a number",
            ),
            (
                GOOD.replace("0.02,0,0", "0.02,0"),
                "line 4: 3 numbers in 4 columns",
            ),
            (
                GOOD.replace("z_m", "z_mm"),
                "line 1: the columns should be time_s,x_m,y_m,z_m",
            ),
            (
                GOOD.replace("z_m", "z_m,force_n"),
                "\"force_n\" in place of qw",
            ),
            (GOOD.replace(",z_m", ""), "z_m is missing"),
            (GOOD[..GOOD.len() - 26].to_owned(), "there are 2 rows"),
            (String::new(), "it is empty"),
            (
                "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,0,0,0,0\n".to_owned(),
                "line 2: the quaternion has the length 0",
            ),
        ];
        for (text, expected) in bad {
            let said = Recorded::parse(&text).unwrap_err().to_string();
            assert!(said.contains(expected), "{said:?} should say {expected:?}");
        }
        let none = Recorded::load(Path::new("no-such-motion.csv")).unwrap_err();
        assert!(none.to_string().contains("can not be read"));
    }
}
