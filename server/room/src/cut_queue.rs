//! Cuts that wait for their preparation. Authors take turns, so that none waits for all cuts of another.

use std::collections::VecDeque;

use palpate_protocol::ParticipantId;
use palpate_protocol::session::REQUESTS_BURST_MAX;

use crate::authority::CutOrder;

/// Maximum cuts of one author, waiting or in preparation: the burst of requests, so that a stroke survives a stall.
const PER_AUTHOR_MAX: usize = REQUESTS_BURST_MAX as usize;

/// Cuts in preparation at once: one at the cutter and one on its way there.
const PREPARED_AT_ONCE: usize = 2;

/// Cuts between their requests and their reports. At most [`PER_AUTHOR_MAX`] per seat and [`PREPARED_AT_ONCE`] of
/// participants who have left.
#[derive(Debug, Default)]
pub(crate) struct CutQueue {
    waiting: VecDeque<CutOrder>,
    /// Authors of the cuts in preparation, in order.
    prepared: VecDeque<ParticipantId>,
    /// Authors by their latest turn, the latest last. A newcomer begins behind the others.
    turns: Vec<ParticipantId>,
}

impl CutQueue {
    /// Whether an author may add a cut.
    pub(crate) fn has_room(&self, author: ParticipantId) -> bool {
        let waiting = self.waiting.iter().filter(|c| c.author == author).count();
        let prepared = self.prepared.iter().filter(|a| **a == author).count();
        waiting + prepared < PER_AUTHOR_MAX
    }

    /// Adds a cut.
    pub(crate) fn push(&mut self, cut: CutOrder) {
        if !self.turns.contains(&cut.author) {
            self.turns.push(cut.author);
        }
        self.waiting.push_back(cut);
    }

    /// The next cut to prepare: the oldest one of the author whose turn was longest ago.
    pub(crate) fn poll(&mut self) -> Option<CutOrder> {
        if self.prepared.len() >= PREPARED_AT_ONCE {
            return None;
        }
        let turn = |author| self.turns.iter().position(|a| *a == author);
        let next = (0..self.waiting.len()).min_by_key(|i| turn(self.waiting[*i].author))?;
        let cut = self.waiting.remove(next)?;
        self.turns.retain(|a| *a != cut.author);
        self.turns.push(cut.author);
        self.prepared.push_back(cut.author);
        Some(cut)
    }

    /// A cut of this author was prepared or refused.
    pub(crate) fn end(&mut self, author: ParticipantId) {
        if let Some(at) = self.prepared.iter().position(|a| *a == author) {
            self.prepared.remove(at);
        }
    }

    /// Drops the waiting cuts of an author who has left.
    pub(crate) fn remove(&mut self, author: ParticipantId) {
        self.waiting.retain(|c| c.author != author);
        self.turns.retain(|a| *a != author);
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::RequestId;

    use super::*;
    use crate::authority::RequestedChange;

    fn cut(author: u16, request: u32) -> CutOrder {
        CutOrder {
            author: ParticipantId(author),
            request: RequestId(request),
            change: RequestedChange::Undo,
        }
    }

    #[test]
    fn authors_take_turns_and_keep_their_order() {
        let mut queue = CutQueue::default();
        for request in 0..4 {
            queue.push(cut(1, request));
        }
        queue.push(cut(2, 0));
        queue.push(cut(2, 1));
        let mut order = Vec::new();
        while let Some(next) = queue.poll() {
            queue.end(next.author);
            order.push((next.author.0, next.request.0));
        }
        assert_eq!(order, [(1, 0), (2, 0), (1, 1), (2, 1), (1, 2), (1, 3)]);
    }

    #[test]
    fn cut_of_another_author_is_next_whatever_one_author_does() {
        let mut queue = CutQueue::default();
        for round in 0..100 {
            // One participant fills its share, leaves and comes back under a new number.
            let author = ParticipantId(round + 10);
            while queue.has_room(author) {
                queue.push(cut(author.0, 0));
            }
            queue.poll();
            queue.remove(author);
        }
        assert!(queue.has_room(ParticipantId(1)));
        queue.push(cut(1, 0));
        for _ in 0..2 {
            let author = queue.prepared[0];
            queue.end(author);
        }
        assert_eq!(queue.poll().map(|c| c.author), Some(ParticipantId(1)));
        assert!(queue.waiting.is_empty());
    }
}
