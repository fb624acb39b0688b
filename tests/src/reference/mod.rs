//! The same two scripts without a network: reference forces of both trainees.
//!
//! The run uses the components of the client in virtual time, without waiting threads, clocks or delay. Two
//! simulated hands with their haptic chains tick at 1 kHz on one replica of the tissue. The replica is solved
//! near the tools when a tool has moved by [`MOVED_M`], and at least every [`SOLVE_AT_LEAST`] ticks. Distant
//! tissue lags behind such solves, so that forces drift by a few percent. At [`CHECKS`] times, and whenever a tool
//! has moved by [`CHECK_MOVED_M`], the whole tissue is solved to a relative residual of `check::TOLERANCE`, which removes the
//! drift. The parts of a stroke are cut
//! while the blade moves.
//!
//! The work is bounded by the motion and the number of checks. The force change by a check is the drift at its
//! largest, and so an upper estimate of the error. The result has this estimate and the largest residual of a
//! check.

mod check;
mod seat;
mod two_hands;

use std::sync::Arc;

use palpate_client::recording::Recording;
use palpate_device::{DeviceFault, Script};
use palpate_protocol::operation::CutStroke;
use palpate_site::{Replica, ReplicaError};
use palpate_tissue::{Model, Shape, Topology, TopologyHash as TissueHash, Vec3, to_rest};
use serde::{Deserialize, Serialize};

use crate::force_error::ForcePoint;
use seat::Seat;
use two_hands::{Pace, TwoHands};

/// Time of hands and chains before the scripts begin, µs: longer than any soft start.
const LEAD_US: i64 = 2_000_000;

/// Tool motion that triggers a solve, m. Without this threshold forces change by no more than two runs differ
/// whose tools slip at different times.
pub const MOVED_M: f64 = 0.2e-3;

/// Maximum ticks between two solves in contact: the neighbourhood relaxes over several solves.
pub const SOLVE_AT_LEAST: i64 = 20;

/// Converged solves during a script, evenly spaced in contact. With 64, checks change forces on the thigh of
/// 57,000 nodes by 0.7 and 2.4 % over scripts of 20 s; with 128, by 0.6 and 1.8 %.
pub const CHECKS: usize = 96;

/// Motion of a tool in contact after which the whole tissue is solved too, m. Without these checks a press of the abdominal wall
/// is 19 % off on its way in.
pub const CHECK_MOVED_M: f64 = 2e-3;

#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    #[error("the simulated hand of the reference failed: {0}")]
    Hand(#[from] DeviceFault),
    #[error("the cut of the reference failed: {0}")]
    Cut(String),
    #[error("the reference was interrupted at {:.0} % of its work", .0 * 100.0)]
    Stopped(f64),
    #[error("the recording of {name} can not be replayed: {what}")]
    Recording { name: String, what: String },
    #[error("the tissue of the reference failed: {0}")]
    Replica(#[from] ReplicaError),
}

#[derive(Debug, Clone)]
pub struct Reference {
    /// Force and position per trainee, in script order, every millisecond of script.
    pub forces: [Vec<ForcePoint>; 2],
    /// Ends of the strokes, seconds of script.
    pub cuts_s: Vec<f64>,
    /// The parts that were cut, in the rest frame.
    pub strokes: Vec<TimedCut>,
    /// Largest distance of the blade's tip in the parts of a session from the paths of the hands' own blades, m, where it is
    /// in the tissue.
    pub cut_apart_m: f64,
    pub topology_hash: TissueHash,
    pub quality: Quality,
}

/// A part of a stroke and the time of script from which on it is cut, s.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedCut {
    pub at_s: f64,
    pub part: CutStroke,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Solves near the tools.
    pub solves: usize,
    /// Checks: converged solves of the whole tissue.
    pub checks: usize,
    pub residual_max: f64,
    /// Rms force change by the checks in percent, per hand. The error grows up to this between two checks, so
    /// this is an upper estimate.
    pub error_percent: [f64; 2],
}

/// Simulates two scripted hands, which yield to the forces, on one replica. `progress` receives the completed
/// share and returns whether to continue.
///
/// `cuts` are the parts that a session cut, in order; if there are any, they replace the strokes of the hands. Forces
/// beside a cut depend on the severed springs: 0.1 mm changes them by 3 to 9 %. [`Reference::cut_apart_m`] is
/// the distance between the two.
pub fn run(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    cuts: &[TimedCut],
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    let seats = [
        Seat::of_script(scripts[0], 1)?,
        Seat::of_script(scripts[1], 2)?,
    ];
    let end_s = scripts[0].end_s().max(scripts[1].end_s());
    let end_us = LEAD_US + (end_s * 1e6) as i64;
    let pace = Pace {
        moved_m: MOVED_M,
        at_least: SOLVE_AT_LEAST,
        check_every: (end_s * 1e3 / CHECKS as f64) as i64,
        check_moved_m: CHECK_MOVED_M,
    };
    let replicas = vec![Replica::new(Arc::clone(model), true)];
    let mut hands = TwoHands::new(model, seats, replicas, pace, cuts);
    hands.run_until(end_us, &mut progress)?;
    Ok(hands.into_reference())
}

/// Replays the recorded motion of both hands of a session without a network. Each hand has its own replica,
/// solved as in a session, with the other tool where that is.
///
/// Scripted hands yield to forces, and a tool that slips earlier moves elsewhere: two sessions over the same
/// network differ more by this than by the network. Replayed hands keep their path, so that only the forces
/// differ.
pub fn replay(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    recordings: [&Recording; 2],
    progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    let first = |r: &&Recording| r.haptic.first().map_or(0, |p| p.t_us);
    let last = |r: &&Recording| r.haptic.last().map_or(0, |p| p.t_us);
    // Both clocks show the same time; ticks of session and reference coincide.
    let zero_us = recordings.iter().map(first).min().unwrap_or(0) + LEAD_US;
    let end_us = recordings.iter().map(last).max().unwrap_or(0) - zero_us + LEAD_US;
    let seat = |k: usize| Seat::of_recording(recordings[k], scripts[k], k as u16 + 1, zero_us);
    let replicas = (0..2).map(|_| Replica::new(Arc::clone(model), true));
    let seats = [seat(0)?, seat(1)?];
    let mut hands = TwoHands::new(model, seats, replicas.collect(), Pace::STEADY, &[]);
    hands.run_until(end_us, progress)?;
    Ok(hands.into_reference())
}

/// Largest distance of the tips of parts from the paths of others, m. Tips in the air cut nothing and do not count: the
/// nearest tissue that they follow to rest is on either side of a wound.
fn apart_m(model: &Arc<Model>, parts: &[TimedCut], others: &[TimedCut]) -> f64 {
    let uncut = Topology::new(Arc::clone(model));
    let at_rest = Shape::rest(&uncut);
    let is_inside = |tip: &Vec3| to_rest(&uncut, &at_rest, *tip).is_some_and(|p| p.outside < 1e-9);
    let path = |cut: &TimedCut| {
        cut.part
            .points
            .iter()
            .map(|p| Vec3::from(p.tip_m))
            .collect::<Vec<_>>()
    };
    // A part that joins begins at the last point of the part before.
    let mut steps = Vec::new();
    let mut end = None;
    for other in others {
        let from = end.filter(|_| other.part.joins);
        let points: Vec<Vec3> = from.into_iter().chain(path(other)).collect();
        steps.extend(points.windows(2).map(|w| (w[0], w[1])));
        end = points.last().copied();
    }
    let from_path = |p: Vec3| {
        let apart = steps.iter().map(|&(a, b)| {
            let along = b - a;
            let share = (p - a).dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE);
            (a + along * share.clamp(0.0, 1.0) - p).norm()
        });
        apart.fold(f64::INFINITY, f64::min)
    };
    parts
        .iter()
        .flat_map(path)
        .filter(is_inside)
        .map(from_path)
        .fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::run;
    use crate::force_error::{ForceError, norm};
    use crate::scripts::Scripts;
    use crate::test_model::soft_block;

    #[test]
    fn reference_presses_cuts_once_and_is_deterministic() {
        let model = Arc::new(soft_block([24, 24, 8], 0.005));
        let scripts = Scripts::for_model(&model, 4.0).unwrap();
        let once = || run(&model, [&scripts.holder, &scripts.cutter], &[], |_| true).unwrap();
        let (a, b) = (once(), once());
        assert_eq!(a.cuts_s.len(), 1);
        assert!((1.5..2.6).contains(&a.cuts_s[0]), "{:?}", a.cuts_s);
        assert_eq!(a.topology_hash, b.topology_hash);
        assert_eq!(a.forces, b.forces);
        for forces in &a.forces {
            let most = forces.iter().map(|p| norm(p.force_n)).fold(0.0, f64::max);
            assert!(most > 0.1, "the largest force is {most} N");
            let error = ForceError::between(forces, forces).unwrap();
            assert_eq!(error.rms_percent, 0.0);
        }
        assert_eq!(a.cut_apart_m, 0.0);
        // The session's cut replaces the scripted one, and the report has the distance.
        let mut moved = a.strokes.clone();
        for point in moved.iter_mut().flat_map(|cut| &mut cut.part.points) {
            point.tip_m[2] -= 0.4e-3;
        }
        let scripts = [&scripts.holder, &scripts.cutter];
        let given = run(&model, scripts, &moved, |_| true).unwrap();
        assert_eq!(given.strokes, moved);
        assert_ne!(given.topology_hash, a.topology_hash);
        assert!(
            (given.cut_apart_m - 0.4e-3).abs() < 0.05e-3,
            "{} m",
            given.cut_apart_m
        );
    }
}
