//! Batches of the client's own samples: four new ones at 250 datagrams a second of a 1 kHz device, with
//! the last one of the batch before repeated.

use std::collections::VecDeque;

use crate::clock::ClockMap;
use crate::datagram::POSITION_MAX_M;
use crate::datagram::motion::{BATCH, USUAL_SAMPLES};
use crate::lateness::Lateness;
use crate::{ClientTime, LocalSample, Span, ToolSample};

/// One batch in this many carries the force, with its newest sample, ten times a second: other
/// participants see and do not feel it, and it would take as many bytes as the poses.
const FORCE_EVERY: u32 = 25;

/// Older unsent samples are dropped: receivers display newer ones by then.
const STALE: Span = Span::from_millis(50);

/// The duration of a batch of a 1 kHz device.
const BATCH_LENGTH: Span = Span::from_millis(BATCH as i64);

/// An incomplete batch goes out after this, so that a slow device is not kept waiting.
const BATCH_WAIT: Span = Span::from_millis(4);

/// Samples kept: 64 ms of a 1 kHz device. Beyond it the oldest unsent one is lost, and counted.
const KEPT_MAX: usize = 64;

#[derive(Debug, Default)]
pub(super) struct MotionBatch {
    /// Oldest first; the last `unsent` have not been sent.
    kept: VecDeque<LocalSample>,
    unsent: usize,
    stale: usize,
    batches: u32,
    /// Newest samples of the last four batches.
    before: [Option<ClientTime>; 4],
}

impl MotionBatch {
    /// Takes a sample; `false` where it can not be sent.
    pub(super) fn push(&mut self, sample: LocalSample) -> bool {
        let norm = sample.pose.orientation.iter().map(|c| c * c).sum::<f64>();
        let in_range = sample
            .pose
            .position_m
            .iter()
            .all(|x| x.abs() <= POSITION_MAX_M)
            && (0.9..1.1).contains(&norm);
        if (self.kept.back()).is_some_and(|last| last.time - sample.time > STALE) {
            // The clock was set back. Samples with earlier stamps would delay all later ones.
            self.stale += std::mem::take(&mut self.unsent);
            self.kept.clear();
            self.before = [None; 4];
        }
        let ordered = self.kept.back().is_none_or(|last| last.time < sample.time);
        if !in_range || !ordered {
            return false;
        }
        if self.kept.len() == KEPT_MAX {
            self.kept.pop_front();
            if self.unsent == KEPT_MAX {
                self.unsent -= 1;
                self.stale += 1;
            }
        }
        self.kept.push_back(sample);
        self.unsent += 1;
        true
    }

    /// The samples for the next datagram, oldest first, if one is due, and how late they leave.
    pub(super) fn poll(
        &mut self,
        now: ClientTime,
        map: &ClockMap,
    ) -> Option<(Vec<ToolSample>, Lateness)> {
        while self.unsent > 0 && now - self.kept[self.kept.len() - self.unsent].time > STALE {
            self.unsent -= 1;
            self.stale += 1;
        }
        if self.unsent == 0 {
            return None;
        }
        let first_new = self.kept.len() - self.unsent;
        if self.unsent < BATCH && now - self.kept[first_new].time < BATCH_WAIT {
            return None;
        }
        let end = self.kept.len().min(first_new + BATCH);
        let newest = self.kept[end - 1].time;
        let late = self.lateness(newest, now);
        let with_force = self.batches.is_multiple_of(FORCE_EVERY);
        self.unsent = self.kept.len() - end;
        self.batches = self.batches.wrapping_add(1);
        let samples = (end.saturating_sub(USUAL_SAMPLES)..end)
            .map(|i| &self.kept[i])
            .filter(|s| newest - s.time <= STALE)
            .map(|s| ToolSample {
                time: map.to_server(s.time),
                pose: s.pose,
                buttons: s.buttons,
                force_n: s
                    .force_n
                    .filter(|f| with_force && s.time == newest && f.iter().all(|x| x.is_finite())),
            });
        Some((samples.collect(), late))
    }

    /// How much later than regular a batch with this newest sample leaves, and the oldest news in it.
    fn lateness(&mut self, newest: ClientTime, now: ClientTime) -> Lateness {
        let [a, b, c, last] = self.before;
        let oldest_due = last.map_or(newest, |last| {
            // A slow device has longer intervals than a batch; a stall makes one of them long.
            let intervals = [(a, b), (b, c), (c, Some(last))];
            let known = intervals.into_iter().filter_map(|(a, b)| Some(b? - a?));
            last + known
                .min()
                .unwrap_or(BATCH_LENGTH)
                .clamp(BATCH_LENGTH, STALE)
        });
        self.before = [b, c, last, Some(newest)];
        Lateness::after(now, newest + BATCH_WAIT, oldest_due + BATCH_WAIT)
    }

    /// Whether samples wait for their batch to be full, or for its time.
    pub(super) fn collects(&self) -> bool {
        self.unsent > 0
    }

    /// How many were lost by waiting, since the last call.
    pub(super) fn take_stale(&mut self) -> usize {
        std::mem::take(&mut self.stale)
    }
}
