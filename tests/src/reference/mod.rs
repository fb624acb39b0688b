//! The same two scripts without a network: the forces that both trainees would feel at one table.
//!
//! In virtual time, with the client's own parts and without threads that wait, clocks or delay, in three passes:
//!
//! 1. **Track** (`table`): two simulated hands and their haptic chains tick at 1 kHz over one copy of the tissue. It
//!    is solved around the tools whenever one of them has moved by [`MOVED_M`], and every [`SOLVE_AT_LEAST`] ticks. A cut
//!    happens in the moment in which its stroke ends. This gives where the hands go, within some hundredths of a
//!    millimetre, and forces that are a few percent off, because tissue far from the tools lags.
//! 2. **Check** (`check`): at [`CHECKS`] of these solves, spread over all that touch, a copy of its own solves the
//!    whole tissue to a relative residual of `check::TOLERANCE`. The checks do not depend on each other: two threads
//!    take one half of the script each.
//! 3. **Render**: hands and chains tick again, over the contact models of the first pass times the ratio of checked to
//!    tracked force, which is interpolated between checks.
//!
//! The work is bounded by the motion and by the number of checks. How far each ratio is from the one that its
//! neighbours predict estimates the error of the result; it is part of it, with the largest residual of a check.

mod check;
mod seat;
mod table;

use std::sync::Arc;

use palpate_client::Replica;
use palpate_client::ahead::ReplicaError;
use palpate_client::convert::tissue_stroke;
use palpate_client::recording::Recording;
use palpate_device::{DeviceFault, Script};
use palpate_protocol::operation::{BladePoint, CutStroke, Operation, OperationKind};
use palpate_protocol::request::CutRequest;
use palpate_protocol::{OperationId, ParticipantId, ServerTime, TopologyHash};
use palpate_tissue::{Model, TopologyHash as TissueHash, cut, to_rest};

use crate::force_error::ForcePoint;
use seat::Seat;
use table::{Pace, Table};

/// Hands and chains run so long before the scripts begin, µs: longer than any soft start.
const LEAD_US: i64 = 2_000_000;

/// A tool that has moved so far is solved for again, m. Without checks the forces on the thigh then differ by 1.4 %
/// (holder) and 2.5 % rms (cutter) from those of converged solves every 12 ms.
pub const MOVED_M: f64 = 0.2e-3;

/// Ticks between two solves at most while something touches: what is near relaxes over some solves.
pub const SOLVE_AT_LEAST: i64 = 20;

/// Solves that are checked, of those that touch. With 64 the estimated error on the thigh of 57,000 nodes is 1.0 and
/// 1.7 % over scripts of 20 s, and 1.2 and 1.0 % over 60 s.
pub const CHECKS: usize = 64;

/// The first pass's part of the progress.
const TRACK_SHARE: f64 = 0.4;

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
    /// The topology in the end.
    pub topology_hash: TissueHash,
    /// How good it is.
    pub quality: Quality,
}

/// How good a reference is.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Quality {
    /// Solves of the first pass.
    pub solves: usize,
    /// Solves that were checked.
    pub checks: usize,
    /// The largest relative residual of a check.
    pub residual_max: f64,
    /// Root mean square of what the checks changed, percent of the force; per hand.
    pub corrected_percent: [f64; 2],
    /// Root mean square of the force that neighbouring checks would have left wrong at a check, percent of the force;
    /// per hand. The neighbours are twice as far away as they are from any other solve, so this is an upper estimate.
    pub error_percent: [f64; 2],
}

/// Runs two scripts against a model: hands that answer to what they feel, one copy of the tissue. `progress`
/// is given the share that is done, and returns whether to go on.
pub fn run(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    run_with(model, scripts, &Effort::default(), progress)
}

/// How much work a reference is.
#[derive(Debug, Clone, Copy)]
pub struct Effort {
    /// A tool that has moved so far is solved for again, m.
    pub moved_m: f64,
    /// Solves that are checked.
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
    effort: &Effort,
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    let seats = || -> Result<[Seat; 2], DeviceFault> {
        Ok([
            Seat::of_script(scripts[0], 1)?,
            Seat::of_script(scripts[1], 2)?,
        ])
    };
    let end_s = scripts[0].end_s().max(scripts[1].end_s());
    let end_us = LEAD_US + (end_s * 1e6) as i64;
    let pace = Pace {
        moved_m: effort.moved_m,
        at_least: SOLVE_AT_LEAST,
    };
    let copies = vec![Replica::new(Arc::clone(model), true)];
    let mut table = Table::new(seats()?, copies, pace);
    table.go_on(end_us, |share| progress(TRACK_SHARE * share))?;
    let checked = check::run(model, &table.solves, &table.cuts, effort.checks, |share| {
        progress(TRACK_SHARE + (1.0 - TRACK_SHARE) * share)
    })?;
    let mut seats = seats()?;
    table::render(&mut seats, &table.solves, &checked.ratios, end_us)?;
    Ok(Reference {
        quality: Quality {
            solves: table.solves.len(),
            ..checked.quality
        },
        topology_hash: table.topology_hash(),
        cuts_s: table.cuts_s,
        courses: seats.map(|s| s.course),
    })
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
    let mut table = Table::new([seat(0)?, seat(1)?], copies.collect(), Pace::STEADY);
    table.go_on(end_us, progress)?;
    Ok(Reference {
        quality: Quality {
            solves: table.solves.len(),
            ..Quality::default()
        },
        topology_hash: table.topology_hash(),
        cuts_s: table.cuts_s,
        courses: table.seats.map(|s| s.course),
    })
}

/// The cut as the room makes it: the stroke is taken to the rest frame first.
fn operation(
    replica: &Replica,
    request: &CutRequest,
    number: usize,
    author: u16,
) -> Result<Operation, ReferenceError> {
    let topology = replica.topology();
    let shape = replica.haptic_shape();
    let at_rest = |blade: &BladePoint| {
        let rest = to_rest(topology, shape?, blade.tip_m.into())?;
        let along = rest.frame * palpate_tissue::Vec3::from(blade.axis);
        let axis = along.try_normalize(1e-6)?;
        Some(BladePoint {
            tip_m: rest.position.into(),
            axis: axis.into(),
            depth_m: blade.depth_m * along.norm(),
        })
    };
    let points = request.points.iter().map(|p| &p.blade);
    let stroke = CutStroke {
        points: points.map(|p| at_rest(p).unwrap_or(*p)).collect(),
        width_m: request.width_m,
    };
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
        let once = || run(&model, [&scripts.holder, &scripts.cutter], |_| true).unwrap();
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
    }
}
