//! Changes in order that are joined later.

/// Changes in order. Two runs of equal length are joined at once, as digits of a binary counter carry, so each of n changes
/// takes part in log n joins.
#[derive(Clone)]
pub(super) struct Chain<T> {
    /// Numbers of changes with these joined, each smaller than the one before.
    runs: Vec<(usize, T)>,
    /// Joins an earlier change and a later one.
    join: fn(T, T) -> T,
}

impl<T> Chain<T> {
    /// No changes.
    pub(super) fn new(join: fn(T, T) -> T) -> Self {
        Self {
            runs: Vec::new(),
            join,
        }
    }

    /// Adds the next change.
    pub(super) fn push(&mut self, change: T) {
        self.push_run(1, change);
    }

    /// Adds the changes of another chain.
    pub(super) fn append(&mut self, later: Self) {
        for (count, change) in later.runs {
            self.push_run(count, change);
        }
    }

    fn push_run(&mut self, mut count: usize, mut change: T) {
        while let Some((former, earlier)) = self.runs.pop_if(|run| run.0 <= count) {
            count += former;
            change = (self.join)(earlier, change);
        }
        self.runs.push((count, change));
    }

    /// All changes joined; `None` if there are none.
    pub(super) fn joined(self) -> Option<T> {
        let mut runs = self.runs.into_iter().rev();
        let last = runs.next()?;
        Some(runs.fold(last.1, |later, run| (self.join)(run.1, later)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The numbers of two lists in order, and the price of all joins.
    fn join(a: (Vec<u32>, usize), b: (Vec<u32>, usize)) -> (Vec<u32>, usize) {
        let all = [a.0, b.0].concat();
        let price = a.1 + b.1 + all.len();
        (all, price)
    }

    #[test]
    fn changes_stay_in_order_and_each_is_joined_log_n_times() {
        for n in [0_u32, 1, 2, 27, 300] {
            for split in [0, n / 3, n] {
                let mut chains = [Chain::new(join), Chain::new(join)];
                for k in 0..n {
                    chains[usize::from(k >= split)].push((vec![k], 0));
                }
                let [mut chain, later] = chains;
                chain.append(later);
                let (all, price) = chain.joined().unwrap_or_default();
                assert_eq!(all, (0..n).collect::<Vec<u32>>());
                let log = n.max(1).ilog2() as usize;
                assert!(price <= n as usize * (2 * log + 2), "{n}: {price}");
            }
        }
    }
}
