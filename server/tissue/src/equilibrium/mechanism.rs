//! The mechanisms of a quick step beyond plain multigrid with a line search, each of which an ablation can switch off.
//!
//! A mechanism stays in the solver only while an ablation shows a loss of accuracy or speed without it; the table is in
//! DECISIONS.md.

use super::solver::Solver;

macro_rules! mechanisms {
    ($($(#[$doc:meta])* $variant:ident $name:literal,)*) => {
        /// A mechanism of the solver.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Mechanism {
            $($(#[$doc])* $variant,)*
        }

        impl Mechanism {
            /// All mechanisms.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            /// Its name on the command line.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }
        }
    };
}

mechanisms! {
    /// Extrapolation of the last displacement increment under tools.
    WarmStart "warm-start",
    /// Smoothing of each coarse level before the correction from the next coarser one.
    PreSmoothing "pre-smoothing",
    /// Three smoothing steps of the contact nodes at the end of a step.
    ContactSmoothing "contact-smoothing",
    /// Contacts count twice in the blocks of the smoother.
    ContactCaution "contact-caution",
    /// Exact contact forces in the line search, instead of the forces at both ends.
    ContactLineSearch "contact-line-search",
    /// The line search stops samples before the middle of a tool.
    CoreGuard "core-guard",
    /// A retreating tool searches as far as tissue may be behind it.
    RetreatSearch "retreat-search",
    /// Contact stiffness on the coarse levels.
    ContactStiffness "contact-stiffness",
    /// Coarse levels follow hardened tissue.
    Hardening "hardening",
    /// Deferred elements answer with their effective stiffness.
    EffectiveStiffness "effective-stiffness",
    /// Deferred elements that were refined before answer with their secant stiffness.
    SecantStiffness "secant-stiffness",
    /// Deferred elements with a large displacement difference are refined.
    StrainLimit "strain-limit",
    /// Strained bricks stay in the active set, as far as the work limit allows.
    StrainedStay "strained-stay",
    /// A step with room in the work limit refines an element with a large deferred force, in rotation.
    Rotation "rotation",
    /// Nodes beside deferred elements do not require refinement.
    KnownForces "known-forces",
    /// Limit of the active nodes.
    WorkLimit "work-limit",
    /// Three iterations at first touch, as far as time allows.
    FirstTouch "first-touch",
    /// Further iterations while the force of a tool changes.
    SteadyForce "steady-force",
    /// Points on the rim of a coarse level follow the last increment of the coarser level.
    RimFollows "rim-follows",
    /// Bricks with small strain use their blocks at rest in the smoother.
    BlocksAtRest "blocks-at-rest",
    /// Tissue out of reach of all tools returns to its equilibrium at rest.
    ReferenceReturn "reference-return",
    /// Lower bound of the force that residuals are relative to.
    LeastReference "least-reference",
    /// The force that residuals are relative to falls slowly.
    FadingReference "fading-reference",
    /// Small distant forces are dropped some steps after a cut.
    Settling "settling",
}

/// Set of switched-off mechanisms.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Disabled(u32);

impl Disabled {
    /// Whether the mechanism is in use.
    #[inline]
    pub(crate) fn allows(self, mechanism: Mechanism) -> bool {
        self.0 >> mechanism as u32 & 1 == 0
    }
}

impl Solver {
    pub(crate) fn disable(&mut self, mechanism: Mechanism) {
        self.disabled.0 |= 1 << mechanism as u32;
        self.fine.disabled = self.disabled;
        self.contacts.disabled = self.disabled;
    }

    #[inline]
    pub(super) fn uses(&self, mechanism: Mechanism) -> bool {
        self.disabled.allows(mechanism)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::Arc;

    use super::*;
    use crate::{Budget, Material, Shape, Tool, Topology, Vec3, block};

    const CELL: f64 = 4e-3;

    /// Presses and slides; returns the forces and the iterations of every step. `follows` rebuilds the solver before the
    /// first step, as a cut does.
    fn press(without: Option<Mechanism>, follows: bool) -> (Vec<Vec3>, Vec<usize>) {
        let material = Material {
            young_pa: 10e3,
            ..Material::default()
        };
        let topology = Topology::new(Arc::new(block([16, 16, 8], CELL, &material, 1)));
        let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
        if let Some(mechanism) = without {
            solver.disable(mechanism);
        }
        if follows {
            let own = std::mem::take(&mut solver.fine.own);
            solver.restart(&topology, own);
        }
        let step = |k: usize| {
            let depth = (0.4e-3 * k as f64).min(5e-3);
            let x = 8.0 * CELL + 0.2e-3 * k as f64;
            let tool = Tool::ball(1, Vec3::new(x, 8.0 * CELL, 8.0 * CELL + 8e-3 - depth), 8e-3);
            let budget = Budget {
                near: true,
                ..Budget::new(10, 0.025)
            };
            let report = solver.step(&topology, &mut shape, &[tool], budget);
            (report.reactions[0].force, report.iterations)
        };
        (1..25).map(step).unzip()
    }

    #[test]
    fn names_are_unique() {
        let names: BTreeSet<&str> = Mechanism::ALL.iter().map(|m| m.name()).collect();
        assert_eq!(names.len(), Mechanism::ALL.len());
        assert!(Mechanism::ALL.len() <= 32, "one bit each");
    }

    #[test]
    fn disabled_mechanism_changes_the_forces_and_stays_disabled_after_a_cut() {
        for follows in [false, true] {
            let (whole, _) = press(None, follows);
            for mechanism in [
                Mechanism::WarmStart,
                Mechanism::PreSmoothing,
                Mechanism::ContactSmoothing,
                Mechanism::ContactCaution,
                Mechanism::ContactStiffness,
                Mechanism::EffectiveStiffness,
            ] {
                let (forces, _) = press(Some(mechanism), follows);
                assert_ne!(whole, forces, "{}", mechanism.name());
            }
        }
    }

    #[test]
    fn steps_without_the_check_of_steady_forces_make_one_iteration() {
        let (_, whole) = press(None, false);
        let (_, once) = press(Some(Mechanism::SteadyForce), false);
        assert!(whole[3..].iter().any(|&n| n > 1), "{whole:?}");
        assert!(once[3..].iter().all(|&n| n <= 1), "{once:?}");
    }
}
