//! A participant who joins late, or resumes, knows the state that the controls have set.

use std::collections::{BTreeMap, BTreeSet};

use palpate_protocol::control::{Annotation, CameraView, Control};
use palpate_protocol::examples;
use palpate_protocol::handshake::{Resume, Welcome};
use palpate_protocol::operation::HeldTool;
use palpate_protocol::{Emulation, OperationId, ParticipantId};
use proptest::prelude::*;

use super::controls::{ANN, Lesson, freeze, mute, resume_of};
use super::*;

/// The state that a participant knows from the log.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct State {
    tools: BTreeMap<ParticipantId, Option<ToolDescription>>,
    pub(super) muted: BTreeSet<ParticipantId>,
    pub(super) held: Option<Vec<HeldTool>>,
    force_limits: BTreeMap<ParticipantId, f64>,
    emulations: BTreeMap<ParticipantId, Emulation>,
    access: Option<(bool, u16, u16)>,
    mode: Option<CompensationMode>,
    annotations: BTreeMap<u32, Annotation>,
    camera: Option<CameraView>,
    /// Open invitations with their expiry.
    invitations: BTreeMap<u32, ServerTime>,
}

impl State {
    pub(super) fn of(operations: &[Arc<Operation>]) -> Self {
        let mut state = Self::default();
        for operation in operations {
            state.apply(&operation.kind);
        }
        state
    }

    /// The state at a time: clients drop expired invitations on their own.
    fn at(operations: &[Arc<Operation>], now: ServerTime) -> Self {
        let mut state = Self::of(operations);
        state.invitations.retain(|_, expires_at| now < *expires_at);
        state
    }

    fn apply(&mut self, kind: &OperationKind) {
        match kind {
            OperationKind::Joined {
                participant, tool, ..
            } => drop(self.tools.insert(*participant, *tool)),
            OperationKind::ToolChanged { participant, tool } => {
                self.tools.insert(*participant, Some(*tool));
            }
            OperationKind::Left { participant, .. } => {
                self.tools.remove(participant);
                self.muted.remove(participant);
                self.force_limits.remove(participant);
                self.emulations.remove(participant);
            }
            OperationKind::Muted {
                participant,
                is_muted: true,
            } => drop(self.muted.insert(*participant)),
            OperationKind::Muted { participant, .. } => drop(self.muted.remove(participant)),
            OperationKind::Frozen { is_frozen, held } => {
                self.held = is_frozen.then(|| held.clone());
            }
            OperationKind::ForceLimit {
                participant,
                newtons,
            } => {
                self.force_limits.remove(participant);
                self.force_limits.extend(newtons.map(|n| (*participant, n)));
            }
            OperationKind::Emulated {
                participant,
                emulation,
            } => {
                self.emulations.insert(*participant, *emulation);
                self.emulations.retain(|_, e| !e.is_none());
            }
            OperationKind::Access {
                is_locked,
                seats,
                spectators,
            } => self.access = Some((*is_locked, *seats, *spectators)),
            OperationKind::CompensationMode { mode } => self.mode = Some(*mode),
            OperationKind::Annotated(a) => drop(self.annotations.insert(a.id, a.clone())),
            OperationKind::AnnotationRemoved { id } => drop(self.annotations.remove(id)),
            OperationKind::CameraShown(view) => self.camera = Some(*view),
            OperationKind::Invited { id, expires_at, .. } => {
                self.invitations.insert(*id, *expires_at);
            }
            OperationKind::InvitationUsed { id } | OperationKind::InvitationRevoked { id } => {
                self.invitations.remove(id);
            }
            _ => {}
        }
    }
}

/// A step of a random lesson.
#[derive(Debug, Clone)]
enum Step {
    Control(Control),
    SetTool(u64, f64),
    Join(u64),
    Lose(u64),
    Resume(u64),
    Pass(i64),
}

fn step() -> impl Strategy<Value = Step> {
    let who = || (1_u16..6).prop_map(ParticipantId);
    let control = prop_oneof![
        (who(), any::<bool>()).prop_map(|(p, m)| mute(p, m)),
        who().prop_map(|participant| Control::HandOver { participant }),
        any::<bool>().prop_map(freeze),
        (who(), prop::option::of(0.5_f64..5.0)).prop_map(|(participant, newtons)| {
            Control::ForceLimit {
                participant,
                newtons,
            }
        }),
        (who(), 0_u16..3, 0_u16..2).prop_map(|(participant, delay_ms, loss_permille)| {
            let emulation = Emulation {
                delay_ms,
                loss_permille,
            };
            Control::Emulate {
                participant,
                emulation,
            }
        }),
        who().prop_map(|participant| Control::Kick { participant }),
        (4_u16..7).prop_map(|seats| Control::Capacity {
            seats,
            spectators: seats
        }),
        (100_000_u32..400_000).prop_map(|cap_us| Control::Compensation {
            mode: CompensationMode::Adaptive { cap_us }
        }),
        (0_u32..4, "[a-z]{0,9}").prop_map(|(id, text)| {
            Control::Annotate(Annotation {
                id,
                text,
                ..examples::annotation()
            })
        }),
        (1_u32..4).prop_map(|id| Control::RemoveAnnotation { id }),
        (60_u32..200).prop_map(|lifetime_s| Control::Invite {
            role: Role::Trainee,
            name: None,
            lifetime_s,
            is_single_use: false,
        }),
        (1_u32..4).prop_map(|id| Control::RevokeInvitation { id }),
        (0.1_f64..1.0).prop_map(|x| {
            Control::ShowCamera(CameraView {
                position_m: [x, 0.0, 0.0],
                ..examples::CAMERA
            })
        }),
    ];
    prop_oneof![
        6 => control.prop_map(Step::Control),
        2 => (2_u64..6, 0.001_f64..0.02).prop_map(|(peer, r)| Step::SetTool(peer, r)),
        2 => (2_u64..6).prop_map(Step::Join),
        1 => (2_u64..6).prop_map(Step::Lose),
        1 => (2_u64..6).prop_map(Step::Resume),
        4 => (1_i64..50_000).prop_map(Step::Pass),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// Ann has been there from the beginning, Zoe joins last, and a client that resumes with any part of the log has the
    /// same state as both.
    #[test]
    fn late_joiner_and_resumed_client_have_the_state_of_an_early_one(
        steps in prop::collection::vec(step(), 1..60),
        missed in any::<prop::sample::Index>(),
    ) {
        let mut lesson = Lesson::new();
        let mut seen = lesson.operations();
        for step in steps {
            match step {
                Step::Control(control) => drop(lesson.control(control)),
                Step::SetTool(peer, radius) => {
                    let tool = ToolDescription::probe(radius);
                    let _ = lesson.request(peer, RequestKind::SetTool(tool));
                }
                Step::Join(peer) => drop(lesson.join(peer, &format!("p{peer}"), Role::Trainee)),
                Step::Lose(peer) => {
                    let lost = CloseReason::ConnectionLost("a test".into());
                    lesson.event(peer, PeerEvent::Closed(lost));
                }
                Step::Resume(peer) => {
                    let resume = resume_of(ParticipantId(peer as u16));
                    lesson.join_with(peer, &format!("p{peer}"), Role::Trainee, Some(resume));
                }
                Step::Pass(millis) => {
                    for _ in 0..5 {
                        lesson.now = lesson.now + Span::from_millis(millis / 5);
                        lesson.tick();
                        seen.extend(operations(&lesson.outputs, PeerKey(1)));
                    }
                }
            }
            seen.extend(operations(&lesson.outputs, PeerKey(1)));
        }
        let early = State::at(&seen, lesson.now);
        // A client of Ann's seat that missed the end of the log.
        let last = missed.index(seen.len());
        let known = &seen[..=last];
        let resume = Resume {
            next_operation: known[last].id.next(),
            topology_version: known[last].topology_version_after,
            topology_hash: known[last].hash_after,
            ..resume_of(ANN)
        };
        lesson.event(1, PeerEvent::Closed(CloseReason::ConnectionLost("a test".into())));
        prop_assert_eq!(lesson.join_with(1, "ann", Role::Instructor, Some(resume)), None);
        let first = welcome(&lesson.outputs, PeerKey(1)).first_operation;
        let mut all = if first == OperationId(0) { Vec::new() } else { known.to_vec() };
        all.extend(operations(&lesson.outputs, PeerKey(1)));
        let resumed = State::at(&all, lesson.now);
        // The roster of a welcome has the tools of the participants.
        prop_assert_eq!(&without_tools(&resumed), &without_tools(&early));
        let zoe = lesson.join(9, "zoe", Role::Instructor);
        prop_assume!(zoe.is_none());
        // Her join may have taken a kept seat.
        seen.extend(operations(&lesson.outputs, PeerKey(1)));
        let early = State::at(&seen, lesson.now);
        let late = State::at(&operations(&lesson.outputs, PeerKey(9)), lesson.now);
        prop_assert_eq!(&late, &early);
    }
}

fn without_tools(state: &State) -> State {
    State {
        tools: BTreeMap::new(),
        ..state.clone()
    }
}

fn welcome(outputs: &[Output], to: PeerKey) -> Welcome {
    let mut welcomes = outputs.iter().filter_map(|o| match o {
        Output::Message(peer, PeerMessage::Welcome(w)) if *peer == to => Some((**w).clone()),
        _ => None,
    });
    welcomes.next().unwrap()
}
