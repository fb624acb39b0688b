//! One tool over time, as others see it.

use crate::{Pose, ServerTime, Span, ToolSample};

/// How missing samples are made up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Method {
    /// Verlet steps with a windowed second difference.
    #[default]
    Verlet,
    /// Cubic between velocities; extrapolates linearly.
    Hermite,
    /// Straight lines at constant speed.
    Linear,
    /// The last sample stays.
    Hold,
}

/// Where what is shown comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// A sample of this very moment.
    Exact,
    /// Between two samples.
    Interpolated,
    /// Beyond the newest sample, by at most the gap limit.
    Extrapolated,
    /// Farther beyond it: the tool stands still.
    Held,
}

/// A tool at a moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shown {
    /// Where it is.
    pub pose: Pose,
    /// How fast it moves, m/s.
    pub velocity_m_s: [f64; 3],
    /// Its buttons.
    pub buttons: u8,
    /// How this is known.
    pub source: Source,
    /// Whether nothing has come for so long that the tool is to be faded and must not press.
    pub stale: bool,
    /// How strongly to draw it: 1 fresh, down to 0 while it is held.
    pub opacity: f64,
}

/// One tool over time. Insert samples as they come, late and doubled ones too; ask for any moment,
/// moments ascending.
pub struct Timeline {}

#[expect(unused_variables, reason = "bodies follow")]
impl Timeline {
    /// An empty timeline that extrapolates at most `gap_limit` (network default 50 ms).
    pub fn new(method: Method, gap_limit: Span) -> Self {
        Self {}
    }
    /// Adds a sample.
    pub fn insert(&mut self, sample: ToolSample) {}
    /// The tool at a moment; `None` before the first sample.
    pub fn at(&mut self, t: ServerTime) -> Option<Shown> {
        None
    }
}
