//! A vector in shared pages: a copy costs a pointer per page, and a change copies one page.

use std::ops::{Index, IndexMut};
use std::sync::Arc;

/// Items per page.
const PAGE: usize = 512;

/// A vector whose copies share the pages that have not changed since.
#[derive(Debug, Clone)]
pub(crate) struct Pages<T> {
    /// All full but the last.
    pages: Vec<Arc<Vec<T>>>,
    len: usize,
}

impl<T: Clone> Pages<T> {
    /// Number of items.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Appends an item.
    pub(crate) fn push(&mut self, item: T) {
        if self.len.is_multiple_of(PAGE) {
            self.pages.push(Arc::new(Vec::with_capacity(PAGE)));
        }
        if let Some(last) = self.pages.last_mut() {
            Arc::make_mut(last).push(item);
        }
        self.len += 1;
    }

    /// The items in order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &T> + Clone {
        self.pages.iter().flat_map(|page| page.iter())
    }
}

impl<T: Clone> From<Vec<T>> for Pages<T> {
    fn from(items: Vec<T>) -> Self {
        Self {
            len: items.len(),
            pages: items
                .chunks(PAGE)
                .map(|page| Arc::new(page.to_vec()))
                .collect(),
        }
    }
}

impl<T> Index<usize> for Pages<T> {
    type Output = T;

    #[inline]
    fn index(&self, at: usize) -> &T {
        &self.pages[at / PAGE][at % PAGE]
    }
}

impl<T: Clone> IndexMut<usize> for Pages<T> {
    fn index_mut(&mut self, at: usize) -> &mut T {
        &mut Arc::make_mut(&mut self.pages[at / PAGE])[at % PAGE]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[derive(Debug, Clone)]
    enum Step {
        Push(u8),
        Set(prop::sample::Index, u8),
        Copy,
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            any::<u8>().prop_map(Step::Push),
            (any::<prop::sample::Index>(), any::<u8>()).prop_map(|(at, v)| Step::Set(at, v)),
            Just(Step::Copy),
        ]
    }

    proptest! {
        #[test]
        fn copies_are_independent_vectors(
            first in prop::collection::vec(any::<u8>(), PAGE - 5..PAGE + 5),
            steps in prop::collection::vec(step(), 0..40),
        ) {
            let mut now = (Pages::from(first.clone()), first);
            let mut copies = Vec::new();
            for step in steps {
                match step {
                    Step::Push(v) => {
                        now.0.push(v);
                        now.1.push(v);
                    }
                    Step::Set(at, v) => {
                        let at = at.index(now.1.len());
                        now.0[at] = v;
                        now.1[at] = v;
                    }
                    Step::Copy => copies.push(now.clone()),
                }
            }
            copies.push(now);
            for (pages, items) in copies {
                prop_assert_eq!(pages.len(), items.len());
                prop_assert!(pages.iter().eq(&items));
                prop_assert!((0..items.len()).all(|i| pages[i] == items[i]));
            }
        }
    }
}
