//! No participant changes what another one may do: seats, cuts, log and playout delay.

use palpate_protocol::ParticipantId;
use palpate_protocol::handshake::Resume;
use palpate_protocol::request::DelayReport;
use proptest::prelude::*;

use super::*;
use crate::room::Room;
use crate::{Limit, LoggedCut, TissueOrder, TissueReport};

const INSTRUCTOR: Grant = Grant([5; 16]);

/// A room without tissue, which prepares every cut at once, and the last message to each peer.
struct Hall {
    room: Room,
    outputs: Vec<Output>,
    versions: u32,
    /// CPU time of a preparation.
    took: Span,
}

impl Hall {
    fn new(seats: u16, spectators: u16) -> Self {
        let mode = CompensationMode::Adaptive { cap_us: 400_000 };
        let mut config = config(seats, 0, mode);
        config.spectators = spectators;
        config.grants.push((Role::Instructor, INSTRUCTOR));
        Self {
            room: Room::new(TopologyHash(7), config, ms(0)),
            outputs: Vec::new(),
            versions: 0,
            took: Span::from_millis(200),
        }
    }

    fn event(&mut self, peer: u64, event: PeerEvent, now: ServerTime) {
        self.room.handle_event(PeerKey(peer), event, now);
        self.work(now);
    }

    fn tick(&mut self, now: ServerTime) {
        self.room.handle_tick(now);
        self.work(now);
    }

    /// Prepares all cuts. A tick of the tissue never ends, so that further ones are skipped.
    fn work(&mut self, now: ServerTime) {
        while let Some(order) = self.room.poll_order() {
            let TissueOrder::Cut(cut) = order else {
                continue;
            };
            let crate::RequestedChange::Cut(points) = &cut.change else {
                continue;
            };
            self.versions += 1;
            let logged = LoggedCut {
                change: OperationKind::Cut(palpate_protocol::operation::CutStroke {
                    began: ServerTime::ZERO,
                    joins: false,
                    points: points.points.iter().map(|p| p.blade).collect(),
                    width_m: 0.0,
                }),
                version: self.versions,
                hash: TopologyHash(u64::from(self.versions)),
                blade_at: None,
            };
            let report = TissueReport::Cut {
                author: cut.author,
                request: cut.request,
                result: Ok(logged),
            };
            self.room.handle_report(report, now);
            let (author, took) = (cut.author, self.took);
            (self.room).handle_report(TissueReport::Prepared { author, took }, now);
        }
        self.outputs = std::iter::from_fn(|| self.room.poll_output()).collect();
    }

    fn join(
        &mut self,
        peer: u64,
        name: &str,
        role: Role,
        now: ServerTime,
    ) -> Option<RefusalReason> {
        let PeerEvent::Hello(mut hello) = hello(name, role, ToolKind::Scalpel) else {
            unreachable!()
        };
        if role == Role::Instructor {
            hello.grant = INSTRUCTOR;
        }
        self.event(peer, PeerEvent::Hello(hello), now);
        refusal(&self.outputs)
    }

    fn lose(&mut self, peer: u64, now: ServerTime) {
        let lost = CloseReason::ConnectionLost("a test".into());
        self.event(peer, PeerEvent::Closed(lost), now);
    }

    /// Draws a stroke that ends at `now` and requests it. Returns the refusal.
    fn cut(&mut self, peer: u64, id: u32, now: ServerTime) -> Option<RequestRefusal> {
        let began = now - (ms(STROKE_MS) - ms(0));
        self.event(peer, shifted(drawing(0.0), began - ms(0), now), now);
        let RequestKind::Cut(mut cut) = stroke() else {
            unreachable!()
        };
        for point in &mut cut.points {
            point.time = point.time + (began - ms(0));
        }
        let request = Request {
            id: RequestId(id),
            kind: RequestKind::Cut(cut),
        };
        self.event(peer, PeerEvent::Request(request), now);
        self.outputs.iter().find_map(|o| match o {
            Output::Message(to, PeerMessage::RequestRefused(r)) if *to == PeerKey(peer) => {
                Some(r.reason.clone())
            }
            _ => None,
        })
    }
}

/// Motion so much later, over a path with a round trip of 20 ms.
fn shifted(event: PeerEvent, by: Span, arrived: ServerTime) -> PeerEvent {
    let PeerEvent::Motion(mut motion) = event else {
        unreachable!()
    };
    for sample in &mut motion.samples {
        sample.time = sample.time + by;
    }
    motion.arrived = arrived;
    motion.round_trip = Some(Span::from_millis(20));
    PeerEvent::Motion(motion)
}

fn wants(us: u32) -> PeerEvent {
    PeerEvent::Delay(DelayReport {
        mean_us: us,
        deviation_us: 0,
        wanted_us: us,
    })
}

/// The largest playout delay within 8 s, ms. Two trainees move with an uplink and a downlink of 10 ms. A third
/// participant of this role reports a need, and its samples are stamped so much earlier.
fn largest_delay_ms(role: Role, report_us: u32, stamped_ms: i64) -> f64 {
    let mut hall = Hall::new(8, 4);
    for (peer, name, role) in [
        (1, "ann", Role::Trainee),
        (2, "bob", Role::Trainee),
        (3, "eve", role),
    ] {
        assert_eq!(hall.join(peer, name, role, ms(0)), None);
    }
    let mut most = 0.0_f64;
    for t in (500..8000).step_by(4) {
        for peer in 1..=3 {
            let age = if peer == 3 { 10 + stamped_ms } else { 10 };
            let motion = pressing(t - age - 4, t - age);
            hall.event(peer, shifted(motion, Span::ZERO, ms(t)), ms(t));
            if t % 252 == 0 {
                let us = if peer == 3 { report_us } else { 20_000 };
                hall.event(peer, wants(us), ms(t));
            }
        }
        hall.tick(ms(t));
        most = most.max(hall.room.delay_at(ms(t)).as_millis_f64());
    }
    most
}

#[test]
fn false_delay_reports_change_the_delay_at_most_by_the_measured_path() {
    let honest = largest_delay_ms(Role::Trainee, 20_000, 0);
    assert!(honest <= 21.0, "{honest}");
    let spectator = largest_delay_ms(Role::Spectator, 399_000, 0);
    assert!((spectator - honest).abs() < 0.1, "{spectator}");
    // Uplink of the others, own round trip, and the unexplained rest.
    let trainee = largest_delay_ms(Role::Trainee, 399_000, 0);
    assert!(trainee <= 10.0 + 20.0 + 25.0 + 1.0, "{trainee}");
    let stamped = largest_delay_ms(Role::Trainee, 20_000, 350);
    assert!(stamped <= 20.0 + 25.0 + 1.0, "{stamped}");
}

#[test]
fn joins_and_drops_of_spectators_leave_seats_for_all_roles() {
    let mut hall = Hall::new(16, 8);
    assert_eq!(hall.join(1, "ann", Role::Trainee, ms(0)), None);
    for i in 0..16 {
        let peer = 100 + i;
        let refused = hall.join(peer, &format!("s{i}"), Role::Spectator, ms(10));
        assert_eq!(refused, None, "{i}");
        hall.lose(peer, ms(11));
    }
    for i in 0..8 {
        let refused = hall.join(200 + i, &format!("t{i}"), Role::Spectator, ms(20));
        assert_eq!(refused, None, "{i}");
    }
    let full = hall.join(300, "u", Role::Spectator, ms(20));
    let (role, seats) = (Role::Spectator, 8);
    assert_eq!(full, Some(RefusalReason::Full { role, seats }));
    for i in 0..6 {
        let refused = hall.join(400 + i, &format!("v{i}"), Role::Trainee, ms(20));
        assert_eq!(refused, None, "{i}");
    }
    let full = hall.join(500, "w", Role::Trainee, ms(20));
    let (role, seats) = (Role::Trainee, 15);
    assert_eq!(full, Some(RefusalReason::Full { role, seats }));
    assert_eq!(hall.join(600, "x", Role::Instructor, ms(20)), None);
    assert_eq!(hall.room.limits().of(Limit::Full), 2);
}

#[test]
fn seat_of_a_participant_who_took_part_is_kept_for_it_alone() {
    let mut hall = Hall::new(2, 0);
    assert_eq!(hall.join(1, "ann", Role::Trainee, ms(0)), None);
    assert_eq!(hall.join(2, "bob", Role::Trainee, ms(0)), None);
    assert_eq!(hall.cut(1, 1, ms(6000)), None);
    hall.lose(1, ms(7000));
    let refused = hall.join(3, "eve", Role::Trainee, ms(7900));
    assert!(matches!(refused, Some(RefusalReason::Full { .. })));
    // Bob never moved his tool.
    hall.lose(2, ms(9000));
    let seats = hall.room.participant_count();
    assert_eq!(hall.join(4, "eve", Role::Trainee, ms(9100)), None);
    assert_eq!(hall.room.participant_count(), seats, "one came for one");
    assert_eq!(
        hall.room.joined_count(),
        3,
        "which the count of joins shows"
    );
}

#[test]
fn spectator_whose_seat_was_given_away_joins_again_by_its_resumption() {
    let mut hall = Hall::new(3, 1);
    assert_eq!(hall.join(1, "sam", Role::Spectator, ms(0)), None);
    hall.lose(1, ms(1000));
    assert_eq!(hall.join(2, "pat", Role::Spectator, ms(2000)), None);
    hall.event(2, PeerEvent::Closed(CloseReason::Left), ms(3000));
    let PeerEvent::Hello(mut again) = hello("sam", Role::Spectator, ToolKind::Probe) else {
        unreachable!()
    };
    again.resume = Some(Resume {
        participant: ParticipantId(1),
        token: ResumeToken([1; 16]),
        next_operation: palpate_protocol::OperationId(2),
        topology_version: 0,
        topology_hash: TopologyHash(7),
    });
    hall.event(3, PeerEvent::Hello(again), ms(3100));
    let welcome = hall.outputs.iter().find_map(|o| match o {
        Output::Message(PeerKey(3), PeerMessage::Welcome(w)) => Some(w),
        _ => None,
    });
    let welcome = welcome.expect("a welcome");
    assert_eq!(welcome.participant, ParticipantId(3));
    assert_eq!(welcome.first_operation.0, 0);
}

#[test]
fn names_that_look_alike_are_taken() {
    let mut hall = Hall::new(16, 8);
    assert_eq!(hall.join(1, "ann", Role::Trainee, ms(0)), None);
    for (i, name) in ["ann", "Ann", "\u{430}nn", "ANN"].into_iter().enumerate() {
        let refused = hall.join(10 + i as u64, name, Role::Trainee, ms(10));
        let name = "ann".to_owned();
        assert_eq!(refused, Some(RefusalReason::NameTaken { name }));
    }
    assert_eq!(hall.join(20, "anna", Role::Trainee, ms(10)), None);
}

#[test]
fn floods_of_joins_and_losses_leave_the_log_to_cuts() {
    let mut hall = Hall::new(16, 8);
    assert_eq!(hall.join(1, "ann", Role::Trainee, ms(0)), None);
    let mut peer = 100;
    for second in 1..1200 {
        let now = ms(1000 * second);
        for _ in 0..12 {
            for role in [Role::Trainee, Role::Spectator] {
                peer += 1;
                hall.join(peer, &format!("x{peer}"), role, now);
                hall.lose(peer, now);
            }
        }
        hall.tick(now);
    }
    let now = ms(1_200_000);
    assert!(hall.room.operation_count() > 10_000);
    let kept = hall
        .room
        .operations_since(palpate_protocol::OperationId(0))
        .len();
    // Ten joins per second of each class, three operations each, for 70 s.
    assert!(kept < 4600, "{kept} operations");
    assert_eq!(hall.cut(1, 1, now), None);
    assert_eq!(hall.room.topology().0, 1);
    assert!(hall.room.limits().of(Limit::Busy) > 0);
}

/// A deed of the adversary.
#[derive(Debug, Clone, Copy)]
enum Deed {
    Joins,
    Leaves,
    Drops,
    Cuts,
    Reports(u32),
    Jumps,
}

fn any_deed() -> impl Strategy<Value = (Deed, i64)> {
    let deed = prop_oneof![
        Just(Deed::Joins),
        Just(Deed::Leaves),
        Just(Deed::Drops),
        Just(Deed::Cuts),
        (0_u32..2_000_000).prop_map(Deed::Reports),
        Just(Deed::Jumps),
    ];
    (deed, 1_i64..2000)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn no_deed_of_one_participant_takes_a_seat_or_a_cut_from_another(
        deeds in prop::collection::vec(any_deed(), 1..400),
        is_trainee in any::<bool>(),
        took_ms in 0_i64..2000,
    ) {
        let role = if is_trainee { Role::Trainee } else { Role::Spectator };
        // The adversary occupies at most two seats.
        let mut hall = Hall::new(5, 2);
        hall.took = Span::from_millis(took_ms);
        prop_assert_eq!(hall.join(1, "ann", Role::Trainee, ms(0)), None);
        let (mut now, mut peer, mut id) = (1000, 100, 0);
        for (deed, wait) in deeds {
            now += wait;
            let at = ms(now);
            match deed {
                Deed::Joins => {
                    peer += 1;
                    hall.join(peer, &format!("x{peer}"), role, at);
                }
                Deed::Leaves => hall.event(peer, PeerEvent::Closed(CloseReason::Left), at),
                Deed::Drops => hall.lose(peer, at),
                Deed::Cuts => {
                    id += 1;
                    hall.cut(peer, id, at);
                }
                Deed::Reports(us) => hall.event(peer, wants(us), at),
                Deed::Jumps => {
                    let far = shifted(drawing(0.7), at - ms(STROKE_MS), at);
                    hall.event(peer, far, at);
                }
            }
            // One participant has one connection at a time.
            if matches!(deed, Deed::Joins) && peer > 101 {
                hall.event(peer - 1, PeerEvent::Closed(CloseReason::Left), at);
            }
            hall.tick(at);
        }
        let now = ms(now + 100);
        prop_assert_eq!(hall.cut(1, 1, now), None);
        prop_assert_eq!(hall.join(2, "bob", Role::Instructor, now), None);
        // The rate of joins of a role is shared.
        let refused = hall.join(3, "cid", Role::Trainee, now);
        let is_busy = is_trainee && refused == Some(RefusalReason::Busy);
        prop_assert!(is_busy || refused.is_none(), "{refused:?}");
        let delay = hall.room.delay_at(now);
        prop_assert!(delay <= Span::from_millis(20 + 20 + 25), "{delay:?}");
    }
}
