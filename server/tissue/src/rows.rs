//! Rows of different lengths in one array.

/// Compressed rows.
#[derive(Debug, Clone, Default)]
pub struct Rows<T> {
    first: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy + Default> Rows<T> {
    /// The rows of `pairs`, each `(row, item)`, items in the order given.
    pub fn new(rows: usize, pairs: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let mut first = vec![0u32; rows + 1];
        for (row, _) in pairs.clone() {
            first[row as usize + 1] += 1;
        }
        for r in 0..rows {
            first[r + 1] += first[r];
        }
        let mut items = vec![T::default(); first[rows] as usize];
        let mut next = first.clone();
        for (row, item) in pairs {
            let at = &mut next[row as usize];
            items[*at as usize] = item;
            *at += 1;
        }
        Self { first, items }
    }

    /// The items of a row.
    #[inline]
    pub fn row(&self, row: u32) -> &[T] {
        let r = row as usize;
        &self.items[self.first[r] as usize..self.first[r + 1] as usize]
    }

    /// Number of items of a row.
    #[inline]
    pub fn len(&self, row: u32) -> u32 {
        self.first[row as usize + 1] - self.first[row as usize]
    }

    /// Sorts the items of each row.
    pub fn sort_rows(&mut self, order: impl Fn(&T, &T) -> std::cmp::Ordering) {
        for ends in self.first.windows(2) {
            self.items[ends[0] as usize..ends[1] as usize].sort_unstable_by(&order);
        }
    }

    #[cfg(test)]
    pub(crate) fn heap_bytes(&self) -> usize {
        self.first.capacity() * size_of::<u32>() + self.items.capacity() * size_of::<T>()
    }
}
