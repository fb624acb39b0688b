//! One seat of the session.

use nalgebra::{Quaternion, UnitQuaternion};
use palpate_protocol::compensation::{DelayEstimator, DelayRule, Demotion};
use palpate_protocol::handshake::{RosterEntry, Subscription};
use palpate_protocol::request::DelayReport;
use palpate_protocol::timeline::Timeline;
use palpate_protocol::tool::{ToolDescription, ToolKind, ToolPart, part_id};
use palpate_protocol::{ParticipantId, ResumeToken, Role, ServerTime, Span};
use palpate_tissue::{Form, Tool, Vec3};

use crate::PeerKey;
use crate::asked::Asked;

/// Bit of the primary button in a sample.
const PRIMARY_BUTTON: u8 = 1;

/// Where somebody with a seat is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Place {
    /// Connected.
    Here(PeerKey),
    /// Their connection was lost; the seat is kept.
    Away {
        /// Until then.
        until: ServerTime,
    },
}

/// Somebody in the session.
#[derive(Debug)]
pub(crate) struct Participant {
    pub(crate) place: Place,
    /// What takes the seat again.
    pub(crate) token: ResumeToken,
    /// How often the seat was taken again.
    pub(crate) resumed: u16,
    pub(crate) id: ParticipantId,
    pub(crate) name: String,
    pub(crate) role: Role,
    pub(crate) tool: Option<ToolDescription>,
    /// What of the tissue they are sent.
    pub(crate) subscription: Subscription,
    /// Where the tool was, for the server's own view.
    pub(crate) timeline: Timeline,
    /// What it asked for.
    pub(crate) asked: Asked,
    /// How late its samples come.
    pub(crate) delay: DelayEstimator,
    /// What its site said last that it needs, and when.
    pub(crate) report: Option<(ServerTime, DelayReport)>,
    /// Its way down when it last said what it needs, µs.
    pub(crate) down_us: i64,
    /// Whether it takes part or, because of its network, only watches.
    pub(crate) demotion: Demotion,
    /// Before this moment the tool does not press, nor from `lifted` on: the moments are those of the
    /// log, so that it is lifted here in the view in which everybody lifts it.
    presses_from: ServerTime,
    lifted: Option<ServerTime>,
    /// Until when it pressed before it was lifted last, and where it was: the view is D behind.
    before: Option<(ServerTime, Timeline)>,
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
            place: Place::Here(peer),
            token,
            resumed: 0,
            id,
            name,
            role,
            tool,
            subscription: Subscription::Full,
            timeline: Timeline::default(),
            asked: Asked::default(),
            delay: DelayEstimator::new(DelayRule::default()),
            report: None,
            down_us: 0,
            demotion: Demotion::new(cap),
            presses_from: ServerTime::ZERO,
            lifted: None,
            before: None,
        }
    }

    /// The tool presses no more from a moment on. One that is lifted already stays so.
    pub(crate) fn lift(&mut self, at: ServerTime) {
        if self.lifted.is_none() {
            self.lifted = Some(at);
            self.before = Some((at, std::mem::take(&mut self.timeline)));
        }
    }

    /// The tool presses again from a moment on.
    pub(crate) fn set_down(&mut self, at: ServerTime) {
        (self.lifted, self.presses_from) = (None, at);
        self.timeline = Timeline::default();
    }

    /// Whether the tool presses nowhere, because its owner watches or is away.
    pub(crate) fn is_lifted(&self) -> bool {
        self.lifted.is_some()
    }

    /// The connection, while there is one.
    pub(crate) fn peer(&self) -> Option<PeerKey> {
        match self.place {
            Place::Here(peer) => Some(peer),
            Place::Away { .. } => None,
        }
    }

    /// Whether the seat was kept for long enough.
    pub(crate) fn is_given_up(&self, now: ServerTime) -> bool {
        matches!(self.place, Place::Away { until } if now >= until)
    }

    /// The connection is lost: the tool is lifted, and how late its samples came says nothing of the next
    /// connection.
    pub(crate) fn lose(&mut self, at: ServerTime) {
        self.lift(at);
        self.delay = DelayEstimator::new(DelayRule::default());
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

    /// The parts of the tool as they press at a moment; none when it has none, nothing is known of it, it has
    /// been silent for too long, it is a blade that is cutting and so goes through, or it is lifted.
    pub(crate) fn pressing_at(&mut self, t: ServerTime) -> Vec<Tool> {
        self.before.take_if(|(until, _)| t >= *until);
        let shown = match &mut self.before {
            Some((_, before)) => before.at(t),
            None if self.lifted.is_some() || t < self.presses_from => None,
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
