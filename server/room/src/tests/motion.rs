//! Relay of motion between all participants.

use std::collections::BTreeMap;

use palpate_protocol::ParticipantId;

use palpate_protocol::tool::INSERTED_BUTTON;

use super::controls::Lesson;
use super::*;
use crate::SEATS_MAX;

/// All participants move at 1 kHz in batches of 4 ms for one second. Returns the datagrams to each peer and the newest
/// sample of each tool that it received.
fn second_of(
    participants: u16,
) -> (
    BTreeMap<PeerKey, usize>,
    BTreeMap<(PeerKey, ParticipantId), ServerTime>,
) {
    let mut room = room_of(participants, 0);
    for who in 1..=participants {
        let hello = hello(&format!("p{who}"), Role::Trainee, ToolKind::Probe);
        room.handle_event(PeerKey(u64::from(who)), hello, ms(0));
    }
    drain(&mut room);
    let (mut sent, mut newest) = (BTreeMap::new(), BTreeMap::new());
    for now in 1..1020 {
        for who in 1..=u64::from(participants) {
            // Each participant has its own phase.
            if (now + who as i64) % 4 == 0 && now <= 1000 {
                let above = |t: i64| ToolSample {
                    time: ms(t),
                    ..ToolSample::default()
                };
                let samples = (now - 4..now).map(above).collect();
                let batch = PeerEvent::Motion(PeerMotion::on_time(samples, ms(now)));
                room.handle_event(PeerKey(who), batch, ms(now));
            }
        }
        if room.poll_timeout() <= ms(now) {
            room.handle_tick(ms(now), &mut || true);
        }
        for output in drain(&mut room) {
            let Output::Datagram(peer, PeerDatagram::Motion(round)) = output else {
                continue;
            };
            *sent.entry(peer).or_insert(0) += 1;
            for track in &round.tracks {
                let last = track.samples[track.samples.len() - 1].time;
                newest.insert((peer, track.participant), last);
            }
        }
    }
    (sent, newest)
}

#[test]
fn many_participants_receive_rounds_instead_of_every_batch() {
    let (sent, newest) = second_of(32);
    assert_eq!(sent.len(), 32);
    for (peer, count) in &sent {
        assert!((80..=130).contains(count), "{count} rounds to {peer:?}");
    }
    for peer in 1..=32 {
        for who in 1..=32 {
            let last = newest[&(PeerKey(peer), ParticipantId(who))];
            assert!(last >= ms(995), "{who} to {peer}: {last:?}");
        }
    }
}

#[test]
fn two_participants_receive_every_batch_within_four_milliseconds() {
    let (sent, _) = second_of(2);
    for (peer, count) in &sent {
        assert!((240..=260).contains(count), "{count} rounds to {peer:?}");
    }
}

#[test]
fn full_session_refuses_another_client_and_continues() {
    let mut room = room_of(1000, 0);
    let come = |room: &mut SimulatedRoom, who: u16, role: Role| {
        let hello = hello(&format!("p{who}"), role, ToolKind::Probe);
        room.handle_event(PeerKey(u64::from(who)), hello, ms(0));
        drain(room)
    };
    for who in 1..=SEATS_MAX {
        assert_eq!(refusal(&come(&mut room, who, Role::Trainee)), None, "{who}");
    }
    // A spectator takes a seat, too.
    for role in [Role::Trainee, Role::Spectator] {
        let reason = refusal(&come(&mut room, SEATS_MAX + 1, role)).unwrap();
        assert_eq!(
            reason,
            RefusalReason::Full {
                role,
                seats: SEATS_MAX
            }
        );
        let sentence = reason.to_string();
        assert!(
            sentence.contains(&format!("all 64 seats for the role {role} are taken")),
            "{sentence}"
        );
        assert!(sentence.contains("come back"), "{sentence}");
    }
    assert_eq!(room.participant_count(), usize::from(SEATS_MAX));
    let (sent, newest) = second_of(SEATS_MAX);
    for (peer, count) in &sent {
        assert!((50..=75).contains(count), "{count} rounds to {peer:?}");
    }
    assert_eq!(newest.len(), 64 * 64);
}

#[test]
fn needle_is_inserted_in_the_tissue_while_its_samples_say_so() {
    let mut lesson = Lesson::new();
    let needle = ToolDescription {
        kind: ToolKind::Needle,
        length_m: 0.05,
        ..ToolDescription::probe(0.6e-3)
    };
    lesson.request(2, RequestKind::SetTool(needle)).unwrap();
    let begin = lesson.now.as_micros() / 1000;
    let sample = |t: i64| ToolSample {
        time: ms(t),
        buttons: if (begin + 40..begin + 80).contains(&t) {
            INSERTED_BUTTON
        } else {
            0
        },
        ..ToolSample::default()
    };
    let samples = (begin..begin + 120).map(sample).collect();
    let batch = PeerMotion::on_time(samples, ms(begin + 120));
    let now = ms(begin + 120);
    lesson
        .room
        .handle_event(PeerKey(2), PeerEvent::Motion(batch), now);
    for (t, is_inserted) in [(20, false), (60, true), (100, false)] {
        let tools = lesson.room.pressing_at(ParticipantId(2), ms(begin + t));
        let needle = tools[0].needle.expect("it is a needle");
        assert_eq!(
            (needle.is_inserted, needle.decides),
            (is_inserted, false),
            "{t}"
        );
    }
}
