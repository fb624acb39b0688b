//! The description of a tool that participants exchange.

use serde::{Deserialize, Serialize};

use crate::ParticipantId;

/// Longest tool, m. All sites solve for every tool, and a plate of half a metre would refine the whole model.
pub const TOOL_LENGTH_MAX_M: f64 = 0.2;

/// Bit of the buttons of a sample: the tissue holds the needle. The client that holds it decides, as on its pose; all
/// other sites follow.
pub const INSERTED_BUTTON: u8 = 1 << 7;

/// Parts of one tool at most.
const PARTS_MAX: u32 = 2;

/// A number for a part of a participant's tool, unique among the parts of all tools.
pub fn part_id(who: ParticipantId, part: usize) -> u32 {
    u32::from(who.0) * PARTS_MAX + part as u32
}

/// The participant that owns the part with this number.
pub fn part_owner(id: u32) -> ParticipantId {
    ParticipantId((id / PARTS_MAX) as u16)
}

/// Distance between the tips of open jaws, in parts of their length.
const OPENING: f64 = 0.25;

/// The shape of a tool as shown to other participants. In its own frame its tip, the pivot that a hand
/// holds, is at the origin, and its handle lies along z.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ToolDescription {
    /// Its kind.
    pub kind: ToolKind,
    /// Radius of its tip and of its edges, m: everything within it of the tool's [parts](Self::parts) is the tool.
    pub radius_m: f64,
    /// Length, m; zero for a probe.
    pub length_m: f64,
    /// Width, m; zero for a kind without a width.
    pub width_m: f64,
}

/// The tools that this version knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum ToolKind {
    /// A ball at the tip, which presses.
    Probe,
    /// An edge from the tip up z that cuts while its main button is held, and presses otherwise.
    Scalpel,
    /// Two jaws from a joint above the tip down to it, each as wide as the tool along y: closed while the main button is held.
    Grasper,
    /// A sharp line from the tip up z, which enters soft tissue.
    Needle,
    /// A rectangle around the tip: its length along x, its width along y.
    Plate,
}

/// The middle of a part of a tool and its half axes, in the tool's frame, m: the part is every `mid + s half[0] + t
/// half[1]` with s and t from -1 to 1. Axes that are zero leave a line or a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolPart {
    /// Its middle.
    pub mid: [f64; 3],
    /// Half its length and half its width, with their directions.
    pub half: [[f64; 3]; 2],
}

impl ToolPart {
    /// The origin.
    const TIP: Self = Self {
        mid: [0.0; 3],
        half: [[0.0; 3]; 2],
    };
}

impl ToolDescription {
    /// A ball.
    pub const fn probe(radius_m: f64) -> Self {
        Self {
            kind: ToolKind::Probe,
            radius_m,
            length_m: 0.0,
            width_m: 0.0,
        }
    }

    /// A blade with an edge of `length_m` (m).
    pub const fn scalpel(radius_m: f64, length_m: f64) -> Self {
        Self {
            kind: ToolKind::Scalpel,
            radius_m,
            length_m,
            width_m: 0.0,
        }
    }

    /// Whether the radius is between 0.1 mm and 100 mm, and length and width fit the kind: above zero
    /// and at most [`TOOL_LENGTH_MAX_M`], or zero.
    pub fn is_valid(&self) -> bool {
        let some = |x: f64| x > 0.0 && x <= TOOL_LENGTH_MAX_M;
        let sides = match self.kind {
            ToolKind::Probe => self.length_m == 0.0 && self.width_m == 0.0,
            ToolKind::Scalpel | ToolKind::Needle => some(self.length_m) && self.width_m == 0.0,
            ToolKind::Grasper | ToolKind::Plate => some(self.length_m) && some(self.width_m),
        };
        (1e-4..=0.1).contains(&self.radius_m) && sides
    }

    /// Its parts; `held` is the state of its main button. A grasper has two parts, every other tool one.
    pub fn parts(&self, held: bool) -> impl Iterator<Item = ToolPart> + use<> {
        let half = 0.5 * self.length_m;
        let across = [0.0, 0.5 * self.width_m, 0.0];
        let (first, second) = match self.kind {
            ToolKind::Probe => (ToolPart::TIP, None),
            ToolKind::Scalpel | ToolKind::Needle => {
                let line = ToolPart {
                    mid: [0.0, 0.0, half],
                    half: [[0.0, 0.0, half], [0.0; 3]],
                };
                (line, None)
            }
            ToolKind::Plate => {
                let plate = ToolPart {
                    half: [[half, 0.0, 0.0], across],
                    ..ToolPart::TIP
                };
                (plate, None)
            }
            ToolKind::Grasper => {
                // Closed jaws touch along their whole length; open ones meet at the joint.
                let tip = if held {
                    0.0
                } else {
                    0.5 * OPENING * self.length_m
                };
                let jaw = |side: f64| ToolPart {
                    mid: [side * (self.radius_m + 0.5 * tip), 0.0, half],
                    half: [[-side * 0.5 * tip, 0.0, half], across],
                };
                (jaw(1.0), Some(jaw(-1.0)))
            }
        };
        std::iter::once(first).chain(second)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tool(kind: ToolKind, length_m: f64, width_m: f64) -> ToolDescription {
        ToolDescription {
            kind,
            radius_m: 2e-3,
            length_m,
            width_m,
        }
    }

    #[test]
    fn tool_dimensions_match_its_kind() {
        assert!(ToolDescription::probe(4e-3).is_valid());
        assert!(ToolDescription::scalpel(5e-4, 0.02).is_valid());
        assert!(tool(ToolKind::Needle, 0.05, 0.0).is_valid());
        assert!(tool(ToolKind::Plate, 0.05, 0.02).is_valid());
        assert!(tool(ToolKind::Grasper, 0.03, 5e-3).is_valid());
        let bad = [
            ToolDescription::probe(0.0),
            ToolDescription::probe(f64::NAN),
            ToolDescription::scalpel(5e-4, 0.0),
            tool(ToolKind::Probe, 0.01, 0.0),
            tool(ToolKind::Needle, f64::NAN, 0.0),
            tool(ToolKind::Needle, 0.05, 0.01),
            tool(ToolKind::Plate, 0.05, 0.6),
            tool(ToolKind::Grasper, 0.05, -1.0),
        ];
        for b in bad {
            assert!(!b.is_valid(), "{b:?}");
        }
    }

    #[test]
    fn part_ids_are_unique_and_give_their_owner() {
        let ids: Vec<u32> = (0..3)
            .flat_map(|who| (0..2).map(move |part| part_id(ParticipantId(who), part)))
            .collect();
        assert!(ids.windows(2).all(|w| w[0] < w[1]));
        assert_eq!(part_owner(part_id(ParticipantId(u16::MAX), 1)).0, u16::MAX);
    }

    #[test]
    fn the_axes_of_a_part_are_at_right_angles_and_jaws_meet_when_closed() {
        let grasper = tool(ToolKind::Grasper, 0.04, 6e-3);
        for held in [false, true] {
            let jaws: Vec<ToolPart> = grasper.parts(held).collect();
            assert_eq!(jaws.len(), 2);
            for jaw in &jaws {
                let dot: f64 = (0..3).map(|i| jaw.half[0][i] * jaw.half[1][i]).sum();
                assert_eq!(dot, 0.0);
            }
            let tip = |jaw: &ToolPart| jaw.mid[0] - jaw.half[0][0];
            let joint = |jaw: &ToolPart| jaw.mid[0] + jaw.half[0][0];
            let apart = tip(&jaws[0]) - tip(&jaws[1]);
            let expected = if held { 4e-3 } else { 4e-3 + 0.01 };
            assert!((apart - expected).abs() < 1e-12, "{apart}");
            assert!((joint(&jaws[0]) - joint(&jaws[1]) - 4e-3).abs() < 1e-12);
        }
        assert_eq!(tool(ToolKind::Plate, 0.05, 0.02).parts(false).count(), 1);
    }
}
