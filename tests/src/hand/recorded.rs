//! The motion of a hand as it was recorded, from a table.
//!
//! ```text
//! time_s,x_m,y_m,z_m[,qw,qx,qy,qz]
//! 0.000,0.0101,0.0200,0.1503
//! 0.001,0.0102,0.0200,0.1503
//! ```
//!
//! Between rows it is the cubic that a replayed device follows; with rows a millisecond apart that is less than a
//! micrometre from any hand.

use std::path::Path;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use palpate_device::Buttons;
use palpate_device::backend::replay::{Moment, Motion, MotionError};
use palpate_device::text_file::{self, TextFileError};
use palpate_protocol::Pose;
use thiserror::Error;

use super::{Hand, pose};

/// The largest file that is read: three hours at a kilohertz.
const BYTES_MAX: u64 = 1 << 29;

/// With fewer rows there is no acceleration to be known.
const ROWS_MIN: usize = 3;

/// Columns: time and place, which every table has, and how the tool is turned.
const COLUMNS: [&str; 8] = ["time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"];

/// What the column of time may also be called: so the tables of a replayed device do.
const TIME_ALSO: &str = "t_s";

/// A column that those tables may end with.
const BUTTONS: &str = "buttons";

/// A recorded motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded {
    motion: Motion,
}

/// Why a file is no motion of a hand. Who shows it says which file.
#[derive(Debug, Error)]
pub enum MotionFileError {
    /// It can not be read.
    #[error("it can not be read: {source}")]
    Read {
        /// What the system said.
        source: std::io::Error,
    },
    /// Too large to be one.
    #[error(
        "it has {bytes} bytes, and a motion at most {BYTES_MAX}; leave rows out, or give a part of it"
    )]
    TooLarge {
        /// Its size.
        bytes: u64,
    },
    /// Nothing in it.
    #[error("it is empty; its first line names the columns: time_s,x_m,y_m,z_m[,qw,qx,qy,qz]")]
    Empty,
    /// The first line names other columns.
    #[error(
        "line 1: the columns should be time_s,x_m,y_m,z_m (time_s may be called t_s), and where turns are known also \
         qw,qx,qy,qz; {0}"
    )]
    Columns(String),
    /// A row is wrong.
    #[error("line {line}: {what}")]
    Row {
        /// Which, from 1.
        line: usize,
        /// What is wrong, and what to do.
        what: String,
    },
    /// Not enough of them.
    #[error("there are {0} rows of numbers; a motion needs at least {ROWS_MIN}")]
    TooFew(usize),
    /// What can not be a hand's motion as a whole.
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

    /// From the text of a table.
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

    /// Rows of the table.
    pub fn rows(&self) -> usize {
        self.motion.moments().len()
    }
}

impl Hand for Recorded {
    fn at(&self, t_s: f64) -> Pose {
        // The search begins at the row before that moment, so that asking anywhere costs the same.
        let mut near = (self.motion.moments())
            .partition_point(|m| m.t_s <= t_s)
            .saturating_sub(1);
        pose(&self.motion.at(t_s, &mut near).0.pose)
    }

    fn length_s(&self) -> f64 {
        self.motion.length_s()
    }
}

/// What a row holds.
#[derive(Debug, Clone, Copy)]
struct Columns {
    /// How many there are.
    all: usize,
    /// How many of them say when and where, the first ones.
    of_pose: usize,
}

/// The columns, when they are the known ones in their order.
fn columns(line: &str) -> Result<Columns, MotionFileError> {
    let mut names: Vec<&str> = line.trim().split(',').map(str::trim).collect();
    let wrong = |what: String| MotionFileError::Columns(what);
    let all = names.len();
    // A motion to be replayed may say what is held; nothing here is moved by it.
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
                    "{name} is {short}, which is no place and no time; leave the row out"
                ));
            }
            Err(_) => return Err(format!("{name} is \"{short}\", which is no number")),
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
    fn a_table_for_a_replayed_device_is_the_same_motion() {
        let hand = Recorded::parse(GOOD).unwrap();
        let theirs = GOOD.replace("time_s", "t_s");
        assert_eq!(Recorded::parse(&theirs).unwrap(), hand);
        let held: Vec<String> = (theirs.lines().enumerate())
            .map(|(k, line)| format!("{line},{}", if k == 0 { "buttons" } else { "1" }))
            .collect();
        assert_eq!(Recorded::parse(&held.join("\n")).unwrap(), hand);
    }

    #[test]
    fn a_table_is_followed_from_its_first_row_on() {
        let hand = Recorded::parse(GOOD).unwrap();
        assert_eq!((hand.rows(), hand.at(-1.0).position_m[0]), (4, 0.0));
        assert!((hand.length_s() - 0.3).abs() < 1e-12);
        for (t, x) in [(0.1, 0.01), (0.15, 0.015), (0.2, 0.02), (9.0, 0.03)] {
            assert!((hand.at(t).position_m[0] - x).abs() < 1e-12, "{t}");
        }
    }

    #[test]
    fn a_turn_is_read_where_there_are_columns_for_it() {
        let text = "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,0,0,0,0.8,0.6,0,0\n2,0,0,0,1,0,0,0\n";
        let q = Recorded::parse(text).unwrap().at(1.0).orientation;
        assert!((q[0] - 0.6).abs() < 1e-12 && (q[3] - 0.8).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_motion_is_refused_with_its_line_and_what_is_wrong() {
        let bad = [
            (
                GOOD.replace("5.2", "5.05"),
                "line 4: its time 5.05 s is not after 5.1 s",
            ),
            (GOOD.replace("0.02", "NaN"), "line 4: x_m is NaN"),
            (GOOD.replace("0.02", "inf"), "line 4: x_m is inf"),
            (
                GOOD.replace("0.02", "two"),
                "line 4: x_m is \"two\", which is no number",
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
