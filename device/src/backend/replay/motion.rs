//! A recorded motion: poses of the tool over time.

use std::path::Path;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::Deserialize;

use crate::script::POSITION_MAX_M;
use crate::{Buttons, Pose, ScriptError, text_file};

/// Maximum size of a file: hours at a kilohertz.
const BYTES_MAX: u64 = 1 << 30;
/// The longest motion, s: a day. Later times are more likely milliseconds.
const LONGEST_S: f64 = 86_400.0;
/// Above any hand's speed, m/s.
const FASTEST_M_S: f64 = 100.0;
/// Alternative name of the time column, used by the laboratory's tables of hands.
const TIME_ALSO: &str = "time_s";
/// Columns of a table: time and position, required in every row; orientation and buttons, optional.
const COLUMNS: [&str; 9] = [
    "t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", "buttons",
];

/// One sample of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// Since the motion began, s.
    pub t_s: f64,
    /// Pose of the tool.
    pub pose: Pose,
    /// The buttons held from here on.
    pub buttons: Buttons,
}

/// A recorded motion: at least two samples, in order of time.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    moments: Vec<Moment>,
}

#[derive(Deserialize)]
struct Recording {
    haptic: Vec<Point>,
    script_started_us: Option<i64>,
}

#[derive(Deserialize)]
struct Point {
    t_us: i64,
    position_m: [f64; 3],
    /// x, y, z, w; older recordings contain neither it nor the buttons.
    #[serde(default = "not_turned")]
    orientation: [f64; 4],
    #[serde(default)]
    buttons: u32,
}

fn not_turned() -> [f64; 4] {
    [0.0, 0.0, 0.0, 1.0]
}

impl Motion {
    /// A motion of these moments; time is counted from the first.
    pub fn new(moments: Vec<Moment>) -> Result<Self, ScriptError> {
        Self::checked(moments, |k| format!("moment {}:", k + 1))
    }

    /// The same; `place` names a moment in an error.
    fn checked(
        mut moments: Vec<Moment>,
        place: impl Fn(usize) -> String,
    ) -> Result<Self, ScriptError> {
        if moments.len() < 2 {
            let n = moments.len();
            let why = format_args!("a motion needs two moments or more; here is {n}");
            return Err(ScriptError::new(why));
        }
        let began = moments[0].t_s;
        let mut last: Option<Moment> = None;
        for (k, moment) in moments.iter_mut().enumerate() {
            let wrong = |what: &str| ScriptError::new(format_args!("{} {what}", place(k)));
            if !(moment.t_s.is_finite() && moment.pose.is_finite()) {
                return Err(wrong("holds a number that is not finite"));
            }
            if moment.pose.position.amax() > POSITION_MAX_M {
                return Err(wrong("is more than 10 m away; are these millimetres?"));
            }
            moment.t_s -= began;
            if moment.t_s > LONGEST_S {
                return Err(wrong(
                    "is more than a day after the first; are these milliseconds?",
                ));
            }
            if let Some(last) = last {
                let dt = moment.t_s - last.t_s;
                if dt <= 0.0 {
                    return Err(wrong("is not later than the one before it"));
                }
                let way = (moment.pose.position - last.pose.position).norm();
                if way > FASTEST_M_S * dt {
                    return Err(wrong("is farther from the one before it than 100 m/s go"));
                }
            }
            last = Some(*moment);
        }
        Ok(Self { moments })
    }

    /// Reads a recording of a session (`.json`), or a table (`.csv`) with a line of column names.
    pub fn load(path: &Path) -> Result<Self, ScriptError> {
        let text = text_file::read(path, BYTES_MAX)?;
        if path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("json"))
        {
            Self::from_recording(&text)
        } else {
            Self::from_table(&text)
        }
    }

    /// From the JSON of a recorded session: the hand's path from the start of its script.
    pub fn from_recording(text: &str) -> Result<Self, ScriptError> {
        let recording: Recording = serde_json::from_str(without_mark(text)).map_err(|e| {
            let what = "this is no recording of a session (JSON with a list \"haptic\")";
            ScriptError::new(format_args!("{what}: {e}"))
        })?;
        let moment = |(k, p): (usize, &Point)| {
            let [x, y, z, w] = p.orientation;
            let orientation = unit(Quaternion::new(w, x, y, z));
            let pose = orientation.map(|orientation| Pose {
                position: p.position_m.into(),
                orientation,
            });
            Ok(Moment {
                t_s: p.t_us as f64 * 1e-6,
                pose: pose
                    .map_err(|what| ScriptError::new(format_args!("moment {}: {what}", k + 1)))?,
                buttons: Buttons::from_bits(p.buttons),
            })
        };
        let began = recording.script_started_us.unwrap_or(i64::MIN);
        let points = recording.haptic.iter().enumerate();
        let points = points.filter(|(_, p)| p.t_us >= began);
        Self::new(points.map(moment).collect::<Result<_, ScriptError>>()?)
    }

    /// From a table of numbers between commas.
    pub fn from_table(text: &str) -> Result<Self, ScriptError> {
        let mut lines = without_mark(text).lines().enumerate();
        let first = lines.next().map_or("", |(_, line)| line.trim());
        let mut names: Vec<&str> = first.split(',').map(str::trim).collect();
        if names[0] == TIME_ALSO {
            names[0] = COLUMNS[0];
        }
        let known = [&COLUMNS[..4], &COLUMNS[..8], &COLUMNS[..]];
        let short = [&COLUMNS[..4], &COLUMNS[8..]].concat();
        if !known.contains(&&names[..]) && names != short {
            let begins: String = first.chars().take(80).collect();
            return Err(ScriptError::new(format_args!(
                "line 1 should name the columns: t_s (or time_s),x_m,y_m,z_m, and if they are known \
                 qw,qx,qy,qz and buttons; it is \"{begins}\""
            )));
        }
        let (mut moments, mut numbers) = (Vec::new(), Vec::new());
        for (k, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
            let wrong = |what: &str| ScriptError::new(format_args!("line {}: {what}", k + 1));
            let cells: Vec<&str> = line.split(',').map(str::trim).collect();
            if cells.len() != names.len() {
                let (has, asked) = (cells.len(), names.len());
                return Err(wrong(&format!("{has} numbers in {asked} columns")));
            }
            let mut row = Vec::with_capacity(cells.len());
            for (name, cell) in names.iter().zip(cells) {
                let number = cell.parse().ok().filter(|x: &f64| x.is_finite());
                let short: String = cell.chars().take(40).collect();
                row.push(number.ok_or_else(|| {
                    wrong(&format!(
                        "{name} is \"{short}\", which is not a finite number"
                    ))
                })?);
            }
            moments.push(moment(&names, &row).map_err(wrong)?);
            numbers.push(k + 1);
        }
        Self::checked(moments, |k| format!("line {}: the moment", numbers[k]))
    }

    /// The moments.
    pub fn moments(&self) -> &[Moment] {
        &self.moments
    }

    /// How long it is, s.
    pub fn length_s(&self) -> f64 {
        self.moments[self.moments.len() - 1].t_s
    }

    /// The tool at `t_s`, with its velocity (m/s) and its angular velocity (rad/s): between two samples by cubic
    /// Hermite interpolation with finite-difference velocities; at rest before the first and after the last. `near`
    /// is the index at which the last search ended and this one begins.
    pub fn at(&self, t_s: f64, near: &mut usize) -> (Moment, Vector3<f64>, Vector3<f64>) {
        let m = &self.moments;
        let still = Vector3::zeros();
        let last = m.len() - 1;
        if t_s <= 0.0 || t_s.is_nan() {
            // No button is held before the motion begins.
            let buttons = if t_s == 0.0 {
                m[0].buttons
            } else {
                Buttons::NONE
            };
            return (Moment { buttons, ..m[0] }, still, still);
        }
        if t_s >= m[last].t_s {
            return (m[last], still, still);
        }
        let mut i = (*near).min(last - 1);
        while m[i].t_s > t_s {
            i -= 1;
        }
        while m[i + 1].t_s <= t_s {
            i += 1;
        }
        *near = i;
        let (a, b) = (&m[i], &m[i + 1]);
        let h = b.t_s - a.t_s;
        let s = (t_s - a.t_s) / h;
        let (va, vb) = (self.velocity(i) * h, self.velocity(i + 1) * h);
        let (pa, pb) = (a.pose.position, b.pose.position);
        let by = pb - pa;
        // Hermite's cubic, starting at pa.
        let (c2, c3) = (by * 3.0 - va * 2.0 - vb, va + vb - by * 2.0);
        let position = pa + (va + (c2 + c3 * s) * s) * s;
        let velocity = (va + (c2 * 2.0 + c3 * (3.0 * s)) * s) / h;
        let turn = a
            .pose
            .orientation
            .rotation_to(&b.pose.orientation)
            .scaled_axis();
        let orientation = UnitQuaternion::from_scaled_axis(turn * s) * a.pose.orientation;
        let moment = Moment {
            t_s,
            pose: Pose {
                position,
                orientation,
            },
            buttons: a.buttons,
        };
        (moment, velocity, turn / h)
    }

    /// Velocity at a sample: the slope between its neighbours, and zero at the ends.
    fn velocity(&self, i: usize) -> Vector3<f64> {
        let m = &self.moments;
        if i == 0 || i + 1 == m.len() {
            return Vector3::zeros();
        }
        (m[i + 1].pose.position - m[i - 1].pose.position) / (m[i + 1].t_s - m[i - 1].t_s)
    }
}

/// Removes the byte order mark that some programs write.
fn without_mark(text: &str) -> &str {
    text.strip_prefix('\u{feff}').unwrap_or(text)
}

fn unit(q: Quaternion<f64>) -> Result<UnitQuaternion<f64>, &'static str> {
    if !(1e-3..=1e3).contains(&q.norm()) {
        return Err("the quaternion is zero, or far from one");
    }
    Ok(UnitQuaternion::new_normalize(q))
}

fn moment(names: &[&str], row: &[f64]) -> Result<Moment, &'static str> {
    let column = |name: &str| names.iter().position(|n| *n == name).map(|k| row[k]);
    let number = |name: &str| column(name).unwrap_or(0.0);
    let orientation = match column("qw") {
        Some(w) => unit(Quaternion::new(w, number("qx"), number("qy"), number("qz")))?,
        None => UnitQuaternion::identity(),
    };
    let buttons = number("buttons");
    if !(buttons >= 0.0 && buttons <= f64::from(u32::MAX) && buttons.fract() == 0.0) {
        return Err("buttons are a number of bits, 0 for none");
    }
    Ok(Moment {
        t_s: number("t_s"),
        pose: Pose {
            position: Vector3::new(number("x_m"), number("y_m"), number("z_m")),
            orientation,
        },
        buttons: Buttons::from_bits(buttons as u32),
    })
}
