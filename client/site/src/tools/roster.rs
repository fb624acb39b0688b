//! Participants of the session, and the poses of their tools at a time.

use std::collections::BTreeMap;

use palpate_protocol::compensation::BRIDGE;
use palpate_protocol::handshake::{ROSTER_MAX, RosterEntry};
use palpate_protocol::operation::HeldTool;
use palpate_protocol::timeline::Timeline;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ParticipantId, ServerTime, Span, ToolSample};

use super::ToolAt;

/// Participants at most: those present, and as many whose leave a view has not reached, because a join counts at once and
/// a leave D later.
const SEATS_SHOWN_MAX: usize = 2 * ROSTER_MAX;

/// Age of samples from which an extrapolated pose differs from the server's: twice the gap that the artificial delay
/// leaves.
const BRIDGED_MAX: Span = Span::from_micros(2 * BRIDGE.as_micros());

/// Age of the newest sample from which a participant counts as silent instead of slow.
const SILENT: Span = Span::from_millis(2000);

#[derive(Debug, Clone)]
struct Seat {
    name: String,
    tool: Option<ToolDescription>,
    /// Whether the participant is demoted: the tool is inactive, because the participant's network is too slow.
    demoted: bool,
    /// Whether the instructor has muted the tool, which is then inactive.
    muted: bool,
    /// The pose that the tool holds while the session is frozen.
    held: Option<HeldTool>,
    /// Timeline for the view, queried on the common grid.
    seen: Timeline,
    /// Timeline for the hand, queried at any time. Corrections are blended along the queried times, so each use has
    /// its own.
    felt: Timeline,
}

impl Seat {
    /// The tool, unless its participant is demoted or muted.
    fn active_tool(&self) -> Option<ToolDescription> {
        self.tool.filter(|_| !self.demoted && !self.muted)
    }

    /// The tool in a frozen session.
    fn held_tool(&self) -> Option<ToolAt> {
        Some(ToolAt::held(self.active_tool()?, self.held.as_ref()?))
    }

    fn forget_motion(&mut self) {
        (self.seen, self.felt) = (Timeline::default(), Timeline::default());
    }
}

/// All participants, ordered by number. The order is the same at every site, because contacts are solved in list
/// order.
#[derive(Debug, Clone, Default)]
pub struct Roster {
    seats: BTreeMap<ParticipantId, Seat>,
    /// Begin of the freeze, if the session is frozen.
    frozen_from: Option<ServerTime>,
}

impl Roster {
    /// The roster of a welcome.
    pub fn new(entries: &[RosterEntry]) -> Self {
        let mut roster = Self::default();
        for entry in entries {
            roster.join(entry.clone());
        }
        roster
    }

    /// Adds a participant. A known participant keeps the tool's timeline. Entries beyond `SEATS_SHOWN_MAX`
    /// are ignored.
    pub fn join(&mut self, entry: RosterEntry) {
        if let Some(seat) = self.seats.get_mut(&entry.participant) {
            (seat.name, seat.tool) = (entry.name, entry.tool);
        } else if self.seats.len() < SEATS_SHOWN_MAX {
            let seat = Seat {
                name: entry.name,
                tool: entry.tool,
                demoted: false,
                muted: false,
                held: None,
                seen: Timeline::default(),
                felt: Timeline::default(),
            };
            self.seats.insert(entry.participant, seat);
        }
    }

    /// Removes a participant.
    pub fn leave(&mut self, who: ParticipantId) {
        self.seats.remove(&who);
    }

    /// Clears the timelines of a disconnected participant: the tool is inactive until its next sample.
    pub fn lose(&mut self, who: ParticipantId) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.forget_motion();
            seat.held = None;
        }
    }

    /// Ends the hold of a tool by a freeze.
    pub fn release_held(&mut self, who: ParticipantId) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.held = None;
        }
    }

    /// Mutes a tool, or makes it active again.
    pub fn set_muted(&mut self, who: ParticipantId, muted: bool) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.muted = muted;
        }
        if muted {
            self.lose(who);
        }
    }

    /// Whether a participant's tool is muted.
    pub fn is_muted(&self, who: ParticipantId) -> bool {
        self.seats.get(&who).is_some_and(|seat| seat.muted)
    }

    /// Holds these tools from a time on; all others are inactive until [`release`](Self::release).
    pub fn freeze(&mut self, held: &[HeldTool], from: ServerTime) {
        self.frozen_from = Some(from);
        for seat in self.seats.values_mut() {
            // The motion after the freeze begins with new samples.
            seat.forget_motion();
            seat.held = None;
        }
        for tool in held {
            if let Some(seat) = self.seats.get_mut(&tool.participant) {
                seat.held = Some(*tool);
            }
        }
    }

    /// Lets all tools move again.
    pub fn release(&mut self) {
        self.frozen_from = None;
        self.seats.values_mut().for_each(|seat| seat.held = None);
    }

    /// Whether the session is frozen.
    pub fn is_frozen(&self) -> bool {
        self.frozen_from.is_some()
    }

    /// Demotes a participant or restores the tool.
    pub fn set_demoted(&mut self, who: ParticipantId, demoted: bool) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.demoted = demoted;
        }
    }

    /// Whether a participant is demoted.
    pub fn is_demoted(&self, who: ParticipantId) -> bool {
        self.seats.get(&who).is_some_and(|seat| seat.demoted)
    }

    /// Changes the tool of a participant.
    pub fn change_tool(&mut self, who: ParticipantId, tool: ToolDescription) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.tool = Some(tool);
        }
    }

    /// Adds a sample of a participant's tool; unknown participants are ignored.
    pub fn insert(&mut self, who: ParticipantId, sample: ToolSample) {
        // Late samples from before the freeze would lead the tool through them afterwards.
        if self.frozen_from.is_some_and(|from| sample.time <= from) {
            return;
        }
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.seen.insert(sample);
            seat.felt.insert(sample);
        }
    }

    /// All tools at a time of the common grid. Query in ascending order: late samples are blended in from one query
    /// to the next.
    pub fn view_tools_at(&mut self, s: ServerTime) -> Vec<ToolAt> {
        if self.is_frozen() {
            return self.seats.values().filter_map(Seat::held_tool).collect();
        }
        let at = |(who, seat): (&ParticipantId, &mut Seat)| {
            let shown = seat.seen.at(s)?;
            Some(ToolAt::shown(*who, seat.active_tool()?, &shown))
        };
        self.seats.iter_mut().filter_map(at).collect()
    }

    /// Whether a tool's pose at `s` is extrapolated from samples that are too old, so that the view differs from the
    /// server's because of the network. Silent participants have no active tool.
    pub fn is_extrapolated(&self, s: ServerTime) -> bool {
        if self.is_frozen() {
            return false;
        }
        let others = self
            .seats
            .values()
            .filter(|seat| !seat.demoted && !seat.muted);
        let mut newest = others.filter_map(|seat| seat.seen.newest());
        newest.any(|newest| (BRIDGED_MAX..SILENT).contains(&(s - newest)))
    }

    /// The tools of all participants but `me` at any time, for the haptic shape. Query in ascending order.
    pub fn haptic_tools_at(&mut self, s: ServerTime, me: ParticipantId) -> Vec<ToolAt> {
        if self.is_frozen() {
            let others = self.seats.iter().filter(|(who, _)| **who != me);
            return others.filter_map(|(_, seat)| seat.held_tool()).collect();
        }
        let at = |(who, seat): (&ParticipantId, &mut Seat)| {
            let shown = seat.felt.at(s)?;
            Some(ToolAt::shown(*who, seat.active_tool()?, &shown))
        };
        let others = self.seats.iter_mut().filter(|(who, _)| **who != me);
        others.filter_map(at).collect()
    }

    /// The tool of a participant; `None` while demoted or muted.
    pub fn tool_of(&self, who: ParticipantId) -> Option<ToolDescription> {
        self.seats.get(&who)?.active_tool()
    }

    /// Display name of a participant.
    pub fn name_of(&self, who: ParticipantId) -> Option<&str> {
        self.seats.get(&who).map(|s| s.name.as_str())
    }

    /// Number of participants.
    pub fn count(&self) -> usize {
        self.seats.len()
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::tool::ToolKind;
    use palpate_protocol::{Pose, Role};

    use super::*;

    fn entry(who: u16, kind: ToolKind) -> RosterEntry {
        RosterEntry {
            participant: ParticipantId(who),
            name: format!("p{who}"),
            role: Role::Trainee,
            tool: Some(match kind {
                ToolKind::Scalpel => ToolDescription::scalpel(0.004, 0.02),
                _ => ToolDescription::probe(0.004),
            }),
        }
    }

    fn sample(us: i64, buttons: u8) -> ToolSample {
        ToolSample {
            time: ServerTime::from_micros(us),
            pose: Pose::IDENTITY,
            buttons,
            force_n: None,
        }
    }

    #[test]
    fn cutting_blade_makes_no_contact() {
        let mut roster = Roster::new(&[entry(1, ToolKind::Scalpel), entry(2, ToolKind::Probe)]);
        for who in [1, 2] {
            roster.insert(ParticipantId(who), sample(0, 1));
            roster.insert(ParticipantId(who), sample(1000, 1));
        }
        let tools = roster.view_tools_at(ServerTime::from_micros(500));
        assert!(tools[0].is_cutting() && tools[0].contacts().next().is_none());
        assert!(tools[1].contacts().next().is_some());
    }

    #[test]
    fn demoted_tool_is_inactive_until_restored() {
        let (me, at) = (ParticipantId(1), ServerTime::from_micros(500));
        let mut roster = Roster::new(&[entry(1, ToolKind::Probe)]);
        for us in [0, 1000] {
            roster.insert(me, sample(us, 0));
        }
        roster.set_demoted(me, true);
        assert!(roster.view_tools_at(at).is_empty() && roster.tool_of(me).is_none());
        assert!(roster.haptic_tools_at(at, ParticipantId(2)).is_empty());
        roster.set_demoted(me, false);
        assert_eq!(roster.view_tools_at(at).len(), 1);
    }

    #[test]
    fn silent_tool_fades_and_left_participant_is_removed() {
        let mut roster = Roster::new(&[entry(1, ToolKind::Probe)]);
        roster.insert(ParticipantId(1), sample(0, 0));
        let held = roster.view_tools_at(ServerTime::from_micros(500_000));
        let strength = |tools: &[ToolAt]| tools[0].contacts().next().map(|tool| tool.strength);
        assert_eq!(strength(&held), Some(1.0));
        let fading = roster.view_tools_at(ServerTime::from_micros(750_000));
        assert_eq!(strength(&fading), Some(0.5));
        let late = roster.view_tools_at(ServerTime::from_micros(1_000_000));
        assert!(late[0].strength == 0.0 && late[0].contacts().next().is_none());
        let now = ServerTime::from_micros(1_300_000);
        roster.insert(ParticipantId(1), sample(1_300_000, 0));
        assert_eq!(roster.view_tools_at(now).len(), 1);
        let now = ServerTime::from_micros(1_400_000);
        assert_eq!(roster.view_tools_at(now)[0].strength, 1.0);
        roster.lose(ParticipantId(1));
        assert!(roster.view_tools_at(now).is_empty());
        roster.leave(ParticipantId(1));
        roster.insert(ParticipantId(1), sample(1_410_000, 0));
        assert!(
            roster
                .view_tools_at(ServerTime::from_micros(1_410_000))
                .is_empty()
        );
    }
}
