//! Rows of different lengths in one array.

use crate::equilibrium::{SLACK, reserve};

/// Place of a row in the array.
#[derive(Debug, Clone, Copy, Default)]
struct Slot {
    first: u32,
    len: u32,
    /// Items that it has room for.
    room: u32,
}

/// Rows in one array, in order as built; a row that has grown moves to the end. Rows that were removed keep their room for
/// later ones of the same number, so that cuts and undos in turn need no more memory.
#[derive(Debug, Clone, Default)]
pub struct Rows<T> {
    slots: Vec<Slot>,
    /// Number of rows; later slots are room.
    count: usize,
    /// Number of items of all rows.
    used: usize,
    items: Vec<T>,
}

impl<T: Copy + Default> Rows<T> {
    /// The rows of `pairs`, each `(row, item)`, items in the order given.
    pub fn new(rows: usize, pairs: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let mut slots = vec![Slot::default(); rows];
        for (row, _) in pairs.clone() {
            slots[row as usize].room += 1;
        }
        let mut first = 0;
        for slot in &mut slots {
            slot.first = first;
            first += slot.room;
        }
        let mut items = vec![T::default(); first as usize];
        for (row, item) in pairs {
            let slot = &mut slots[row as usize];
            items[(slot.first + slot.len) as usize] = item;
            slot.len += 1;
        }
        let used = items.len();
        Self {
            slots,
            count: rows,
            used,
            items,
        }
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.count
    }

    /// The items of a row.
    #[inline]
    pub fn row(&self, row: u32) -> &[T] {
        let Slot { first, len, .. } = self.slots[row as usize];
        &self.items[first as usize..][..len as usize]
    }

    /// Number of items of a row.
    #[inline]
    pub fn len(&self, row: u32) -> u32 {
        self.slots[row as usize].len
    }

    /// Replaces the items of a row, which may be new.
    pub fn set(&mut self, row: u32, items: &[T]) {
        let r = row as usize;
        self.count = self.count.max(r + 1);
        if self.slots.len() < self.count {
            self.slots.resize(self.count, Slot::default());
        }
        let slot = &mut self.slots[r];
        self.used = self.used + items.len() - slot.len as usize;
        slot.len = items.len() as u32;
        if slot.len > slot.room {
            (slot.first, slot.room) = (self.items.len() as u32, slot.len);
            self.items.extend_from_slice(items);
        } else {
            self.items[slot.first as usize..][..items.len()].copy_from_slice(items);
        }
    }

    /// Removes the rows from `rows` on.
    pub(crate) fn truncate(&mut self, rows: usize) {
        if rows >= self.count {
            return;
        }
        for slot in self.slots.iter_mut().take(self.count).skip(rows) {
            self.used -= slot.len as usize;
            slot.len = 0;
        }
        self.count = rows;
        if self.items.len() > self.used + self.used / SLACK {
            self.compact();
        }
    }

    /// Gives all room back.
    fn compact(&mut self) {
        let pairs =
            (0..self.count as u32).flat_map(|r| self.row(r).iter().map(move |&item| (r, item)));
        let mut compact = Self::new(self.count, pairs);
        compact.reserve();
        *self = compact;
    }

    /// Makes room for the rows and items that cuts will add.
    pub(crate) fn reserve(&mut self) {
        reserve(&mut self.slots);
        reserve(&mut self.items);
    }

    /// Sorts the items of each row.
    pub fn sort_rows(&mut self, order: impl Fn(&T, &T) -> std::cmp::Ordering) {
        for slot in &self.slots {
            self.items[slot.first as usize..][..slot.len as usize].sort_unstable_by(&order);
        }
    }

    #[cfg(test)]
    pub(crate) fn heap_bytes(&self) -> usize {
        self.slots.capacity() * size_of::<Slot>() + self.items.capacity() * size_of::<T>()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn rows_have_the_items_set_last(
            pairs in prop::collection::vec((0_u32..6, any::<u8>()), 0..30),
            sets in prop::collection::vec((0_u32..9, prop::option::of(prop::collection::vec(any::<u8>(), 0..7))), 0..20),
        ) {
            let mut rows = Rows::new(6, pairs.iter().copied());
            let mut expected: Vec<Vec<u8>> = (0..6)
                .map(|r| pairs.iter().filter(|p| p.0 == r).map(|p| p.1).collect())
                .collect();
            for (row, items) in sets {
                let Some(items) = items else {
                    rows.truncate(row as usize);
                    expected.truncate(row as usize);
                    continue;
                };
                rows.set(row, &items);
                expected.resize(expected.len().max(row as usize + 1), Vec::new());
                expected[row as usize] = items;
            }
            prop_assert_eq!(rows.rows(), expected.len());
            for (r, items) in expected.iter().enumerate() {
                prop_assert_eq!(rows.row(r as u32), &items[..]);
                prop_assert_eq!(rows.len(r as u32) as usize, items.len());
            }
        }
    }
}
