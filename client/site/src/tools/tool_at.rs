//! A tool at one time, and its contact geometry.

use nalgebra::UnitQuaternion;
use palpate_device::Pose;
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
    /// The pose for which the tissue is solved, predicted for the time at which the contact model is used; `None` for the
    /// tool's own.
    pub predicted: Option<Pose>,
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
            predicted: None,
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
            predicted: None,
        }
    }

    /// Whether both are the same tool in the same state.
    pub fn is_alike(&self, other: &Self) -> bool {
        let state = |t: &Self| (t.participant, t.description, t.buttons, t.strength);
        state(self) == state(other)
    }

    /// Whether both are the same tool in the same state, solved for poses less than `way_m` apart.
    pub fn is_within(&self, other: &Self, way_m: f64) -> bool {
        let [a, b] = [self.solved_pose(), other.solved_pose()];
        let moved =
            (a.position - b.position).norm() + LEVER_M * a.orientation.angle_to(&b.orientation);
        self.is_alike(other) && moved < way_m
    }

    /// For a blade, whether it cuts: its main button is held. `None` for other tools.
    pub(crate) fn blade_cuts(&self) -> Option<bool> {
        (self.description.kind == ToolKind::Scalpel).then_some(self.buttons & 1 == 1)
    }

    /// Whether it is a cutting blade.
    pub fn is_cutting(&self) -> bool {
        self.blade_cuts() == Some(true)
    }

    /// The pose for which the tissue is solved. A needle is not predicted: its channel keeps the farthest place that it reached.
    pub(crate) fn solved_pose(&self) -> Pose {
        let own = Pose {
            position: self.position,
            orientation: self.orientation,
        };
        let is_needle = self.description.kind == ToolKind::Needle;
        self.predicted.filter(|_| !is_needle).unwrap_or(own)
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
        let pose = self.solved_pose();
        let needle = (self.description.kind == ToolKind::Needle).then_some(Needle {
            is_inserted: self.is_inserted(),
            decides: false,
        });
        parts
            .filter(move |_| presses)
            .map(move |(i, part)| Tool {
                turn: pose.orientation,
                form: Form::rectangle(part.mid.into(), part.half.map(Vec3::from)),
                needle,
                strength: self.strength,
                ..Tool::ball(
                    part_id(self.participant, i),
                    pose.position,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tools_are_solved_where_they_are_predicted_and_needles_where_they_are() {
        let of = |description| ToolAt {
            participant: ParticipantId(1),
            description,
            position: Vec3::zeros(),
            orientation: UnitQuaternion::identity(),
            buttons: 0,
            strength: 1.0,
            returns: false,
            predicted: Some(Pose::at(Vec3::x())),
        };
        let needle = of(ToolDescription {
            kind: ToolKind::Needle,
            ..ToolDescription::scalpel(5e-4, 0.1)
        });
        let solved_m = |tool: ToolAt| tool.contacts().next().unwrap().centre.x;
        assert_eq!(solved_m(of(ToolDescription::probe(5e-3))), 1.0);
        assert_eq!(solved_m(needle), 0.0);
    }
}
