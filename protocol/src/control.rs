//! The instructor's controls over a session.

use serde::{Deserialize, Serialize};

use crate::datagram::POSITION_MAX_M;
use crate::handshake::Role;
use crate::name::{is_visible, normalise};
use crate::operation::CompensationMode;
use crate::{Emulation, ParticipantId};

/// Longest text of an annotation, bytes.
pub const ANNOTATION_MAX_BYTES: usize = 200;

/// Largest force limit of a participant, N; above the limit of every supported device.
pub const FORCE_LIMIT_MAX_N: f64 = 100.0;

/// Largest cap of the playout delay, µs: beyond it the participants no longer work on one moment.
pub const CAP_MAX_US: u32 = 2_000_000;

/// Shortest lifetime of an invitation, s.
pub const LIFETIME_MIN_S: u32 = 60;

/// Longest lifetime of an invitation, s: 30 days.
pub const LIFETIME_MAX_S: u32 = 30 * 24 * 3600;

/// Largest node number of a model plus one, as in datagrams of displacements.
const NODES_MAX: u32 = 1 << 25;

/// A change of the session that the instructor requests.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Control {
    /// Makes a participant's tool inactive, or active again.
    Mute {
        /// The participant.
        participant: ParticipantId,
        /// Whether the tool becomes inactive.
        is_muted: bool,
    },
    /// Leaves only this participant's tool active: all other tools are muted.
    HandOver {
        /// The participant.
        participant: ParticipantId,
    },
    /// Holds the poses of all tools in the shared tissue and refuses cuts, or releases them.
    Freeze {
        /// Whether the session freezes.
        is_frozen: bool,
    },
    /// Returns to the uncut tissue. The undo history ends with it.
    Reset,
    /// Takes back the last cut in effect, of any author.
    Undo,
    /// Repeats the last cut that was taken back.
    Redo,
    /// Lowers the force limit of a participant's device.
    ForceLimit {
        /// The participant.
        participant: ParticipantId,
        /// The limit in N, above 0 and at most [`FORCE_LIMIT_MAX_N`]; `None` for that of the device alone.
        newtons: Option<f64>,
    },
    /// Removes a participant, who may join again.
    Kick {
        /// The participant.
        participant: ParticipantId,
    },
    /// Removes a participant. Names that look like the participant's are refused for the rest of the session.
    Ban {
        /// The participant.
        participant: ParticipantId,
    },
    /// Refuses further joins, or permits them again. Lost seats can always be resumed.
    Lock {
        /// Whether the session is locked.
        is_locked: bool,
    },
    /// Changes the numbers of seats. Present participants keep theirs.
    Capacity {
        /// Seats in total.
        seats: u16,
        /// Seats that spectators and recorders may take together.
        spectators: u16,
    },
    /// Changes the rule for the playout delay, and its cap.
    Compensation {
        /// The rule.
        mode: CompensationMode,
    },
    /// Places an annotation, or replaces the one with its number.
    Annotate(Annotation),
    /// Removes an annotation.
    RemoveAnnotation {
        /// Its number.
        id: u32,
    },
    /// Shows one view direction to all participants.
    ShowCamera(CameraView),
    /// Creates an invitation. Its number and grant are returned to the requester alone, in an
    /// [`Invitation`](crate::request::Invitation).
    Invite {
        /// The role that it allows.
        role: Role,
        /// The only name that may use it, [normalised](crate::name::normalise); `None` for any name.
        name: Option<String>,
        /// Time until it expires in s, from [`LIFETIME_MIN_S`] to [`LIFETIME_MAX_S`].
        lifetime_s: u32,
        /// Whether the first join uses it up.
        is_single_use: bool,
    },
    /// Revokes an invitation: joins and resumptions with it are refused. Connected participants stay.
    RevokeInvitation {
        /// Its number.
        id: u32,
    },
    /// Emulates a network between the server and a participant, or ends that. The room refuses an emulation out of
    /// range with a sentence.
    Emulate {
        /// The participant.
        participant: ParticipantId,
        /// Delay and loss; [`Emulation::NONE`] ends it.
        emulation: Emulation,
    },
}

impl Control {
    /// Whether every number is finite and in range and every text is visible.
    pub fn is_valid(&self) -> bool {
        match self {
            Self::ForceLimit { newtons, .. } => newtons.is_none_or(is_force_limit),
            Self::Compensation { mode } => is_mode(*mode),
            Self::Annotate(annotation) => annotation.is_valid(),
            Self::ShowCamera(view) => view.is_valid(),
            Self::Invite {
                name, lifetime_s, ..
            } => {
                name.as_deref().is_none_or(is_name)
                    && (LIFETIME_MIN_S..=LIFETIME_MAX_S).contains(lifetime_s)
            }
            Self::Mute { .. }
            | Self::HandOver { .. }
            | Self::Freeze { .. }
            | Self::Reset
            | Self::Undo
            | Self::Redo
            | Self::Kick { .. }
            | Self::Ban { .. }
            | Self::Lock { .. }
            | Self::Capacity { .. }
            | Self::RemoveAnnotation { .. }
            | Self::RevokeInvitation { .. }
            | Self::Emulate { .. } => true,
        }
    }
}

/// Whether a name is in its normal form.
pub(crate) fn is_name(name: &str) -> bool {
    normalise(name).is_ok_and(|normal| normal == name)
}

/// Whether a force limit in N is in range.
pub(crate) fn is_force_limit(newtons: f64) -> bool {
    newtons > 0.0 && newtons <= FORCE_LIMIT_MAX_N
}

/// Whether the cap of a compensation mode is in range.
pub(crate) const fn is_mode(mode: CompensationMode) -> bool {
    match mode {
        CompensationMode::None | CompensationMode::Fixed => true,
        CompensationMode::Adaptive { cap_us } => cap_us <= CAP_MAX_US,
    }
}

/// A text at a place of the tissue.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Annotation {
    /// Its number. In a request, 0 asks the server for a new number.
    pub id: u32,
    /// Visible characters and white space, at most [`ANNOTATION_MAX_BYTES`].
    pub text: String,
    /// Its mark.
    pub kind: AnnotationKind,
    /// Its place.
    pub anchor: Anchor,
    /// The tail of an arrow relative to the anchor, world frame, metres; zero for a pin.
    pub offset_m: [f64; 3],
}

/// The mark of an annotation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum AnnotationKind {
    /// A pin at the anchor.
    Pin,
    /// An arrow whose head is at the anchor.
    Arrow,
}

/// A point on a triangle of the tissue, which moves with it. Cuts keep the numbers of nodes. An anchor whose nodes do
/// not exist in a topology has no place there.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Anchor {
    /// The nodes of the triangle.
    pub nodes: [u32; 3],
    /// Barycentric weights, each from 0 to 1 and together 1.
    pub weights: [f32; 3],
}

impl Annotation {
    /// Whether the text is visible and not too long, the weights are barycentric, and the offset is in range.
    pub fn is_valid(&self) -> bool {
        self.text.len() <= ANNOTATION_MAX_BYTES
            && is_visible(&self.text)
            && self.anchor.is_valid()
            && is_place(&self.offset_m)
    }
}

impl Anchor {
    fn is_valid(&self) -> bool {
        let sum: f32 = self.weights.iter().sum();
        self.nodes.iter().all(|n| *n < NODES_MAX)
            && self.weights.iter().all(|w| (0.0..=1.0).contains(w))
            && (sum - 1.0).abs() <= 1e-3
    }
}

/// A view direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraView {
    /// The eye, world frame, metres.
    pub position_m: [f64; 3],
    /// The point in the middle of the picture, world frame, metres.
    pub target_m: [f64; 3],
    /// Unit vector that points up in the picture.
    pub up: [f64; 3],
}

impl CameraView {
    /// Whether the places are in range, the eye is at least 1 mm from its target, and `up` is a unit vector that is
    /// not along the line of sight.
    pub fn is_valid(&self) -> bool {
        let norm = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let sight: [f64; 3] = std::array::from_fn(|i| self.target_m[i] - self.position_m[i]);
        let along: f64 = (0..3).map(|i| sight[i] * self.up[i]).sum();
        is_place(&self.position_m)
            && is_place(&self.target_m)
            && norm(sight) >= 1e-3
            && (norm(self.up) - 1.0).abs() < 1e-3
            && along.abs() < 0.999 * norm(sight)
    }
}

/// Whether a place or an offset is finite and in the range of positions.
fn is_place(place_m: &[f64; 3]) -> bool {
    place_m.iter().all(|x| x.abs() <= POSITION_MAX_M)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::examples::{CAMERA, annotation};

    #[test]
    fn text_and_anchor_of_an_annotation_are_checked() {
        assert!(annotation().is_valid());
        let with = |change: fn(&mut Annotation)| {
            let mut changed = annotation();
            change(&mut changed);
            changed.is_valid()
        };
        assert!(with(|a| a.text = "x".repeat(ANNOTATION_MAX_BYTES)));
        assert!(!with(|a| a.text = "x".repeat(ANNOTATION_MAX_BYTES + 1)));
        assert!(!with(|a| a.text = "left\u{202e}right".to_owned()));
        assert!(!with(|a| a.text = "two\nlines".to_owned()));
        assert!(!with(|a| a.anchor.weights = [f32::NAN, 0.5, 0.5]));
        assert!(!with(|a| a.anchor.weights = [0.5, 0.5, 0.5]));
        assert!(!with(|a| a.anchor.weights = [2.0, -0.5, -0.5]));
        assert!(!with(|a| a.anchor.nodes[2] = u32::MAX));
        assert!(!with(|a| a.offset_m[1] = f64::INFINITY));
    }

    #[test]
    fn camera_has_a_line_of_sight() {
        assert!(CAMERA.is_valid());
        let bad = [
            CameraView {
                target_m: CAMERA.position_m,
                ..CAMERA
            },
            CameraView {
                up: [0.0; 3],
                ..CAMERA
            },
            CameraView {
                up: [f64::NAN, 0.0, 1.0],
                ..CAMERA
            },
            CameraView {
                position_m: [1.0, 0.0, 0.0],
                target_m: [0.0; 3],
                up: [1.0, 0.0, 0.0],
            },
        ];
        for view in bad {
            assert!(!view.is_valid(), "{view:?}");
        }
    }

    #[test]
    fn lifetime_and_name_of_an_invitation_are_checked() {
        let invite = |name: Option<&str>, lifetime_s| {
            let control = Control::Invite {
                role: Role::Trainee,
                name: name.map(str::to_owned),
                lifetime_s,
                is_single_use: true,
            };
            control.is_valid()
        };
        assert!(invite(None, LIFETIME_MIN_S) && invite(Some("Bo Li"), LIFETIME_MAX_S));
        assert!(!invite(None, LIFETIME_MIN_S - 1) && !invite(None, LIFETIME_MAX_S + 1));
        for name in ["", " Bo", "Bo  Li", "B\u{200b}o", &"x".repeat(65)] {
            assert!(!invite(Some(name), LIFETIME_MIN_S), "{name:?}");
        }
    }

    #[test]
    fn force_limits_and_caps_are_bounded() {
        let limit = |newtons| Control::ForceLimit {
            participant: ParticipantId(1),
            newtons,
        };
        assert!(limit(None).is_valid() && limit(Some(3.0)).is_valid());
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 2.0 * FORCE_LIMIT_MAX_N] {
            assert!(!limit(Some(bad)).is_valid(), "{bad}");
        }
        let mode = |cap_us| Control::Compensation {
            mode: CompensationMode::Adaptive { cap_us },
        };
        assert!(mode(CAP_MAX_US).is_valid() && !mode(CAP_MAX_US + 1).is_valid());
    }
}
