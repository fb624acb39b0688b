//! Script of a trainee who inserts a needle twice.

use palpate_device::script::{Hand, Tool, ToolKind};
use palpate_device::{Script, ScriptError};
use palpate_tissue::Vec3;

use super::{Path, Sizes, upright};
use crate::tool_location::ToolLocation;

/// Insertions in the script.
pub const INSERTIONS: u64 = 2;

/// Of gauge 18: 1.27 mm wide.
const RADIUS_M: f64 = 0.635e-3;

/// Depth of the tip below the resting surface, m: tissue is dented by up to 15 mm before the tip enters.
const DEPTH_M: f64 = 0.025;

/// Part of the soft depth that the tip may use.
const DEPTH_SHARE: f64 = 0.7;

/// The shaft above the surface at the greatest depth, m.
const GRIP_M: f64 = 0.040;

/// A hand that pushes with 3 N while it lags by 2 mm.
const HAND: Hand = Hand {
    mass_kg: 0.3,
    stiffness_n_per_m: 1_500.0,
    damping_ns_per_m: 30.0,
    tremor_m: 0.0,
    seed: 1,
};

/// A needle that enters straight, rests, and leaves; then the same beside the first place.
pub(super) fn needle(
    location: &ToolLocation,
    sizes: &Sizes,
    seconds: f64,
) -> Result<Script, ScriptError> {
    let depth_m = (DEPTH_M * location.scale()).min(DEPTH_SHARE * location.depth_m);
    let place = |aside_m: f64| {
        let beside_m = -location.separation_m() / 2.0;
        location.spot(beside_m, aside_m, sizes.probe_radius)
    };
    let first = place(0.0);
    let mut path = Path {
        waypoints: Vec::new(),
        turn: upright(&first.normal, &location.v),
        length_s: seconds,
    };
    for (from, aside_m) in [(0.0, 0.0), (0.5, sizes.beside)] {
        let spot = place(aside_m);
        let at = |depth_m: f64| -> Vec3 { spot.at - first.normal * depth_m };
        path.to(from + 0.02, at(-sizes.hover / 2.0));
        path.to(from + 0.20, at(depth_m));
        path.to(from + 0.28, at(depth_m));
        path.to(from + 0.46, at(-sizes.hover / 2.0));
    }
    let tool = Tool {
        kind: ToolKind::Needle,
        ..Tool::blade(RADIUS_M, depth_m + GRIP_M)
    };
    Script::new(tool, HAND, path.waypoints, false)
}
