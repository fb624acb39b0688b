//! Haptic solves of the site: contact model of the own tool, and the decision when to solve again.
//!
//! Between two solves the force loop extrapolates with the solved stiffness. A new solve is needed only after a tool
//! has moved, after the topology has changed, or while forces have not settled. Otherwise the contact model is
//! renewed without a solve.

use palpate_device::Pose;
use palpate_haptics::ContactModel;
use palpate_protocol::tool::INSERTED_BUTTON;
use palpate_protocol::{ClientTime, Span};
use palpate_tissue::Budget;

use super::Site;
use crate::replica::Replica;
use crate::tools::ToolAt;

/// Movement of this hand's tool that triggers a solve, m. The error of the linear law is then below that of the
/// solver.
const OWN_MOVED_M: f64 = 0.15e-3;

/// Movement of another tool that triggers a solve, m; the tissue in between smooths its effect on this hand.
const OTHER_MOVED_M: f64 = 0.3e-3;

/// Maximum time between two solves: tissue far from the tools relaxes over many solves.
const SOLVE_WITHIN: Span = Span::from_millis(20);

/// The latest haptic solve.
pub(super) struct LastSolve {
    at: ClientTime,
    /// The tools of the solve, moved since if they touched nothing.
    own: Option<ToolAt>,
    others: Vec<ToolAt>,
    model: ContactModel,
    /// Whether the next step must solve in any case.
    unsettled: bool,
}

impl LastSolve {
    /// Whether another solve would give a force that is equal within perception. Tools without contact are moved in
    /// the replica.
    fn holds(
        &mut self,
        now: ClientTime,
        own: Option<&ToolAt>,
        others: &[ToolAt],
        replica: &mut Replica,
    ) -> bool {
        let tools = self.own.iter().chain(&self.others);
        let alike = |(old, new): (&ToolAt, &ToolAt)| new.is_alike(old);
        let same = !self.unsettled
            && now - self.at < SOLVE_WITHIN
            && self.model.topology_version == replica.topology().version()
            && self.own.is_some() == own.is_some()
            && self.others.len() == others.len()
            && tools.zip(own.into_iter().chain(others)).all(alike);
        if !same {
            return false;
        }
        let own = self.own.iter_mut().zip(own);
        let mut own = own.map(|(old, new)| (old, new, OWN_MOVED_M));
        let others = self.others.iter_mut().zip(others);
        let mut others = others.map(|(old, new)| (old, new, OTHER_MOVED_M));
        let mut is_still = |(old, new, limit): (&mut ToolAt, &ToolAt, f64)| {
            if new.is_within(old, limit) {
                return true;
            }
            let is_free = replica.move_free(new);
            if is_free {
                *old = *new;
            }
            is_free
        };
        own.all(&mut is_still) && others.all(&mut is_still)
    }
}

/// The pose of a hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandPose {
    /// The newest measured pose.
    pub measured: Pose,
    /// The pose predicted for the time at which the contact model is used.
    pub predicted: Pose,
}

/// A hand at rest.
impl From<Pose> for HandPose {
    fn from(pose: Pose) -> Self {
        Self {
            measured: pose,
            predicted: pose,
        }
    }
}

impl Site {
    /// The contact model of the tool of a `hand`, solved if anything has changed since the last solve; `None` for
    /// spectators. While the log is replayed the tool touches nothing.
    pub fn haptic_step(
        &mut self,
        now: ClientTime,
        hand: impl Into<HandPose>,
        buttons: u8,
        budget: Budget<'_>,
    ) -> Option<ContactModel> {
        if !self.replica.has_hand() {
            return None;
        }
        let hand = hand.into();
        let own = self.own_tool().map(|description| ToolAt {
            participant: self.me,
            description,
            position: hand.measured.position,
            orientation: hand.measured.orientation,
            buttons,
            strength: 1.0,
            returns: false,
            predicted: Some(hand.predicted),
        });
        let others = match self.common_time(now) {
            Some((s, _)) => self.roster.haptic_tools_at(s, self.me),
            None => Vec::new(),
        };
        if let Some(last) = &mut self.last_solve
            && last.holds(now, own.as_ref(), &others, &mut self.replica)
        {
            last.model.solved_at = now;
            last.model.force_limit_n = self.session.force_limit_n;
            return Some(last.model);
        }
        let mut model = self.replica.haptic_step(now, own.as_ref(), &others, budget);
        model.force_limit_n = self.session.force_limit_n;
        // A frozen or muted needle stays where it was.
        if own.is_none() {
            model.is_inserted = buttons & INSERTED_BUTTON != 0;
        }
        self.counters.haptic_solves += 1;
        self.last_solve = Some(LastSolve {
            at: now,
            own,
            others,
            model,
            unsettled: self.replica.is_unsettled() || !model.is_usable(),
        });
        Some(model)
    }
}
