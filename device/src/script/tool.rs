//! The tool in the hand of a script.

use serde::{Deserialize, Serialize};

use super::bad_value;
use crate::ScriptError;

/// Default length of a blade's edge, mm: about that of a number 10 blade.
const BLADE_LENGTH_MM: f64 = 20.0;
/// Longest tool, m.
const LENGTH_MAX_M: f64 = 0.2;

/// Kind of tool. In its own frame the tip is at the origin and the handle along z.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ToolKind {
    /// A ball that presses.
    Probe,
    /// An edge from the tip up z that cuts along the path of its tip while the primary button is held.
    Blade,
    /// A line from the tip up z that presses.
    Needle,
    /// A rectangle around the tip that presses: its length along x, its width along y.
    Plate,
    /// Two jaws from a joint above the tip down to it, closed while the primary button is held.
    Forceps,
}

/// The tool of a script.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tool {
    /// Its kind.
    pub kind: ToolKind,
    /// Radius of the probe's ball, or half the thickness of anything else, m.
    pub radius_m: f64,
    /// Length of the blade's edge, the needle, the plate or the jaws, m; zero for a probe.
    pub length_m: f64,
    /// Width of the plate or the jaws, m; zero for the other kinds.
    pub width_m: f64,
}

impl Tool {
    /// A ball.
    pub const fn probe(radius_m: f64) -> Self {
        Self {
            kind: ToolKind::Probe,
            radius_m,
            length_m: 0.0,
            width_m: 0.0,
        }
    }

    /// A blade with an edge of `length_m` (m).
    pub const fn blade(radius_m: f64, length_m: f64) -> Self {
        Self {
            kind: ToolKind::Blade,
            radius_m,
            length_m,
            width_m: 0.0,
        }
    }

    /// Checks the numbers against the kind.
    pub(super) fn check(&self) -> Result<(), ScriptError> {
        let refuse = |key, value_m: f64, rule| Err(bad_value(key, value_m * 1e3, rule));
        if !(1e-4..=0.1).contains(&self.radius_m) {
            return refuse("tool.radius_mm", self.radius_m, "must be 0.1 to 100");
        }
        let is_side = |m: f64| m > 0.0 && m <= LENGTH_MAX_M;
        let some = "must be above 0 and at most 200";
        let (long, wide) = (self.length_m, self.width_m);
        match self.kind {
            ToolKind::Probe if long != 0.0 => refuse(
                "tool.length_mm",
                long,
                "a probe has no length; remove the line",
            ),
            ToolKind::Probe => self.without_width(refuse),
            _ if !is_side(long) => refuse("tool.length_mm", long, some),
            ToolKind::Blade | ToolKind::Needle => self.without_width(refuse),
            ToolKind::Plate | ToolKind::Forceps if !is_side(wide) => {
                refuse("tool.width_mm", wide, some)
            }
            ToolKind::Plate | ToolKind::Forceps => Ok(()),
        }
    }

    fn without_width(
        &self,
        refuse: impl Fn(&'static str, f64, &'static str) -> Result<(), ScriptError>,
    ) -> Result<(), ScriptError> {
        if self.width_m == 0.0 {
            return Ok(());
        }
        let rule = "only a plate and forceps have a width; remove the line";
        refuse("tool.width_mm", self.width_m, rule)
    }
}

/// The tool in a file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ToolTable {
    kind: ToolKind,
    radius_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    length_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    width_mm: Option<f64>,
}

impl ToolTable {
    /// The tool that it describes, not checked yet.
    pub(super) fn tool(&self) -> Tool {
        let usual = if self.kind == ToolKind::Blade {
            BLADE_LENGTH_MM
        } else {
            0.0
        };
        Tool {
            kind: self.kind,
            radius_m: self.radius_mm / 1e3,
            length_m: self.length_mm.unwrap_or(usual) / 1e3,
            width_m: self.width_mm.unwrap_or(0.0) / 1e3,
        }
    }

    /// The table of a tool; `to_mm` turns metres into millimetres.
    pub(super) fn of(tool: &Tool, to_mm: impl Fn(f64) -> f64) -> Self {
        let side = |m: f64| (m > 0.0).then(|| to_mm(m));
        Self {
            kind: tool.kind,
            radius_mm: to_mm(tool.radius_m),
            length_mm: side(tool.length_m),
            width_mm: side(tool.width_m),
        }
    }
}
