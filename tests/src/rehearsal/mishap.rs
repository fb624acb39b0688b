//! What goes wrong in a rehearsal besides the network of all.

use palpate_protocol::Span;
use palpate_protocol::operation::OperationKind;
use palpate_protocol::session::ClientEvent;

use crate::network::Profile;

/// Something that goes wrong for one guest, numbered from 0.
#[derive(Debug, Clone)]
pub enum Mishap {
    /// A network of its own.
    Network {
        /// Whose.
        seat: usize,
        /// What it is like.
        profile: Box<Profile>,
    },
    /// It makes the next cut elsewhere, and so has another topology than everybody.
    OtherCut {
        /// Who.
        seat: usize,
        /// By how much the stroke is moved, m.
        by_m: [f64; 3],
        /// How often.
        times: usize,
    },
    /// It sees the tools of the others elsewhere for a while, and so has another shape than everybody.
    OtherTools {
        /// Who.
        seat: usize,
        /// By how much, m.
        by_m: [f64; 3],
        /// From when on after its first view, s.
        from_s: f64,
        /// Until when, s.
        until_s: f64,
    },
}

impl Mishap {
    /// Whom it happens to.
    pub(super) fn seat(&self) -> usize {
        match self {
            Self::Network { seat, .. }
            | Self::OtherCut { seat, .. }
            | Self::OtherTools { seat, .. } => *seat,
        }
    }

    /// Changes what a guest hears, `since` its first view, if it has come.
    pub(super) fn spoil(&mut self, event: &mut ClientEvent, since: Option<Span>) {
        match (self, event) {
            (Self::OtherCut { by_m, times, .. }, ClientEvent::Operation(operation)) => {
                if let OperationKind::Cut(stroke) = &mut operation.kind
                    && *times > 0
                {
                    *times -= 1;
                    for point in &mut stroke.points {
                        add(&mut point.tip_m, *by_m);
                    }
                }
            }
            (
                Self::OtherTools {
                    by_m,
                    from_s,
                    until_s,
                    ..
                },
                ClientEvent::Motion(track),
            ) => {
                let is_time = since.is_some_and(|s| (*from_s..*until_s).contains(&s.as_secs_f64()));
                for sample in track.samples.iter_mut().filter(|_| is_time) {
                    add(&mut sample.pose.position_m, *by_m);
                }
            }
            _ => {}
        }
    }
}

fn add(to: &mut [f64; 3], by: [f64; 3]) {
    for (x, b) in to.iter_mut().zip(by) {
        *x += b;
    }
}
