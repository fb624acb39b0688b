//! Perceptual deadband: motion that the receiver can predict is not sent.
//!
//! The receiver extrapolates a tool beyond its newest sample ([`Timeline`]). No datagram is needed while
//! the extrapolation error is imperceptible to hand and eye. A datagram is still sent within
//! [`DEADBAND_HEARTBEAT`], so that silence still indicates a fault. After the predictive deadband of
//! Hinterseer, Hirche, Chaudhuri, Steinbach and Buss (2008); by Weber's law the threshold grows with the
//! motion.

use nalgebra::{Quaternion, UnitQuaternion};

use crate::datagram::as_sent;
use crate::datagram::motion::BATCH;
use crate::timeline::Timeline;
use crate::{Pose, Span, ToolSample};

/// The longest silence of a predictable tool: below the 50 ms beyond which receivers hold it.
pub const DEADBAND_HEARTBEAT: Span = Span::from_millis(40);

/// The largest extrapolation error that is not corrected. Rounding on the wire adds to it: extrapolated
/// over the heartbeat, a step in a sample contributed up to 0.22 mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deadband {
    /// Threshold for the distance of the tip, m, independent of motion.
    pub position_m: f64,
    /// Weber fraction: a share of the distance from the last sent position, where that allows more.
    pub share: f64,
    /// Angle, rad.
    pub angle_rad: f64,
}

impl Default for Deadband {
    /// 0.2 mm or 5 % of the distance, at the lower end of perception, and one degree.
    fn default() -> Self {
        Self {
            position_m: 2e-4,
            share: 0.05,
            angle_rad: 1_f64.to_radians(),
        }
    }
}

impl Deadband {
    /// Whether the error of `shown` against `truth` is within the deadband; `last` is the last pose
    /// sent.
    pub(super) fn allows(&self, truth: &Pose, shown: &Pose, last: &Pose) -> bool {
        let allowed = self.position_m.max(self.share * distance(truth, last));
        distance(truth, shown) <= allowed && angle(truth, shown) <= self.angle_rad
    }
}

fn distance(a: &Pose, b: &Pose) -> f64 {
    let parts = a.position_m.iter().zip(b.position_m);
    parts.map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

fn angle(a: &Pose, b: &Pose) -> f64 {
    let unit = |[x, y, z, w]: [f64; 4]| UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z));
    unit(a.orientation).angle_to(&unit(b.orientation))
}

/// The receiver's knowledge of one tool.
#[derive(Debug)]
pub(super) struct SentMotion {
    deadband: Deadband,
    timeline: Timeline,
    newest: Option<ToolSample>,
}

impl SentMotion {
    pub(super) fn nothing(deadband: Deadband) -> Self {
        Self {
            deadband,
            timeline: Timeline::default(),
            newest: None,
        }
    }

    /// Whether the receiver predicts all of a batch, so that the batch need not be sent yet.
    pub(super) fn predicts(&self, batch: &[ToolSample]) -> bool {
        let Some(sent) = &self.newest else {
            return false;
        };
        let batch = batch.iter().filter(|s| s.time > sent.time);
        batch.rev().take(BATCH).all(|s| {
            let silence = s.time - sent.time + Span::from_millis(BATCH as i64);
            let shown = self.timeline.foresee(s.time);
            silence <= DEADBAND_HEARTBEAT
                && s.buttons == sent.buttons
                && shown.is_some_and(|shown| self.deadband.allows(&s.pose, &shown, &sent.pose))
        })
    }

    /// Notes a batch that is sent.
    pub(super) fn note(&mut self, batch: &[ToolSample]) {
        // The receiver extrapolates from rounded samples.
        for sample in batch {
            // The batch omits samples that can not be sent.
            self.timeline.insert(as_sent(sample).unwrap_or(*sample));
        }
        self.newest = batch.last().copied().or(self.newest);
    }

    /// The newest moment that was sent.
    #[cfg(test)]
    pub(super) fn newest(&self) -> Option<crate::ServerTime> {
        self.newest.map(|s| s.time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::PeerEvent;
    use crate::session::rate_tests::Hand;
    use crate::session::tests::Pair;
    use crate::{LocalSample, ServerTime};

    /// The rounding of samples between two others, extrapolated over 40 ms.
    const ROUNDING_M: f64 = 3e-4;

    /// The batches received during ten seconds of a hand, and the hand's motion, by server time in µs.
    fn arrived(
        deadband: Option<Deadband>,
        slow: f64,
    ) -> (Vec<Vec<ToolSample>>, Vec<(ServerTime, Pose)>) {
        let mut pair = Pair::new(1, 10_000, 0, 0.0);
        pair.client.set_deadband(deadband);
        pair.join(0);
        pair.steps(1000);
        let hand = Hand::new(7);
        let mut truth = Vec::new();
        for i in 0..10_000_i64 {
            let pose = hand.pose(slow * i as f64 * 1e-3);
            let map = pair.client.clock().unwrap();
            truth.push((map.to_server(pair.client_now()), pose));
            pair.client.send_motion(LocalSample {
                time: pair.client_now(),
                pose,
                buttons: u8::from(i % 1000 > 500),
                force_n: None,
            });
            pair.step();
        }
        let batches = pair.server_events.iter().filter_map(|e| match e {
            PeerEvent::Motion(motion) => Some(motion.samples.clone()),
            _ => None,
        });
        (batches.collect(), truth)
    }

    #[test]
    fn extrapolation_error_stays_within_the_deadband_and_silence_below_50_ms() {
        let deadband = Deadband::default();
        for slow in [1.0, 0.3] {
            let (batches, truth) = arrived(Some(deadband), slow);
            let (all, _) = arrived(None, slow);
            let loose = Deadband {
                position_m: deadband.position_m + ROUNDING_M,
                angle_rad: deadband.angle_rad + 5e-3,
                ..deadband
            };
            let mut others = Timeline::default();
            let mut last: Option<ToolSample> = None;
            for batch in &batches {
                let news = batch.iter().find(|s| last.is_none_or(|l| s.time > l.time));
                if let (Some(last), Some(news)) = (last, news) {
                    let silence = batch[batch.len() - 1].time - last.time;
                    assert!(silence <= Span::from_millis(50), "{silence:?}");
                    let unsaid = truth
                        .iter()
                        .filter(|(t, _)| *t > last.time && *t < news.time);
                    for (t, pose) in unsaid {
                        let shown = others.foresee(*t).unwrap();
                        assert!(loose.allows(pose, &shown, &last.pose), "{pose:?} {shown:?}");
                    }
                }
                for sample in batch {
                    others.insert(*sample);
                }
                last = batch.last().copied();
            }
            let share = batches.len() as f64 / all.len() as f64;
            // 0.14 of a hand of 87 mm/s, 0.12 of one of 26 mm/s: little more than the heartbeat.
            assert!(share < 0.2, "{share}");
        }
    }

    #[test]
    fn button_change_is_sent_at_once() {
        let mut sent = SentMotion::nothing(Deadband::default());
        let sample = |ms: i64| ToolSample {
            time: ServerTime::from_micros(1000 * ms),
            ..ToolSample::default()
        };
        sent.note(&[0, 1, 2, 3].map(sample));
        assert_eq!(sent.newest(), Some(sample(3).time));
        let mut next = [4, 5, 6, 7].map(sample);
        assert!(sent.predicts(&next));
        next[2].buttons = 1;
        assert!(!sent.predicts(&next));
    }
}
