//! Rows of different lengths in one array.

use crate::equilibrium::reserve;

/// Rows in one array, in order as built; a row that has grown moves to the end.
#[derive(Debug, Clone, Default)]
pub struct Rows<T> {
    /// First item and end of each row.
    ends: Vec<[u32; 2]>,
    items: Vec<T>,
}

impl<T: Copy + Default> Rows<T> {
    /// The rows of `pairs`, each `(row, item)`, items in the order given.
    pub fn new(rows: usize, pairs: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let mut ends = vec![[0u32; 2]; rows];
        for (row, _) in pairs.clone() {
            ends[row as usize][1] += 1;
        }
        let mut first = 0;
        for row in &mut ends {
            let len = row[1];
            *row = [first; 2];
            first += len;
        }
        let mut items = vec![T::default(); first as usize];
        for (row, item) in pairs {
            let at = &mut ends[row as usize][1];
            items[*at as usize] = item;
            *at += 1;
        }
        Self { ends, items }
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.ends.len()
    }

    /// The items of a row.
    #[inline]
    pub fn row(&self, row: u32) -> &[T] {
        let [first, end] = self.ends[row as usize];
        &self.items[first as usize..end as usize]
    }

    /// Number of items of a row.
    #[inline]
    pub fn len(&self, row: u32) -> u32 {
        let [first, end] = self.ends[row as usize];
        end - first
    }

    /// Replaces the items of a row, which may be new.
    pub fn set(&mut self, row: u32, items: &[T]) {
        let r = row as usize;
        if self.ends.len() <= r {
            self.ends.resize(r + 1, [0; 2]);
        }
        if items.len() > self.len(row) as usize {
            self.ends[r][0] = self.items.len() as u32;
            self.items.extend_from_slice(items);
        } else {
            let first = self.ends[r][0] as usize;
            self.items[first..first + items.len()].copy_from_slice(items);
        }
        self.ends[r][1] = self.ends[r][0] + items.len() as u32;
    }

    /// Makes room for the rows and items that cuts will add.
    pub(crate) fn reserve(&mut self) {
        reserve(&mut self.ends);
        reserve(&mut self.items);
    }

    /// Sorts the items of each row.
    pub fn sort_rows(&mut self, order: impl Fn(&T, &T) -> std::cmp::Ordering) {
        for &[first, end] in &self.ends {
            self.items[first as usize..end as usize].sort_unstable_by(&order);
        }
    }

    #[cfg(test)]
    pub(crate) fn heap_bytes(&self) -> usize {
        self.ends.capacity() * size_of::<[u32; 2]>() + self.items.capacity() * size_of::<T>()
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
            sets in prop::collection::vec((0_u32..9, prop::collection::vec(any::<u8>(), 0..7)), 0..20),
        ) {
            let mut rows = Rows::new(6, pairs.iter().copied());
            let mut expected: Vec<Vec<u8>> = (0..6)
                .map(|r| pairs.iter().filter(|p| p.0 == r).map(|p| p.1).collect())
                .collect();
            for (row, items) in sets {
                rows.set(row, &items);
                expected.resize(expected.len().max(row as usize + 1), Vec::new());
                expected[row as usize] = items;
            }
            for (r, items) in expected.iter().enumerate() {
                prop_assert_eq!(rows.row(r as u32), &items[..]);
                prop_assert_eq!(rows.len(r as u32) as usize, items.len());
            }
        }
    }
}
