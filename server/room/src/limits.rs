//! Refusals and limits of the room, for the host.

use std::fmt;

/// A limit that took effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Limit {
    /// A join or resumption with a wrong grant, name, tool or seat was refused.
    JoinRefused,
    /// A join was refused, because no seat is left for its role.
    Full,
    /// A join or resumption was refused, because there were too many.
    Busy,
    /// A kept seat was given to another participant, because its own was away for longer than it had taken part.
    SeatReused,
    /// A cut was refused, because its author exceeds its share.
    CutBudget,
    /// A cut was refused, because it does not follow its author's tool or does not fit its blade.
    CutRefused,
    /// A cut was refused, because its author's share of the log is used, which no snapshot returned.
    LogFull,
    /// A snapshot was dropped, because it is too large for newcomers.
    Snapshot,
    /// A sample was dropped, because no hand moves that fast.
    Sample,
    /// A delay report was reduced to the measured path, or ignored.
    DelayReport,
    /// The playout delay stayed, because it changed too often.
    DelayChange,
}

impl Limit {
    /// All of them, in the order of their numbers.
    pub const ALL: [Self; 11] = [
        Self::JoinRefused,
        Self::Full,
        Self::Busy,
        Self::SeatReused,
        Self::CutBudget,
        Self::CutRefused,
        Self::LogFull,
        Self::Snapshot,
        Self::Sample,
        Self::DelayReport,
        Self::DelayChange,
    ];

    /// Its name in summaries.
    pub const fn word(self) -> &'static str {
        match self {
            Self::JoinRefused => "join-refused",
            Self::Full => "full",
            Self::Busy => "busy",
            Self::SeatReused => "seat-reused",
            Self::CutBudget => "cut-budget",
            Self::CutRefused => "cut-refused",
            Self::LogFull => "log-full",
            Self::Snapshot => "snapshot",
            Self::Sample => "sample",
            Self::DelayReport => "delay-report",
            Self::DelayChange => "delay-change",
        }
    }
}

impl fmt::Display for Limit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::JoinRefused => "joins refused: wrong grant, name, tool or seat",
            Self::Full => "joins refused: no seat left for the role",
            Self::Busy => "joins refused: too many in a short time",
            Self::SeatReused => "kept seats reused: away for longer than they took part",
            Self::CutBudget => "cuts refused: too much for one participant",
            Self::CutRefused => "cuts refused: not at the tool, or not by its blade",
            Self::LogFull => "cuts refused: the share of the log is used up",
            Self::Snapshot => "snapshots dropped: too large for newcomers",
            Self::Sample => "samples dropped: faster than a hand",
            Self::DelayReport => "delay reports limited: the measured path does not explain them",
            Self::DelayChange => "ticks without a new playout delay: it changed too often",
        })
    }
}

/// How often each limit took effect.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LimitCounters([u64; Limit::ALL.len()]);

impl LimitCounters {
    /// Counts one.
    pub(crate) fn count(&mut self, limit: Limit) {
        self.0[limit as usize] += 1;
    }

    /// How often a limit took effect.
    pub const fn of(&self, limit: Limit) -> u64 {
        self.0[limit as usize]
    }
}
