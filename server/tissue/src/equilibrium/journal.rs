//! The ways back from cuts that an undo may take.

use super::hierarchy::Hierarchy;
use super::reversal::Reversal;

/// For each kept state of the history the way back to it from the next one, in order.
#[derive(Clone)]
pub(super) struct Journal {
    /// Parts of strokes at its start.
    first: usize,
    ways: Vec<(usize, Reversal)>,
}

impl Journal {
    /// An empty journal from the state after this many parts on.
    pub(super) fn new(parts: usize) -> Self {
        Self {
            first: parts,
            ways: Vec::new(),
        }
    }

    /// Adds the way back from a part that was cut after the first `parts`.
    pub(super) fn push(&mut self, parts: usize, way: Reversal) {
        self.ways.push((parts, way));
    }

    /// Joins the ways over states that are not kept any more.
    pub(super) fn thin(&mut self, is_kept: impl Fn(usize) -> bool) {
        let mut ways: Vec<(usize, Reversal)> = Vec::with_capacity(self.ways.len());
        for (parts, way) in self.ways.drain(..) {
            if is_kept(parts) {
                ways.push((parts, way));
            } else if let Some((earlier_parts, earlier)) = ways.pop() {
                ways.push((earlier_parts, way.then(earlier)));
            }
        }
        self.ways = ways;
    }

    /// Takes the way back to the state after the first `parts`; `None` if the journal began later.
    pub(super) fn take(&mut self, parts: usize, hierarchy: &Hierarchy) -> Option<Reversal> {
        if self.ways.is_empty() && parts == self.first {
            return Some(Reversal::none(hierarchy));
        }
        let first = self.ways.iter().position(|way| way.0 == parts);
        let mut ways = self.ways.split_off(first.unwrap_or(0)).into_iter().rev();
        let newest = first.and(ways.next())?;
        Some(ways.fold(newest.1, |way, earlier| way.then(earlier.1)))
    }
}
