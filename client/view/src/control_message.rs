//! The instructor's controls as JSON, see `WIRE.md`.

use palpate_protocol::control::{Anchor, Annotation, AnnotationKind, CameraView, Control};
use palpate_protocol::name::normalise;
use palpate_protocol::operation::CompensationMode;
use palpate_protocol::{Emulation, ParticipantId, Role};
use serde::{Deserialize, Serialize};

use crate::message::MessageError;

/// A control in a message.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "act", rename_all = "snake_case")]
pub(crate) enum ControlMessage {
    Mute {
        participant: u16,
        is_muted: bool,
    },
    HandOver {
        participant: u16,
    },
    Freeze {
        is_frozen: bool,
    },
    Reset,
    Undo,
    Redo,
    ForceLimit {
        participant: u16,
        newtons: Option<f64>,
    },
    Kick {
        participant: u16,
    },
    Ban {
        participant: u16,
    },
    Lock {
        is_locked: bool,
    },
    Capacity {
        seats: u16,
        spectators: u16,
    },
    Compensation {
        mode: ModeWord,
        ms: Option<f64>,
    },
    Annotate(AnnotationMessage),
    RemoveAnnotation {
        id: u32,
    },
    ShowCamera(CameraMessage),
    Invite {
        role: String,
        name: Option<String>,
        lifetime_s: u32,
        is_single_use: bool,
    },
    RevokeInvitation {
        id: u32,
    },
    Emulate {
        participant: u16,
        delay_ms: f64,
        loss_percent: f64,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum ModeWord {
    None,
    Fixed,
    Adaptive,
}

/// An emulated network in a state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EmulationMessage {
    /// One-way delay, ms.
    pub delay_ms: u16,
    /// Loss, percent.
    pub loss_percent: f64,
}

/// An annotation in a message.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AnnotationMessage {
    #[serde(default)]
    id: u32,
    text: String,
    kind: MarkWord,
    nodes: [u32; 3],
    weights: [f32; 3],
    #[serde(default)]
    offset_m: [f64; 3],
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum MarkWord {
    Pin,
    Arrow,
}

/// A view direction in a message.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraMessage {
    /// Counts the view directions that were shown, so that a page follows each once.
    #[serde(default)]
    pub(crate) id: u64,
    position_m: [f64; 3],
    target_m: [f64; 3],
    up: [f64; 3],
}

impl CameraMessage {
    /// A view direction with its number.
    pub fn new(id: u64, view: &CameraView) -> Self {
        let CameraView {
            position_m,
            target_m,
            up,
        } = *view;
        Self {
            id,
            position_m,
            target_m,
            up,
        }
    }
}

/// An emulation in whole ms and per mille. Too large a number saturates; the room refuses it with a sentence.
fn emulation(delay_ms: f64, loss_percent: f64) -> Result<Emulation, MessageError> {
    let whole = |x: f64| {
        let is_number = x.is_finite() && x >= 0.0;
        is_number.then(|| x.round() as u16)
    };
    let numbers = whole(delay_ms).zip(whole(loss_percent * 10.0));
    let (delay_ms, loss_permille) = numbers.ok_or(MessageError::Control)?;
    Ok(Emulation {
        delay_ms,
        loss_permille,
    })
}

impl From<Emulation> for EmulationMessage {
    fn from(emulation: Emulation) -> Self {
        Self {
            delay_ms: emulation.delay_ms,
            loss_percent: f64::from(emulation.loss_permille) / 10.0,
        }
    }
}

impl From<&Annotation> for AnnotationMessage {
    fn from(annotation: &Annotation) -> Self {
        Self {
            id: annotation.id,
            text: annotation.text.clone(),
            kind: match annotation.kind {
                AnnotationKind::Pin => MarkWord::Pin,
                AnnotationKind::Arrow => MarkWord::Arrow,
            },
            nodes: annotation.anchor.nodes,
            weights: annotation.anchor.weights,
            offset_m: annotation.offset_m,
        }
    }
}

impl ControlMessage {
    /// The control, with every number in range.
    pub(crate) fn check(self) -> Result<Control, MessageError> {
        let control = match self {
            Self::Mute {
                participant,
                is_muted,
            } => Control::Mute {
                participant: ParticipantId(participant),
                is_muted,
            },
            Self::HandOver { participant } => Control::HandOver {
                participant: ParticipantId(participant),
            },
            Self::Freeze { is_frozen } => Control::Freeze { is_frozen },
            Self::Reset => Control::Reset,
            Self::Undo => Control::Undo,
            Self::Redo => Control::Redo,
            Self::ForceLimit {
                participant,
                newtons,
            } => Control::ForceLimit {
                participant: ParticipantId(participant),
                newtons,
            },
            Self::Kick { participant } => Control::Kick {
                participant: ParticipantId(participant),
            },
            Self::Ban { participant } => Control::Ban {
                participant: ParticipantId(participant),
            },
            Self::Lock { is_locked } => Control::Lock { is_locked },
            Self::Capacity { seats, spectators } => Control::Capacity { seats, spectators },
            Self::Compensation { mode, ms } => Control::Compensation {
                mode: match mode {
                    ModeWord::None => CompensationMode::None,
                    ModeWord::Fixed => CompensationMode::Fixed,
                    ModeWord::Adaptive => CompensationMode::Adaptive {
                        // Too large a number saturates, and is then out of range.
                        cap_us: (ms.filter(|ms| *ms >= 0.0).ok_or(MessageError::Control)? * 1e3)
                            as u32,
                    },
                },
            },
            Self::Annotate(annotation) => Control::Annotate(Annotation {
                id: annotation.id,
                text: annotation.text,
                kind: match annotation.kind {
                    MarkWord::Pin => AnnotationKind::Pin,
                    MarkWord::Arrow => AnnotationKind::Arrow,
                },
                anchor: Anchor {
                    nodes: annotation.nodes,
                    weights: annotation.weights,
                },
                offset_m: annotation.offset_m,
            }),
            Self::RemoveAnnotation { id } => Control::RemoveAnnotation { id },
            Self::ShowCamera(camera) => Control::ShowCamera(CameraView {
                position_m: camera.position_m,
                target_m: camera.target_m,
                up: camera.up,
            }),
            Self::Invite {
                role,
                name,
                lifetime_s,
                is_single_use,
            } => Control::Invite {
                role: (role.parse::<Role>()).map_err(|e| MessageError::Role(e.to_string()))?,
                name: name.as_deref().map(normalise).transpose()?,
                lifetime_s,
                is_single_use,
            },
            Self::RevokeInvitation { id } => Control::RevokeInvitation { id },
            Self::Emulate {
                participant,
                delay_ms,
                loss_percent,
            } => Control::Emulate {
                participant: ParticipantId(participant),
                emulation: emulation(delay_ms, loss_percent)?,
            },
        };
        if control.is_valid() {
            Ok(control)
        } else {
            Err(MessageError::Control)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Control, String> {
        let message: ControlMessage = serde_json::from_str(text).map_err(|e| e.to_string())?;
        message.check().map_err(|e| e.to_string())
    }

    #[test]
    fn acts_are_read_and_checked() {
        let mute = Control::Mute {
            participant: ParticipantId(3),
            is_muted: true,
        };
        assert_eq!(
            parse(r#"{"act":"mute","participant":3,"is_muted":true}"#),
            Ok(mute)
        );
        let adaptive = Control::Compensation {
            mode: CompensationMode::Adaptive { cap_us: 250_000 },
        };
        assert_eq!(
            parse(r#"{"act":"compensation","mode":"adaptive","ms":250}"#),
            Ok(adaptive)
        );
        let invite = r#"{"act":"invite","role":"ROLE","name":" Bo  Li ","lifetime_s":3600,"is_single_use":true}"#;
        let invited = Control::Invite {
            role: Role::Trainee,
            name: Some("Bo Li".to_owned()),
            lifetime_s: 3600,
            is_single_use: true,
        };
        assert_eq!(parse(&invite.replace("ROLE", "trainee")), Ok(invited));
        let emulate = r#"{"act":"emulate","participant":3,"delay_ms":150,"loss_percent":LOSS}"#;
        let emulated = |loss_permille| Control::Emulate {
            participant: ParticipantId(3),
            emulation: Emulation {
                delay_ms: 150,
                loss_permille,
            },
        };
        assert_eq!(parse(&emulate.replace("LOSS", "5.54")), Ok(emulated(55)));
        // The room refuses it with a sentence.
        assert_eq!(
            parse(&emulate.replace("LOSS", "1e9")),
            Ok(emulated(u16::MAX))
        );
        let pin = r#"{"act":"annotate","text":"TEXT","kind":"pin","nodes":[1,2,3],"weights":[0.2,0.3,0.5]}"#;
        let Ok(Control::Annotate(annotation)) = parse(&pin.replace("TEXT", "<b>here</b>")) else {
            panic!("markup is text");
        };
        let back = AnnotationMessage::from(&annotation);
        assert_eq!((back.text.as_str(), back.nodes), ("<b>here</b>", [1, 2, 3]));
        for bad in [
            pin.replace("TEXT", &"x".repeat(2000)),
            pin.replace("0.2", "1e30"),
            r#"{"act":"force_limit","participant":1,"newtons":-1}"#.to_owned(),
            r#"{"act":"compensation","mode":"adaptive","ms":1e12}"#.to_owned(),
            r#"{"act":"compensation","mode":"adaptive"}"#.to_owned(),
            r#"{"act":"compensation","mode":"adaptive","ms":-5}"#.to_owned(),
            r#"{"act":"show_camera","position_m":[0,0,0],"target_m":[0,0,0],"up":[0,0,1]}"#
                .to_owned(),
            invite.replace("ROLE", "king"),
            invite.replace("ROLE", "trainee").replace("3600", "59"),
            invite.replace("ROLE", "trainee").replace(" Bo  Li ", ""),
            emulate.replace("LOSS", "-1"),
            emulate.replace("LOSS", "NaN"),
            emulate.replace("LOSS", "null"),
            emulate.replace("150", "-150").replace("LOSS", "1"),
            r#"{"act":"explode"}"#.to_owned(),
        ] {
            assert!(parse(&bad).is_err(), "{bad}");
        }
    }
}
