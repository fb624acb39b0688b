//! The poses of the tools at the displayed time, as a message for pages.

use palpate_protocol::{ParticipantId, Pose, ServerTime, Span};

/// Number of this message, see `WIRE.md`.
pub(crate) const KIND: u8 = 3;

const ACTIVE: u8 = 1;
const OWN_DEVICE: u8 = 2;
const OWN_PROXY: u8 = 4;

/// The owner and the time of a pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ShownTool {
    /// A participant's tool at the displayed time, as all sites show it.
    #[default]
    Shared,
    /// The own device at present.
    OwnDevice,
    /// The own tool at present, moved to where the tissue would no longer press it.
    OwnProxy,
}

/// One tool.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ToolPose {
    /// Its owner.
    pub participant: ParticipantId,
    /// The owner and the time of a pose.
    pub shown: ShownTool,
    /// Whether it presses and cuts.
    pub is_active: bool,
    /// One bit per button.
    pub buttons: u8,
    /// Where it is.
    pub pose: Pose,
    /// Force on it, N.
    pub force_n: [f64; 3],
    /// Whether it returns from a hold; pages then show it with bounded steps.
    pub returns: bool,
}

/// All tools at one displayed time.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ToolFrame {
    /// Playout delay D.
    pub delay: Span,
    /// The displayed time s.
    pub time: ServerTime,
    /// The time of sending.
    pub sent: ServerTime,
    /// The tools.
    pub tools: Vec<ToolPose>,
}

impl ToolFrame {
    /// The message.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![KIND, 0];
        bytes.extend((self.tools.len() as u16).to_le_bytes());
        bytes.extend((self.delay.as_millis_f64() as f32).to_le_bytes());
        for time in [self.time, self.sent] {
            bytes.extend((time.as_micros() as f64).to_le_bytes());
        }
        for tool in &self.tools {
            bytes.extend(tool.participant.0.to_le_bytes());
            let shown = match tool.shown {
                ShownTool::Shared => 0,
                ShownTool::OwnDevice => OWN_DEVICE,
                ShownTool::OwnProxy => OWN_PROXY,
            };
            bytes.push(shown | if tool.is_active { ACTIVE } else { 0 });
            bytes.push(tool.buttons);
            let Pose {
                position_m,
                orientation,
            } = tool.pose;
            for x in position_m.iter().chain(&orientation).chain(&tool.force_n) {
                bytes.extend((*x as f32).to_le_bytes());
            }
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tools_have_the_layout_of_the_document() {
        let frame = ToolFrame {
            delay: Span::from_millis(120),
            tools: vec![ToolPose {
                participant: ParticipantId(513),
                shown: ShownTool::OwnProxy,
                is_active: true,
                buttons: 1,
                force_n: [0.0, 0.0, 2.0],
                ..ToolPose::default()
            }],
            ..ToolFrame::default()
        };
        let bytes = frame.encode();
        assert_eq!(bytes.len(), 24 + 44);
        assert_eq!(bytes[..8], [3, 0, 1, 0, 0, 0, 0xf0, 0x42]);
        assert_eq!(bytes[24..28], [1, 2, 5, 1]);
        assert_eq!(bytes[64..], 2.0_f32.to_le_bytes());
    }
}
