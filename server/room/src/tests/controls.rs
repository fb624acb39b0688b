//! Laws of the instructor's controls.

use std::collections::BTreeSet;

use palpate_protocol::control::{Annotation, Control};
use palpate_protocol::examples;
use palpate_protocol::handshake::Resume;
use palpate_protocol::{EMULATED_DELAY_MAX_MS, EMULATED_LOSS_MAX_PERMILLE};
use palpate_protocol::{Emulation, OperationId, ParticipantId};

use super::late_join::State;
use super::*;
use crate::TissueOrder;
use crate::room::Room;

const INSTRUCTOR: Grant = Grant([5; 16]);
pub(super) const ANN: ParticipantId = ParticipantId(1);
const BOB: ParticipantId = ParticipantId(2);

/// A room whose tissue is never solved: Ann, the instructor, and Bob, a trainee, with blades.
pub(super) struct Lesson {
    pub(super) room: Room,
    pub(super) now: ServerTime,
    requests: u32,
    /// Tools of the newest tick.
    pressing: usize,
    pub(super) outputs: Vec<Output>,
}

impl Lesson {
    pub(super) fn new() -> Self {
        let mut config = config(6, 0, CompensationMode::Fixed);
        config.grants.push((Role::Instructor, INSTRUCTOR));
        let mut lesson = Self {
            room: Room::new(TopologyHash(7), config, ms(0)),
            now: ms(0),
            requests: 0,
            pressing: 0,
            outputs: Vec::new(),
        };
        assert_eq!(lesson.join(1, "ann", Role::Instructor), None);
        assert_eq!(lesson.join(2, "bob", Role::Trainee), None);
        lesson
    }

    pub(super) fn event(&mut self, peer: u64, event: PeerEvent) {
        self.room.handle_event(PeerKey(peer), event, self.now);
        self.outputs = std::iter::from_fn(|| self.room.poll_output()).collect();
    }

    pub(super) fn join(&mut self, peer: u64, name: &str, role: Role) -> Option<RefusalReason> {
        self.join_with(peer, name, role, None)
    }

    pub(super) fn join_with(
        &mut self,
        peer: u64,
        name: &str,
        role: Role,
        resume: Option<Resume>,
    ) -> Option<RefusalReason> {
        let PeerEvent::Hello(mut hello) = hello(name, role, ToolKind::Scalpel) else {
            unreachable!()
        };
        if role == Role::Instructor {
            hello.grant = INSTRUCTOR;
        }
        hello.resume = resume;
        self.event(peer, PeerEvent::Hello(hello));
        refusal(&self.outputs)
    }

    pub(super) fn request(&mut self, peer: u64, kind: RequestKind) -> Result<(), RequestRefusal> {
        self.requests += 1;
        let id = RequestId(self.requests);
        self.event(peer, PeerEvent::Request(Request { id, kind }));
        let refused = self.outputs.iter().find_map(|o| match o {
            Output::Message(to, PeerMessage::RequestRefused(r)) if *to == PeerKey(peer) => {
                Some(r.reason.clone())
            }
            _ => None,
        });
        refused.map_or(Ok(()), Err)
    }

    pub(super) fn control(&mut self, control: Control) -> Result<(), RequestRefusal> {
        self.request(1, RequestKind::Control(control))
    }

    /// Moves on by ticks and lets Bob press meanwhile, at the height of his time in seconds.
    fn press_for(&mut self, millis: i64) {
        for _ in 0..millis / 20 {
            let t = self.now.as_micros() / 1000;
            let sample = |t: i64| ToolSample {
                time: ms(t),
                pose: Pose {
                    position_m: [0.0, 0.0, t as f64 * 1e-3],
                    ..Pose::IDENTITY
                },
                buttons: 0,
                force_n: None,
            };
            self.now = ms(t + 20);
            let samples = (t..t + 20).map(sample).collect();
            self.event(2, PeerEvent::Motion(PeerMotion::on_time(samples, self.now)));
            self.tick();
        }
    }

    pub(super) fn tick(&mut self) {
        self.room.handle_tick(self.now);
        self.room.handle_report(settled(), self.now);
        while let Some(order) = self.room.poll_order() {
            if let TissueOrder::Settle(settling) = order {
                self.pressing = settling.tools.len();
            }
        }
        self.outputs = std::iter::from_fn(|| self.room.poll_output()).collect();
    }

    pub(super) fn operations(&self) -> Vec<Arc<Operation>> {
        self.room.operations_since(OperationId(0)).to_vec()
    }

    fn bob_at(&mut self, t: ServerTime) -> Option<f64> {
        let tools = self.room.pressing_at(BOB, t);
        tools.first().map(|tool| tool.centre.z)
    }
}

pub(super) fn settled() -> crate::TissueReport {
    crate::TissueReport::Settled {
        tick: crate::TickReport {
            view_time: ms(0),
            tools: 0,
            iterations: 0,
            residual: 0.0,
            active_nodes: 0,
        },
        inserted: Vec::new(),
        corrections: None,
        picture: None,
    }
}

pub(super) fn mute(participant: ParticipantId, is_muted: bool) -> Control {
    Control::Mute {
        participant,
        is_muted,
    }
}

pub(super) fn freeze(is_frozen: bool) -> Control {
    Control::Freeze { is_frozen }
}

fn emulate(participant: ParticipantId, delay_ms: u16, loss_permille: u16) -> Control {
    let emulation = Emulation {
        delay_ms,
        loss_permille,
    };
    Control::Emulate {
        participant,
        emulation,
    }
}

fn every_control(participant: ParticipantId) -> Vec<Control> {
    let mut all = vec![
        mute(participant, true),
        Control::HandOver { participant },
        freeze(true),
        Control::Reset,
        Control::Undo,
        Control::Redo,
        Control::ForceLimit {
            participant,
            newtons: Some(1.0),
        },
        emulate(participant, 100, 50),
        Control::Kick { participant },
        Control::Ban { participant },
        Control::Lock { is_locked: true },
        Control::Capacity {
            seats: 1,
            spectators: 0,
        },
        Control::Compensation {
            mode: CompensationMode::None,
        },
        Control::RemoveAnnotation { id: 1 },
        Control::ShowCamera(examples::CAMERA),
    ];
    all.push(Control::Annotate(examples::annotation()));
    all
}

#[test]
fn control_of_a_trainee_is_refused_and_changes_nothing() {
    let mut lesson = Lesson::new();
    let before = lesson.operations();
    for control in every_control(ANN) {
        let refused = lesson.request(2, RequestKind::Control(control.clone()));
        assert_eq!(refused, Err(RequestRefusal::NotAllowed), "{control:?}");
    }
    assert_eq!(lesson.operations(), before);
    assert_eq!(lesson.room.participant_count(), 2);
    assert_eq!(lesson.join(3, "cid", Role::Spectator), None);
}

#[test]
fn unknown_participants_and_values_out_of_range_are_refused() {
    let mut lesson = Lesson::new();
    lesson.join(3, "cid", Role::Spectator);
    let before = lesson.operations();
    let nobody = ParticipantId(9);
    for control in [
        mute(nobody, true),
        Control::HandOver {
            participant: nobody,
        },
        Control::Kick {
            participant: nobody,
        },
        Control::Ban {
            participant: nobody,
        },
        emulate(nobody, 100, 50),
    ] {
        let refused = lesson.control(control);
        assert_eq!(refused, Err(RequestRefusal::UnknownParticipant));
    }
    for control in [
        mute(ParticipantId(3), true),
        Control::Kick { participant: ANN },
        Control::Capacity {
            seats: 65,
            spectators: 1,
        },
        Control::Capacity {
            seats: 2,
            spectators: 3,
        },
        Control::RemoveAnnotation { id: 1 },
        Control::Annotate(examples::annotation()),
        emulate(BOB, EMULATED_DELAY_MAX_MS + 1, 0),
        emulate(BOB, 0, EMULATED_LOSS_MAX_PERMILLE + 1),
        emulate(BOB, u16::MAX, u16::MAX),
    ] {
        let refused = lesson.control(control.clone());
        assert!(
            matches!(refused, Err(RequestRefusal::OutOfRange(_))),
            "{control:?}: {refused:?}"
        );
    }
    assert_eq!(lesson.operations(), before);
}

#[test]
fn muted_tool_neither_presses_nor_cuts_until_it_is_active_again() {
    let mut lesson = Lesson::new();
    lesson.press_for(200);
    assert_eq!(lesson.pressing, 1);
    let muted_at = lesson.now;
    lesson.control(mute(BOB, true)).unwrap();
    assert_eq!(
        lesson.request(2, stroke()),
        Err(RequestRefusal::Muted),
        "a muted blade does not cut"
    );
    assert!(
        lesson
            .bob_at(ms(muted_at.as_micros() / 1000 - 15))
            .is_some(),
        "earlier views still show it"
    );
    lesson.press_for(200);
    assert_eq!(lesson.pressing, 0);
    let relayed = |o: &Output| matches!(o, Output::Datagram(_, PeerDatagram::Motion(_)));
    assert!(!lesson.outputs.iter().any(relayed));
    lesson.control(mute(BOB, false)).unwrap();
    lesson.press_for(200);
    assert_eq!(lesson.pressing, 1);
    assert_ne!(lesson.request(2, stroke()), Err(RequestRefusal::Muted));
}

#[test]
fn silent_tool_presses_for_half_a_second_then_fades() {
    let mut lesson = Lesson::new();
    lesson.press_for(400);
    let newest_ms = lesson.now.as_micros() / 1000 - 1;
    let mut strength_after = |silent_ms: i64| {
        let tools = lesson.room.pressing_at(BOB, ms(newest_ms + silent_ms));
        tools.first().map(|tool| tool.strength)
    };
    assert_eq!(strength_after(500), Some(1.0));
    assert_eq!(strength_after(750), Some(0.5));
    assert_eq!(strength_after(1000), None);
}

#[test]
fn mute_outlasts_a_reconnect() {
    let mut lesson = Lesson::new();
    lesson.press_for(100);
    lesson.control(mute(BOB, true)).unwrap();
    lesson.event(
        2,
        PeerEvent::Closed(CloseReason::ConnectionLost("a test".into())),
    );
    let resume = resume_of(BOB);
    assert_eq!(
        lesson.join_with(2, "bob", Role::Trainee, Some(resume)),
        None
    );
    lesson.press_for(200);
    assert_eq!(lesson.pressing, 0);
}

#[test]
fn emulation_is_logged_when_it_changes_and_lasts_as_long_as_the_seat() {
    let mut lesson = Lesson::new();
    let of_bob = |lesson: &Lesson| {
        let figures = lesson.room.seat_figures();
        let seat = figures.iter().find(|f| f.id == BOB).unwrap();
        (seat.peer, seat.emulation.delay_ms)
    };
    let logged = |lesson: &Lesson| {
        let is = |o: &&Arc<Operation>| matches!(o.kind, OperationKind::Emulated { .. });
        lesson.operations().iter().filter(is).count()
    };
    let largest = emulate(BOB, EMULATED_DELAY_MAX_MS, EMULATED_LOSS_MAX_PERMILLE);
    for (control, count) in [
        (emulate(BOB, 0, 0), 0),
        (emulate(BOB, 100, 50), 1),
        (emulate(BOB, 100, 50), 1),
        (emulate(BOB, 0, 0), 2),
        (largest, 3),
    ] {
        lesson.control(control).unwrap();
        assert_eq!(logged(&lesson), count);
    }
    lesson.event(
        2,
        PeerEvent::Closed(CloseReason::ConnectionLost("a test".into())),
    );
    assert_eq!(of_bob(&lesson), (None, EMULATED_DELAY_MAX_MS));
    let resumed = lesson.join_with(3, "bob", Role::Trainee, Some(resume_of(BOB)));
    assert_eq!(resumed, None);
    let peer = Some(PeerKey(3));
    assert_eq!(of_bob(&lesson), (peer, EMULATED_DELAY_MAX_MS));
    lesson.event(3, PeerEvent::Closed(CloseReason::Left));
    assert_eq!(lesson.join(4, "bob", Role::Trainee), None);
    let figures = lesson.room.seat_figures();
    assert!(figures.iter().all(|f| f.emulation.is_none()));
}

#[test]
fn hand_over_leaves_one_tool_active() {
    let mut lesson = Lesson::new();
    lesson.join(3, "cid", Role::Trainee);
    lesson
        .control(Control::HandOver { participant: BOB })
        .unwrap();
    let state = State::of(&lesson.operations());
    assert_eq!(state.muted, BTreeSet::from([ANN, ParticipantId(3)]));
    lesson
        .control(Control::HandOver { participant: ANN })
        .unwrap();
    let state = State::of(&lesson.operations());
    assert_eq!(state.muted, BTreeSet::from([BOB, ParticipantId(3)]));
}

#[test]
fn frozen_tools_hold_their_pose_and_continue_afterwards() {
    let mut lesson = Lesson::new();
    lesson.press_for(200);
    let frozen_at = lesson.now;
    lesson.control(freeze(true)).unwrap();
    let held = 0.199;
    lesson.press_for(2000);
    assert_eq!(lesson.pressing, 1, "a held tool presses");
    for later in [0, 10, 500, 1999] {
        let z = lesson.bob_at(frozen_at + Span::from_millis(later)).unwrap();
        assert!((z - held).abs() < 1e-9, "{z} m after {later} ms");
    }
    assert_eq!(lesson.request(2, stroke()), Err(RequestRefusal::Frozen));
    let tool = RequestKind::SetTool(ToolDescription::probe(0.004));
    assert_eq!(lesson.request(2, tool), Err(RequestRefusal::Frozen));
    let state = State::of(&lesson.operations());
    assert_eq!(state.held.as_ref().map(Vec::len), Some(1));
    let released_at = lesson.now;
    lesson.control(freeze(false)).unwrap();
    let z = lesson.bob_at(released_at - Span::from_millis(1)).unwrap();
    assert!((z - held).abs() < 1e-9, "views before the release: {z} m");
    lesson.press_for(200);
    let z = lesson.bob_at(lesson.now - Span::from_millis(20)).unwrap();
    let expected = lesson.now.as_micros() as f64 * 1e-6 - 0.02;
    assert!((z - expected).abs() < 2e-3, "{z} m instead of {expected}");
}

#[test]
fn tool_that_joins_or_returns_in_a_freeze_presses_after_it() {
    let mut lesson = Lesson::new();
    lesson.press_for(100);
    lesson.control(freeze(true)).unwrap();
    lesson.event(
        2,
        PeerEvent::Closed(CloseReason::ConnectionLost("a test".into())),
    );
    lesson.join_with(2, "bob", Role::Trainee, Some(resume_of(BOB)));
    lesson.press_for(200);
    assert_eq!(lesson.pressing, 0);
    lesson.control(freeze(false)).unwrap();
    lesson.press_for(200);
    assert_eq!(lesson.pressing, 1);
}

#[test]
fn log_of_a_freeze_keeps_the_ends_of_holds() {
    let mut lesson = Lesson::new();
    lesson.press_for(100);
    lesson.control(freeze(true)).unwrap();
    lesson.control(mute(BOB, true)).unwrap();
    lesson.control(mute(BOB, false)).unwrap();
    lesson.event(
        2,
        PeerEvent::Closed(CloseReason::ConnectionLost("a test".into())),
    );
    lesson.join_with(2, "bob", Role::Trainee, Some(resume_of(BOB)));
    // Longer than superseded operations are kept.
    lesson.press_for(80_000);
    let has = |lesson: &Lesson, is: fn(&OperationKind) -> bool| {
        lesson.operations().iter().any(|o| is(&o.kind))
    };
    let is_muted =
        |kind: &OperationKind| matches!(kind, OperationKind::Muted { is_muted: true, .. });
    let is_lost = |kind: &OperationKind| matches!(kind, OperationKind::Disconnected { .. });
    // A newcomer must learn that Bob's tool is no longer held.
    assert!(has(&lesson, is_muted) && has(&lesson, is_lost));
    lesson.control(freeze(false)).unwrap();
    lesson.press_for(80_000);
    assert!(!has(&lesson, is_muted) && !has(&lesson, is_lost));
}

#[test]
fn locked_session_refuses_joins_but_no_resumption_and_no_instructor() {
    let mut lesson = Lesson::new();
    lesson.control(Control::Lock { is_locked: true }).unwrap();
    let refused = lesson.join(3, "cid", Role::Spectator);
    assert_eq!(refused, Some(RefusalReason::Locked));
    lesson.event(
        2,
        PeerEvent::Closed(CloseReason::ConnectionLost("a test".into())),
    );
    let resumed = lesson.join_with(4, "bob", Role::Trainee, Some(resume_of(BOB)));
    assert_eq!(resumed, None);
    assert_eq!(lesson.join(5, "dan", Role::Instructor), None);
    lesson.control(Control::Lock { is_locked: false }).unwrap();
    assert_eq!(lesson.join(6, "cid", Role::Spectator), None);
}

#[test]
fn kicked_participant_gets_a_goodbye_and_may_join_again_but_not_resume() {
    let mut lesson = Lesson::new();
    lesson.control(Control::Kick { participant: BOB }).unwrap();
    let goodbye = lesson.outputs.iter().find_map(|o| match o {
        Output::Message(PeerKey(2), PeerMessage::Goodbye(sentence)) => Some(sentence.clone()),
        _ => None,
    });
    assert!(goodbye.is_some_and(|s| s.contains("instructor")));
    assert_eq!(lesson.room.participant_count(), 1);
    let refused = lesson.join_with(3, "bob", Role::Trainee, Some(resume_of(BOB)));
    assert_eq!(refused, Some(RefusalReason::NoSuchSeat));
    assert_eq!(lesson.join(4, "bob", Role::Trainee), None);
}

#[test]
fn banned_names_and_those_like_them_are_refused() {
    let mut lesson = Lesson::new();
    lesson.control(Control::Ban { participant: BOB }).unwrap();
    for name in ["bob", "Bob", "b\u{43e}b"] {
        for role in [Role::Trainee, Role::Spectator] {
            let refused = lesson.join(3, name, role);
            let name = "bob".to_owned();
            assert_eq!(refused, Some(RefusalReason::Banned { name }));
        }
    }
    assert_eq!(lesson.join(4, "cid", Role::Trainee), None);
}

#[test]
fn smaller_capacity_refuses_further_joins_only() {
    let mut lesson = Lesson::new();
    assert_eq!(lesson.join(3, "cid", Role::Spectator), None);
    let capacity = |seats| Control::Capacity {
        seats,
        spectators: seats,
    };
    lesson.control(capacity(2)).unwrap();
    assert_eq!(lesson.room.participant_count(), 3);
    let role = Role::Spectator;
    let refused = lesson.join(4, "dan", role);
    assert_eq!(refused, Some(RefusalReason::Full { role, seats: 2 }));
    lesson.control(capacity(6)).unwrap();
    assert_eq!(lesson.join(5, "dan", role), None);
}

#[test]
fn delay_ends_with_the_rule_without_compensation() {
    let mut lesson = Lesson::new();
    assert_eq!(lesson.room.delay_at(lesson.now), Span::from_millis(20));
    let mode = CompensationMode::None;
    lesson.control(Control::Compensation { mode }).unwrap();
    lesson.press_for(3000);
    assert_eq!(lesson.room.delay_at(lesson.now), Span::ZERO);
}

#[test]
fn tool_is_changed_on_request_at_a_limited_rate() {
    let mut lesson = Lesson::new();
    lesson.press_for(200);
    let probe = RequestKind::SetTool(ToolDescription::probe(0.004));
    lesson.request(2, probe.clone()).unwrap();
    let changed_at = lesson.now;
    let radius = |lesson: &mut Lesson, t| lesson.room.pressing_at(BOB, t)[0].radius_m;
    assert_eq!(
        radius(&mut lesson, changed_at - Span::from_millis(10)),
        0.008,
        "earlier views show the former tool"
    );
    lesson.press_for(100);
    let now = lesson.now;
    assert_eq!(radius(&mut lesson, now - Span::from_millis(20)), 0.004);
    assert_eq!(lesson.request(2, stroke()), Err(RequestRefusal::NotAllowed));
    let results = (0..20).map(|_| lesson.request(2, probe.clone()));
    assert!(results.last().unwrap() == Err(RequestRefusal::TooMany));
    lesson.join(3, "cid", Role::Spectator);
    assert_eq!(
        lesson.request(3, probe),
        Err(RequestRefusal::NotAllowed),
        "a spectator has no tool"
    );
}

#[test]
fn controls_are_limited_in_rate_and_keep_the_log_short() {
    let mut lesson = Lesson::new();
    let mut longest = 0;
    let mut refused = 0;
    for i in 0..20_000_u32 {
        lesson.now = lesson.now + Span::from_millis(20);
        let control = match i % 4 {
            0 => mute(BOB, i % 8 == 0),
            1 => Control::ShowCamera(examples::CAMERA),
            2 => Control::Annotate(Annotation {
                id: 0,
                ..examples::annotation()
            }),
            _ => Control::RemoveAnnotation { id: i / 40 },
        };
        refused += u32::from(lesson.control(control) == Err(RequestRefusal::TooMany));
        lesson.tick();
        longest = longest.max(lesson.operations().len());
    }
    assert!(refused > 10_000 && longest < 700, "{refused}, {longest}");
}

pub(super) fn resume_of(participant: ParticipantId) -> Resume {
    Resume {
        participant,
        token: ResumeToken([participant.0 as u8; 16]),
        next_operation: OperationId(0),
        topology_version: 0,
        topology_hash: TopologyHash(0),
    }
}
