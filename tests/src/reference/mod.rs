//! The same two scripts without a network: the forces that both trainees would feel at one table.
//!
//! In virtual time, with the client's own parts and without threads that wait, clocks or delay. Two simulated hands
//! and their haptic chains tick at 1 kHz over one copy of the tissue, which is solved around the tools whenever one of
//! them has moved by [`MOVED_M`], and every [`SOLVE_AT_LEAST`] ticks. Tissue far from the tools lags behind such solves,
//! so that forces drift by a few percent. At [`CHECKS`] moments the whole tissue is solved to a relative residual of
//! `check::TOLERANCE`, which ends the drift. A cut happens in the moment in which its stroke ends.
//!
//! The work is bounded by the motion and by the number of checks. What checks change is the drift at its largest, and
//! so an upper estimate of the error of the result; it is part of it, with the largest residual of a check.

mod check;
mod seat;
mod table;

use std::sync::Arc;

use palpate_client::Replica;
use palpate_client::convert::tissue_stroke;
use palpate_client::prefetch::ReplicaError;
use palpate_client::recording::Recording;
use palpate_device::{DeviceFault, Script};
use palpate_protocol::operation::{BladePoint, CutStroke, Operation, OperationKind};
use palpate_protocol::request::CutRequest;
use palpate_protocol::{OperationId, ParticipantId, ServerTime, TopologyHash};
use palpate_tissue::{Model, TopologyHash as TissueHash, Vec3, cut, to_rest};

use crate::force_error::ForcePoint;
use seat::Seat;
use table::{Pace, Table};

/// Hands and chains run so long before the scripts begin, µs: longer than any soft start.
const LEAD_US: i64 = 2_000_000;

/// A tool that has moved so far is solved for again, m. Without that threshold forces change by no more than two runs
/// differ whose tools slip at other moments.
pub const MOVED_M: f64 = 0.2e-3;

/// Ticks between two solves at most while something touches: what is near relaxes over some solves.
pub const SOLVE_AT_LEAST: i64 = 20;

/// Converged solves in the course of a script, at equal distances while something touches. With 64 the checks change
/// forces on the thigh of 57,000 nodes by 0.7 and 2.4 % over scripts of 20 s, with 128 by 0.6 and 1.8 %.
pub const CHECKS: usize = 96;

/// Why there is no reference.
#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    /// The simulated hand refused.
    #[error("the simulated hand of the reference failed: {0}")]
    Hand(#[from] DeviceFault),
    /// The cut did not work.
    #[error("the cut of the reference failed: {0}")]
    Cut(String),
    /// The caller wants no reference any more.
    #[error("the reference was interrupted at {:.0} % of its work", .0 * 100.0)]
    Stopped(f64),
    /// What was recorded can not be replayed.
    #[error("what was recorded of {name} can not be replayed: {what}")]
    Recording {
        /// The participant.
        name: String,
        /// What is wrong.
        what: String,
    },
    /// The copy of the tissue refused.
    #[error("the tissue of the reference failed: {0}")]
    Replica(#[from] ReplicaError),
}

/// What the two trainees would have felt.
#[derive(Debug, Clone)]
pub struct Reference {
    /// Force and position of each, in the order of the scripts, every millisecond of script.
    pub courses: [Vec<ForcePoint>; 2],
    /// Moments of the cuts, seconds of script.
    pub cuts_s: Vec<f64>,
    /// Strokes of the cuts, in the rest frame.
    pub strokes: Vec<CutStroke>,
    /// Largest distance of a point of a hand's own stroke from the stroke that was cut in its place, m.
    pub cut_apart_m: f64,
    /// The topology in the end.
    pub topology_hash: TissueHash,
    /// How good it is.
    pub quality: Quality,
}

/// How good a reference is.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Quality {
    /// Solves around the tools.
    pub solves: usize,
    /// Checks: converged solves of the whole tissue.
    pub checks: usize,
    /// The largest relative residual of a check.
    pub residual_max: f64,
    /// Change of the force by the checks, root mean square in percent; per hand. Between two checks the error grows up
    /// to that, so this is an upper estimate of it.
    pub error_percent: [f64; 2],
}

/// Runs two scripts against a model: hands that answer to what they feel, one copy of the tissue. `progress`
/// is given the share that is done, and returns whether to go on.
///
/// Strokes of the session in `cuts`, in the rest frame and in order, are cut in place of the hands' own ones: forces
/// beside a cut depend on which springs it severs, and a tenth of a millimetre makes 3 to 9 % of them. How far apart the
/// two are is told in [`Reference::cut_apart_m`].
pub fn run(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    cuts: &[CutStroke],
    progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    run_with(model, scripts, cuts, &Effort::default(), progress)
}

/// How much work a reference is.
#[derive(Debug, Clone, Copy)]
pub struct Effort {
    /// A tool that has moved so far is solved for again, m.
    pub moved_m: f64,
    /// Converged solves of the whole tissue.
    pub checks: usize,
}

impl Default for Effort {
    fn default() -> Self {
        Self {
            moved_m: MOVED_M,
            checks: CHECKS,
        }
    }
}

/// The same with another effort, which tells how much the result depends on it.
pub fn run_with(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    cuts: &[CutStroke],
    effort: &Effort,
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    let seats = [
        Seat::of_script(scripts[0], 1)?,
        Seat::of_script(scripts[1], 2)?,
    ];
    let end_s = scripts[0].end_s().max(scripts[1].end_s());
    let end_us = LEAD_US + (end_s * 1e6) as i64;
    let pace = Pace {
        moved_m: effort.moved_m,
        at_least: SOLVE_AT_LEAST,
        check_every: (end_s * 1e3 / effort.checks.max(1) as f64) as i64,
    };
    let copies = vec![Replica::new(Arc::clone(model), true)];
    let mut table = Table::new(seats, copies, pace, cuts);
    table.go_on(end_us, &mut progress)?;
    Ok(table.into_reference())
}

/// Lets both hands of a session go their ways again, as they were recorded, without what is between
/// them: each feels its own copy of the tissue, solved as in a session, with the other's tool where it is at that
/// moment; a stroke cuts when it ends.
///
/// Hands that follow a script answer to what they feel, and a stick that slips a moment earlier leads
/// them elsewhere: two sessions over the same network differ by it more than by the network. Hands whose
/// ways are given feel nothing but the difference.
pub fn replay(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    recordings: [&Recording; 2],
    progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    let first = |r: &&Recording| r.haptic.first().map_or(0, |p| p.t_us);
    let last = |r: &&Recording| r.haptic.last().map_or(0, |p| p.t_us);
    // Both clocks tell the same time; ticks of a session and of the table fall together.
    let zero_us = recordings.iter().map(first).min().unwrap_or(0) + LEAD_US;
    let end_us = recordings.iter().map(last).max().unwrap_or(0) - zero_us + LEAD_US;
    let seat = |k: usize| Seat::of_recording(recordings[k], scripts[k], k as u16 + 1, zero_us);
    let copies = (0..2).map(|_| Replica::new(Arc::clone(model), true));
    let mut table = Table::new([seat(0)?, seat(1)?], copies.collect(), Pace::STEADY, &[]);
    table.go_on(end_us, progress)?;
    Ok(table.into_reference())
}

/// The stroke as the room takes it to the rest frame.
fn stroke_at_rest(replica: &Replica, request: &CutRequest) -> CutStroke {
    let topology = replica.topology();
    let shape = replica.haptic_shape();
    let at_rest = |blade: &BladePoint| {
        let rest = to_rest(topology, shape?, blade.tip_m.into())?;
        let along = rest.frame * Vec3::from(blade.axis);
        let axis = along.try_normalize(1e-6)?;
        Some(BladePoint {
            tip_m: rest.position.into(),
            axis: axis.into(),
            depth_m: blade.depth_m * along.norm(),
        })
    };
    let points = request.points.iter().map(|p| &p.blade);
    CutStroke {
        points: points.map(|p| at_rest(p).unwrap_or(*p)).collect(),
        width_m: request.width_m,
    }
}

/// Largest distance of a point of one stroke's tip from the path of the other's, m.
fn apart_m(stroke: &CutStroke, other: &CutStroke) -> f64 {
    let from_path = |p: &BladePoint| {
        let p = Vec3::from(p.tip_m);
        let pieces = other.points.windows(2).map(|w| {
            let (a, b) = (Vec3::from(w[0].tip_m), Vec3::from(w[1].tip_m));
            let along = b - a;
            let share = (p - a).dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE);
            (a + along * share.clamp(0.0, 1.0) - p).norm()
        });
        pieces.fold(f64::INFINITY, f64::min)
    };
    stroke.points.iter().map(from_path).fold(0.0, f64::max)
}

/// A cut as the room makes it.
fn operation(
    replica: &Replica,
    stroke: CutStroke,
    number: usize,
    author: u16,
) -> Result<Operation, ReferenceError> {
    let topology = replica.topology();
    let mut after = topology.clone();
    cut(&mut after, &tissue_stroke(&stroke)).map_err(|e| ReferenceError::Cut(e.to_string()))?;
    Ok(Operation {
        id: OperationId(number as u64),
        at: ServerTime::ZERO,
        author: ParticipantId(author),
        topology_version_before: topology.version(),
        topology_version_after: after.version(),
        hash_after: TopologyHash(after.hash().0),
        kind: OperationKind::Cut(stroke),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use palpate_tissue::{Material, Topology, block};

    use super::run;
    use crate::force_error::{ForceError, norm};
    use crate::place::Place;
    use crate::scripts::Scripts;

    #[test]
    fn the_reference_presses_cuts_once_and_is_the_same_every_time() {
        let soft = Material {
            name: "soft".into(),
            young_pa: 1e4,
            density_kg_m3: 1000.0,
            friction_static: 0.4,
            friction_dynamic: 0.3,
            source: "test".into(),
            ..Material::default()
        };
        let model = Arc::new(block([24, 24, 8], 0.005, &soft, 1));
        let place = Place::find(&Topology::new(Arc::clone(&model))).unwrap();
        let scripts = Scripts::for_place(&place, 4.0).unwrap();
        let once = || run(&model, [&scripts.holder, &scripts.cutter], &[], |_| true).unwrap();
        let (a, b) = (once(), once());
        assert_eq!(a.cuts_s.len(), 1);
        assert!((1.5..2.6).contains(&a.cuts_s[0]), "{:?}", a.cuts_s);
        assert_eq!(a.topology_hash, b.topology_hash);
        assert_eq!(a.courses, b.courses);
        for course in &a.courses {
            let most = course.iter().map(|p| norm(p.force_n)).fold(0.0, f64::max);
            assert!(most > 0.1, "nobody feels {most} N");
            let error = ForceError::between(course, course).unwrap();
            assert_eq!(error.rms_percent, 0.0);
        }
        assert_eq!(a.cut_apart_m, 0.0);
        // The cut of the session replaces the cut of the script, and the report has the distance.
        let mut moved = a.strokes[0].clone();
        for point in &mut moved.points {
            point.tip_m[2] -= 0.4e-3;
        }
        let scripts = [&scripts.holder, &scripts.cutter];
        let given = run(&model, scripts, &[moved.clone()], |_| true).unwrap();
        assert_eq!(given.strokes, [moved]);
        assert_ne!(given.topology_hash, a.topology_hash);
        assert!(
            (given.cut_apart_m - 0.4e-3).abs() < 0.05e-3,
            "{} m",
            given.cut_apart_m
        );
    }
}
