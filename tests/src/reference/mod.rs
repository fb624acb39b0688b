//! The same two scripts without a network: what the forces would be if everybody sat at one table.
//!
//! In virtual time, with the client's own parts: two simulated hands and their haptic chains tick
//! at 1 kHz, one copy of the tissue is solved every 4 ms for both tools where they are, and a cut
//! happens in the moment in which its stroke ends. No threads, no clocks, no delay, and half the
//! tolerance of the sites in two iterations per solve, which is not a converged answer: what differs in a
//! session comes from the network and from solving in real time, and to a part from that.

mod seat;

use std::sync::Arc;

use palpate_client::Replica;
use palpate_client::ahead::ReplicaError;
use palpate_client::convert::tissue_stroke;
use palpate_client::recording::Recording;
use palpate_client::replica::hand_budget;
use palpate_device::{DeviceFault, Script};
use palpate_protocol::operation::{BladePoint, CutStroke, Operation, OperationKind};
use palpate_protocol::request::CutRequest;
use palpate_protocol::{ClientTime, OperationId, ParticipantId, ServerTime, TopologyHash};
use palpate_tissue::{Budget, Model, TopologyHash as TissueHash, cut, to_rest};

use crate::force_error::ForcePoint;
use seat::Seat;

/// The tick of hands and chains, µs.
const TICK_US: i64 = 1000;

/// Ticks between two solves.
const SOLVE_EVERY: i64 = 4;

/// Ticks between two words about the progress.
const PROGRESS_EVERY: i64 = 20;

/// Hands and chains run so long before the scripts begin, µs: longer than any soft start.
const LEAD_US: i64 = 2_000_000;

/// Iterations of one solve at most. Warm-started every 4 ms, two of them follow a hand; more would
/// take many times as long as the session.
const ITERATIONS_MAX: usize = 2;

/// Relative residual at which a solve ends: below half of what the session's sites solve to.
const TOLERANCE: f64 = 1e-2;

/// Why there is no reference.
#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    /// The simulated hand refused.
    #[error("the simulated hand of the reference failed: {0}")]
    Hand(#[from] DeviceFault),
    /// The cut did not work.
    #[error("the cut of the reference failed: {0}")]
    Cut(String),
    /// Nobody wants to wait any longer.
    #[error("computing it without a network was broken off at {:.0} s of the script", .0.max(0.0))]
    Stopped(f64),
    /// What was recorded can not be replayed.
    #[error("what was recorded of {name} can not be replayed: {what}")]
    Recording {
        /// Who.
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
}

/// Runs two scripts against a model: hands that answer to what they feel, one copy of the tissue. `progress`
/// is told the share that is done, and gives whether to go on.
pub fn run(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    let seats = [
        Seat::of_script(scripts[0], 1)?,
        Seat::of_script(scripts[1], 2)?,
    ];
    let end_s = scripts[0].end_s().max(scripts[1].end_s());
    let mut table = Table {
        seats,
        copies: vec![Replica::new(Arc::clone(model), true)],
        cuts_s: Vec::new(),
    };
    table.go_on(LEAD_US + (end_s * 1e6) as i64, progress)?;
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
    let mut table = Table {
        seats: [seat(0)?, seat(1)?],
        copies: (0..2)
            .map(|_| Replica::new(Arc::clone(model), true))
            .collect(),
        cuts_s: Vec::new(),
    };
    table.go_on(end_us, progress)?;
    Ok(table.into_reference())
}

/// Who sits at it, and the tissue: one copy for both, or one for each.
struct Table {
    seats: [Seat; 2],
    copies: Vec<Replica>,
    cuts_s: Vec<f64>,
}

impl Table {
    fn go_on(
        &mut self,
        end_us: i64,
        mut progress: impl FnMut(f64) -> bool,
    ) -> Result<(), ReferenceError> {
        let ticks = end_us / TICK_US;
        for tick in 0..=ticks {
            let us = tick * TICK_US;
            let [a, b] = &mut self.seats;
            let samples = [a.tick(us)?, b.tick(us)?];
            if tick % SOLVE_EVERY != 0 {
                continue;
            }
            for (k, sample) in samples.iter().enumerate() {
                if let Some(request) = self.seats[k].take(us, sample) {
                    self.cut(k, &request)?;
                    self.cuts_s.push(self.seats[k].script_s(us));
                }
            }
            self.solve(ClientTime::from_micros(us));
            if tick % PROGRESS_EVERY == 0 && !progress(tick as f64 / ticks as f64) {
                return Err(ReferenceError::Stopped(self.seats[0].script_s(us)));
            }
        }
        Ok(())
    }

    fn solve(&mut self, now: ClientTime) {
        let [a, b] = &mut self.seats;
        if let [one] = &mut self.copies[..] {
            let budget = Budget::new(ITERATIONS_MAX, TOLERANCE);
            a.contact = one.haptic_step(now, Some(&a.tool), &[b.tool], budget);
            // The shape is solved for both: the second call only asks what the other one feels.
            let solved = Budget::new(0, f64::INFINITY);
            b.contact = one.haptic_step(now, Some(&b.tool), &[a.tool], solved);
            return;
        }
        let others = [b.tool, a.tool];
        for ((copy, seat), other) in self.copies.iter_mut().zip(&mut self.seats).zip(others) {
            // It ends by iterations and residual, which every run repeats, and not by time.
            let mut never = || false;
            let budget = hand_budget(&mut never);
            seat.contact = copy.haptic_step(now, Some(&seat.tool), &[other], budget);
        }
    }

    /// Cuts every copy by the stroke of the one at seat `author`.
    fn cut(&mut self, author: usize, request: &CutRequest) -> Result<(), ReferenceError> {
        let own = &self.copies[author.min(self.copies.len() - 1)];
        let operation = operation(own, request, self.cuts_s.len(), author as u16 + 1)?;
        for copy in &mut self.copies {
            copy.apply(&operation)?;
        }
        Ok(())
    }

    fn into_reference(self) -> Reference {
        Reference {
            topology_hash: self.copies[0].topology().hash(),
            courses: self.seats.map(|s| s.course),
            cuts_s: self.cuts_s,
        }
    }
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
