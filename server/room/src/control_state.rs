//! The state that the instructor's controls have set for the whole session.

use std::collections::BTreeSet;

use palpate_protocol::name::Appearance;
use palpate_protocol::{ServerTime, TokenBucket};

use crate::invitations::Invitations;

/// Annotations at once; further ones are refused.
pub(crate) const ANNOTATIONS_MAX: usize = 64;

/// Banned names; further bans are refused, so that the instructor locks the session instead.
const BANNED_MAX: usize = 256;

/// Operations by controls at once: a hand-over mutes all other tools, twice.
const BURST: f64 = 128.0;

/// Operations by controls per second in the long run. Compaction drops superseded ones, see [`crate::log`].
const PER_S: f64 = 5.0;

/// State of the session.
#[derive(Debug)]
pub(crate) struct ControlState {
    /// Begin of the freeze, if the session is frozen.
    pub(crate) frozen_from: Option<ServerTime>,
    /// Whether only lost seats are given out.
    pub(crate) is_locked: bool,
    /// Names of banned participants.
    banned: Vec<(String, Appearance)>,
    /// Numbers of the annotations.
    pub(crate) annotations: BTreeSet<u32>,
    last_annotation: u32,
    /// The invitations.
    pub(crate) invitations: Invitations,
    operations: TokenBucket,
}

impl ControlState {
    /// No control was used.
    pub(crate) fn new(now: ServerTime) -> Self {
        Self {
            frozen_from: None,
            is_locked: false,
            banned: Vec::new(),
            annotations: BTreeSet::new(),
            last_annotation: 0,
            invitations: Invitations::default(),
            operations: TokenBucket::new(PER_S, BURST, now - ServerTime::ZERO),
        }
    }

    /// Takes so many operations from the budget, if it has them.
    pub(crate) fn take(&mut self, operations: usize, now: ServerTime) -> bool {
        self.operations
            .take(operations as f64, now - ServerTime::ZERO)
    }

    /// Bans names that look like this one. Returns whether there was room.
    pub(crate) fn ban(&mut self, name: &str, appearance: Appearance) -> bool {
        let has_room = self.banned.len() < BANNED_MAX;
        if has_room {
            self.banned.push((name.to_owned(), appearance));
        }
        has_room
    }

    /// The banned name that looks like this one.
    pub(crate) fn banned_like(&self, name: &str) -> Option<String> {
        // Most sessions have no bans, and the skeleton of a name costs allocations.
        if self.banned.is_empty() {
            return None;
        }
        let wanted = Appearance::of(name);
        let alike = self.banned.iter().find(|(_, b)| b.is_like(&wanted));
        alike.map(|(name, _)| name.clone())
    }

    /// A number for a new annotation, which no earlier one had.
    pub(crate) fn fresh_annotation(&mut self) -> u32 {
        self.last_annotation += 1;
        self.last_annotation
    }
}
