//! Laws of invitations.

use std::collections::BTreeMap;

use palpate_protocol::ParticipantId;
use palpate_protocol::control::Control;
use palpate_protocol::handshake::Resume;
use palpate_protocol::request::Invitation;
use proptest::prelude::*;

use super::controls::{Lesson, resume_of};
use super::*;

const MINUTE: Span = Span::from_millis(60_000);

fn invite(role: Role, name: Option<&str>, is_single_use: bool) -> Control {
    Control::Invite {
        role,
        name: name.map(str::to_owned),
        lifetime_s: 60,
        is_single_use,
    }
}

/// The secrets in messages, with their receivers.
fn secrets(outputs: &[Output]) -> Vec<(PeerKey, Invitation)> {
    let secret = |o: &Output| match o {
        Output::Message(peer, PeerMessage::Invitation(secret)) => Some((*peer, *secret)),
        _ => None,
    };
    outputs.iter().filter_map(secret).collect()
}

impl Lesson {
    /// Lets Ann, the instructor, create an invitation.
    fn invited(&mut self, control: Control) -> Invitation {
        self.control(control).unwrap();
        secrets(&self.outputs)[0].1
    }

    fn join_by(
        &mut self,
        peer: u64,
        name: &str,
        role: Role,
        grant: Grant,
    ) -> Option<RefusalReason> {
        self.hello_by(peer, name, role, grant, None)
    }

    fn hello_by(
        &mut self,
        peer: u64,
        name: &str,
        role: Role,
        grant: Grant,
        resume: Option<Resume>,
    ) -> Option<RefusalReason> {
        let PeerEvent::Hello(hello) = hello(name, role, ToolKind::Scalpel) else {
            unreachable!()
        };
        let hello = Hello {
            grant,
            resume,
            ..hello
        };
        self.event(peer, PeerEvent::Hello(hello));
        refusal(&self.outputs)
    }

    fn lose(&mut self, peer: u64) {
        let lost = CloseReason::ConnectionLost("a test".into());
        self.event(peer, PeerEvent::Closed(lost));
    }
}

#[test]
fn only_the_requester_receives_the_grant_and_the_log_has_none() {
    let mut lesson = Lesson::new();
    lesson.join(3, "eve", Role::Instructor);
    let secret = lesson.invited(invite(Role::Trainee, Some("cid"), true));
    assert_eq!(secrets(&lesson.outputs), [(PeerKey(1), secret)]);
    let logged = operations(&lesson.outputs, PeerKey(2));
    let invited = OperationKind::Invited {
        id: secret.id,
        role: Role::Trainee,
        name: Some("cid".to_owned()),
        expires_at: lesson.now + MINUTE,
        is_single_use: true,
    };
    assert_eq!(logged[0].kind, invited);
    let at = |o: &Output| matches!(o, Output::Message(PeerKey(1), PeerMessage::Operation(_)));
    assert!(at(&lesson.outputs[0]), "the operation precedes the secret");
}

#[test]
fn only_instructors_invite_and_revoke() {
    let mut lesson = Lesson::new();
    let secret = lesson.invited(invite(Role::Trainee, None, false));
    let id = secret.id;
    for control in [
        invite(Role::Instructor, None, false),
        Control::RevokeInvitation { id },
    ] {
        let refused = lesson.request(2, RequestKind::Control(control));
        assert_eq!(refused, Err(RequestRefusal::NotAllowed));
    }
    assert_eq!(lesson.join_by(3, "cid", Role::Trainee, secret.grant), None);
}

#[test]
fn invitation_admits_its_role_and_its_name_only() {
    let mut lesson = Lesson::new();
    let grant = lesson
        .invited(invite(Role::Instructor, Some("cid"), false))
        .grant;
    let role = Role::Trainee;
    let other_role = lesson.join_by(3, "cid", role, grant);
    assert_eq!(other_role, Some(RefusalReason::BadGrant { role }));
    let other_name = lesson.join_by(3, "dan", Role::Instructor, grant);
    let name = "cid".to_owned();
    assert_eq!(other_name, Some(RefusalReason::InvitationName { name }));
    assert_eq!(lesson.join_by(3, "cid", Role::Instructor, grant), None);
    let freeze = Control::Freeze { is_frozen: true };
    assert_eq!(lesson.request(3, RequestKind::Control(freeze)), Ok(()));
}

#[test]
fn each_end_of_an_invitation_has_its_own_refusal() {
    let mut lesson = Lesson::new();
    let trainee = Role::Trainee;
    let single = lesson.invited(invite(trainee, None, true));
    assert_eq!(lesson.join_by(3, "cid", trainee, single.grant), None);
    let used = operations(&lesson.outputs, PeerKey(1));
    let is_logged = |o: &Arc<Operation>| o.kind == OperationKind::InvitationUsed { id: single.id };
    assert!(used.iter().any(is_logged));
    let again = lesson.join_by(4, "dan", trainee, single.grant);
    assert_eq!(again, Some(RefusalReason::InvitationUsed));
    let revoked = lesson.invited(invite(trainee, None, false));
    let id = revoked.id;
    lesson.control(Control::RevokeInvitation { id }).unwrap();
    let refused = lesson.join_by(4, "dan", trainee, revoked.grant);
    assert_eq!(refused, Some(RefusalReason::InvitationRevoked));
    let expiring = lesson.invited(invite(trainee, None, false));
    lesson.now = lesson.now + MINUTE - Span::from_micros(1);
    assert_eq!(lesson.join_by(4, "dan", trainee, expiring.grant), None);
    lesson.now = lesson.now + Span::from_micros(1);
    let expired = lesson.join_by(5, "fay", trainee, expiring.grant);
    assert_eq!(expired, Some(RefusalReason::InvitationExpired));
    let unknown = lesson.join_by(5, "fay", trainee, Grant([0xee; 16]));
    assert_eq!(unknown, Some(RefusalReason::BadGrant { role: trainee }));
    let id = 99;
    let none = lesson.control(Control::RevokeInvitation { id });
    assert!(matches!(none, Err(RequestRefusal::OutOfRange(_))));
}

#[test]
fn refused_join_does_not_use_an_invitation_up() {
    let mut lesson = Lesson::new();
    let grant = lesson.invited(invite(Role::Trainee, None, true)).grant;
    lesson.control(Control::Lock { is_locked: true }).unwrap();
    let locked = lesson.join_by(3, "cid", Role::Trainee, grant);
    assert_eq!(locked, Some(RefusalReason::Locked));
    lesson.control(Control::Lock { is_locked: false }).unwrap();
    let taken = lesson.join_by(3, "bob", Role::Trainee, grant);
    assert!(matches!(taken, Some(RefusalReason::NameTaken { .. })));
    assert_eq!(lesson.join_by(3, "cid", Role::Trainee, grant), None);
}

#[test]
fn seat_is_resumed_after_use_and_expiry_but_not_after_revocation() {
    let mut lesson = Lesson::new();
    let trainee = Role::Trainee;
    let secret = lesson.invited(invite(trainee, None, true));
    assert_eq!(lesson.join_by(3, "cid", trainee, secret.grant), None);
    let resume = Some(resume_of(ParticipantId(3)));
    lesson.lose(3);
    let other = lesson.hello_by(4, "cid", trainee, Grant([0xee; 16]), resume);
    assert_eq!(other, Some(RefusalReason::BadGrant { role: trainee }));
    lesson.now = lesson.now + MINUTE - Span::from_millis(1);
    assert_eq!(
        lesson.hello_by(4, "cid", trainee, secret.grant, resume),
        None
    );
    // Invitations that give way to newer ones are no longer in the table.
    for _ in 0..70 {
        lesson.now = lesson.now + Span::from_millis(1000);
        lesson.tick();
        let id = lesson.invited(invite(trainee, None, false)).id;
        lesson.control(Control::RevokeInvitation { id }).unwrap();
    }
    assert_eq!(lesson.room.invitation(secret.id), None);
    lesson.lose(4);
    assert_eq!(
        lesson.hello_by(5, "cid", trainee, secret.grant, resume),
        None
    );
    // A revocation holds for the seats of its invitation.
    let many = lesson.invited(invite(trainee, None, false));
    assert_eq!(lesson.join_by(6, "dan", trainee, many.grant), None);
    let id = many.id;
    lesson.control(Control::RevokeInvitation { id }).unwrap();
    let resume = Some(resume_of(ParticipantId(4)));
    for _ in 0..2 {
        let revoked = lesson.hello_by(7, "dan", trainee, many.grant, resume);
        assert_eq!(revoked, Some(RefusalReason::InvitationRevoked));
        lesson.lose(6);
    }
    lesson.event(5, PeerEvent::Closed(CloseReason::Left));
    let rejoin = lesson.join_by(8, "gus", trainee, many.grant);
    assert_eq!(rejoin, Some(RefusalReason::InvitationRevoked));
}

#[test]
fn open_invitations_are_bounded_and_spent_ones_give_way() {
    let mut lesson = Lesson::new();
    let mut grants = Vec::new();
    for _ in 0..64 {
        lesson.now = lesson.now + Span::from_millis(200);
        let control = Control::Invite {
            role: Role::Spectator,
            name: None,
            lifetime_s: 3600,
            is_single_use: false,
        };
        grants.push(lesson.invited(control));
    }
    let one_more = invite(Role::Spectator, None, false);
    let full = lesson.control(one_more.clone());
    assert!(matches!(full, Err(RequestRefusal::OutOfRange(s)) if s.contains("revoke one")));
    let id = grants[10].id;
    lesson.control(Control::RevokeInvitation { id }).unwrap();
    lesson.invited(one_more);
    let role = Role::Spectator;
    let forgotten = lesson.join_by(3, "cid", role, grants[10].grant);
    assert_eq!(forgotten, Some(RefusalReason::BadGrant { role }));
    assert_eq!(lesson.join_by(3, "cid", role, grants[0].grant), None);
}

#[test]
fn log_forgets_invitations_that_are_over() {
    let mut lesson = Lesson::new();
    let before = lesson.operations().len();
    for i in 0..400_u64 {
        lesson.now = lesson.now + Span::from_millis(1000);
        lesson.tick();
        let secret = lesson.invited(invite(Role::Spectator, None, i % 3 == 0));
        if i % 3 == 0 {
            assert_eq!(
                lesson.join_by(10 + i, "cid", Role::Spectator, secret.grant),
                None
            );
            lesson.event(10 + i, PeerEvent::Closed(CloseReason::Left));
        } else if i % 3 == 1 {
            let id = secret.id;
            lesson.control(Control::RevokeInvitation { id }).unwrap();
        }
    }
    let about = |o: &&Arc<Operation>| {
        !matches!(
            o.kind,
            OperationKind::Joined { .. } | OperationKind::Left { .. }
        )
    };
    let kept = lesson.operations().iter().filter(about).count();
    assert!(kept <= 75, "{kept} operations about invitations");
    lesson.now = lesson.now + Span::from_millis(140_000);
    lesson.tick();
    assert_eq!(lesson.operations().len(), before);
}

/// A step of a random lesson with invitations.
#[derive(Debug, Clone)]
enum Step {
    Invite {
        lifetime_s: u32,
        is_single_use: bool,
    },
    Revoke(prop::sample::Index),
    Join(prop::sample::Index),
    Pass(i64),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        2 => (60_u32..180, any::<bool>()).prop_map(|(lifetime_s, is_single_use)| Step::Invite {
            lifetime_s,
            is_single_use
        }),
        1 => any::<prop::sample::Index>().prop_map(Step::Revoke),
        4 => any::<prop::sample::Index>().prop_map(Step::Join),
        2 => (1_i64..50_000).prop_map(Step::Pass),
    ]
}

/// The invitation as the test knows it.
struct Known {
    grant: Grant,
    expires_at: ServerTime,
    is_single_use: bool,
    is_used: bool,
    is_revoked: bool,
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn expired_revoked_or_used_grant_never_admits(
        steps in prop::collection::vec(step(), 1..120),
    ) {
        let mut lesson = Lesson::new();
        let mut known: BTreeMap<u32, Known> = BTreeMap::new();
        for (step, peer) in steps.into_iter().zip(10..) {
            let pick = |index: prop::sample::Index, known: &BTreeMap<u32, Known>| {
                (!known.is_empty()).then(|| *known.keys().nth(index.index(known.len())).unwrap())
            };
            match step {
                Step::Invite { lifetime_s, is_single_use } => {
                    let control = Control::Invite {
                        role: Role::Spectator,
                        name: None,
                        lifetime_s,
                        is_single_use,
                    };
                    let secret = lesson.invited(control);
                    let known_one = Known {
                        grant: secret.grant,
                        expires_at: lesson.now + Span::from_millis(1000 * i64::from(lifetime_s)),
                        is_single_use,
                        is_used: false,
                        is_revoked: false,
                    };
                    prop_assert!(known.insert(secret.id, known_one).is_none());
                }
                Step::Revoke(index) => if let Some(id) = pick(index, &known) {
                    // An invitation that gave way is unknown, and stays refused.
                    let _ = lesson.control(Control::RevokeInvitation { id });
                    known.get_mut(&id).unwrap().is_revoked = true;
                },
                Step::Join(index) => if let Some(id) = pick(index, &known) {
                    let one = known.get_mut(&id).unwrap();
                    let may = !one.is_revoked && !one.is_used && lesson.now < one.expires_at;
                    let refused = lesson.join_by(peer, "cid", Role::Spectator, one.grant);
                    prop_assert_eq!(refused.is_none(), may, "{:?}", refused);
                    one.is_used |= may && one.is_single_use;
                    lesson.event(peer, PeerEvent::Closed(CloseReason::Left));
                },
                Step::Pass(millis) => {
                    lesson.now = lesson.now + Span::from_millis(millis);
                    lesson.tick();
                }
            }
        }
    }
}
