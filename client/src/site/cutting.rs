//! Cuts that are made elsewhere, from their arrival to their due time.

use std::collections::VecDeque;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::{ServerTime, Span};
use palpate_tissue::SolverState;

use super::{DEFERRED_MAX, Site, ViewNews};
use crate::ahead::{CutNews, CutOrder, ReadyCut};
use crate::replica::HAPTIC_PERIOD;

/// Time before its due time from which on the hand's side is prepared for a cut. On 57,000 nodes it takes half of
/// that; what is prepared earlier has to follow the tools for longer.
const PREPARE_AHEAD: Span = Span::from_millis(60);

/// Progress of the first cut that waits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Stage {
    /// It is being made, or its due time is far away.
    #[default]
    Waits,
    /// The hand's side is being prepared, and follows the tools.
    Follows,
    /// It was asked for.
    Asked,
}

/// Cuts between the log and the machine that makes them.
#[derive(Default)]
pub(super) struct Cuts {
    orders: VecDeque<CutOrder>,
    /// Memory for a state of the hand, one for each cut that is made.
    rooms: VecDeque<Box<SolverState>>,
    stage: Stage,
    /// Whether the hand's side has just been copied.
    captured: bool,
    ready: VecDeque<ReadyCut>,
}

impl Cuts {
    /// Has a cut made.
    pub(super) fn make(&mut self, operation: &Operation) {
        self.orders.push_back(CutOrder::Make(operation.clone()));
    }

    /// Whether the hand's side has been copied since the last question.
    pub(super) fn take_captured(&mut self) -> bool {
        std::mem::take(&mut self.captured)
    }
}

pub(super) fn is_cut(operation: &Operation) -> bool {
    matches!(operation.kind, OperationKind::Cut(_))
}

impl Site {
    /// The next order for [`Ahead`](crate::ahead::Ahead).
    pub fn poll_cut_order(&mut self) -> Option<CutOrder> {
        self.cuts.orders.pop_front()
    }

    /// A result of [`Ahead`](crate::ahead::Ahead).
    pub fn handle_cut(&mut self, news: CutNews) {
        match news {
            CutNews::Made(room) => self.cuts.rooms.push_back(room),
            CutNews::Ready(ready) => self.cuts.ready.push_back(ready),
        }
    }

    /// Has the hand's side prepared for the first cut that waits, in time for its due time.
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
            // It comes with the next step.
            Stage::Follows if is_near(HAPTIC_PERIOD) => {
                cuts.orders.push_back(CutOrder::HandOver);
                cuts.stage = Stage::Asked;
            }
            Stage::Waits | Stage::Follows | Stage::Asked => {}
        }
    }

    /// Passes on where the tools of the hand's newest step are.
    pub(super) fn lead_cut(&mut self) {
        if self.cuts.stage == Stage::Follows {
            let tools = self.replica.tools().to_vec();
            self.cuts.orders.push_back(CutOrder::Follow(tools));
        }
    }

    /// Applies the first cut that waits. Returns whether it is ready.
    pub(super) fn exchange(&mut self) -> bool {
        let Some(ready) = self.cuts.ready.pop_front() else {
            return false;
        };
        let (view, retired) = self.replica.exchange(ready);
        self.view_news.push_back(ViewNews::Cut(view));
        self.cuts.orders.push_back(CutOrder::Retire(retired));
        self.cuts.stage = Stage::Waits;
        true
    }
}
