//! The same two scripts without a network: what the forces would be if everybody sat at one table.
//!
//! In virtual time, with the client's own parts: two simulated hands and their haptic chains tick
//! at 1 kHz, one copy of the tissue is solved every 4 ms for both tools where they are, and a cut
//! happens in the moment in which its stroke ends. No threads, no clocks, no delay, and half the
//! tolerance of the sites in two iterations per solve, which is not a converged answer: what differs in a
//! session comes from the network and from solving in real time, and to a part from that.

use std::sync::Arc;

use palpate_client::ahead::ReplicaError;
use palpate_client::convert::{tissue_stroke, tool_description};
use palpate_client::stroke::StrokeCollector;
use palpate_client::{Replica, ToolAt};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{DeviceFault, DeviceTime, HapticDevice, Sample, Script};
use palpate_haptics::{Chain, ChainConfig, ContactModel};
use palpate_protocol::operation::{BladePoint, CutStroke, Operation, OperationKind};
use palpate_protocol::request::CutRequest;
use palpate_protocol::{ClientTime, OperationId, ParticipantId, Pose, ServerTime, TopologyHash};
use palpate_tissue::{Budget, Model, TopologyHash as TissueHash, cut, to_rest};

use crate::force_error::ForcePoint;

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

/// A hand with all that is its own.
struct Seat {
    hand: SimHand,
    chain: Box<Chain>,
    contact: ContactModel,
    tool: ToolAt,
    stroke: StrokeCollector,
    course: Vec<ForcePoint>,
}

impl Seat {
    fn new(script: &Script, number: u16) -> Result<Self, DeviceFault> {
        let start = ScriptStart::at(DeviceTime::from_micros(LEAD_US));
        let mut hand = SimHand::new(script.clone(), start);
        hand.enable_forces(true)?;
        Ok(Self {
            chain: Box::new(Chain::new(ChainConfig::default(), hand.caps())),
            contact: ContactModel::FREE,
            tool: ToolAt {
                participant: ParticipantId(number),
                description: tool_description(&script.tool()),
                position: script.ways()[0].position,
                orientation: script.ways()[0].orientation,
                buttons: 0,
                stale: false,
            },
            stroke: StrokeCollector::new(script.tool().length_m),
            course: Vec::new(),
            hand,
        })
    }

    fn tick(&mut self, us: i64) -> Result<Sample, DeviceFault> {
        let now = DeviceTime::from_micros(us);
        let sample = self.hand.read(now)?;
        let tick = self
            .chain
            .tick(ClientTime::from_micros(us), &sample, &self.contact);
        // What the hand can not render it clamps; the chain clamps below that.
        let _ = self.hand.write(now, tick.wrench);
        if us >= LEAD_US {
            self.course.push(ForcePoint {
                t_s: (us - LEAD_US) as f64 * 1e-6,
                force_n: tick.wrench.force.into(),
                position_m: sample.pose.position.into(),
            });
        }
        Ok(sample)
    }

    /// Takes over where the tool is; gives the stroke that has just ended.
    fn take(&mut self, us: i64, sample: &Sample) -> Option<CutRequest> {
        self.tool.position = sample.pose.position;
        self.tool.orientation = sample.pose.orientation;
        self.tool.buttons = (sample.buttons.bits() & 0xff) as u8;
        let q = sample.pose.orientation;
        let pose = Pose {
            position_m: sample.pose.position.into(),
            orientation: [q.i, q.j, q.k, q.w],
        };
        let pressed = self.tool.is_cutting();
        self.stroke
            .push(ServerTime::from_micros(us), &pose, pressed)
    }
}

/// Runs two scripts against a model. `progress` is told the share that is done, and gives whether to
/// go on.
pub fn run(
    model: &Arc<Model>,
    scripts: [&Script; 2],
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Reference, ReferenceError> {
    let mut replica = Replica::new(Arc::clone(model), true);
    let mut seats = [Seat::new(scripts[0], 1)?, Seat::new(scripts[1], 2)?];
    let mut cuts_s = Vec::new();
    let end_s = scripts[0].end_s().max(scripts[1].end_s());
    let ticks = (LEAD_US + (end_s * 1e6) as i64) / TICK_US;
    for tick in 0..=ticks {
        let us = tick * TICK_US;
        let [a, b] = &mut seats;
        let samples = [a.tick(us)?, b.tick(us)?];
        if tick % SOLVE_EVERY != 0 {
            continue;
        }
        for (seat, sample) in seats.iter_mut().zip(&samples) {
            if let Some(request) = seat.take(us, sample) {
                apply(&mut replica, &request, cuts_s.len())?;
                cuts_s.push((us - LEAD_US) as f64 * 1e-6);
            }
        }
        let now = ClientTime::from_micros(us);
        let [a, b] = &mut seats;
        a.contact = replica.haptic_step(now, Some(&a.tool), &[b.tool], budget());
        // The shape is solved for both: the second call only asks what the other one feels.
        let solved = Budget::new(0, f64::INFINITY);
        b.contact = replica.haptic_step(now, Some(&b.tool), &[a.tool], solved);
        if tick % PROGRESS_EVERY == 0 && !progress(tick as f64 / ticks as f64) {
            return Err(ReferenceError::Stopped((us - LEAD_US) as f64 * 1e-6));
        }
    }
    Ok(Reference {
        topology_hash: replica.topology().hash(),
        courses: seats.map(|s| s.course),
        cuts_s,
    })
}

fn budget() -> Budget<'static> {
    Budget::new(ITERATIONS_MAX, TOLERANCE)
}

/// Cuts here and now, as the room does: the stroke is taken to the rest frame first.
fn apply(replica: &mut Replica, request: &CutRequest, number: usize) -> Result<(), ReferenceError> {
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
    replica.apply(&Operation {
        id: OperationId(number as u64),
        at: ServerTime::ZERO,
        author: ParticipantId(2),
        topology_version_before: topology.version(),
        topology_version_after: after.version(),
        hash_after: TopologyHash(after.hash().0),
        kind: OperationKind::Cut(stroke),
    })?;
    Ok(())
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
