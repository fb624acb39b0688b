//! The ways back from cuts that an undo may take.

use super::chain::Chain;
use super::hierarchy::Hierarchy;
use super::reversal::Reversal;

/// For each kept state of the history the ways back to it from the next one, in order.
#[derive(Clone)]
pub(super) struct Journal {
    /// Parts of strokes at its start.
    first: usize,
    ways: Vec<(usize, Chain<Reversal>)>,
}

/// The ways back from no cut, in the order of the cuts.
fn none() -> Chain<Reversal> {
    Chain::new(|earlier: Reversal, way| way.then(earlier))
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
        let mut ways = none();
        ways.push(way);
        self.ways.push((parts, ways));
    }

    /// Joins the ways over states that are not kept any more.
    pub(super) fn thin(&mut self, is_kept: impl Fn(usize) -> bool) {
        let mut all: Vec<(usize, Chain<Reversal>)> = Vec::with_capacity(self.ways.len());
        for (parts, ways) in self.ways.drain(..) {
            if is_kept(parts) {
                all.push((parts, ways));
            } else if let Some((_, earlier)) = all.last_mut() {
                earlier.append(ways);
            }
        }
        self.ways = all;
    }

    /// Takes the way back to the state after the first `parts`; `None` if the journal began later.
    pub(super) fn take(&mut self, parts: usize, hierarchy: &Hierarchy) -> Option<Reversal> {
        if self.ways.is_empty() && parts == self.first {
            return Some(Reversal::none(hierarchy));
        }
        let first = self.ways.iter().position(|way| way.0 == parts);
        let taken = self.ways.split_off(first.unwrap_or(0));
        first?;
        let mut all = none();
        for (_, ways) in taken {
            all.append(ways);
        }
        all.joined()
    }
}
