//! One seat of the session.

use nalgebra::{Quaternion, UnitQuaternion};
use palpate_protocol::compensation::{DelayEstimator, Demotion};
use palpate_protocol::handshake::{Hello, RosterEntry, SEAT_RETENTION, Subscription};
use palpate_protocol::name::Appearance;
use palpate_protocol::request::DelayReport;
use palpate_protocol::tool::{INSERTED_BUTTON, ToolDescription, ToolKind, ToolPart, part_id};
use palpate_protocol::{
    Emulation, ParticipantId, ResumeToken, Role, ServerTime, Span, TokenBucket,
};
use palpate_tissue::{BladePoint, Form, Needle, Tool, Vec3};

use crate::PeerKey;
use crate::admission::Admission;
use crate::cut_budget::CutBudget;
use crate::joins;
use crate::request_history::RequestHistory;
use crate::shown_motion::{ShownMotion, ShownPose};
use crate::track::Track;

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

/// Allowance of a delay estimate above the measured path: the longest round of motion and a batch (20 ms), and the
/// margin of bursts (5 ms).
const UNEXPLAINED_MAX: Span = Span::from_millis(25);

/// Changes of one tool at once, and per second in the long run. Compaction drops all but the latest.
const TOOL_CHANGES_BURST: f64 = 8.0;
const TOOL_CHANGES_PER_S: f64 = 1.0;

/// A measured path with [`UNEXPLAINED_MAX`], µs.
fn limit_us(path: Span) -> u32 {
    let us = (path + UNEXPLAINED_MAX).as_micros();
    u32::try_from(us.max(0)).unwrap_or(u32::MAX)
}

/// A participant of the session.
#[derive(Debug)]
pub(crate) struct Participant {
    pub(crate) presence: Presence,
    /// Token that resumes the seat.
    pub(crate) token: ResumeToken,
    /// The right by which it joined.
    pub(crate) admission: Admission,
    /// Budget of resumptions.
    pub(crate) resumptions: TokenBucket,
    /// The first motion of its tool.
    moved_since: Option<ServerTime>,
    pub(crate) id: ParticipantId,
    pub(crate) name: String,
    pub(crate) appearance: Appearance,
    pub(crate) role: Role,
    pub(crate) tool: Option<ToolDescription>,
    /// Full or thin subscription to the tissue.
    pub(crate) subscription: Subscription,
    /// Motion of the tool, for the authoritative shape.
    pub(crate) motion: ShownMotion,
    /// Where the tool was, for the check of strokes.
    pub(crate) track: Track,
    /// Its share of the work of cutting.
    pub(crate) cuts: CutBudget,
    /// Number of its latest stroke.
    pub(crate) latest_stroke: Option<u64>,
    /// Requests of the seat, for the detection of repetitions.
    pub(crate) requests: RequestHistory,
    /// Age of its samples on arrival at the server.
    pub(crate) delay: DelayEstimator,
    /// The longest round trip of the last half minute; `None` before it is known.
    pub(crate) round_trip: Option<Span>,
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
    /// End and motion of the previous pressing interval, which views still show for D.
    previous: Option<(ServerTime, ShownMotion)>,
    /// End of the time of the previous tool, and that tool, which views still show for D.
    previous_tool: Option<(ServerTime, ToolDescription)>,
    /// Whether the instructor has made the tool inactive.
    pub(crate) is_muted: bool,
    /// The instructor's limit of the force, N.
    pub(crate) force_limit: Option<f64>,
    /// The network that the instructor emulates for it, over all its connections.
    pub(crate) emulation: Emulation,
    /// Budget of changes of the tool.
    tool_changes: TokenBucket,
}

impl Participant {
    /// A participant who joins now.
    pub(crate) fn new(
        peer: PeerKey,
        token: ResumeToken,
        id: ParticipantId,
        hello: Hello,
        cap: Span,
        cuts: CutBudget,
        now: ServerTime,
    ) -> Self {
        Self {
            presence: Presence::Connected(peer),
            token,
            admission: Admission::new(hello.grant),
            resumptions: joins::resumptions(now),
            moved_since: None,
            id,
            appearance: Appearance::of(&hello.name),
            name: hello.name,
            role: hello.role,
            tool: hello.tool.filter(|_| hello.role.has_tool()),
            subscription: hello.subscription,
            motion: ShownMotion::default(),
            track: Track::default(),
            cuts,
            latest_stroke: None,
            requests: RequestHistory::default(),
            delay: DelayEstimator::new(cap),
            round_trip: None,
            report: None,
            downlink_us: 0,
            demotion: Demotion::new(cap),
            active_from: ServerTime::ZERO,
            inactive_from: None,
            previous: None,
            previous_tool: None,
            is_muted: false,
            force_limit: None,
            emulation: Emulation::NONE,
            tool_changes: TokenBucket::new(
                TOOL_CHANGES_PER_S,
                TOOL_CHANGES_BURST,
                now - ServerTime::ZERO,
            ),
        }
    }

    /// Takes another tool from a time on, if the budget of changes permits it. Returns whether it does.
    pub(crate) fn change_tool(&mut self, tool: ToolDescription, at: ServerTime) -> bool {
        if !self.tool_changes.take(1.0, at - ServerTime::ZERO) {
            return false;
        }
        self.previous_tool = self.tool.map(|before| (at, before));
        self.tool = Some(tool);
        true
    }

    /// Notes motion of the tool that arrives now.
    pub(crate) fn note_motion(&mut self, round_trip: Option<Span>, now: ServerTime) {
        self.round_trip = round_trip;
        self.moved_since.get_or_insert(now);
    }

    /// Whether its kept seat gives way to a newcomer: it has been away for longer than it took part. Therefore one
    /// participant occupies at most two seats, however often it joins and drops.
    pub(crate) fn gives_way(&self, now: ServerTime) -> bool {
        let Some(until) = self.kept_until() else {
            return false;
        };
        let lost = until - SEAT_RETENTION;
        self.moved_since
            .is_none_or(|since| now - lost >= lost - since)
    }

    /// Age of its samples on arrival, as far as the measured round trip explains it; `None` until both are known.
    /// Sample times come from the client, the round trip does not.
    pub(crate) fn explained_uplink(&self) -> Option<DelayReport> {
        let report = self.delay.report()?;
        let most = limit_us(self.round_trip?);
        Some(DelayReport {
            wanted_us: report.wanted_us.min(most),
            ..report
        })
    }

    /// The longest downlink that the measured round trip leaves beside this uplink, µs; zero before it is known.
    pub(crate) fn downlink_max_us(&self, uplink_us: i64) -> i64 {
        let path_us = self.round_trip.map_or(0, limit_us);
        (i64::from(path_us) - uplink_us).max(0)
    }

    /// A delay report as far as the longest uplink of the other participants and the measured round trip explain it;
    /// `None` for a participant whose own samples are not measured.
    pub(crate) fn explained(
        &self,
        report: DelayReport,
        longest_uplink: Span,
    ) -> Option<DelayReport> {
        let most = self.path_max_us(longest_uplink)?;
        Some(DelayReport {
            wanted_us: report.wanted_us.min(most),
            ..report
        })
    }

    /// The longest way from another participant with this uplink, µs; `None` for a participant whose own samples are not
    /// measured.
    pub(crate) fn path_max_us(&self, longest_uplink: Span) -> Option<u32> {
        self.delay.report()?;
        Some(limit_us(longest_uplink + self.round_trip?))
    }

    /// Deactivates the tool from a time on. An inactive tool stays inactive.
    pub(crate) fn deactivate(&mut self, at: ServerTime) {
        if self.inactive_from.is_none() {
            self.inactive_from = Some(at);
            self.previous = Some((at, self.next_motion()));
        }
    }

    /// Begins an interval of motion. Returns the one that ends.
    fn next_motion(&mut self) -> ShownMotion {
        let next = ShownMotion::new(self.motion.frozen_from());
        std::mem::replace(&mut self.motion, next)
    }

    /// Lets the tool press again from a time on, unless another reason keeps it inactive.
    pub(crate) fn activate(&mut self, at: ServerTime) {
        let is_active = self.inactive_from.is_none();
        if is_active || self.peer().is_none() || self.demotion.is_demoted() || self.is_muted {
            return;
        }
        (self.inactive_from, self.active_from) = (None, at);
        self.next_motion();
    }

    /// Begins in a session that has been frozen since a time, without a held pose.
    pub(crate) fn begin_frozen(&mut self, since: Option<ServerTime>) {
        self.motion = ShownMotion::new(since);
    }

    /// Holds the pose of the tool from a time on. Returns the pose, unless the tool is inactive or silent.
    pub(crate) fn freeze(&mut self, at: ServerTime) -> Option<ShownPose> {
        let pose = self.motion.hold(at);
        pose.filter(|_| self.tool.is_some())
    }

    /// Lets the tool move again from a time on.
    pub(crate) fn release(&mut self, at: ServerTime) {
        let held = std::mem::take(&mut self.motion);
        if self.inactive_from.is_none() {
            self.previous = Some((at, held));
            self.active_from = at;
        }
    }

    /// Whether the tool is inactive, because its owner is demoted, muted or disconnected.
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

    /// Until when the seat is kept without a connection.
    pub(crate) fn kept_until(&self) -> Option<ServerTime> {
        match self.presence {
            Presence::Connected(_) => None,
            Presence::Disconnected { until } => Some(until),
        }
    }

    /// Whether the time for which the seat is kept is over.
    pub(crate) fn is_expired(&self, now: ServerTime) -> bool {
        self.kept_until().is_some_and(|until| now >= until)
    }

    /// Handles a lost connection: deactivates the tool and resets the delay estimate, which does not apply to the next
    /// connection.
    pub(crate) fn disconnect(&mut self, at: ServerTime) {
        self.deactivate(at);
        self.delay.restart();
        self.round_trip = None;
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

    /// The active tool at time t with its pose; `None` if there is none or it has no recent sample.
    pub(crate) fn shown_at(&mut self, t: ServerTime) -> Option<(ToolDescription, ShownPose)> {
        self.previous.take_if(|(until, _)| t >= *until);
        self.previous_tool.take_if(|(until, _)| t >= *until);
        let shown = match &mut self.previous {
            Some((_, motion)) => motion.at(t),
            None if self.inactive_from.is_some() || t < self.active_from => None,
            None => self.motion.at(t),
        };
        let tool = self.previous_tool.map(|(_, tool)| tool).or(self.tool);
        tool.zip(shown)
    }

    /// The edge of a cutting blade at time t; `None` for any other tool.
    pub(crate) fn cutting_at(&mut self, t: ServerTime) -> Option<BladePoint> {
        let (description, shown) = self.shown_at(t)?;
        let is_cutting = is_cutting(&description, &shown) && shown.strength > 0.0;
        is_cutting.then(|| BladePoint {
            tip: shown.pose.position_m.into(),
            axis: turn(&shown) * Vec3::z(),
            depth_m: description.length_m,
        })
    }

    /// The parts of the tool that press at time t. Empty if there is no tool, no sample, only old samples, a cutting
    /// blade, or an inactive tool.
    pub(crate) fn pressing_at(&mut self, t: ServerTime) -> Vec<Tool> {
        let Some((description, shown)) = self.shown_at(t) else {
            return Vec::new();
        };
        if is_cutting(&description, &shown) {
            return Vec::new();
        }
        let held = shown.buttons & PRIMARY_BUTTON != 0;
        let turn = turn(&shown);
        let needle = (description.kind == ToolKind::Needle).then_some(Needle {
            is_inserted: shown.buttons & INSERTED_BUTTON != 0,
            decides: false,
        });
        let part = |(i, part): (usize, ToolPart)| Tool {
            turn,
            form: Form::rectangle(part.mid.into(), part.half.map(Vec3::from)),
            needle,
            strength: shown.strength,
            ..Tool::ball(
                part_id(self.id, i),
                Vec3::from(shown.pose.position_m),
                description.radius_m,
            )
        };
        description.parts(held).enumerate().map(part).collect()
    }
}

/// Whether a tool is a blade whose main button is held.
fn is_cutting(description: &ToolDescription, shown: &ShownPose) -> bool {
    description.kind == ToolKind::Scalpel && shown.buttons & PRIMARY_BUTTON != 0
}

fn turn(shown: &ShownPose) -> UnitQuaternion<f64> {
    let [x, y, z, w] = shown.pose.orientation;
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6).unwrap_or_default()
}
