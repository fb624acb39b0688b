//! Which shapes a page gets, when each travels on a stream of its own.
//!
//! A change needs the shape before it, so a page that lost one needs a full shape. Full shapes are never given up, or a
//! slow path would not deliver any; meanwhile changes are dropped. A change is given up when two newer shapes have been
//! sent and it has not arrived in due time.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use palpate_transport::Delivery;

/// Shapes under way at once, 2 s of them; further ones are dropped.
const STREAMS_MAX: usize = 64;

/// A change that is under way for longer than this and three round trips is late: a lost packet is repeated within two.
const LATE: Duration = Duration::from_millis(100);

/// A shape under way.
pub(crate) trait Sent {
    /// Whether it has arrived, or never will.
    fn is_done(&self) -> bool;
    /// Gives it up.
    fn reset(self);
}

impl Sent for Delivery {
    fn is_done(&self) -> bool {
        Delivery::is_done(self)
    }

    fn reset(self) {
        Delivery::reset(self);
    }
}

struct Open<S> {
    is_full: bool,
    at: Instant,
    sent: S,
}

/// The shapes under way to one page, oldest first.
pub(crate) struct ShapeStreams<S> {
    open: VecDeque<Open<S>>,
}

impl<S> Default for ShapeStreams<S> {
    fn default() -> Self {
        Self {
            open: VecDeque::new(),
        }
    }
}

impl<S: Sent> ShapeStreams<S> {
    /// Whether to send the next shape now. If not, it must be dropped, and the page needs a full shape next. Gives up the
    /// changes that are late.
    pub(crate) fn make_room(&mut self, is_full: bool, now: Instant, round_trip: Duration) -> bool {
        self.open.retain(|shape| !shape.sent.is_done());
        let late = LATE + 3 * round_trip;
        // The next shape is one of the two newer ones.
        let overtaken = self.open.len().saturating_sub(1);
        let is_late = |shape: &Open<S>| !shape.is_full && now - shape.at > late;
        if self.open.iter().take(overtaken).any(is_late) {
            // The changes after it can not be displayed without it.
            for shape in std::mem::take(&mut self.open) {
                if shape.is_full {
                    self.open.push_back(shape);
                } else {
                    shape.sent.reset();
                }
            }
            return false;
        }
        let has_full = self.open.iter().any(|shape| shape.is_full);
        self.open.len() < STREAMS_MAX && !(is_full && has_full)
    }

    /// Adds a shape that was sent.
    pub(crate) fn add(&mut self, is_full: bool, at: Instant, sent: S) {
        self.open.push_back(Open { is_full, at, sent });
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::rc::Rc;

    use super::*;

    #[derive(Clone, Default)]
    struct Fake {
        is_done: Rc<Cell<bool>>,
        is_reset: Rc<Cell<bool>>,
    }

    impl Sent for Fake {
        fn is_done(&self) -> bool {
            self.is_done.get()
        }

        fn reset(self) {
            self.is_reset.set(true);
        }
    }

    struct Path {
        streams: ShapeStreams<Fake>,
        began: Instant,
    }

    impl Path {
        fn new() -> Self {
            Self {
                streams: ShapeStreams::default(),
                began: Instant::now(),
            }
        }

        /// Offers a shape after a time; returns it if it is sent. The round trip is 100 ms.
        fn offer(&mut self, is_full: bool, ms: u64) -> Option<Fake> {
            let now = self.began + Duration::from_millis(ms);
            let round_trip = Duration::from_millis(100);
            self.streams.make_room(is_full, now, round_trip).then(|| {
                let sent = Fake::default();
                self.streams.add(is_full, now, sent.clone());
                sent
            })
        }
    }

    #[test]
    fn late_change_is_reset_once_two_newer_shapes_exist_and_not_before() {
        let mut path = Path::new();
        let first = path.offer(false, 0).unwrap();
        let second = path.offer(false, 500).unwrap();
        assert!(!first.is_reset.get(), "one newer shape");
        assert!(path.offer(false, 501).is_none());
        assert!(first.is_reset.get() && second.is_reset.get());
        assert!(path.offer(true, 502).is_some(), "a full shape follows");
    }

    #[test]
    fn change_in_due_time_is_kept_however_many_are_newer() {
        let mut path = Path::new();
        let first = path.offer(false, 0).unwrap();
        for ms in (33..400).step_by(33) {
            assert!(path.offer(false, ms).is_some());
        }
        assert!(!first.is_reset.get());
    }

    #[test]
    fn full_shape_arrives_on_a_slow_path_before_the_next_full_one_is_sent() {
        let mut path = Path::new();
        let full = path.offer(true, 0).unwrap();
        let change = path.offer(false, 33).unwrap();
        path.offer(false, 66).unwrap();
        assert!(path.offer(false, 2000).is_none(), "the changes are late");
        assert!(change.is_reset.get() && !full.is_reset.get());
        assert!(path.offer(true, 2033).is_none(), "one full shape at a time");
        full.is_done.set(true);
        assert!(path.offer(true, 2066).is_some());
    }
}
