//! Strokes whose blades are still moving, joined from the parts that arrive.
//!
//! A part that parts nothing yet, because it is short or outside of the tissue, is not logged. Its path becomes the
//! beginning of the next part.

use std::collections::BTreeMap;

use palpate_protocol::operation::{BladePoint, CutStroke, STROKE_MAX_POINTS};
use palpate_protocol::{ParticipantId, ServerTime};

use crate::config::SEATS_MAX;

/// Points before a part that are kept while they part nothing: 18 to 36 mm of path. With them and the points of its request (9 at
/// 0.4 m/s), a part is short enough for copies.
const PENDING_MAX: usize = 24;

/// Strokes that are open at once: one per seat. Of more, as participants leave during their strokes, the oldest are dropped.
const OPEN_MAX: usize = SEATS_MAX as usize;

/// Smallest step in the rest frame, m; closer points define no direction.
const STEP_MIN_M: f64 = 0.1e-3;

/// A part of a stroke, mapped to the rest frame.
#[derive(Debug, Clone)]
pub(crate) struct RestPart {
    /// When the stroke began.
    pub(crate) began: ServerTime,
    /// Times of the first and the last point.
    pub(crate) times: [ServerTime; 2],
    /// The blade; the first point of a later part is the last one of the part before.
    pub(crate) points: Vec<BladePoint>,
    pub(crate) width_m: f64,
    pub(crate) is_last: bool,
}

#[derive(Debug)]
struct OpenStroke {
    began: ServerTime,
    ended: ServerTime,
    /// The last point in the log; `None` while no part is.
    logged: Option<BladePoint>,
    /// The path since then.
    pending: Vec<BladePoint>,
}

/// The latest stroke of every author.
#[derive(Debug, Default)]
pub(crate) struct OpenStrokes(BTreeMap<ParticipantId, OpenStroke>);

impl OpenStrokes {
    /// Adds a part to the stroke of its author. Returns what to cut now; `None` while the blade has not moved.
    pub(crate) fn extend(&mut self, author: ParticipantId, part: &RestPart) -> Option<CutStroke> {
        let [first, last] = part.times;
        let open = self.0.remove(&author);
        let mut open = match open.filter(|o| o.began == part.began && o.ended == first) {
            Some(open) => OpenStroke {
                ended: last,
                ..open
            },
            None => OpenStroke {
                began: part.began,
                ended: last,
                logged: None,
                pending: part.points.first().copied().into_iter().collect(),
            },
        };
        for point in part.points.iter().skip(1) {
            let before = open.pending.last().or(open.logged.as_ref());
            if before.is_none_or(|b| distance(b, point) >= STEP_MIN_M) {
                open.pending.push(*point);
            }
        }
        let joins = open.logged.is_some();
        let cut = CutStroke {
            began: part.began,
            joins,
            points: open.pending.clone(),
            width_m: part.width_m,
        };
        self.0.insert(author, open);
        if self.0.len() > OPEN_MAX {
            let oldest = self.0.iter().min_by_key(|(_, open)| open.ended);
            let oldest = oldest.map(|(author, _)| *author);
            oldest.map(|author| self.0.remove(&author));
        }
        (usize::from(joins) + cut.points.len() >= 2).then_some(cut)
    }

    /// Notes whether the latest part of an author is in the log.
    pub(crate) fn note(&mut self, author: ParticipantId, part: &RestPart, is_logged: bool) {
        let Some(open) = self.0.get_mut(&author) else {
            return;
        };
        if part.is_last {
            self.0.remove(&author);
        } else if is_logged {
            open.logged = open.pending.last().copied().or(open.logged);
            open.pending.clear();
        } else if open.pending.len() > PENDING_MAX {
            // The blade is outside of the tissue.
            open.pending.drain(..open.pending.len() - PENDING_MAX);
            open.logged = None;
        }
    }

    /// Ends all strokes: what later parts would join is no longer in effect.
    pub(crate) fn clear(&mut self) {
        self.0.clear();
    }
}

fn distance(a: &BladePoint, b: &BladePoint) -> f64 {
    let square = |i: usize| (a.tip_m[i] - b.tip_m[i]).powi(2);
    (0..3).map(square).sum::<f64>().sqrt()
}

const _: () = assert!(PENDING_MAX < STROKE_MAX_POINTS);

#[cfg(test)]
mod tests {
    use palpate_protocol::codec::{PREFIX_BYTES, encode_frame};
    use palpate_protocol::operation::{Operation, OperationKind};
    use palpate_protocol::request::ServerMessage;
    use palpate_protocol::session::COPY_MAX_BYTES;
    use palpate_protocol::{OperationId, TopologyHash};

    use super::*;

    const ME: ParticipantId = ParticipantId(1);

    fn part(began: i64, from: i64, to: i64, is_last: bool) -> RestPart {
        let at = ServerTime::from_micros;
        let point = |t: i64| BladePoint {
            tip_m: [1e-3 * t as f64, 0.0, 0.0],
            axis: [0.0, 0.0, 1.0],
            depth_m: 0.01,
        };
        RestPart {
            began: at(began),
            times: [at(from), at(to)],
            points: (from..=to).map(point).collect(),
            width_m: 0.0,
            is_last,
        }
    }

    fn tips(cut: &CutStroke) -> Vec<i64> {
        let tip = |p: &BladePoint| (1e3 * p.tip_m[0]).round() as i64;
        cut.points.iter().map(tip).collect()
    }

    #[test]
    fn first_part_of_a_stroke_is_short_enough_for_copies() {
        let mut open = OpenStrokes::default();
        let hour = 3_600_000_000;
        for i in 0..40 {
            // 9 points per request.
            let [from, to] = [hour + 9 * i, hour + 9 * (i + 1)];
            let part = part(hour, from, to, false);
            let cut = open.extend(ME, &part).unwrap();
            open.note(ME, &part, false);
            let operation = Operation {
                id: OperationId(1 << 40),
                at: ServerTime::from_micros(to),
                author: ME,
                topology_version_before: u32::MAX - 1,
                topology_version_after: u32::MAX,
                hash_after: TopologyHash(u64::MAX),
                kind: OperationKind::Cut(cut),
            };
            let frame = encode_frame(&ServerMessage::Operation(operation)).unwrap();
            let bytes = frame.len() - PREFIX_BYTES;
            assert!(bytes <= COPY_MAX_BYTES, "{bytes} bytes");
        }
    }

    #[test]
    fn every_point_is_cut_once() {
        let mut open = OpenStrokes::default();
        let mut cut = |part: RestPart, is_logged: bool| {
            let cut = open.extend(ME, &part).unwrap();
            open.note(ME, &part, is_logged);
            (cut.joins, tips(&cut))
        };
        assert_eq!(cut(part(0, 0, 2, false), false), (false, vec![0, 1, 2]));
        assert_eq!(cut(part(0, 2, 3, false), true), (false, vec![0, 1, 2, 3]));
        assert_eq!(cut(part(0, 3, 5, false), false), (true, vec![4, 5]));
        assert_eq!(cut(part(0, 5, 6, false), true), (true, vec![4, 5, 6]));
        assert_eq!(cut(part(0, 6, 7, true), true), (true, vec![7]));
        assert_eq!(cut(part(8, 8, 9, false), true), (false, vec![8, 9]));
    }

    #[test]
    fn strokes_of_those_who_left_do_not_pile_up() {
        let mut open = OpenStrokes::default();
        for author in 0..1000 {
            let part = part(author, author, author + 2, false);
            open.extend(ParticipantId(author as u16), &part).unwrap();
        }
        assert_eq!(open.0.len(), OPEN_MAX);
        assert!(
            open.0.contains_key(&ParticipantId(999)) && !open.0.contains_key(&ParticipantId(0))
        );
    }

    #[test]
    fn part_after_a_gap_joins_nothing() {
        let mut open = OpenStrokes::default();
        let first = part(0, 0, 2, false);
        open.extend(ME, &first).unwrap();
        open.note(ME, &first, true);
        let cut = open.extend(ME, &part(0, 4, 5, false)).unwrap();
        assert_eq!((cut.joins, tips(&cut)), (false, vec![4, 5]));
    }

    #[test]
    fn resting_blade_cuts_nothing_and_a_long_way_outside_is_forgotten() {
        let mut open = OpenStrokes::default();
        assert_eq!(open.extend(ME, &part(0, 0, 0, false)), None);
        for t in 0..100 {
            let part = part(0, t, t + 1, false);
            let cut = open.extend(ME, &part).unwrap();
            assert!(cut.points.len() <= PENDING_MAX + 2);
            open.note(ME, &part, false);
        }
    }
}
