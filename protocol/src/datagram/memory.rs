//! Sent or received points as baselines for differences: one memory per direction of a connection at
//! each end.
//!
//! A sender encodes differences only to acknowledged datagrams, so that no loss makes a later datagram
//! unreadable. A receiver without the named baseline drops the datagram and does not acknowledge it; the
//! sender chooses another baseline within `KEPT_POINTS` datagrams.

use std::collections::VecDeque;

use super::TRACKS_MAX;
use super::motion::Anchor;
use super::shape::Nodes;
use crate::ParticipantId;

/// Datagrams of one tool that both ends remember: half a second of batches. After a longer
/// acknowledgement delay samples are coded without a difference.
pub(super) const KEPT_POINTS: usize = 128;

/// Datagrams with displacements that both ends remember: some frames of a whole view.
pub(super) const KEPT_SHAPES: usize = 64;

#[derive(Debug)]
struct Kept<T> {
    sequence: u32,
    acknowledged: bool,
    content: T,
}

/// Contents by their sequence, oldest first.
#[derive(Debug)]
struct Ring<T> {
    kept: VecDeque<Kept<T>>,
    most: usize,
}

impl<T> Ring<T> {
    fn new(most: usize) -> Self {
        Self {
            kept: VecDeque::new(),
            most,
        }
    }

    fn remember(&mut self, sequence: u32, content: T) {
        self.forget(sequence);
        if self.kept.len() == self.most {
            self.kept.pop_front();
        }
        self.kept.push_back(Kept {
            sequence,
            acknowledged: false,
            content,
        });
    }

    fn forget(&mut self, sequence: u32) {
        self.kept.retain(|k| k.sequence != sequence);
    }

    fn acknowledge(&mut self, sequence: u32) {
        let kept = self.kept.iter_mut().find(|k| k.sequence == sequence);
        if let Some(kept) = kept {
            kept.acknowledged = true;
        }
    }

    fn acknowledged(&self) -> impl Iterator<Item = (u32, &T)> {
        let known = self.kept.iter().rev().filter(|k| k.acknowledged);
        known.map(|k| (k.sequence, &k.content))
    }

    fn at(&self, sequence: u32) -> Option<&T> {
        let mut found = self.kept.iter().rev();
        found.find(|k| k.sequence == sequence).map(|k| &k.content)
    }
}

#[derive(Debug)]
struct Track {
    participant: ParticipantId,
    newest: u32,
    points: Ring<Anchor>,
}

/// See the module.
#[derive(Debug)]
pub struct Memory {
    tracks: Vec<Track>,
    shapes: Ring<Nodes>,
}

impl Default for Memory {
    fn default() -> Self {
        Self {
            tracks: Vec::new(),
            shapes: Ring::new(KEPT_SHAPES),
        }
    }
}

impl Memory {
    /// Notes that the other side has this datagram.
    pub fn acknowledge(&mut self, sequence: u32) {
        for track in &mut self.tracks {
            track.points.acknowledge(sequence);
        }
        self.shapes.acknowledge(sequence);
    }

    /// Removes a datagram that was not sent, or could not be read.
    pub(super) fn forget(&mut self, sequence: u32) {
        for track in &mut self.tracks {
            track.points.forget(sequence);
        }
        self.shapes.forget(sequence);
    }

    fn track(&self, participant: ParticipantId) -> Option<&Track> {
        self.tracks.iter().find(|t| t.participant == participant)
    }

    /// The newest acknowledged point of a tool.
    pub(super) fn known_point(&self, participant: ParticipantId) -> Option<(u32, Anchor)> {
        let (sequence, anchor) = self.track(participant)?.points.acknowledged().next()?;
        Some((sequence, *anchor))
    }

    /// The received point of a tool under this number.
    pub(super) fn point_at(&self, participant: ParticipantId, sequence: u32) -> Option<Anchor> {
        self.track(participant)?.points.at(sequence).copied()
    }

    pub(super) fn remember_point(
        &mut self,
        participant: ParticipantId,
        sequence: u32,
        anchor: Anchor,
    ) {
        let found = self
            .tracks
            .iter()
            .position(|t| t.participant == participant);
        let at = found.unwrap_or_else(|| {
            if self.tracks.len() >= TRACKS_MAX {
                // The participant with the longest silence has most likely left.
                let age = |t: &Track| sequence.wrapping_sub(t.newest);
                let oldest = (0..self.tracks.len()).max_by_key(|i| age(&self.tracks[*i]));
                self.tracks.swap_remove(oldest.unwrap_or(0));
            }
            self.tracks.push(Track {
                participant,
                newest: sequence,
                points: Ring::new(KEPT_POINTS),
            });
            self.tracks.len() - 1
        });
        self.tracks[at].newest = sequence;
        self.tracks[at].points.remember(sequence, anchor);
    }

    /// Among the acknowledged shapes of the same step, the newest nodes that begin closest to `first`.
    pub(super) fn known_shape(&self, step_um: u16, first: u32) -> Option<(u32, &Nodes)> {
        let known = self.shapes.acknowledged();
        known
            .filter(|(_, n)| n.step_um == step_um)
            .min_by_key(|(_, n)| n.first().abs_diff(first))
    }

    /// The nodes that arrived under this number.
    pub(super) fn shape_at(&self, sequence: u32) -> Option<&Nodes> {
        self.shapes.at(sequence)
    }

    pub(super) fn remember_shape(&mut self, sequence: u32, nodes: Nodes) {
        self.shapes.remember(sequence, nodes);
    }
}
