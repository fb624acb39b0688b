//! A vector in shared pages: a copy costs a pointer per half a megabyte, and a change copies a page of 2 kB and
//! the pointers to its neighbours.

use std::ops::{Index, IndexMut};
use std::sync::Arc;

/// Bytes of a page. A cut changes a few items on each of several pages, and every kept state of the history has its own
/// copies of them: with pages of 16 kB a log of 1,000 cuts takes 20 MB more.
const PAGE_BYTES: usize = 2048;
/// Pages per branch.
const BRANCH: usize = 256;

type Page<T> = Arc<Vec<T>>;

/// A vector whose copies share the pages that have not changed since: a tree of two levels.
#[derive(Debug, Clone)]
pub(crate) struct Pages<T> {
    /// Branches and pages are full but for the last.
    branches: Vec<Arc<Vec<Page<T>>>>,
    len: usize,
}

impl<T> Pages<T> {
    /// Items per page.
    const PAGE: usize = {
        assert!(size_of::<T>() <= PAGE_BYTES, "an item fits into a page");
        PAGE_BYTES / size_of::<T>().next_power_of_two()
    };
}

impl<T> Default for Pages<T> {
    fn default() -> Self {
        Self {
            branches: Vec::new(),
            len: 0,
        }
    }
}

impl<T: Clone> Pages<T> {
    /// Copies of one item, which share one page.
    pub(crate) fn filled(item: T, len: usize) -> Self {
        let rest = Arc::new(vec![item.clone(); len % Self::PAGE]);
        let full = Arc::new(vec![item; Self::PAGE]);
        let mut pages: Vec<Page<T>> = std::iter::repeat_n(full, len / Self::PAGE).collect();
        pages.extend((!rest.is_empty()).then_some(rest));
        let branches = pages.chunks(BRANCH);
        Self {
            branches: branches.map(|branch| Arc::new(branch.to_vec())).collect(),
            len,
        }
    }

    /// Number of items.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Appends an item.
    pub(crate) fn push(&mut self, item: T) {
        if self.len.is_multiple_of(Self::PAGE * BRANCH) {
            self.branches.push(Arc::default());
        }
        if let Some(branch) = self.branches.last_mut().map(Arc::make_mut) {
            if self.len.is_multiple_of(Self::PAGE) {
                branch.push(Arc::new(Vec::with_capacity(Self::PAGE)));
            }
            if let Some(page) = branch.last_mut() {
                Arc::make_mut(page).push(item);
            }
        }
        self.len += 1;
    }

    /// The items in order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &T> + Clone {
        let pages = self.branches.iter().flat_map(|branch| branch.iter());
        pages.flat_map(|page| page.iter())
    }
}

impl<T: Clone> From<Vec<T>> for Pages<T> {
    fn from(items: Vec<T>) -> Self {
        let page = |page: &[T]| Arc::new(page.to_vec());
        let branch = |branch: &[T]| Arc::new(branch.chunks(Self::PAGE).map(page).collect());
        Self {
            len: items.len(),
            branches: items.chunks(Self::PAGE * BRANCH).map(branch).collect(),
        }
    }
}

impl<T> Index<usize> for Pages<T> {
    type Output = T;

    #[inline]
    fn index(&self, at: usize) -> &T {
        &self.branches[at / (Self::PAGE * BRANCH)][at / Self::PAGE % BRANCH][at % Self::PAGE]
    }
}

impl<T: Clone> IndexMut<usize> for Pages<T> {
    fn index_mut(&mut self, at: usize) -> &mut T {
        let branch = Arc::make_mut(&mut self.branches[at / (Self::PAGE * BRANCH)]);
        &mut Arc::make_mut(&mut branch[at / Self::PAGE % BRANCH])[at % Self::PAGE]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// An item of 32 bytes.
    type Item = [u64; 4];

    const PAGE: usize = Pages::<Item>::PAGE;

    #[derive(Debug, Clone)]
    enum Step {
        Push(Item),
        Set(prop::sample::Index, Item),
        Copy,
    }

    fn item() -> impl Strategy<Value = Item> + Clone {
        any::<u64>().prop_map(|v| [v, !v, 0, 1])
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            item().prop_map(Step::Push),
            (any::<prop::sample::Index>(), item()).prop_map(|(at, v)| Step::Set(at, v)),
            Just(Step::Copy),
        ]
    }

    proptest! {
        #[test]
        fn copies_are_independent_vectors(
            first in prop_oneof![
                prop::collection::vec(item(), PAGE - 5..PAGE + 5),
                prop::collection::vec(item(), PAGE * BRANCH - 5..PAGE * BRANCH + 5),
            ],
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
            let filled = Pages::filled([7; 4], PAGE + 1);
            prop_assert!(filled.iter().eq([[7; 4]; PAGE + 1].iter()));
            for (pages, items) in copies {
                prop_assert_eq!(pages.len(), items.len());
                prop_assert!(pages.iter().eq(&items));
                prop_assert!((0..items.len()).all(|i| pages[i] == items[i]));
            }
        }
    }
}
