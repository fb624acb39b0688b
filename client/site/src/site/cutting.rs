//! Prefetched cuts, from their arrival to their due time.

use std::collections::VecDeque;

use palpate_protocol::operation::Operation;

use super::{Site, ViewUpdate};
use crate::replica::{CutOrder, MadeCut};

/// Cuts between the log and the cut worker.
#[derive(Default)]
pub(super) struct Cuts {
    orders: VecDeque<CutOrder>,
    made: VecDeque<MadeCut>,
}

impl Cuts {
    /// Orders a cut.
    pub(super) fn make(&mut self, operation: &Operation) {
        self.orders.push_back(CutOrder::Make(operation.clone()));
    }
}

/// Whether the cut worker makes it: a cut, an undo, a redo or a reset.
pub(super) fn is_cut(operation: &Operation) -> bool {
    operation.kind.changes_topology()
}

impl Site {
    /// The next order to the [cut worker](crate::Prefetch).
    pub fn poll_cut_order(&mut self) -> Option<CutOrder> {
        self.cuts.orders.pop_front()
    }

    /// Takes a cut from the [cut worker](crate::Prefetch).
    pub fn handle_cut(&mut self, made: MadeCut) {
        self.cuts.made.push_back(made);
    }

    /// Applies the first waiting cut. Returns whether it was made already.
    pub(super) fn adopt_cut(&mut self) -> bool {
        let Some(made) = self.cuts.made.pop_front() else {
            return false;
        };
        let (view, retired) = self.replica.adopt(made);
        self.view_updates.push_back(ViewUpdate::Cut(view));
        self.cuts.orders.extend(retired.map(CutOrder::Retire));
        true
    }
}
