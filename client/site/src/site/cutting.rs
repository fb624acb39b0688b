//! Prefetched cuts, from their arrival to their due time.

use std::collections::VecDeque;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::{ServerTime, Span};
use palpate_tissue::SolverState;

use super::{DEFERRED_MAX, Site, ViewUpdate};
use crate::replica::{CutOrder, CutWorkerEvent, HAPTIC_PERIOD, ReadyCut};

/// Lead time before the due time at which the hand's side is prepared for a cut. On 57,000 nodes it takes half of
/// that; an earlier copy would follow the tools for longer.
const PREPARE_AHEAD: Span = Span::from_millis(60);

/// Progress of the first waiting cut.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Stage {
    /// The cut is in preparation, or its due time is far away.
    #[default]
    Waits,
    /// The hand's side is in preparation and follows the tools.
    Follows,
    /// The hand-over was requested.
    Asked,
}

/// Cuts between the log and the cut worker.
#[derive(Default)]
pub(super) struct Cuts {
    orders: VecDeque<CutOrder>,
    /// Memory for the hand's solver state, one per prepared cut.
    rooms: VecDeque<Box<SolverState>>,
    stage: Stage,
    /// Whether the hand's state has just been copied.
    captured: bool,
    ready: VecDeque<ReadyCut>,
}

impl Cuts {
    /// Orders a cut.
    pub(super) fn make(&mut self, operation: &Operation) {
        self.orders.push_back(CutOrder::Make(operation.clone()));
    }

    /// Whether the hand's state has been copied since the last call.
    pub(super) fn take_captured(&mut self) -> bool {
        std::mem::take(&mut self.captured)
    }
}

pub(super) fn is_cut(operation: &Operation) -> bool {
    matches!(operation.kind, OperationKind::Cut(_))
}

impl Site {
    /// The next order to the [cut worker](crate::Prefetch).
    pub fn poll_cut_order(&mut self) -> Option<CutOrder> {
        self.cuts.orders.pop_front()
    }

    /// Processes a result of the [cut worker](crate::Prefetch).
    pub fn handle_cut(&mut self, news: CutWorkerEvent) {
        match news {
            CutWorkerEvent::Made(room) => self.cuts.rooms.push_back(room),
            CutWorkerEvent::Ready(ready) => self.cuts.ready.push_back(ready),
        }
    }

    /// Orders the hand's side of the first waiting cut, in time for its due time.
    pub(super) fn prepare_cut(&mut self, s: ServerTime) {
        if !self.is_detached {
            return;
        }
        let Some(first) = self.deferred.iter().find(|o| is_cut(o)) else {
            return;
        };
        let is_pressing = self.deferred.len() > DEFERRED_MAX;
        let is_near = |ahead: Span| is_pressing || first.at - s <= ahead;
        let cuts = &mut self.cuts;
        match cuts.stage {
            Stage::Waits if is_near(PREPARE_AHEAD) => {
                let Some(mut state) = cuts.rooms.pop_front() else {
                    return;
                };
                if let Some(tools) = self.replica.capture(&mut state) {
                    cuts.orders.push_back(CutOrder::Prepare(state, tools));
                    cuts.stage = Stage::Follows;
                    cuts.captured = true;
                }
            }
            // The cut arrives with the next step.
            Stage::Follows if is_near(HAPTIC_PERIOD) => {
                cuts.orders.push_back(CutOrder::HandOver);
                cuts.stage = Stage::Asked;
            }
            Stage::Waits | Stage::Follows | Stage::Asked => {}
        }
    }

    /// Sends the tools of the hand's newest step to the cut worker.
    pub(super) fn lead_cut(&mut self) {
        if self.cuts.stage == Stage::Follows {
            let tools = self.replica.tools().to_vec();
            self.cuts.orders.push_back(CutOrder::Follow(tools));
        }
    }

    /// Applies the first waiting cut. Returns whether it was ready.
    pub(super) fn exchange(&mut self) -> bool {
        let Some(ready) = self.cuts.ready.pop_front() else {
            return false;
        };
        let (view, retired) = self.replica.exchange(ready);
        self.view_updates.push_back(ViewUpdate::Cut(view));
        self.cuts.orders.push_back(CutOrder::Retire(retired));
        self.cuts.stage = Stage::Waits;
        true
    }
}
