//! Which numbered datagrams arrived, for duplicates, loss and acknowledgement.

/// How far back a duplicate is recognised. Everything older is refused as old.
pub const WINDOW_BITS: u32 = 64;

/// The window's verdict on a datagram's number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arrival {
    /// Newer than all before.
    New,
    /// Late, but seen for the first time.
    Late,
    /// Seen before.
    Duplicate,
    /// Too far behind to know.
    Old,
}

impl Arrival {
    /// Whether the content is to be read.
    pub const fn is_fresh(self) -> bool {
        matches!(self, Self::New | Self::Late)
    }
}

/// The last [`WINDOW_BITS`] numbers of one stream of datagrams. Numbers wrap around at 2^32.
#[derive(Debug, Clone, Default)]
pub struct SequenceWindow {
    /// Highest number seen and, in bit i, whether the number i below it was seen.
    newest: Option<(u32, u64)>,
    first: u32,
    received: u64,
    duplicates: u64,
    old: u64,
}

impl SequenceWindow {
    /// An empty window.
    pub fn new() -> Self {
        Self::default()
    }

    /// Notes the arrival of number `n`.
    pub fn insert(&mut self, n: u32) -> Arrival {
        let Some((newest, bits)) = self.newest else {
            self.newest = Some((n, 1));
            self.first = n;
            self.received = 1;
            return Arrival::New;
        };
        let ahead = n.wrapping_sub(newest) as i32;
        if ahead > 0 {
            let shifted = bits.checked_shl(ahead as u32).unwrap_or(0);
            self.newest = Some((n, shifted | 1));
            self.received += 1;
            return Arrival::New;
        }
        let behind = ahead.unsigned_abs();
        if behind >= WINDOW_BITS {
            self.old += 1;
            return Arrival::Old;
        }
        let bit = 1_u64 << behind;
        if bits & bit != 0 {
            self.duplicates += 1;
            return Arrival::Duplicate;
        }
        if (n.wrapping_sub(self.first) as i32) < 0 {
            self.first = n;
        }
        self.newest = Some((newest, bits | bit));
        self.received += 1;
        Arrival::Late
    }

    /// The newest number and, in bit i, whether the number 1 + i below it arrived; `None` before
    /// the first.
    pub fn acknowledgement(&self) -> Option<(u32, u32)> {
        self.newest.map(|(n, bits)| (n, (bits >> 1) as u32))
    }

    /// How many different numbers arrived.
    pub fn received(&self) -> u64 {
        self.received
    }

    /// The number of datagrams sent, inferred from the newest number.
    pub fn expected(&self) -> u64 {
        self.newest
            .map_or(0, |(n, _)| u64::from(n.wrapping_sub(self.first)) + 1)
    }

    /// The number of duplicates.
    pub fn duplicates(&self) -> u64 {
        self.duplicates
    }

    /// The number of datagrams that were too old for the window.
    pub fn old(&self) -> u64 {
        self.old
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn duplicates_and_old_numbers_are_distinguished() {
        let mut w = SequenceWindow::new();
        assert_eq!(w.insert(100), Arrival::New);
        assert_eq!(w.insert(102), Arrival::New);
        assert_eq!(w.insert(101), Arrival::Late);
        assert_eq!(w.insert(101), Arrival::Duplicate);
        assert_eq!(w.insert(102 + 70), Arrival::New);
        assert_eq!(w.insert(102), Arrival::Old);
        assert_eq!(w.acknowledgement(), Some((172, 0)));
        assert_eq!(
            (w.duplicates(), w.old(), w.received(), w.expected()),
            (1, 1, 4, 73)
        );
    }

    #[test]
    fn numbers_wrap_around() {
        let mut w = SequenceWindow::new();
        assert_eq!(w.insert(u32::MAX), Arrival::New);
        assert_eq!(w.insert(0), Arrival::New);
        assert_eq!(w.insert(u32::MAX), Arrival::Duplicate);
        assert_eq!(w.expected(), 2);
    }

    proptest! {
        #[test]
        fn each_number_is_fresh_at_most_once(numbers in proptest::collection::vec(0_u32..200, 0..400)) {
            let mut w = SequenceWindow::new();
            let mut fresh = std::collections::HashSet::new();
            for n in numbers {
                if w.insert(n).is_fresh() {
                    prop_assert!(fresh.insert(n));
                }
            }
            prop_assert_eq!(w.received(), fresh.len() as u64);
            prop_assert!(w.expected() >= w.received());
        }
    }
}
