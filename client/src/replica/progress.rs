//! Progress of the replica thread, for the main thread.

use std::collections::VecDeque;

use palpate_protocol::Span;
use palpate_site::{Site, ThinCounters};

use crate::program::Ending;

/// Maximum number of queued notices: a full session may join at once.
const NOTICES_MAX: usize = 64;

/// State of the participant in the session.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) enum Part {
    /// Participating normally.
    #[default]
    Participating,
    /// The initial log is being applied.
    CatchingUp,
    /// A resync is in progress: no force is rendered.
    Resyncing,
    /// The tool is inactive, because the network is too slow.
    Demoted,
    /// The instructor has muted the tool.
    Muted,
    /// The instructor has frozen the session.
    Frozen,
}

impl Part {
    pub(super) fn of(site: &Site) -> Self {
        if site.is_resyncing() {
            Self::Resyncing
        } else if site.is_catching_up() {
            Self::CatchingUp
        } else if site.is_demoted() {
            Self::Demoted
        } else if site.is_muted() {
            Self::Muted
        } else if site.is_frozen() {
            Self::Frozen
        } else {
            Self::Participating
        }
    }
}

/// State of the thread, for the main thread.
#[derive(Debug, Clone, Default)]
pub(crate) struct Progress {
    pub(crate) delay: Span,
    pub(crate) clock_error: Option<Span>,
    pub(crate) topology_version: u32,
    /// Age of the contact model; `None` without a hand.
    pub(crate) model_age: Option<Span>,
    pub(crate) here: usize,
    pub(crate) link_lost: bool,
    pub(crate) part: Part,
    /// Notices to display, oldest first.
    pub(crate) notices: VecDeque<String>,
    /// Counters of a thin view; `None` for a full subscription.
    pub(crate) thin: Option<ThinCounters>,
    /// End of the session, once it has come.
    pub(crate) ending: Option<Ending>,
}

impl Progress {
    pub(super) fn note(&mut self, sentence: String) {
        if self.notices.len() == NOTICES_MAX {
            self.notices.pop_front();
        }
        self.notices.push_back(sentence);
    }
}
