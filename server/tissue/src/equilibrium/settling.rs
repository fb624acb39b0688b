//! Settling: the first quick steps after every force was evaluated, on new levels or by a full solve.

use super::fine_level::{FineLevel, OuterForces};
use super::mechanism::Mechanism;
use super::quad::square;
use super::solver::{INITIAL_THRESHOLD, QUICK, Solver};

/// Minimum and maximum number of steps of settling on a changed topology. The forces of a press are within tolerance
/// after two or three.
const SETTLING: [usize; 2] = [3, 8];

impl Solver {
    /// Ends the settling after a change of the topology: drops the small forces far from the tools that the evaluation
    /// of every brick has found. Quick steps leave forces of that size anyway. After a few steps the coarse levels have
    /// solved the smooth part, and every remaining force is below the threshold. Processing them for 57,000 nodes takes
    /// longer than a press.
    pub(super) fn settle(&mut self, tolerance: f64) {
        let Some(steps) = &mut self.settling else {
            return;
        };
        *steps += 1;
        let [least, most] = SETTLING;
        if *steps < least || *steps < most && self.report.residual > tolerance {
            return;
        }
        self.settling = None;
        if !self.uses(Mechanism::Settling) {
            return;
        }
        let threshold = (INITIAL_THRESHOLD * QUICK * self.reference) as f32;
        let FineLevel {
            unbalanced,
            below_threshold,
            nodes,
            r,
            outer_forces,
            ..
        } = &mut self.fine;
        *outer_forces = OuterForces::Changed;
        unbalanced.retain(|node| {
            let stays = nodes.contains(node) || square(&r[node as usize]) > threshold * threshold;
            if !stays {
                below_threshold.insert(node);
            }
            stays
        });
    }

    /// Whether settling continues.
    pub(crate) fn is_settling(&self) -> bool {
        self.settling.is_some()
    }
}
