//! Demotion to spectator because of the network, and restoration.

use palpate_protocol::ParticipantId;
use palpate_protocol::compensation::{DEMOTE_AFTER, RESTORE_AFTER};
use palpate_protocol::operation::CutStroke;
use palpate_protocol::request::DelayReport;

use super::*;
use crate::{LoggedCut, TissueReport};

const CAP_MS: i64 = 400;

/// A participant with a moving tool, its one-way delays, and the false age of its samples, ms.
struct Mover {
    peer: PeerKey,
    up_ms: i64,
    down_ms: i64,
    false_ms: i64,
}

/// A session in which all participants press and report their delay requirement.
struct Session {
    room: SimulatedRoom,
    movers: Vec<Mover>,
    now_ms: i64,
    operations: Vec<Arc<Operation>>,
    refusals: Vec<RequestRefusal>,
    /// Tools of the newest tick.
    tools: usize,
}

impl Session {
    fn of(path_delays: &[(i64, i64)]) -> Self {
        let mut room = room_with(
            8,
            0,
            CompensationMode::Adaptive {
                cap_us: CAP_MS as u32 * 1000,
            },
        );
        let mut movers = Vec::new();
        for (i, &(up_ms, down_ms)) in path_delays.iter().enumerate() {
            let peer = PeerKey(i as u64 + 1);
            let name = format!("p{}", i + 1);
            room.handle_event(peer, hello(&name, Role::Trainee, ToolKind::Scalpel), ms(0));
            movers.push(Mover {
                peer,
                up_ms,
                down_ms,
                false_ms: 0,
            });
        }
        Self {
            room,
            movers,
            now_ms: 0,
            operations: Vec::new(),
            refusals: Vec::new(),
            tools: 0,
        }
    }

    /// Age of the other active participants' samples on arrival at `i`.
    fn requirement_of(&self, i: usize) -> Option<i64> {
        let demoted = self.demoted();
        let others = self.movers.iter().enumerate().filter(|(j, m)| {
            let who = ParticipantId(m.peer.0 as u16);
            *j != i && !demoted.contains(&who)
        });
        let up = others.map(|(_, m)| m.up_ms + m.false_ms).max()?;
        Some(up + self.movers[i].down_ms)
    }

    fn demoted(&self) -> Vec<ParticipantId> {
        let mut demoted = Vec::new();
        for operation in &self.operations {
            match operation.kind {
                OperationKind::Demoted { participant, .. } => demoted.push(participant),
                OperationKind::Restored { participant } => demoted.retain(|p| *p != participant),
                _ => {}
            }
        }
        demoted
    }

    fn run_until(&mut self, until_ms: i64) {
        while self.now_ms < until_ms {
            self.now_ms += 4;
            let now = self.now_ms;
            for i in 0..self.movers.len() {
                let Mover {
                    peer,
                    up_ms,
                    down_ms,
                    false_ms,
                } = self.movers[i];
                let newest = now - up_ms - false_ms;
                let PeerEvent::Motion(motion) = pressing_at(newest - 4, newest, ms(now)) else {
                    unreachable!()
                };
                let motion = PeerMotion {
                    round_trip: Some(Span::from_millis(up_ms + down_ms)),
                    ..motion
                };
                self.room
                    .handle_event(peer, PeerEvent::Motion(motion), ms(now));
                if now % 252 == 0
                    && let Some(needed_ms) = self.requirement_of(i)
                {
                    let report = DelayReport {
                        mean_us: needed_ms as u32 * 1000,
                        wanted_us: needed_ms as u32 * 1000,
                        ..DelayReport::default()
                    };
                    self.room
                        .handle_event(peer, PeerEvent::Delay(report), ms(now));
                }
            }
            if let Some(report) = self.room.handle_tick(ms(now), &mut || true) {
                self.tools = report.tools;
            }
            let outputs = drain(&mut self.room);
            self.operations.extend(operations(&outputs, PeerKey(1)));
            self.refusals.extend(outputs.iter().filter_map(|o| match o {
                Output::Message(_, PeerMessage::RequestRefused(r)) => Some(r.reason.clone()),
                _ => None,
            }));
        }
    }

    fn target_ms(&self) -> Option<u32> {
        self.operations.iter().rev().find_map(|o| match o.kind {
            OperationKind::Compensation { delay_us, .. } => Some(delay_us / 1000),
            _ => None,
        })
    }
}

#[test]
fn false_sample_times_of_one_participant_demote_no_other() {
    // Its pairs with honest participants need 290 ms of 400.
    let mut s = Session::of(&[(140, 140), (10, 10)]);
    s.movers[1].false_ms = 269;
    s.run_until(8000);
    assert_eq!(s.demoted(), []);
}

#[test]
fn participant_beyond_the_cap_does_not_hide_the_uplink_of_another() {
    let mut s = Session::of(&[(30, 30), (30, 30), (30, 30)]);
    s.run_until(2000);
    (s.movers[2].up_ms, s.movers[2].down_ms) = (500, 500);
    // Its level beyond the cap is certain.
    s.run_until(4000);
    s.movers[0].up_ms = 150;
    s.run_until(4800);
    assert_eq!(s.demoted(), []);
    assert!(s.target_ms() >= Some(150), "{:?} ms", s.target_ms());
}

#[test]
fn participant_beyond_the_cap_is_demoted_and_no_longer_raises_the_delay() {
    let mut s = Session::of(&[(30, 30), (30, 30), (30, 30)]);
    s.run_until(2000);
    assert_eq!(s.tools, 3);
    (s.movers[2].up_ms, s.movers[2].down_ms) = (500, 500);
    s.run_until(2000 + DEMOTE_AFTER.as_micros() / 1000 - 300);
    assert_eq!(s.demoted(), [], "a short burst does not demote");
    let held = s.target_ms();
    assert!(
        held.is_none_or(|ms| ms < 150),
        "no delay covers it: {held:?} ms"
    );
    s.run_until(7000);
    assert_eq!(
        s.demoted(),
        [ParticipantId(3)],
        "the slow participant alone"
    );
    assert!(s.target_ms().unwrap() < 100, "{:?} ms", s.target_ms());
    s.run_until(9000);
    assert_eq!(s.tools, 2, "the demoted tool does not press");
    let motion = |room: &mut SimulatedRoom| {
        let outputs = drain(room);
        outputs.iter().any(|o| {
            matches!(o, Output::Datagram(_, PeerDatagram::Motion(round))
            if round.tracks.iter().any(|t| t.participant == ParticipantId(3)))
        })
    };
    s.room
        .handle_event(PeerKey(3), pressing_at(8000, 8004, ms(9001)), ms(9001));
    s.room.handle_tick(ms(9020), &mut || true);
    assert!(!motion(&mut s.room), "its motion is not relayed");
    let request = Request {
        id: RequestId(1),
        kind: stroke(),
    };
    s.room
        .handle_event(PeerKey(3), PeerEvent::Request(request), ms(9021));
    s.run_until(9100);
    assert_eq!(s.refusals, [RequestRefusal::Demoted]);
    (s.movers[2].up_ms, s.movers[2].down_ms) = (30, 30);
    let recovered = s.now_ms;
    s.run_until(recovered + RESTORE_AFTER.as_micros() / 1000 - 500);
    assert_eq!(s.demoted(), [ParticipantId(3)]);
    s.run_until(recovered + RESTORE_AFTER.as_micros() / 1000 + 6000);
    assert_eq!(s.demoted(), []);
    assert_eq!((s.tools, s.room.demotion_count()), (3, 1));
    assert_eq!(s.room.participant_count(), 3, "in the same seat");
}

#[test]
fn all_slow_participants_are_demoted_and_no_fast_one() {
    let mut s = Session::of(&[(20, 20), (450, 450), (20, 20), (300, 300)]);
    s.run_until(15_000);
    let mut demoted = s.demoted();
    demoted.sort_unstable();
    assert_eq!(
        demoted,
        [ParticipantId(2)],
        "300 ms and 20 ms are below the cap together"
    );
    s.movers[3].up_ms = 600;
    s.run_until(30_000);
    demoted = s.demoted();
    demoted.sort_unstable();
    assert_eq!(demoted, [ParticipantId(2), ParticipantId(4)]);
}

#[test]
fn of_two_equally_slow_participants_the_later_one_is_demoted() {
    let mut s = Session::of(&[(240, 240), (240, 240), (20, 20)]);
    s.run_until(10_000);
    assert_eq!(s.demoted(), [ParticipantId(2)]);
}

#[test]
fn fixed_delay_demotes_no_participant() {
    let mut room = room_with(3, 0, CompensationMode::Fixed);
    for (peer, name) in [(1, "ann"), (2, "bob")] {
        let hello = hello(name, Role::Trainee, ToolKind::Probe);
        room.handle_event(PeerKey(peer), hello, ms(0));
    }
    for t in (0..10_000).step_by(250) {
        let report = DelayReport {
            wanted_us: 2_000_000,
            ..DelayReport::default()
        };
        room.handle_event(PeerKey(1), PeerEvent::Delay(report), ms(t));
        room.handle_tick(ms(t), &mut || true);
    }
    assert_eq!(room.demotion_count(), 0);
}

#[test]
fn full_log_refuses_cuts_but_demotes_restores_and_admits() {
    let mut s = Session::of(&[(30, 30), (30, 30), (500, 500)]);
    s.run_until(6000);
    assert_eq!(s.demoted(), [ParticipantId(3)]);
    for _ in 0..6000 {
        let cut = TissueReport::Cut {
            author: ParticipantId(1),
            request: RequestId(1),
            result: Ok(LoggedCut {
                change: OperationKind::Cut(CutStroke {
                    began: ServerTime::ZERO,
                    joins: false,
                    points: Vec::new(),
                    width_m: 0.0,
                }),
                version: 1,
                hash: TopologyHash(1),
                blade_at: None,
            }),
        };
        s.room.handle_report(cut, ms(6000));
    }
    let request = Request {
        id: RequestId(2),
        kind: stroke(),
    };
    s.room
        .handle_event(PeerKey(1), PeerEvent::Request(request), ms(6000));
    s.run_until(6100);
    assert_eq!(s.refusals.last(), Some(&RequestRefusal::LogFull));
    (s.movers[2].up_ms, s.movers[2].down_ms) = (30, 30);
    let recovered = s.now_ms;
    s.run_until(recovered + RESTORE_AFTER.as_micros() / 1000 + 6000);
    assert_eq!(s.demoted(), [], "the demoted participant is restored");
    s.movers[1].up_ms = 900;
    s.run_until(s.now_ms + 2 * DEMOTE_AFTER.as_micros() / 1000);
    assert_eq!(s.demoted(), [ParticipantId(2)]);
    let newcomer = hello("eve", Role::Trainee, ToolKind::Probe);
    s.room.handle_event(PeerKey(9), newcomer, ms(s.now_ms));
    let outputs = drain(&mut s.room);
    assert_eq!(refusal(&outputs), None, "new clients are admitted");
    let log = operations(&outputs, PeerKey(9));
    assert_eq!(log.len(), s.room.operation_count());
}

#[test]
fn constant_delays_do_not_alternate_demotion_and_restoration() {
    // Uplink and downlink are each below the cap, but their sum is not. If both participants are demoted, neither
    // receives motion.
    for path_delays in [
        &[(304, 304), (304, 304)][..],
        &[(350, 250), (340, 260)],
        &[(20, 500), (15, 20)],
    ] {
        let mut session = Session::of(path_delays);
        session.run_until(60_000);
        assert_eq!(session.demoted().len(), 1, "{path_delays:?}");
        assert_eq!(session.room.demotion_count(), 1, "{path_delays:?}");
    }
}

#[test]
fn two_demoted_participants_without_motion_are_not_both_restored() {
    let mut session = Session::of(&[(304, 304), (304, 304)]);
    session.run_until(8000);
    assert_eq!(session.demoted(), [ParticipantId(2)]);
    (session.movers[0].up_ms, session.movers[0].down_ms) = (450, 450);
    session.run_until(14_000);
    assert_eq!(
        session.demoted().len(),
        2,
        "no participant receives motion now"
    );
    (session.movers[0].up_ms, session.movers[0].down_ms) = (304, 304);
    session.run_until(80_000);
    assert_eq!(session.demoted().len(), 1, "only one of the two");
    assert_eq!(session.room.demotion_count(), 2);
}
