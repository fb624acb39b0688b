//! Scripts of the two simulated trainees, for any model and length.
//!
//! The HOLDER presses a probe at the first location, holds it with slow small motion, lifts, and presses again.
//! The CUTTER presses gently beside the second location and lifts. It draws the blade once, with the button
//! held, through the tissue between the locations, beginning and ending outside; then it presses beside the
//! wound. Times are shares of the length T:
//!
//! ```text
//! share of T   0    .1   .2   .3   .4   .5   .6   .7   .8   .9   1
//! holder       ^-press hold hold hold hold hold-^lift ^-press hold-^
//! cutter       ^-press-^lift    |=== stroke ===|lift  ^-press hold-^
//! ```

mod crossing;
mod piercing;

use std::sync::Arc;

use nalgebra::{Rotation3, UnitQuaternion};
use palpate_device::script::{Hand, Tool, Waypoint};
use palpate_device::{Script, ScriptError};
use palpate_tissue::{Model, Tissue, Topology, Vec3};

use crate::tool_location::{SurfacePoint, ToolLocation};

pub use piercing::INSERTIONS;

/// Shortest scripts, s. In less time the stroke would be faster than a hand.
pub const SECONDS_MIN: f64 = 4.0;

/// Longest scripts, s: the recording of a client has to fit into memory.
pub const SECONDS_MAX: f64 = 600.0;

/// Begin and end of the stroke in the tissue, as shares of the script length.
pub const STROKE_SHARES: (f64, f64) = (0.32, 0.48);

/// Maximum radius of the holder's probe, m.
const PROBE_RADIUS_M: f64 = 0.008;

/// Radius of the blunt end for presses of the cutter without the button, m.
const BLADE_RADIUS_M: f64 = 0.006;

/// Length of the blade edge for a stroke of [`STROKE_DEPTH_M`], m: it stands out of the tissue while cutting.
const BLADE_LENGTH_M: f64 = 0.012;
const PRESS_DEPTH_M: f64 = 0.008;

/// Depth of the blade tip, m.
const STROKE_DEPTH_M: f64 = 0.010;

/// Length of the stroke in the tissue, m.
const STROKE_LENGTH_M: f64 = 0.050;

/// Height of a waiting hand above the surface, m.
const HOVER_M: f64 = 0.020;

/// Distance of the last press from the wound, m.
const BESIDE_M: f64 = 0.012;
const STROKE_POINTS: usize = 24;

/// Period of the slow motion while holding, s.
const SWAY_PERIOD_S: f64 = 2.5;

/// Exercise of the two trainees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exercise {
    /// The holder presses, and the cutter cuts.
    Press,
    /// Both cut across each other all the time.
    Crossing,
    /// The holder inserts a needle, and the cutter cuts.
    Needle,
}

#[derive(Debug, Clone)]
pub struct Scripts {
    pub holder: Script,
    pub cutter: Script,
}

#[derive(Debug, Clone, Copy)]
struct Sizes {
    probe_radius: f64,
    press_depth: f64,
    stroke_depth: f64,
    stroke_length: f64,
    blade_length: f64,
    hover: f64,
    sway: f64,
    beside: f64,
}

impl Sizes {
    fn of(location: &ToolLocation) -> Self {
        let scale = location.scale();
        let soft = location.depth_m;
        // A cut has to sever some cells; a press uses at most a third of the soft depth.
        let stroke_depth = (STROKE_DEPTH_M * scale)
            .min(soft / 2.0)
            .max(1.5 * location.spacing_m);
        let probe_radius = (PROBE_RADIUS_M * scale).max(0.75 * location.spacing_m);
        Self {
            probe_radius,
            press_depth: (PRESS_DEPTH_M * scale).min(soft / 3.0),
            stroke_depth,
            stroke_length: (STROKE_LENGTH_M * scale).max(5.0 * location.spacing_m),
            blade_length: stroke_depth * BLADE_LENGTH_M / STROKE_DEPTH_M,
            hover: HOVER_M * scale.max(0.3),
            sway: 0.005 * scale,
            beside: (BESIDE_M * scale)
                .min(location.separation_m() / 2.0)
                .max(2.0 * location.spacing_m),
        }
    }
}

struct Path {
    waypoints: Vec<Waypoint>,
    turn: UnitQuaternion<f64>,
    length_s: f64,
}

impl Path {
    fn to(&mut self, share: f64, at: Vec3) -> &mut Waypoint {
        let way = Waypoint::new(share * self.length_s, at).turned(self.turn);
        self.waypoints.push(way);
        self.waypoints.last_mut().expect("one was pushed")
    }

    /// Holds from `from` to `until` (shares), swaying between points `at(-1..1)`.
    fn sway(&mut self, from: f64, until: f64, at: impl Fn(f64) -> Vec3) {
        let length = (until - from) * self.length_s;
        let turns = (2.0 * length / SWAY_PERIOD_S).floor().max(1.0) as usize;
        for i in 1..=turns {
            let side = match i {
                i if i == turns => 0.0,
                i if i % 2 == 1 => 1.0,
                _ => -1.0,
            };
            let share = from + (until - from) * i as f64 / turns as f64;
            self.to(share, at(side));
        }
    }
}

impl Scripts {
    /// Scripts of `seconds` for the best location on a model, sagged by its weight.
    pub fn for_model(model: &Arc<Model>, seconds: f64) -> Result<Self, String> {
        Self::of(Exercise::Press, model, seconds)
    }

    /// The same for an exercise.
    pub fn of(exercise: Exercise, model: &Arc<Model>, seconds: f64) -> Result<Self, String> {
        let topology = Topology::new(Arc::clone(model));
        let mut location = ToolLocation::find(&topology)?;
        if model.gravity != [0.0; 3] {
            location.sag(&Tissue::at_rest(topology));
        }
        let scripts = Self::at(&location, exercise, seconds);
        scripts.map_err(|e| format!("the generated scripts are invalid: {e}"))
    }

    pub fn for_location(location: &ToolLocation, seconds: f64) -> Result<Self, ScriptError> {
        Self::at(location, Exercise::Press, seconds)
    }

    fn at(location: &ToolLocation, exercise: Exercise, seconds: f64) -> Result<Self, ScriptError> {
        let sizes = Sizes::of(location);
        let holder = match exercise {
            Exercise::Press => holder(location, &sizes, seconds)?,
            Exercise::Crossing => crossing::blade(location, &sizes, seconds, false)?,
            Exercise::Needle => piercing::needle(location, &sizes, seconds)?,
        };
        let cutter = match exercise {
            Exercise::Crossing => crossing::blade(location, &sizes, seconds, true)?,
            Exercise::Press | Exercise::Needle => cutter(location, &sizes, seconds)?,
        };
        Ok(Self { holder, cutter })
    }
}

/// Centre of a sphere of `radius` at `depth` below a surface point; negative depths are above it.
fn ball(point: &SurfacePoint, radius: f64, depth: f64) -> Vec3 {
    point.at + point.normal * (radius - depth)
}

fn holder(location: &ToolLocation, sizes: &Sizes, seconds: f64) -> Result<Script, ScriptError> {
    let r = sizes.probe_radius;
    let spot = location.spot(-location.separation_m() / 2.0, 0.0, r);
    let along = (location.v - spot.normal * location.v.dot(&spot.normal)).normalize();
    let pressed = |side: f64| ball(&spot, r, sizes.press_depth) + along * (sizes.sway * side);
    let above = ball(&spot, r, -sizes.hover);
    let mut path = Path {
        waypoints: Vec::new(),
        turn: upright(&spot.normal, &along),
        length_s: seconds,
    };
    path.to(0.0, above);
    path.to(0.03, above);
    path.to(0.12, pressed(0.0));
    path.sway(0.15, 0.64, pressed);
    path.to(0.70, above);
    path.to(0.73, above);
    path.to(0.80, pressed(0.0));
    path.sway(0.82, 0.94, pressed);
    path.to(1.0, above);
    let tool = Tool::probe(r);
    Script::new(tool, Hand::default(), path.waypoints, false)
}

fn cutter(location: &ToolLocation, sizes: &Sizes, seconds: f64) -> Result<Script, ScriptError> {
    let r = BLADE_RADIUS_M;
    let spot = location.spot(location.separation_m() / 2.0, 0.0, 2.0 * r);
    let gentle = sizes.press_depth / 2.0;
    let mut path = Path {
        waypoints: Vec::new(),
        turn: upright(&location.normal, &location.v),
        length_s: seconds,
    };
    let above = ball(&spot, r, -sizes.hover);
    path.to(0.0, above);
    path.to(0.03, above);
    path.to(0.10, ball(&spot, r, gentle));
    path.to(0.18, ball(&spot, r, gentle));
    path.to(0.23, above);
    stroke(location, sizes, &mut path);
    let beside = location.spot(sizes.beside, 0.0, 2.0 * r);
    let over = ball(&beside, r, -sizes.hover);
    let pressed = |side: f64| ball(&beside, r, gentle) + location.v * (sizes.sway * side);
    path.to(0.60, over);
    path.to(0.68, pressed(0.0));
    path.sway(0.70, 0.94, pressed);
    path.to(1.0, over);
    let tool = Tool::blade(r, sizes.blade_length);
    Script::new(tool, Hand::default(), path.waypoints, false)
}

/// The stroke from above the surface through the tissue and out again, with the button held.
fn stroke(location: &ToolLocation, sizes: &Sizes, path: &mut Path) {
    // The tip dives in the first fifth and rises in the last one.
    let ramp = |x: f64| (x / 0.2).min((1.0 - x) / 0.2).clamp(0.0, 1.0);
    let tip = |x: f64| {
        let point = location.surface(0.0, (x - 0.5) * sizes.stroke_length);
        let outside = 0.4 * sizes.stroke_depth;
        point.at + location.normal * (outside - (outside + sizes.stroke_depth) * ramp(x))
    };
    let high = |x: f64| tip(x) + location.normal * sizes.hover / 2.0;
    let (from, until) = STROKE_SHARES;
    path.to(from - 0.03, high(0.0));
    path.to(from, tip(0.0)).button = true;
    for i in 1..=STROKE_POINTS {
        let x = i as f64 / STROKE_POINTS as f64;
        let way = path.to(from + (until - from) * x, tip(x));
        *way = way.linear().pressed();
    }
    path.to(until + 0.03, high(1.0)).button = false;
}

/// The rotation with the tool z along `normal` and its x as near to `along` as possible.
fn upright(normal: &Vec3, along: &Vec3) -> UnitQuaternion<f64> {
    let x = (along - normal * along.dot(normal)).normalize();
    let y = normal.cross(&x);
    let axes = Rotation3::from_basis_unchecked(&[x, y, *normal]);
    UnitQuaternion::from_rotation_matrix(&axes)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use palpate_anatomy::sample;
    use palpate_device::Script;
    use palpate_device::script::Waypoint;
    use palpate_tissue::{Model, Topology, Vec3};

    use super::{SECONDS_MIN, Scripts};
    use crate::test_model::soft_block;
    use crate::tool_location::ToolLocation;

    /// Peak speed of a script: 15/8 of the mean for a minimum-jerk motion.
    fn top_speed(waypoints: &[Waypoint]) -> f64 {
        waypoints
            .windows(2)
            .map(|w| 1.875 * (w[1].position - w[0].position).norm() / (w[1].t_s - w[0].t_s))
            .fold(0.0, f64::max)
    }

    fn check(model: Model) {
        let topology = Topology::new(Arc::new(model));
        let location = ToolLocation::find(&topology).unwrap();
        for seconds in [SECONDS_MIN, 20.0] {
            let scripts = Scripts::for_location(&location, seconds).unwrap();
            for script in [&scripts.holder, &scripts.cutter] {
                let waypoints = script.waypoints();
                assert!(
                    waypoints
                        .iter()
                        .all(|w| w.position.iter().all(|c| c.is_finite()))
                );
                assert!(
                    waypoints.windows(2).all(|w| w[0].t_s < w[1].t_s),
                    "times increase"
                );
                assert!((script.end_s() - seconds).abs() < 1e-9);
            }
            if seconds == 20.0 {
                for script in [&scripts.holder, &scripts.cutter] {
                    let v = top_speed(script.waypoints());
                    assert!(v < 0.1, "{v} m/s is no hand's speed");
                }
            }
            stroke_passes_through(&location, &scripts);
            for script in [&scripts.holder, &scripts.cutter] {
                presses_into_it(&topology, script);
            }
        }
    }

    /// Whether the sphere of the tool contacts the tissue before and after the stroke.
    fn presses_into_it(topology: &Topology, script: &Script) {
        let radius = script.tool().radius_m;
        let skin = topology.boundary().triangles.iter().flat_map(|triangle| {
            let [a, b, c] = triangle.map(|n| topology.rest(n));
            let shares = (0..=6).flat_map(|i| (0..=6 - i).map(move |j| (i, j)));
            shares.map(move |(i, j)| {
                a + (b - a) * (f64::from(i) / 6.0) + (c - a) * (f64::from(j) / 6.0)
            })
        });
        let skin: Vec<Vec3> = skin.collect();
        let waypoints = script.waypoints().iter().filter(|w| !w.button);
        let end_s = script.end_s();
        let (first, last): (Vec<&Waypoint>, _) = waypoints.partition(|w| w.t_s < 0.3 * end_s);
        for presses in [first, last] {
            let nearest = |w: &&Waypoint| {
                let apart = skin.iter().map(|p| (p - w.position).norm());
                apart.fold(f64::INFINITY, f64::min)
            };
            let nearest = presses.iter().map(nearest).fold(f64::INFINITY, f64::min);
            assert!(nearest < radius, "{nearest} m is no contact at {radius} m");
        }
    }

    /// Height of the tip over the surface while the button is held: above, deep inside, above.
    fn stroke_passes_through(location: &ToolLocation, scripts: &Scripts) {
        let held: Vec<&Waypoint> = scripts
            .cutter
            .waypoints()
            .iter()
            .filter(|w| w.button)
            .collect();
        let height = |w: &Waypoint| {
            let d: Vec3 = w.position - location.middle;
            let b = d.dot(&location.v);
            (w.position - location.surface(d.dot(&location.u), b).at).dot(&location.normal)
        };
        assert!(height(held[0]) > 0.0 && height(held[held.len() - 1]) > 0.0);
        let deepest = held.iter().map(|w| height(w)).fold(0.0, f64::min);
        assert!(deepest < -location.spacing_m, "only {deepest} m deep");
        let deep: Vec<&&Waypoint> = held.iter().filter(|w| height(w) < 0.0).collect();
        let length = (deep[deep.len() - 1].position - deep[0].position).norm();
        assert!(length > 3.0 * location.spacing_m, "only {length} m long");
        for way in held {
            let blade = way.orientation * Vec3::z();
            assert!(
                blade.dot(&location.normal) > 0.999,
                "the blade points out of the tissue"
            );
        }
    }

    #[test]
    fn stroke_enters_and_leaves_blocks_of_many_sizes() {
        check(soft_block([30, 30, 10], 0.004));
        check(soft_block([12, 12, 6], 0.005));
        check(soft_block([10, 8, 4], 0.002));
    }

    #[test]
    fn stroke_enters_and_leaves_every_sample() {
        for sample in sample::Sample::ALL {
            let mut input = sample.input().unwrap();
            input.scene.spacing_m *= 1.5;
            let (model, _) = palpate_anatomy::build(&input, &mut |_, _| ()).unwrap();
            check(model);
        }
    }
}
