//! A tool at one time, and its contact geometry.

use nalgebra::UnitQuaternion;
use palpate_protocol::ParticipantId;
use palpate_protocol::operation::HeldTool;
use palpate_protocol::timeline::Shown;
use palpate_protocol::tool::{INSERTED_BUTTON, ToolDescription, ToolKind, part_id};
use palpate_tissue::{BladePoint, Form, Needle, Tool, Vec3};

use super::convert::orientation;

/// A tool at one time, with all data that the tissue needs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolAt {
    /// Participant that holds it.
    pub participant: ParticipantId,
    /// Kind and size.
    pub description: ToolDescription,
    /// Position of its tip, m.
    pub position: Vec3,
    /// Rotation from its own frame to the scene's.
    pub orientation: UnitQuaternion<f64>,
    /// One bit per button; bit 0 is the main one.
    pub buttons: u8,
    /// Share of its contact force: below 1 while its samples are missing, 0 if it presses no more.
    pub strength: f64,
    /// Whether it returns from a hold, so that pictures limit its steps.
    pub returns: bool,
}

/// Lever that converts a rotation into a distance, m: the length of a long tool.
const LEVER_M: f64 = 0.05;

impl ToolAt {
    /// The tool of a participant, as its timeline shows it.
    pub(super) fn shown(
        participant: ParticipantId,
        description: ToolDescription,
        shown: &Shown,
    ) -> Self {
        Self {
            participant,
            description,
            position: Vec3::from(shown.pose.position_m),
            orientation: orientation(&shown.pose),
            buttons: shown.buttons,
            strength: shown.strength,
            returns: shown.returns,
        }
    }

    /// A tool that holds its pose.
    pub(super) fn held(description: ToolDescription, held: &HeldTool) -> Self {
        Self {
            participant: held.participant,
            description,
            position: Vec3::from(held.pose.position_m),
            orientation: orientation(&held.pose),
            buttons: held.buttons,
            strength: 1.0,
            returns: false,
        }
    }

    /// Whether both are the same tool in the same state.
    pub fn is_alike(&self, other: &Self) -> bool {
        let state = |t: &Self| (t.participant, t.description, t.buttons, t.strength);
        state(self) == state(other)
    }

    /// Whether both are the same tool in the same state, less than `way_m` apart.
    pub fn is_within(&self, other: &Self, way_m: f64) -> bool {
        let moved = (self.position - other.position).norm()
            + LEVER_M * self.orientation.angle_to(&other.orientation);
        self.is_alike(other) && moved < way_m
    }

    /// Whether it is a cutting blade: its main button is held.
    pub fn is_cutting(&self) -> bool {
        self.description.kind == ToolKind::Scalpel && self.buttons & 1 == 1
    }

    /// Its edge, if it is a cutting blade.
    pub(crate) fn edge(&self) -> Option<BladePoint> {
        self.is_cutting().then(|| BladePoint {
            tip: self.position,
            axis: self.orientation * Vec3::z(),
            depth_m: self.description.length_m,
        })
    }

    /// Whether it is a needle in the tissue, by the decision of its holder.
    pub fn is_inserted(&self) -> bool {
        self.description.kind == ToolKind::Needle && self.buttons & INSERTED_BUTTON != 0
    }

    /// Contact geometry of the tool; empty if it cuts, presses no more or has an invalid pose.
    pub fn contacts(&self) -> impl Iterator<Item = Tool> + '_ {
        let held = self.buttons & 1 == 1;
        let parts = self.description.parts(held).enumerate();
        let presses = self.strength > 0.0 && !self.is_cutting();
        let needle = (self.description.kind == ToolKind::Needle).then_some(Needle {
            is_inserted: self.is_inserted(),
            decides: false,
        });
        parts
            .filter(move |_| presses)
            .map(move |(i, part)| Tool {
                turn: self.orientation,
                form: Form::rectangle(part.mid.into(), part.half.map(Vec3::from)),
                needle,
                strength: self.strength,
                ..Tool::ball(
                    part_id(self.participant, i),
                    self.position,
                    self.description.radius_m,
                )
            })
            .filter(Tool::is_sound)
    }
}

/// Collects the tools that can make contact, in the tissue's format.
pub(crate) fn gather<'a>(into: &mut Vec<Tool>, tools: impl Iterator<Item = &'a ToolAt>) {
    into.clear();
    into.extend(tools.flat_map(ToolAt::contacts));
}
