//! Rates of joins, per class of roles: each join adds operations to the log and work to all clients.
//!
//! The room does not know addresses; the transport limits connections per address. Classes keep a flood of spectators
//! away from trainees, and one of trainees away from the instructor. A seat resumes from its own budget.

use palpate_protocol::{Role, ServerTime, TokenBucket};

use crate::config::SEATS_MAX;

/// Joins of one class at once: all seats, as at the start of a session.
const BURST: f64 = SEATS_MAX as f64;

/// Joins of one class per second in the long run: a newcomer is hardly ever refused beside a participant who joins and
/// drops as fast as one connection can, and all classes together add fewer than 90 operations per second.
const PER_S: f64 = 10.0;

/// Resumptions of one seat at once. A loss is detected after 2 s.
const RESUMPTIONS_BURST: f64 = 8.0;

/// Resumptions of one seat per second in the long run: one loss in five seconds.
const RESUMPTIONS_PER_S: f64 = 0.2;

/// Roles that share a budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RoleClass {
    Instructors,
    Trainees,
    /// Spectators and recorders, who have no tool.
    Observers,
}

impl RoleClass {
    /// The class of a role.
    pub(crate) fn of(role: Role) -> Self {
        match role {
            Role::Instructor => Self::Instructors,
            Role::Trainee => Self::Trainees,
            Role::Spectator | Role::Recorder => Self::Observers,
        }
    }
}

/// The budgets of all classes.
#[derive(Debug)]
pub(crate) struct Joins {
    classes: [TokenBucket; 3],
}

impl Joins {
    /// Full budgets.
    pub(crate) fn new(now: ServerTime) -> Self {
        Self {
            classes: [TokenBucket::new(PER_S, BURST, now - ServerTime::ZERO); 3],
        }
    }

    /// Takes one join of a class, if its budget has one.
    pub(crate) fn take(&mut self, class: RoleClass, now: ServerTime) -> bool {
        self.classes[class as usize].take(1.0, now - ServerTime::ZERO)
    }
}

/// The budget of one seat's resumptions.
pub(crate) fn resumptions(now: ServerTime) -> TokenBucket {
    TokenBucket::new(RESUMPTIONS_PER_S, RESUMPTIONS_BURST, now - ServerTime::ZERO)
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Span;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn flood_of_one_class_leaves_the_others_their_joins(
            waits in prop::collection::vec(0_i64..100_000, 0..2000),
            flooding in 0_usize..3,
        ) {
            let classes = [RoleClass::Instructors, RoleClass::Trainees, RoleClass::Observers];
            let mut now = ServerTime::ZERO;
            let mut joins = Joins::new(now);
            for wait in waits {
                now = now + Span::from_micros(wait);
                joins.take(classes[flooding], now);
            }
            for class in classes.into_iter().filter(|c| *c != classes[flooding]) {
                prop_assert!(joins.take(class, now));
            }
        }
    }
}
