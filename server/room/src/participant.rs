//! One seat of the session.

use nalgebra::{Quaternion, UnitQuaternion};
use palpate_protocol::compensation::{DelayEstimator, Demotion};
use palpate_protocol::handshake::{RosterEntry, Subscription};
use palpate_protocol::request::DelayReport;
use palpate_protocol::timeline::Timeline;
use palpate_protocol::tool::{ToolDescription, ToolKind, ToolPart, part_id};
use palpate_protocol::{ParticipantId, ResumeToken, Role, ServerTime, Span};
use palpate_tissue::{Form, Tool, Vec3};

use crate::PeerKey;
use crate::request_history::RequestHistory;

/// Bit of the primary button in a sample.
const PRIMARY_BUTTON: u8 = 1;

/// Connection state of a seat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Presence {
    /// Connected.
    Connected(PeerKey),
    /// The connection was lost; the seat is kept.
    Disconnected {
        /// End of the time for which the seat is kept.
        until: ServerTime,
    },
}

/// A participant of the session.
#[derive(Debug)]
pub(crate) struct Participant {
    pub(crate) presence: Presence,
    /// Token that resumes the seat.
    pub(crate) token: ResumeToken,
    /// Number of resumptions.
    pub(crate) resumed: u16,
    pub(crate) id: ParticipantId,
    pub(crate) name: String,
    pub(crate) role: Role,
    pub(crate) tool: Option<ToolDescription>,
    /// Full or thin subscription to the tissue.
    pub(crate) subscription: Subscription,
    /// Samples of the tool, for the authoritative shape.
    pub(crate) timeline: Timeline,
    /// Requests of the seat, for the detection of repetitions.
    pub(crate) requests: RequestHistory,
    /// Age of its samples on arrival at the server.
    pub(crate) delay: DelayEstimator,
    /// The last delay report of the client, with its time of reception.
    pub(crate) report: Option<(ServerTime, DelayReport)>,
    /// Its downlink at the last delay report, µs.
    pub(crate) downlink_us: i64,
    /// Whether it is demoted to spectator because of its network.
    pub(crate) demotion: Demotion,
    /// The tool is active from this time until `inactive_from`. Both are times of the log, so that server and
    /// clients deactivate the tool in the same view.
    active_from: ServerTime,
    inactive_from: Option<ServerTime>,
    /// End and samples of the previous pressing interval, which views still show for D.
    previous: Option<(ServerTime, Timeline)>,
}

impl Participant {
    pub(crate) fn new(
        peer: PeerKey,
        token: ResumeToken,
        id: ParticipantId,
        name: String,
        role: Role,
        tool: Option<ToolDescription>,
        cap: Span,
    ) -> Self {
        Self {
            presence: Presence::Connected(peer),
            token,
            resumed: 0,
            id,
            name,
            role,
            tool,
            subscription: Subscription::Full,
            timeline: Timeline::default(),
            requests: RequestHistory::default(),
            delay: DelayEstimator::default(),
            report: None,
            downlink_us: 0,
            demotion: Demotion::new(cap),
            active_from: ServerTime::ZERO,
            inactive_from: None,
            previous: None,
        }
    }

    /// Deactivates the tool from a time on. An inactive tool stays inactive.
    pub(crate) fn deactivate(&mut self, at: ServerTime) {
        if self.inactive_from.is_none() {
            self.inactive_from = Some(at);
            self.previous = Some((at, std::mem::take(&mut self.timeline)));
        }
    }

    /// Lets the tool press again from a time on.
    pub(crate) fn activate(&mut self, at: ServerTime) {
        (self.inactive_from, self.active_from) = (None, at);
        self.timeline = Timeline::default();
    }

    /// Whether the tool is inactive, because its owner is demoted or disconnected.
    pub(crate) fn is_inactive(&self) -> bool {
        self.inactive_from.is_some()
    }

    /// The connection, if there is one.
    pub(crate) fn peer(&self) -> Option<PeerKey> {
        match self.presence {
            Presence::Connected(peer) => Some(peer),
            Presence::Disconnected { .. } => None,
        }
    }

    /// Whether the time for which the seat is kept is over.
    pub(crate) fn is_expired(&self, now: ServerTime) -> bool {
        matches!(self.presence, Presence::Disconnected { until } if now >= until)
    }

    /// Handles a lost connection: deactivates the tool and resets the delay estimate, which does not apply to the next
    /// connection.
    pub(crate) fn disconnect(&mut self, at: ServerTime) {
        self.deactivate(at);
        self.delay = DelayEstimator::default();
        self.report = None;
    }

    pub(crate) fn roster_entry(&self) -> RosterEntry {
        RosterEntry {
            participant: self.id,
            name: self.name.clone(),
            role: self.role,
            tool: self.tool,
        }
    }

    /// The parts of the tool that press at time t. Empty if there is no tool, no sample, only stale samples, a cutting
    /// blade, or an inactive tool.
    pub(crate) fn pressing_at(&mut self, t: ServerTime) -> Vec<Tool> {
        self.previous.take_if(|(until, _)| t >= *until);
        let shown = match &mut self.previous {
            Some((_, timeline)) => timeline.at(t),
            None if self.inactive_from.is_some() || t < self.active_from => None,
            None => self.timeline.at(t),
        };
        let known = self.tool.zip(shown);
        let Some((description, shown)) = known.filter(|(_, shown)| !shown.stale) else {
            return Vec::new();
        };
        let held = shown.buttons & PRIMARY_BUTTON != 0;
        if description.kind == ToolKind::Scalpel && held {
            return Vec::new();
        }
        let [x, y, z, w] = shown.pose.orientation;
        let turn = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6).unwrap_or_default();
        let part = |(i, part): (usize, ToolPart)| Tool {
            turn,
            form: Form::rectangle(part.mid.into(), part.half.map(Vec3::from)),
            ..Tool::ball(
                part_id(self.id, i),
                Vec3::from(shown.pose.position_m),
                description.radius_m,
            )
        };
        description.parts(held).enumerate().map(part).collect()
    }
}
