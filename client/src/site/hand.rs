//! What the hand feels, and when it is solved again.
//!
//! Between two solves the force loop follows the solved stiffness, so that a solve is worth its work only after a tool
//! has moved, the topology has changed, or while forces have not settled. A model of which all that still holds is
//! renewed without a solve.

use palpate_haptics::ContactModel;
use palpate_protocol::{ClientTime, Span};
use palpate_tissue::Budget;

use super::Site;
use crate::replica::Replica;
use crate::roster::ToolAt;

/// The tool of this hand is solved for again after it has moved so far, m. The linear law is then off by less than the solver.
const OWN_MOVED_M: f64 = 0.15e-3;

/// Another tool is solved for again after it has moved so far, m: the tissue between smooths its effect on this hand.
const OTHER_MOVED_M: f64 = 0.3e-3;

/// From one solve to the next at most: what is far from the tools relaxes over many.
const SOLVE_WITHIN: Span = Span::from_millis(20);

/// The newest solve of the hand's side.
pub(super) struct Felt {
    at: ClientTime,
    /// The tools as they were solved for, or moved since without touching anything.
    own: Option<ToolAt>,
    others: Vec<ToolAt>,
    model: ContactModel,
    /// Whether it has to be solved again whatever moves.
    unsettled: bool,
}

impl Felt {
    /// Whether another solve would give the same, as far as a hand can tell. Tools that touch nothing are moved in
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

impl Site {
    /// What the hand feels with its tool at `pose`, solved if anything has changed since the last solve; `None` for
    /// who has no hand.
    pub fn haptic_step(
        &mut self,
        now: ClientTime,
        pose: palpate_device::Pose,
        buttons: u8,
        budget: Budget<'_>,
    ) -> Option<ContactModel> {
        self.replica.haptic_shape()?;
        let own = self.own_tool().map(|description| ToolAt {
            participant: self.me,
            description,
            position: pose.position,
            orientation: pose.orientation,
            buttons,
            stale: false,
        });
        let others = match self.moment(now) {
            Some((s, _)) => self.roster.tools_felt_at(s, self.me),
            None => Vec::new(),
        };
        // The copy for a cut has taken this turn's time.
        let is_spent = self.cuts.take_captured();
        if let Some(felt) = &mut self.felt {
            if felt.holds(now, own.as_ref(), &others, &mut self.replica) {
                felt.model.solved_at = now;
                return Some(felt.model);
            }
            let version = self.replica.topology().version();
            if is_spent && felt.model.topology_version == version {
                return Some(felt.model);
            }
        }
        let model = self.replica.haptic_step(now, own.as_ref(), &others, budget);
        self.counters.haptic_solves += 1;
        self.lead_cut();
        self.felt = Some(Felt {
            at: now,
            own,
            others,
            model,
            unsettled: self.replica.is_unsettled() || !model.is_usable(),
        });
        Some(model)
    }
}
