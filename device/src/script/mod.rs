//! Scripts: where a simulated hand wants to be, as way points in a documented TOML file.
//!
//! ```toml
//! format = "palpate-script/1"
//! repeat = false              # true: begin again at the first way point (the last must be there)
//!
//! [tool]
//! kind = "probe"              # "probe" (a ball), "blade" (cuts along the path of its tip), "needle", "plate" or "forceps"
//! radius_mm = 4.0             # of the probe's ball, or half the thickness of any other tool
//! # length_mm = 20.0          # of blade and needle from the tip upwards, of a plate along x, of the jaws; not of a probe
//! # width_mm = 10.0           # of a plate, or of the jaws of forceps, along y
//!
//! [hand]                      # optional, as is each line of it
//! mass_kg = 0.3
//! stiffness_n_per_m = 400.0   # of the spring that pulls the hand to the script
//! damping_ns_per_m = 12.0     # of the damper beside that spring
//! tremor_mm = 0.0             # root mean square along each axis, 8 to 12 Hz
//! seed = 1                    # of the tremor
//!
//! [[way]]
//! t_s = 0.0
//! at_mm = [0.0, 0.0, 80.0]
//!
//! [[way]]
//! t_s = 1.5
//! at_mm = [0.0, 0.0, 45.0]
//! button = true               # the primary button is held from this way point on
//! ease = "minimum-jerk"       # how this way point is reached; or "linear"
//! quat = [1.0, 0.0, 0.0, 0.0] # w, x, y, z; without it the tool keeps the turn it had
//! ```
//!
//! Before the first way point the hand stays at the first, after the last at the last.
//!
//! Minimum jerk (Flash and Hogan 1985): with u in 0..1 the share of the time between two way
//! points, the share of the path is s = 10 u³ − 15 u⁴ + 6 u⁵, which starts and ends at rest.

mod format;
mod motion;
mod tool;

use std::path::Path;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::{Placement, Pose, ScriptError, text_file};

pub use motion::ScriptPose;
pub use tool::{Tool, ToolKind};

/// Maximum number of way points in a script: one per millisecond for 100 s. The limit bounds memory, because a
/// script is read whole.
pub const WAYPOINTS_MAX: usize = 100_000;

/// Maximum size of a script file, bytes. A larger file is rejected before parsing.
pub const SCRIPT_BYTES_MAX: u64 = 16 << 20;

/// Maximum distance of a way point from the origin, m. A larger one is most probably in another unit.
pub const POSITION_MAX_M: f64 = 10.0;

/// Maximum distance between the first and the last way point of a repeated script, m; a larger one would be a jump
/// of the hand at every repetition.
pub const REPEAT_GAP_MAX_M: f64 = 1e-4;

/// The hand that a script pulls along.
///
/// The defaults are a choice, not a measurement: a light grip (0.3 kg that move with the tool, 5.8 Hz, damping
/// ratio 0.55). Tissue of 100 to 1000 N/m pushes it back visibly, and it follows a script within a millimetre or
/// two.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Hand {
    /// Mass that moves with the tool, kg.
    pub mass_kg: f64,
    /// Stiffness of the spring between hand and script, N/m.
    pub stiffness_n_per_m: f64,
    /// Damping between hand and script, N·s/m. It acts on the difference of their velocities, so
    /// that a free hand in steady motion does not lag.
    pub damping_ns_per_m: f64,
    /// Root mean square of the free hand's tremor along each axis, m.
    #[serde(rename = "tremor_mm", with = "format::mm")]
    pub tremor_m: f64,
    /// Seed of the tremor.
    pub seed: u64,
}

impl Default for Hand {
    fn default() -> Self {
        Self {
            mass_kg: 0.3,
            stiffness_n_per_m: 400.0,
            damping_ns_per_m: 12.0,
            tremor_m: 0.0,
            seed: 1,
        }
    }
}

/// Interpolation from the previous way point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ease {
    /// Rest to rest, as a hand moves.
    #[default]
    MinimumJerk,
    /// At constant speed.
    Linear,
}

/// One way point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Waypoint {
    /// Time, s.
    pub t_s: f64,
    /// Position of the tip, m.
    pub position: Vector3<f64>,
    /// Orientation of the tool.
    pub orientation: UnitQuaternion<f64>,
    /// Whether the primary button is held from here on.
    pub button: bool,
    /// Interpolation towards this point.
    pub ease: Ease,
}

impl Waypoint {
    /// A way point at `t_s` seconds and `position` metres, reached rest to rest, not turned, no
    /// button held.
    pub fn new(t_s: f64, position: Vector3<f64>) -> Self {
        Self {
            t_s,
            position,
            orientation: UnitQuaternion::identity(),
            button: false,
            ease: Ease::MinimumJerk,
        }
    }

    /// The same way point with the primary button held from it on.
    #[must_use]
    pub fn pressed(self) -> Self {
        Self {
            button: true,
            ..self
        }
    }

    /// The same way point, reached at constant speed.
    #[must_use]
    pub fn linear(self) -> Self {
        Self {
            ease: Ease::Linear,
            ..self
        }
    }

    /// The same way point with the tool turned.
    #[must_use]
    pub fn turned(self, orientation: UnitQuaternion<f64>) -> Self {
        Self {
            orientation,
            ..self
        }
    }
}

/// The motion of a simulated hand over time. Valid by construction.
#[derive(Debug, Clone, PartialEq)]
pub struct Script {
    tool: Tool,
    hand: Hand,
    waypoints: Vec<Waypoint>,
    repeat: bool,
}

impl Script {
    /// A script from its parts; rejects the same errors as a file.
    pub fn new(
        tool: Tool,
        hand: Hand,
        waypoints: Vec<Waypoint>,
        repeat: bool,
    ) -> Result<Self, ScriptError> {
        tool.check()?;
        check_hand(&hand)?;
        check_waypoints(&waypoints, repeat)?;
        Ok(Self {
            tool,
            hand,
            waypoints,
            repeat,
        })
    }

    /// A probe that rests at `position` (m) for ever.
    pub fn resting_probe(position: Vector3<f64>, radius_m: f64) -> Result<Self, ScriptError> {
        let tool = Tool::probe(radius_m);
        Self::new(
            tool,
            Hand::default(),
            vec![Waypoint::new(0.0, position)],
            false,
        )
    }

    /// Reads a script file.
    pub fn load(path: &Path) -> Result<Self, ScriptError> {
        Self::from_toml(&text_file::read(path, SCRIPT_BYTES_MAX)?)
    }

    /// The tool in the hand.
    pub fn tool(&self) -> Tool {
        self.tool
    }

    /// The hand.
    pub fn hand(&self) -> Hand {
        self.hand
    }

    /// The way points, in the order of time.
    pub fn waypoints(&self) -> &[Waypoint] {
        &self.waypoints
    }

    /// Whether the script begins again after its last way point.
    pub fn repeats(&self) -> bool {
        self.repeat
    }

    /// The middle of the box around all way points, m.
    pub fn middle(&self) -> Vector3<f64> {
        let first = self.waypoints[0].position;
        let around = self
            .waypoints
            .iter()
            .fold((first, first), |(low, high), way| {
                (low.inf(&way.position), high.sup(&way.position))
            });
        (around.0 + around.1) * 0.5
    }

    /// The same script in the frame of a device with this placement.
    pub fn seen_from(&self, placement: &Placement) -> Result<Self, ScriptError> {
        let moved = |way: &Waypoint| {
            let pose = placement.to_device(&Pose {
                position: way.position,
                orientation: way.orientation,
            });
            Waypoint {
                position: pose.position,
                orientation: pose.orientation,
                ..*way
            }
        };
        let waypoints = self.waypoints.iter().map(moved).collect();
        Self::new(self.tool, self.hand, waypoints, self.repeat)
    }

    /// The time of the last way point, s. A repeated script continues after it.
    pub fn end_s(&self) -> f64 {
        self.waypoints[self.waypoints.len() - 1].t_s
    }
}

fn check_hand(hand: &Hand) -> Result<(), ScriptError> {
    // The upper bounds keep the sub-step of the hand's integration stable: with the lightest
    // hand, stiffness * dt² / mass <= 0.0125 and damping * dt / mass <= 0.5 at dt = 0.25 ms.
    // TOML has signed integers of 64 bits, which bounds the seed.
    let ranges = [
        ("hand.mass_kg", hand.mass_kg, 0.05..=20.0),
        ("hand.stiffness_n_per_m", hand.stiffness_n_per_m, 1.0..=1e4),
        ("hand.damping_ns_per_m", hand.damping_ns_per_m, 0.0..=100.0),
        ("hand.tremor_mm", hand.tremor_m * 1e3, 0.0..=10.0),
        ("hand.seed", hand.seed as f64, 0.0..=(1_u64 << 62) as f64),
    ];
    for (key, value, range) in ranges {
        if !range.contains(&value) {
            let (least, most) = range.into_inner();
            let rule = format!("must be from {least} to {most}");
            return Err(bad_value(key, value, &rule));
        }
    }
    Ok(())
}

/// An invalid value of `[tool]` or `[hand]`.
fn bad_value(key: &str, value: f64, rule: &str) -> ScriptError {
    ScriptError::new(format_args!("{key} = {value}: {rule}"))
}

/// An invalid way point, the first being number 1.
fn bad_waypoint(number: usize, t_s: f64, rule: &str) -> ScriptError {
    ScriptError::new(format_args!("way point {number} (at {t_s} s): {rule}"))
}

fn check_waypoints(waypoints: &[Waypoint], repeat: bool) -> Result<(), ScriptError> {
    let Some((first, last)) = waypoints.first().zip(waypoints.last()) else {
        return Err(ScriptError::new(
            "the script has no [[way]]; write at least one",
        ));
    };
    if waypoints.len() > WAYPOINTS_MAX {
        let n = waypoints.len();
        let why = format_args!("the script has {n} way points; {WAYPOINTS_MAX} are the most");
        return Err(ScriptError::new(why));
    }
    let mut before = f64::NEG_INFINITY;
    for (i, way) in waypoints.iter().enumerate() {
        let refuse = |rule| Err(bad_waypoint(i + 1, way.t_s, rule));
        if !way.t_s.is_finite() || way.t_s.abs() > 1e6 {
            return refuse("t_s must be a finite time below a million seconds");
        }
        if way.t_s <= before {
            return refuse("t_s must be later than that of the way point before it");
        }
        if !way.position.iter().all(|c| c.abs() <= POSITION_MAX_M) {
            return refuse("at_mm must be finite and within 10 m of the origin");
        }
        if !way.orientation.coords.iter().all(|c| c.is_finite()) {
            return refuse("quat must be finite");
        }
        before = way.t_s;
    }
    let gap = (last.position - first.position).norm();
    if repeat && waypoints.len() < 2 {
        let rule = "repeat = true needs at least two way points";
        return Err(bad_waypoint(1, first.t_s, rule));
    }
    if repeat && gap > REPEAT_GAP_MAX_M {
        return Err(ScriptError::new(format_args!(
            "repeat = true, but the last way point is {} mm from the first; end the script where it \
             begins",
            gap * 1e3
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::{Hand, Script, Tool, Waypoint};

    fn probe() -> Tool {
        Tool::probe(0.004)
    }

    fn waypoints(at: &[(f64, f64)]) -> Vec<Waypoint> {
        at.iter()
            .map(|&(t, x)| Waypoint::new(t, Vector3::new(x, 0.0, 0.0)))
            .collect()
    }

    #[test]
    fn times_must_increase_and_the_message_names_the_way_point() {
        let e = Script::new(
            probe(),
            Hand::default(),
            waypoints(&[(0.0, 0.0), (1.0, 0.0), (1.0, 0.1)]),
            false,
        )
        .unwrap_err();
        assert!(e.to_string().starts_with("way point 3 (at 1 s)"), "{e}");
    }

    #[test]
    fn positions_beyond_ten_metres_or_not_finite_are_rejected() {
        for x in [10.1, f64::NAN, f64::INFINITY] {
            let e =
                Script::new(probe(), Hand::default(), waypoints(&[(0.0, x)]), false).unwrap_err();
            assert!(e.to_string().starts_with("way point 1"), "{x}: {e}");
        }
        let none = Script::new(probe(), Hand::default(), vec![], false).unwrap_err();
        assert!(none.to_string().contains("no [[way]]"), "{none}");
    }

    #[test]
    fn a_repeated_script_ends_where_it_begins() {
        let open = waypoints(&[(0.0, 0.0), (1.0, 0.1)]);
        let shut = waypoints(&[(0.0, 0.0), (1.0, 0.1), (2.0, 0.0)]);
        let gap = Script::new(probe(), Hand::default(), open, true).unwrap_err();
        assert!(
            gap.to_string().contains("is 100 mm from the first"),
            "{gap}"
        );
        assert!(Script::new(probe(), Hand::default(), shut, true).is_ok());
    }

    #[test]
    fn a_hand_outside_the_stable_range_is_rejected() {
        for hand in [
            Hand {
                mass_kg: 0.0,
                ..Hand::default()
            },
            Hand {
                stiffness_n_per_m: f64::NAN,
                ..Hand::default()
            },
            Hand {
                damping_ns_per_m: 1e4,
                ..Hand::default()
            },
            Hand {
                tremor_m: -0.001,
                ..Hand::default()
            },
        ] {
            let e = Script::new(probe(), hand, waypoints(&[(0.0, 0.0)]), false).unwrap_err();
            assert!(e.to_string().starts_with("hand."), "{e}");
        }
    }
}
