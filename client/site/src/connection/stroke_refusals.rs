//! Which refusals of the parts of a stroke the user should see: each reason once per stroke, and "parts nothing" only for a
//! stroke none of whose parts was cut.

use std::collections::VecDeque;

use palpate_protocol::operation::CutStroke;
use palpate_protocol::request::{CutRequest, RequestRefusal, RequestRefused};
use palpate_protocol::{RequestId, ServerTime};

/// Parts that wait for an answer: those of four seconds.
const PARTS_MAX: usize = 128;

/// A part that was sent.
#[derive(Debug, Clone)]
struct Part {
    id: RequestId,
    began: ServerTime,
    is_last: bool,
}

/// The strokes of one participant.
#[derive(Debug, Clone, Default)]
pub struct StrokeRefusals {
    /// Unanswered parts, oldest first.
    parts: VecDeque<Part>,
    /// The latest stroke of which a part was cut.
    cut: Option<ServerTime>,
    shown: Option<(ServerTime, RequestRefusal)>,
}

impl StrokeRefusals {
    /// Notes a part that is sent.
    pub fn note_sent(&mut self, id: RequestId, part: &CutRequest) {
        if self.parts.len() == PARTS_MAX {
            self.parts.pop_front();
        }
        self.parts.push_back(Part {
            id,
            began: part.began,
            is_last: part.is_last,
        });
    }

    /// Notes that a part was cut.
    pub fn note_cut(&mut self, part: &CutStroke) {
        self.cut = Some(part.began);
    }

    /// Whether the user should see a refusal.
    pub fn is_shown(&mut self, refused: &RequestRefused) -> bool {
        let Some(at) = self.parts.iter().position(|part| part.id == refused.id) else {
            return true;
        };
        // Answers come in order, so the parts before it have theirs.
        let Some(part) = self.parts.drain(..=at).next_back() else {
            return true;
        };
        let parts_nothing = matches!(
            refused.reason,
            RequestRefusal::NothingCut | RequestRefusal::CanNotCut(_)
        );
        if parts_nothing && (!part.is_last || self.cut == Some(part.began)) {
            return false;
        }
        let shown = Some((part.began, refused.reason.clone()));
        let is_new = self.shown != shown;
        self.shown = shown;
        is_new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(began: i64, is_last: bool) -> CutRequest {
        CutRequest {
            began: ServerTime::from_micros(began),
            points: Vec::new(),
            width_m: 0.0,
            is_last,
        }
    }

    fn cut(began: i64) -> CutStroke {
        CutStroke {
            began: ServerTime::from_micros(began),
            joins: false,
            points: Vec::new(),
            width_m: 0.0,
        }
    }

    fn refused(id: u32, reason: RequestRefusal) -> RequestRefused {
        RequestRefused {
            id: RequestId(id),
            reason,
        }
    }

    #[test]
    fn stroke_that_parts_something_is_not_refused() {
        let mut strokes = StrokeRefusals::default();
        for id in 0..4 {
            strokes.note_sent(RequestId(id), &part(7, id == 3));
        }
        assert!(!strokes.is_shown(&refused(0, RequestRefusal::NothingCut)));
        strokes.note_cut(&cut(7));
        assert!(!strokes.is_shown(&refused(2, RequestRefusal::NothingCut)));
        assert!(!strokes.is_shown(&refused(3, RequestRefusal::NothingCut)));
    }

    #[test]
    fn stroke_that_parts_nothing_is_refused_once_at_its_end() {
        let mut strokes = StrokeRefusals::default();
        strokes.note_cut(&cut(3));
        for id in 0..4 {
            strokes.note_sent(RequestId(id), &part(7, id == 3));
        }
        let shown = (0..4).map(|id| strokes.is_shown(&refused(id, RequestRefusal::NothingCut)));
        assert_eq!(shown.collect::<Vec<_>>(), [false, false, false, true]);
    }

    #[test]
    fn other_reasons_are_shown_once_per_stroke() {
        let mut strokes = StrokeRefusals::default();
        for id in 0..4 {
            strokes.note_sent(RequestId(id), &part(i64::from(id / 2), id % 2 == 1));
        }
        let shown = (0..4).map(|id| strokes.is_shown(&refused(id, RequestRefusal::Muted)));
        assert_eq!(shown.collect::<Vec<_>>(), [true, false, true, false]);
        assert!(strokes.is_shown(&refused(9, RequestRefusal::Muted)));
    }
}
