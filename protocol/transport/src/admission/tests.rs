//! Laws of the admission, in virtual time.

use std::net::Ipv4Addr;

use proptest::prelude::*;

use super::*;

const S: i64 = 1_000_000;

/// More time than a join takes over the worst path that a session can use.
const JOIN: Span = Span::from_millis(1000);

fn v4(n: u32) -> IpAddr {
    Ipv4Addr::from_bits(0x0a00_0000 + n).into()
}

fn at(us: i64) -> Span {
    Span::from_micros(us)
}

fn admitted(verdict: Verdict) -> Option<(Ticket, Option<Ticket>)> {
    match verdict {
        Verdict::Admit { ticket, evicted } => Some((ticket, evicted)),
        Verdict::Retry | Verdict::Ignore => None,
    }
}

#[derive(Debug, Clone)]
enum Event {
    /// Attempts of an address that has or has not proved itself.
    Attempts(u32, bool, usize),
    /// The connection with this rank in age completes its handshake, hello or join.
    Shakes(usize),
    Hello(usize),
    Joins(usize),
    Timeout,
}

fn event() -> impl Strategy<Value = Event> {
    let address = prop_oneof![3 => 0_u32..3, 1 => 0_u32..5000];
    let rank = 0_usize..PENDING_MAX;
    prop_oneof![
        6 => (address, prop::bool::weighted(0.9), 1_usize..80)
            .prop_map(|(from, is_proved, times)| Event::Attempts(from, is_proved, times)),
        1 => rank.clone().prop_map(Event::Shakes),
        1 => rank.clone().prop_map(Event::Hello),
        1 => rank.prop_map(Event::Joins),
        1 => Just(Event::Timeout),
    ]
}

/// The pending connections of an address.
fn count(admission: &Admission, address: IpAddr) -> usize {
    let all = admission.pending.values();
    all.filter(|p| p.address == address).count()
}

proptest! {
    // A case has some thousand attempts.
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn tables_are_bounded_and_only_the_oldest_of_the_most_crowded_address_is_evicted(
        events in prop::collection::vec((event(), 0..400_000_i64), 1..120),
    ) {
        let mut admission = Admission::new(Span::ZERO);
        let mut now = Span::ZERO;
        for (event, wait) in events {
            now += at(wait);
            let nth = |a: &Admission, rank: usize| a.pending.keys().nth(rank).copied();
            match event {
                Event::Attempts(from, is_proved, times) => for _ in 0..times {
                    let before: Vec<(Ticket, IpAddr)> =
                        admission.pending.iter().map(|(t, p)| (*t, p.address)).collect();
                    let verdict = admission.handle_attempt(v4(from), is_proved, now);
                    let Some((ticket, evicted)) = admitted(verdict) else {
                        prop_assert_eq!(before.len(), admission.pending.len());
                        continue;
                    };
                    prop_assert!(admission.pending.contains_key(&ticket), "a newcomer is never evicted");
                    prop_assert_eq!(evicted.is_some(), before.len() == PENDING_MAX);
                    if let Some(evicted) = evicted {
                        let mut crowds = BTreeMap::from([(v4(from), 1)]);
                        for (_, address) in &before {
                            *crowds.entry(*address).or_insert(0) += 1;
                        }
                        let most = before.iter().map(|(_, a)| crowds[a]).max().unwrap();
                        let oldest = before.iter().find(|(_, a)| crowds[a] == most);
                        prop_assert_eq!(oldest.unwrap().0, evicted);
                    }
                },
                Event::Shakes(rank) => if let Some(ticket) = nth(&admission, rank) {
                    prop_assert!(admission.handle_handshake(ticket, now));
                },
                Event::Hello(rank) => if let Some(ticket) = nth(&admission, rank) {
                    admission.handle_hello(ticket, now);
                },
                Event::Joins(rank) => if let Some(ticket) = nth(&admission, rank) {
                    admission.finish(ticket);
                },
                Event::Timeout => {
                    admission.handle_timeout(now);
                    for pending in admission.pending.values() {
                        prop_assert!(now - pending.since < pending.stage.time_max());
                    }
                }
            }
            prop_assert!(admission.pending.len() <= PENDING_MAX);
            prop_assert!(admission.origins.len() <= ADDRESSES_MAX);
            for (address, origin) in &admission.origins {
                prop_assert_eq!(origin.pending, count(&admission, *address));
            }
        }
    }

    #[test]
    fn honest_address_joins_during_any_flood_of_few_addresses(
        crowd in 1_u32..5,
        waits_us in prop::collection::vec(100..20_000_i64, 200..800),
        leaves_after in 0..2_i64,
    ) {
        let honest: IpAddr = v4(1000);
        let mut admission = Admission::new(Span::ZERO);
        let mut now = Span::ZERO;
        let mut joining: Option<(Ticket, Span)> = None;
        let mut joined = 0;
        for (i, wait) in waits_us.into_iter().enumerate() {
            now += at(wait);
            let from = v4(i as u32 % crowd);
            let verdict = admission.handle_attempt(from, true, now);
            if let Some((_, Some(evicted))) = admitted(verdict) {
                prop_assert!(joining.is_none_or(|(ticket, _)| ticket != evicted));
            }
            for over in admission.handle_timeout(now) {
                prop_assert!(joining.is_none_or(|(ticket, _)| ticket != over));
            }
            match joining {
                None => {
                    // Five attackers at their rate leave nothing of the total rate.
                    let verdict = admission.handle_attempt(honest, true, now);
                    let (ticket, evicted) = admitted(verdict).unwrap();
                    prop_assert_ne!(evicted, Some(ticket));
                    joining = Some((ticket, now));
                }
                Some((ticket, since)) if now - since >= JOIN + at(leaves_after * S / 2) => {
                    admission.finish(ticket);
                    joining = None;
                    joined += 1;
                }
                Some(_) => {}
            }
        }
        prop_assert!(joined > 0 || now < at(2 * S));
    }
}

#[test]
fn newcomers_join_while_one_address_opens_ten_thousand_handshakes() {
    let mut admission = Admission::new(Span::ZERO);
    for ms in 0..10_000 {
        let now = at(ms * 1000);
        admission.handle_attempt(v4(1), true, now);
        if ms % 100 == 0 {
            let newcomer = v4(100 + ms as u32);
            let (ticket, _) = admitted(admission.handle_attempt(newcomer, true, now)).unwrap();
            assert!(admission.handle_handshake(ticket, now));
            admission.handle_hello(ticket, now);
            admission.finish(ticket);
        }
        admission.handle_timeout(now);
    }
    let stats = admission.stats();
    assert!(
        stats.dropped > 7000,
        "{stats:?}: 200 of 1,000 a second pass"
    );
    assert!(stats.evicted > 1000, "{stats:?}");
}

#[test]
fn address_with_one_connection_loses_it_only_while_no_address_has_two() {
    let mut admission = Admission::new(Span::ZERO);
    let (honest, _) = admitted(admission.handle_attempt(v4(0), true, Span::ZERO)).unwrap();
    for n in 1..PENDING_MAX as u32 {
        let verdict = admission.handle_attempt(v4(n), true, Span::ZERO);
        assert_eq!(admitted(verdict).unwrap().1, None);
    }
    // An address comes a second time and loses its first connection.
    let verdict = admission.handle_attempt(v4(7), true, at(1));
    let (second, evicted) = admitted(verdict).unwrap();
    assert!(evicted.is_some_and(|ticket| ticket != honest));
    assert!(admission.pending.contains_key(&second));
    // Now all have one; the oldest gives way.
    let verdict = admission.handle_attempt(v4(5000), true, at(1));
    assert_eq!(admitted(verdict).unwrap().1, Some(honest));
    assert!(!admission.handle_handshake(honest, at(1)), "it is evicted");
}

#[test]
fn unproved_addresses_use_up_nothing_under_pressure() {
    let mut admission = Admission::new(Span::ZERO);
    for _ in 0..RETRY_FROM {
        assert!(admitted(admission.handle_attempt(v4(1), false, Span::ZERO)).is_some());
    }
    let before = format!("{:?} {:?}", admission.pending, admission.total);
    for n in 0..10_000 {
        let verdict = admission.handle_attempt(v4(n), false, Span::ZERO);
        assert_eq!(verdict, Verdict::Retry);
    }
    assert_eq!(
        before,
        format!("{:?} {:?}", admission.pending, admission.total)
    );
    assert_eq!(admission.origins.len(), 1);
    assert!(admitted(admission.handle_attempt(v4(2), true, Span::ZERO)).is_some());
}

#[test]
fn table_of_addresses_has_room_during_a_flood_of_all_addresses() {
    let mut admission = Admission::new(Span::ZERO);
    let mut total = 0;
    for n in 0..100_000_u32 {
        // Ten thousand attempts per second, each of a new address.
        let verdict = admission.handle_attempt(v4(n), true, at(i64::from(n) * 100));
        total += u32::from(admitted(verdict).is_some());
        assert!(admission.origins.len() <= ADDRESSES_MAX);
    }
    // The burst and ten seconds: only the total rate limits them.
    assert!((10_900..=11_000).contains(&total), "{total}");
}

#[test]
fn each_stage_has_its_own_time() {
    let mut admission = Admission::new(Span::ZERO);
    let mut attempt = |n| {
        admitted(admission.handle_attempt(v4(n), true, Span::ZERO))
            .unwrap()
            .0
    };
    let (slow, quiet, waiting) = (attempt(1), attempt(2), attempt(3));
    admission.handle_handshake(quiet, at(S));
    admission.handle_handshake(waiting, at(S));
    admission.handle_hello(waiting, at(2 * S));
    assert_eq!(admission.handle_timeout(at(3 * S - 1)), []);
    assert_eq!(admission.handle_timeout(at(3 * S)), [quiet]);
    assert_eq!(admission.handle_timeout(at(10 * S)), [slow]);
    assert_eq!(admission.handle_timeout(at(12 * S)), [waiting]);
    assert_eq!(admission.stats().timed_out, 3);
}

#[test]
fn hosts_of_one_ipv6_network_count_as_one_address() {
    let ip = |text: &str| prefix(text.parse().unwrap());
    assert_eq!(ip("2001:db8::1"), ip("2001:db8::ffff:2"));
    assert_ne!(ip("2001:db8::1"), ip("2001:db8:0:1::1"));
    assert_eq!(ip("::ffff:192.0.2.1"), ip("192.0.2.1"));
    assert_ne!(ip("192.0.2.1"), ip("192.0.2.2"));
}
