//! The network that the instructor emulates for a page.
//!
//! A page receives pictures that do not wait, so its messages wait for both directions together. The motion of its tool
//! is lost at the rate of the emulated loss; requests are not lost, because a page does not repeat them.

use std::collections::VecDeque;

use palpate_protocol::{Emulation, ServerTime};
use palpate_view::PageEvent;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Messages that may wait, 1 s of 1,000 messages; further ones are lost. A page sends at most 400 per second.
const HELD_MAX: usize = 1000;

/// See the module.
pub(super) struct EmulatedPage {
    emulation: Emulation,
    random: Pcg64Mcg,
    /// With their due times, which ascend.
    held: VecDeque<(ServerTime, PageEvent)>,
}

impl EmulatedPage {
    /// Emulates nothing. Equal seeds and calls lose equal motion.
    pub(super) fn new(seed: u64) -> Self {
        Self {
            emulation: Emulation::NONE,
            random: Pcg64Mcg::seed_from_u64(seed),
            held: VecDeque::new(),
        }
    }

    /// Changes delay and loss. Later messages do not overtake those that wait.
    pub(super) fn set(&mut self, emulation: Emulation) {
        self.emulation = emulation;
    }

    /// Whether it emulates nothing and holds nothing.
    pub(super) fn is_idle(&self) -> bool {
        self.emulation.is_none() && self.held.is_empty()
    }

    /// Takes a message that arrives now, or loses it.
    pub(super) fn push(&mut self, mut event: PageEvent, now: ServerTime) {
        let both_ways = self.emulation.delay() + self.emulation.delay();
        let mut is_lost = self.held.len() >= HELD_MAX;
        if let PageEvent::Motion { round_trip, .. } = &mut event {
            is_lost |= self.random.random::<f64>() < self.emulation.loss();
            *round_trip = round_trip.map(|real| real + both_ways);
        }
        if !is_lost {
            let last = self.held.back().map_or(now, |(due, _)| *due);
            self.held.push_back((last.max(now + both_ways), event));
        }
    }

    /// When the next message is due; `None` while none waits.
    pub(super) fn poll_timeout(&self) -> Option<ServerTime> {
        self.held.front().map(|(due, _)| *due)
    }

    /// The next message that is due.
    pub(super) fn poll(&mut self, now: ServerTime) -> Option<PageEvent> {
        self.held.front().filter(|(due, _)| now >= *due)?;
        self.held.pop_front().map(|(_, event)| event)
    }

    /// The next message, due or not, when the page is gone; motion is dropped.
    pub(super) fn take_request(&mut self) -> Option<PageEvent> {
        let mut events = std::iter::from_fn(|| self.held.pop_front());
        events.find_map(|(_, event)| matches!(event, PageEvent::Request(_)).then_some(event))
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Span;
    use palpate_view::PageRequest;

    use super::*;

    fn ms(ms: i64) -> ServerTime {
        ServerTime::from_micros(1000 * ms)
    }

    fn motion() -> PageEvent {
        PageEvent::Motion {
            samples: Vec::new(),
            round_trip: Some(Span::from_millis(20)),
        }
    }

    fn leave() -> PageEvent {
        PageEvent::Request(PageRequest::Leave)
    }

    fn network(delay_ms: u16, loss_permille: u16) -> EmulatedPage {
        let mut network = EmulatedPage::new(3);
        network.set(Emulation {
            delay_ms,
            loss_permille,
        });
        network
    }

    #[test]
    fn messages_wait_for_both_directions_in_their_order() {
        let mut network = network(150, 0);
        network.push(motion(), ms(0));
        network.push(leave(), ms(10));
        network.set(Emulation::NONE);
        network.push(motion(), ms(20));
        assert_eq!(
            (network.poll_timeout(), network.poll(ms(299))),
            (Some(ms(300)), None)
        );
        let Some(PageEvent::Motion { round_trip, .. }) = network.poll(ms(300)) else {
            panic!("the motion is due");
        };
        assert_eq!(round_trip, Some(Span::from_millis(320)));
        assert_eq!(network.poll(ms(309)), None);
        assert_eq!(network.poll(ms(310)), Some(leave()));
        assert_eq!(network.poll(ms(310)), Some(motion()));
        assert!(network.is_idle());
    }

    #[test]
    fn motion_is_lost_at_the_rate_of_the_loss_and_requests_are_not() {
        let mut network = network(0, 100);
        let mut arrived = 0;
        for t in 0..5000 {
            network.push(motion(), ms(t));
            network.push(leave(), ms(t));
            let events: Vec<_> = std::iter::from_fn(|| network.poll(ms(t))).collect();
            assert_eq!(events.last(), Some(&leave()));
            arrived += events.len() - 1;
        }
        assert!((4350..4650).contains(&arrived), "{arrived}");
    }

    #[test]
    fn requests_of_a_page_that_is_gone_are_left_and_memory_is_bounded() {
        let mut network = network(500, 0);
        network.push(leave(), ms(0));
        for _ in 0..2 * HELD_MAX {
            network.push(motion(), ms(0));
        }
        assert_eq!(network.held.len(), HELD_MAX);
        assert_eq!(network.take_request(), Some(leave()));
        assert_eq!(network.take_request(), None);
    }
}
