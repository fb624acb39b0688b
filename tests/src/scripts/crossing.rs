//! Scripts of two trainees who cut across each other all the time.

use palpate_device::script::{Hand, Tool};
use palpate_device::{Script, ScriptError};
use palpate_tissue::Vec3;

use super::{BLADE_RADIUS_M, Path, STROKE_POINTS, Sizes, ball, upright};
use crate::tool_location::ToolLocation;

/// Time per stroke with its return, s.
const STROKE_PERIOD_S: f64 = 5.0;

/// Strokes per trainee, each on a line of its own: an eighth of a stroke's length apart, two spacings on the thigh.
const LINES_MAX: usize = 8;

/// Strokes of one blade along the location's v or, with `is_across`, along its u, each followed by a press of its blunt end
/// beyond the stroke. Both blades begin at once.
pub(super) fn blade(
    location: &ToolLocation,
    sizes: &Sizes,
    seconds: f64,
    is_across: bool,
) -> Result<Script, ScriptError> {
    let lines = ((seconds / STROKE_PERIOD_S) as usize).clamp(1, LINES_MAX);
    let along = if is_across { location.u } else { location.v };
    let mut path = Path {
        waypoints: Vec::new(),
        turn: upright(&location.normal, &along),
        length_s: seconds,
    };
    let gap = sizes.stroke_length / LINES_MAX as f64;
    let point = |line: usize, x: f64, depth: f64| -> Vec3 {
        let aside = (line as f64 - 0.5 * (lines - 1) as f64) * gap;
        let ahead = (x - 0.5) * sizes.stroke_length;
        let surface = if is_across {
            location.surface(ahead, aside)
        } else {
            location.surface(aside, ahead)
        };
        surface.at - location.normal * depth
    };
    let share = 1.0 / lines as f64;
    // Beyond the ends of the strokes.
    let reach = 0.5 * sizes.stroke_length + 2.0 * BLADE_RADIUS_M;
    let (a, b) = if is_across {
        (reach, 0.0)
    } else {
        (0.0, reach)
    };
    let beyond = location.spot(a, b, 2.0 * BLADE_RADIUS_M);
    let gentle = sizes.press_depth / 2.0;
    path.to(0.0, point(0, 0.0, -sizes.hover));
    for line in 0..lines {
        let at = |x: f64| share * (line as f64 + x);
        path.to(at(0.1), point(line, 0.0, -sizes.hover / 2.0));
        path.to(at(0.15), point(line, 0.0, -0.4 * sizes.stroke_depth));
        for i in 0..=STROKE_POINTS {
            let x = i as f64 / STROKE_POINTS as f64;
            // The tip dives in the first fifth and rises in the last one.
            let ramp = (x / 0.2).min((1.0 - x) / 0.2).clamp(0.0, 1.0);
            let depth = sizes.stroke_depth * (1.4 * ramp - 0.4);
            let way = path.to(at(0.2 + 0.6 * x), point(line, x, depth));
            *way = way.linear().pressed();
        }
        path.to(at(0.84), point(line, 1.0, -sizes.hover / 2.0))
            .button = false;
        path.to(at(0.88), ball(&beyond, BLADE_RADIUS_M, -sizes.hover / 2.0));
        path.to(at(0.92), ball(&beyond, BLADE_RADIUS_M, gentle));
        path.to(at(0.96), ball(&beyond, BLADE_RADIUS_M, gentle));
        path.to(at(1.0), ball(&beyond, BLADE_RADIUS_M, -sizes.hover));
    }
    let tool = Tool::blade(BLADE_RADIUS_M, sizes.blade_length);
    Script::new(tool, Hand::default(), path.waypoints, false)
}
