//! Who is in the session, and where their tools are at a moment.

use std::collections::BTreeMap;

use nalgebra::UnitQuaternion;
use palpate_protocol::compensation::BRIDGE;
use palpate_protocol::handshake::{ROSTER_MAX, RosterEntry};
use palpate_protocol::timeline::{Shown, Timeline};
use palpate_protocol::tool::{ToolDescription, ToolKind, part_id};
use palpate_protocol::{ParticipantId, Role, ServerTime, Span, ToolSample};
use palpate_tissue::{Form, Tool, Vec3};

use crate::convert::orientation;

/// What is made up from samples older than this is no longer what the server has: twice what the
/// artificial delay leaves to be bridged.
const BRIDGED_MAX: Span = Span::from_micros(2 * BRIDGE.as_micros());

/// Whose newest sample is older than this is silent, and not slow.
const SILENT: Span = Span::from_millis(2000);

/// A tool at a moment, with all that the tissue has to know of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolAt {
    /// Whose it is.
    pub participant: ParticipantId,
    /// What it is.
    pub description: ToolDescription,
    /// Position of its tip, m.
    pub position: Vec3,
    /// Rotation from its own frame to the scene's.
    pub orientation: UnitQuaternion<f64>,
    /// One bit per button; bit 0 is the main one.
    pub buttons: u8,
    /// Whether nothing has come from it for too long.
    pub stale: bool,
}

/// A turn counts as the way of a point so far from the pivot, m: the far end of a long tool.
const LEVER_M: f64 = 0.05;

impl ToolAt {
    /// Whether it is the same tool in the same state.
    pub fn is_alike(&self, other: &Self) -> bool {
        let state = |t: &Self| (t.participant, t.description, t.buttons, t.stale);
        state(self) == state(other)
    }

    /// Whether it is the same tool in the same state, and has moved by less than `way_m` from where `other` is.
    pub fn is_within(&self, other: &Self, way_m: f64) -> bool {
        let moved = (self.position - other.position).norm()
            + LEVER_M * self.orientation.angle_to(&other.orientation);
        self.is_alike(other) && moved < way_m
    }

    /// Whether it is a blade that cuts now: its main button is held.
    pub fn is_cutting(&self) -> bool {
        self.description.kind == ToolKind::Scalpel && self.buttons & 1 == 1
    }

    /// The parts of the tool as the tissue feels them; none while it cuts, or is stale, or is no place at all.
    pub fn contacts(&self) -> impl Iterator<Item = Tool> + '_ {
        let held = self.buttons & 1 == 1;
        let parts = self.description.parts(held).enumerate();
        let presses = !self.stale && !self.is_cutting();
        parts
            .filter(move |_| presses)
            .map(|(i, part)| Tool {
                turn: self.orientation,
                form: Form::rectangle(part.mid.into(), part.half.map(Vec3::from)),
                ..Tool::ball(
                    part_id(self.participant, i),
                    self.position,
                    self.description.radius_m,
                )
            })
            .filter(Tool::is_sound)
    }
}

/// The tools that touch, as the tissue takes them.
pub(crate) fn gather<'a>(into: &mut Vec<Tool>, tools: impl Iterator<Item = &'a ToolAt>) {
    into.clear();
    into.extend(tools.flat_map(ToolAt::contacts));
}

#[derive(Debug, Clone)]
struct Seat {
    name: String,
    role: Role,
    tool: Option<ToolDescription>,
    /// Whether the tool is lifted for everybody, because its owner's network is too slow.
    lifted: bool,
    /// Asked on the common grid, for the view.
    seen: Timeline,
    /// Asked between its points too, for the hand. Corrections are blended along the moments asked
    /// for, so each has its own.
    felt: Timeline,
}

impl Seat {
    /// The tool, unless it is lifted.
    fn tool_down(&self) -> Option<ToolDescription> {
        self.tool.filter(|_| !self.lifted)
    }
}

/// Everybody in the session, in the order of their numbers: the same order at every site, because
/// tools press in the order in which they are listed.
#[derive(Debug, Clone, Default)]
pub struct Roster {
    seats: BTreeMap<ParticipantId, Seat>,
}

impl Roster {
    /// Those in a welcome.
    pub fn new(entries: &[RosterEntry]) -> Self {
        let mut roster = Self::default();
        for entry in entries {
            roster.join(entry.clone());
        }
        roster
    }

    /// Somebody came. Who is known already keeps their tool's past. Beyond [`ROSTER_MAX`] nobody is
    /// taken; no server lets more in.
    pub fn join(&mut self, entry: RosterEntry) {
        if let Some(seat) = self.seats.get_mut(&entry.participant) {
            (seat.name, seat.role, seat.tool) = (entry.name, entry.role, entry.tool);
        } else if self.seats.len() < ROSTER_MAX {
            let seat = Seat {
                name: entry.name,
                role: entry.role,
                tool: entry.tool,
                lifted: false,
                seen: Timeline::default(),
                felt: Timeline::default(),
            };
            self.seats.insert(entry.participant, seat);
        }
    }

    /// Somebody went, and their tool with them.
    pub fn leave(&mut self, who: ParticipantId) {
        self.seats.remove(&who);
    }

    /// The connection of somebody was lost: their tool is nowhere until it is heard of again.
    pub fn lose(&mut self, who: ParticipantId) {
        if let Some(seat) = self.seats.get_mut(&who) {
            (seat.seen, seat.felt) = (Timeline::default(), Timeline::default());
        }
    }

    /// The tool of somebody is lifted for everybody, or set down again.
    pub fn lift(&mut self, who: ParticipantId, lifted: bool) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.lifted = lifted;
        }
    }

    /// Whether somebody's tool is lifted.
    pub fn is_lifted(&self, who: ParticipantId) -> bool {
        self.seats.get(&who).is_some_and(|seat| seat.lifted)
    }

    /// Somebody took another tool.
    pub fn change_tool(&mut self, who: ParticipantId, tool: ToolDescription) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.tool = Some(tool);
        }
    }

    /// A sample of somebody's tool; of who is not here it is ignored.
    pub fn insert(&mut self, who: ParticipantId, sample: ToolSample) {
        if let Some(seat) = self.seats.get_mut(&who) {
            seat.seen.insert(sample);
            seat.felt.insert(sample);
        }
    }

    /// Every tool at a moment of the common grid. Ask with ascending times: late news are blended
    /// from one to the next.
    pub fn tools_seen_at(&mut self, s: ServerTime) -> Vec<ToolAt> {
        let at = |(who, seat): (&ParticipantId, &mut Seat)| {
            let shown = seat.seen.at(s)?;
            Some(placed(*who, seat.tool_down()?, &shown))
        };
        self.seats.iter_mut().filter_map(at).collect()
    }

    /// Whether somebody's tool at a moment is made up from samples that are too old: then the view differs
    /// from the server's because of the network. Who is silent for longer presses nowhere.
    pub fn is_made_up(&self, s: ServerTime) -> bool {
        let others = self.seats.values().filter(|seat| !seat.lifted);
        let mut newest = others.filter_map(|seat| seat.seen.newest());
        newest.any(|newest| (BRIDGED_MAX..SILENT).contains(&(s - newest)))
    }

    /// The tools of all but `me` at any moment, for what the hand feels. Ask with ascending times.
    pub fn tools_felt_at(&mut self, s: ServerTime, me: ParticipantId) -> Vec<ToolAt> {
        let at = |(who, seat): (&ParticipantId, &mut Seat)| {
            let shown = seat.felt.at(s)?;
            Some(placed(*who, seat.tool_down()?, &shown))
        };
        let others = self.seats.iter_mut().filter(|(who, _)| **who != me);
        others.filter_map(at).collect()
    }

    /// The tool that somebody holds; `None` while it is lifted.
    pub fn tool_of(&self, who: ParticipantId) -> Option<ToolDescription> {
        self.seats.get(&who)?.tool_down()
    }

    /// The name of somebody, for people.
    pub fn name_of(&self, who: ParticipantId) -> Option<&str> {
        self.seats.get(&who).map(|s| s.name.as_str())
    }

    /// How many are here.
    pub fn len(&self) -> usize {
        self.seats.len()
    }

    /// Whether nobody is here.
    pub fn is_empty(&self) -> bool {
        self.seats.is_empty()
    }

    /// How many of those here have a tool.
    pub fn tools(&self) -> usize {
        self.seats.values().filter(|s| s.role.has_tool()).count()
    }
}

fn placed(participant: ParticipantId, description: ToolDescription, shown: &Shown) -> ToolAt {
    ToolAt {
        participant,
        description,
        position: Vec3::from(shown.pose.position_m),
        orientation: orientation(&shown.pose),
        buttons: shown.buttons,
        stale: shown.stale,
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Pose;

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
    fn a_blade_with_its_button_held_does_not_press() {
        let mut roster = Roster::new(&[entry(1, ToolKind::Scalpel), entry(2, ToolKind::Probe)]);
        for who in [1, 2] {
            roster.insert(ParticipantId(who), sample(0, 1));
            roster.insert(ParticipantId(who), sample(1000, 1));
        }
        let tools = roster.tools_seen_at(ServerTime::from_micros(500));
        assert!(tools[0].is_cutting() && tools[0].contacts().next().is_none());
        assert!(tools[1].contacts().next().is_some());
    }

    #[test]
    fn a_lifted_tool_is_nowhere_and_back_when_it_is_set_down() {
        let (me, at) = (ParticipantId(1), ServerTime::from_micros(500));
        let mut roster = Roster::new(&[entry(1, ToolKind::Probe)]);
        for us in [0, 1000] {
            roster.insert(me, sample(us, 0));
        }
        roster.lift(me, true);
        assert!(roster.tools_seen_at(at).is_empty() && roster.tool_of(me).is_none());
        assert!(roster.tools_felt_at(at, ParticipantId(2)).is_empty());
        roster.lift(me, false);
        assert_eq!(roster.tools_seen_at(at).len(), 1);
    }

    #[test]
    fn a_tool_that_is_not_heard_of_does_not_press_and_one_that_left_is_gone() {
        let mut roster = Roster::new(&[entry(1, ToolKind::Probe)]);
        roster.insert(ParticipantId(1), sample(0, 0));
        let late = roster.tools_seen_at(ServerTime::from_micros(300_000));
        assert!(late[0].stale && late[0].contacts().next().is_none());
        roster.insert(ParticipantId(1), sample(300_000, 0));
        let now = ServerTime::from_micros(300_000);
        assert!(!roster.tools_seen_at(now)[0].stale);
        roster.lose(ParticipantId(1));
        assert!(roster.tools_seen_at(now).is_empty());
        roster.leave(ParticipantId(1));
        roster.insert(ParticipantId(1), sample(310_000, 0));
        assert!(
            roster
                .tools_seen_at(ServerTime::from_micros(310_000))
                .is_empty()
        );
    }
}
