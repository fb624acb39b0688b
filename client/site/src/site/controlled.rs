//! Effects of the instructor's controls at a site.

use std::collections::BTreeMap;

use palpate_protocol::control::{Annotation, CameraView};
use palpate_protocol::operation::{CompensationMode, HeldTool};
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_protocol::{ParticipantId, ServerTime};

use super::Site;
use crate::tools::StrokeCollector;

/// Annotations kept; the server has fewer, and further ones are ignored.
const ANNOTATIONS_MAX: usize = 256;

/// Conditions for joining.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    /// Whether only lost seats are given out.
    pub is_locked: bool,
    /// Seats in total.
    pub seats: u16,
    /// Seats that spectators and recorders may take together.
    pub spectators: u16,
}

/// The state of the session that controls have set.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionState {
    /// Limit of the own force, N; infinite for none.
    pub force_limit_n: f64,
    /// Annotations by their number.
    pub annotations: BTreeMap<u32, Annotation>,
    /// The view direction for all, if one was shown.
    pub camera: Option<CameraView>,
    /// The conditions for joining, if they were changed.
    pub access: Option<Access>,
    /// The rule for the delay, if it was changed.
    pub compensation: Option<CompensationMode>,
}

impl Default for SessionState {
    fn default() -> Self {
        Self {
            force_limit_n: f64::INFINITY,
            annotations: BTreeMap::new(),
            camera: None,
            access: None,
            compensation: None,
        }
    }
}

impl SessionState {
    pub(super) fn annotate(&mut self, annotation: &Annotation) {
        let is_known = self.annotations.contains_key(&annotation.id);
        if is_known || self.annotations.len() < ANNOTATIONS_MAX {
            self.annotations.insert(annotation.id, annotation.clone());
        }
    }
}

impl Site {
    /// The state of the session that controls have set.
    pub fn session_state(&self) -> &SessionState {
        &self.session
    }

    /// Whether the instructor has muted the own tool.
    pub fn is_muted(&self) -> bool {
        self.roster.is_muted(self.me)
    }

    /// Whether the session is frozen.
    pub fn is_frozen(&self) -> bool {
        self.roster.is_frozen()
    }

    pub(super) fn change_tool(&mut self, who: ParticipantId, tool: ToolDescription) {
        self.roster.change_tool(who, tool);
        if who == self.me {
            let is_blade = tool.kind == ToolKind::Scalpel;
            self.strokes = is_blade.then(|| StrokeCollector::new(tool.length_m));
        }
    }

    /// Holds these tools from a time on, or lets all tools move.
    pub(super) fn freeze(&mut self, held: Option<&Vec<HeldTool>>, from: ServerTime) {
        if let Some(held) = held {
            self.roster.freeze(held, from);
            self.notice("the instructor has frozen the session".to_owned());
        } else {
            self.roster.release();
            self.notice("the session continues".to_owned());
        }
    }

    pub(super) fn change_access(&mut self, author: ParticipantId, access: Access) {
        self.session.access = Some(access);
        let state = if access.is_locked { "locked" } else { "open" };
        let what = format!("has changed access: {state}, {} seats", access.seats);
        self.notice_of(author, &what);
    }

    pub(super) fn mute(&mut self, who: ParticipantId, is_muted: bool) {
        self.roster.set_muted(who, is_muted);
        match (who == self.me, is_muted) {
            (true, true) => {
                self.notice("the instructor has muted your tool: it is inactive".to_owned());
            }
            (true, false) => self.notice("your tool is active again".to_owned()),
            (false, true) => {
                self.notice_of(who, "can not use the tool: it is muted by the instructor");
            }
            (false, false) => self.notice_of(who, "can use the tool again"),
        }
    }

    /// Limits the own force; limits of other participants have no effect here.
    pub(super) fn limit_force(&mut self, who: ParticipantId, newtons: Option<f64>) {
        if who != self.me {
            return;
        }
        self.session.force_limit_n = newtons.unwrap_or(f64::INFINITY);
        self.notice(match newtons {
            Some(newtons) => format!("the instructor limits your force to {newtons:.1} N"),
            None => "the instructor no longer limits your force".to_owned(),
        });
    }
}
