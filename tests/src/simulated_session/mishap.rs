//! Faults of single participants in a simulated session.

use palpate_protocol::Span;
use palpate_protocol::operation::OperationKind;
use palpate_protocol::session::ClientEvent;

use crate::network::Profile;

/// A fault of one trainee; seats count from 0.
#[derive(Debug, Clone)]
pub enum SessionFault {
    Network {
        seat: usize,
        profile: Box<Profile>,
    },
    /// The trainee applies its next cuts at a shifted position, so its topology diverges.
    OtherCut {
        seat: usize,
        /// Shift of the stroke, m.
        by_m: [f64; 3],
        /// Number of shifted cuts.
        times: usize,
    },
    /// The trainee receives other tools at shifted positions for a while, so its shape diverges.
    OtherTools {
        seat: usize,
        by_m: [f64; 3],
        /// Start after the first view, s.
        from_s: f64,
        until_s: f64,
    },
}

impl SessionFault {
    pub(super) fn seat(&self) -> usize {
        match self {
            Self::Network { seat, .. }
            | Self::OtherCut { seat, .. }
            | Self::OtherTools { seat, .. } => *seat,
        }
    }

    /// Modifies an event before the trainee receives it; `since` is the time since the first view, if any.
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
