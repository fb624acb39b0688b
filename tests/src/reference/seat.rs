//! A hand with its haptic chain, its tool and the stroke of its blade.

use nalgebra::{Quaternion, Unit};
use palpate_client::realtime::{Horizon, tool_buttons};
use palpate_client::recording::Recording;
use palpate_client::tool_description;
use palpate_device::backend::replay::{Moment, Motion, Replay};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{
    Buttons, DeviceFault, DeviceTime, HapticDevice, Pose as DevicePose, Sample, Script,
};
use palpate_haptics::{Chain, ChainConfig, ContactModel};
use palpate_protocol::request::CutRequest;
use palpate_protocol::{ClientTime, ParticipantId, Pose, ServerTime};
use palpate_site::{StrokeCollector, ToolAt};

use super::{LEAD_US, ReferenceError};
use crate::force_error::ForcePoint;

/// Offset against rounding of session times: far below a tick, s.
const EARLY_S: f64 = 1e-7;

pub(super) struct Seat {
    hand: Box<dyn HapticDevice>,
    chain: Box<Chain>,
    /// Start of the script, µs of the run.
    script_us: i64,
    pub(super) contact: ContactModel,
    pub(super) tool: ToolAt,
    stroke: StrokeCollector,
    pub(super) forces: Vec<ForcePoint>,
}

impl Seat {
    /// A trainee that follows a script, which begins after [`LEAD_US`].
    pub(super) fn of_script(script: &Script, number: u16) -> Result<Self, DeviceFault> {
        let start = ScriptStart::at(DeviceTime::from_micros(LEAD_US));
        let hand = SimHand::new(script.clone(), start);
        let chain = Chain::new(ChainConfig::default(), hand.caps());
        Self::new(Box::new(hand), chain, script, number, LEAD_US)
    }

    /// A trainee whose hand replays a recorded motion, independent of the force. `zero_us` of the session clock
    /// is [`LEAD_US`] of the run.
    pub(super) fn of_recording(
        recording: &Recording,
        script: &Script,
        number: u16,
        zero_us: i64,
    ) -> Result<Self, ReferenceError> {
        let unusable = |what: String| ReferenceError::Recording {
            name: recording.name.clone(),
            what,
        };
        let began = recording
            .script_started_us
            .ok_or_else(|| unusable("its script did not begin".to_owned()))?;
        let first = recording.haptic.first().map_or(0, |p| p.t_us);
        let moments = recording.haptic.iter().map(|p| {
            let [x, y, z, w] = p.orientation;
            Moment {
                // All but the first point are slightly early, so that a tick at the time of a point finds it
                // despite rounding. A button pressed one solve later changes the force.
                t_s: ((p.t_us - first) as f64 * 1e-6 - EARLY_S).max(0.0),
                pose: DevicePose {
                    position: p.position_m.into(),
                    orientation: Unit::new_normalize(Quaternion::new(w, x, y, z)),
                },
                buttons: Buttons::from_bits(p.buttons),
            }
        });
        let motion = Motion::new(moments.collect()).map_err(|e| unusable(e.to_string()))?;
        let first_us = recording.haptic[0].t_us - zero_us + LEAD_US;
        let start = ScriptStart::at(DeviceTime::from_micros(first_us));
        let rendering = SimHand::new(script.clone(), ScriptStart::not_yet());
        let chain = Chain::new(ChainConfig::default(), rendering.caps());
        let script_us = began - zero_us + LEAD_US;
        let hand = Box::new(Replay::new(motion, start));
        Ok(Self::new(hand, chain, script, number, script_us)?)
    }

    fn new(
        mut hand: Box<dyn HapticDevice>,
        chain: Chain,
        script: &Script,
        number: u16,
        script_us: i64,
    ) -> Result<Self, DeviceFault> {
        hand.enable_forces(true)?;
        Ok(Self {
            hand,
            chain: Box::new(chain),
            script_us,
            contact: ContactModel::FREE,
            tool: ToolAt {
                participant: ParticipantId(number),
                description: tool_description(&script.tool()),
                position: script.waypoints()[0].position,
                orientation: script.waypoints()[0].orientation,
                buttons: 0,
                strength: 1.0,
                returns: false,
                predicted: None,
            },
            stroke: StrokeCollector::new(script.tool().length_m),
            forces: Vec::new(),
        })
    }

    pub(super) fn script_s(&self, us: i64) -> f64 {
        (us - self.script_us) as f64 * 1e-6
    }

    pub(super) fn tick(&mut self, us: i64) -> Result<Sample, DeviceFault> {
        let now = DeviceTime::from_micros(us);
        let sample = self.hand.read(now)?;
        let tick = self
            .chain
            .tick(ClientTime::from_micros(us), &sample, &self.contact);
        // The hand clamps forces beyond its limit; the chain clamps below that.
        let _ = self.hand.write(now, tick.wrench);
        if us >= self.script_us {
            self.forces.push(ForcePoint {
                t_s: self.script_s(us),
                force_n: tick.wrench.force.into(),
                position_m: sample.pose.position.into(),
            });
        }
        Ok(sample)
    }

    /// Refreshes the time stamp of the contact model: nothing has moved since its solve, and the chain fades
    /// out old models.
    pub(super) fn renew(&mut self, us: i64) {
        self.contact.solved_at = ClientTime::from_micros(us);
    }

    /// Updates the tool pose; returns a stroke that has just ended.
    pub(super) fn take(&mut self, us: i64, sample: &Sample) -> Option<CutRequest> {
        self.tool.position = sample.pose.position;
        self.tool.orientation = sample.pose.orientation;
        self.tool.predicted = Some(Horizon::default().predicted_pose(sample));
        self.tool.buttons = tool_buttons(sample.buttons, self.contact.is_inserted);
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
