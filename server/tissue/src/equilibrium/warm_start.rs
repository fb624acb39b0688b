//! Warm start: the displacement increment of the last step, extrapolated (the predictor of a continuation method).
//!
//! A hand moves smoothly, and equilibrium follows it smoothly. The factor is at most the tool's motion relative to its last
//! one: a tool that stops has nothing to extrapolate. Within that bound a line search along the last increment finds it, because
//! the tool's path does not determine the contacts. The brick forces are known at both ends of the increment and interpolated
//! linearly. Without contact nothing is extrapolated.

use super::mechanism::Mechanism;
use super::solver::Solver;
use crate::{Topology, Vec3};

impl Solver {
    /// Stage: gathers contacts and applies the warm start. Returns whether a proxy lags.
    pub(super) fn apply_warm_start(&mut self, topology: &Topology, u: &mut [Vec3]) -> bool {
        let rim = self.uses(Mechanism::RimFollows);
        self.coarse.load_last_correction(&self.hierarchy, rim);
        self.fine.mark_applied(&self.hierarchy, &self.coarse);
        let mut last = self.fine.take_increments(&self.hierarchy, &self.coarse, u);
        let lags = self.gather(topology, u);
        if !self.uses(Mechanism::WarmStart) {
            last.clear();
        }
        let pace = self.contacts.pace();
        if pace > 0.0 && !last.is_empty() {
            // Only the increment near the contacts is extrapolated: the rest costs more than it gains.
            let share = self.increment_line_search(u, &last, pace);
            self.extrapolate(u, &last, share);
            // Before a further iteration contacts are gathered again if a tool lags, which updates their nodes.
            self.fine.mark_applied(&self.hierarchy, &self.coarse);
            self.fine.blend_forces(&self.hierarchy, share as f32);
        }
        lags
    }

    /// Line search for the extrapolation factor, up to `most`: the work along the increment vanishes there.
    fn increment_line_search(&mut self, u: &mut [Vec3], last: &[(u32, Vec3)], most: f64) -> f64 {
        self.fine.refresh(&self.hierarchy, u);
        self.fine.evaluate_bricks(&self.hierarchy, u);
        self.fine.keep_forces();
        self.coarse.defer(&self.hierarchy);
        self.fine.restrict_outer(&self.hierarchy, &mut self.coarse);
        let waiting = self.deferred_work();
        let r = &self.fine.r;
        let before: Vec<_> = last.iter().map(|m| r[m.0 as usize]).collect();
        self.fine.add_increments(u, last, 1.0);
        self.fine.evaluate_bricks(&self.hierarchy, u);
        let share = self.line_search(u, last, &before, waiting, [0.0, most]);
        self.fine.add_increments(u, last, -1.0);
        share
    }

    /// Applies the last increment on all levels.
    fn extrapolate(&mut self, u: &mut [Vec3], last: &[(u32, Vec3)], share: f64) {
        if share != 0.0 {
            self.coarse
                .commit(&self.hierarchy, share as f32, f32::INFINITY);
            self.fine
                .apply_increments(&self.hierarchy, &self.coarse, u, last, share);
        }
    }
}
