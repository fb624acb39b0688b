//! Warm start: the displacement increment of the last step, extrapolated.
//!
//! A hand moves smoothly, and equilibrium follows it smoothly. If the held nodes moved by γ times their last increment,
//! the shape starts with γ times its last increment; the remaining error is of second order in the step. Under tools a
//! line search along the increment finds the factor, because the tool's path does not determine the contacts. The brick
//! forces are known at both ends of the increment and interpolated linearly.

use std::collections::BTreeMap;

use super::budget::relative;
use super::fine_level::SetChange;
use super::mechanism::Mechanism;
use super::predictor::Predictor;
use super::solver::Solver;
use crate::{Topology, Vec3};

/// Cosine between two increments from which the second one continues the first.
const SAME_DIRECTION: f64 = 0.7;
/// Residual of the last active set up to which its increment is extrapolated; its errors are extrapolated too.
const RESIDUAL_MAX: f64 = 0.1;
/// Relative deviation of the extrapolation factor up to which the correction still updates the curvature.
const FACTOR_TOLERANCE: f64 = 1e-3;
/// Bounds of the extrapolation factor under tools, and the first trial value.
const FACTORS: [f64; 2] = [0.0, 1.0];

/// Positions of held nodes and their increments in the last step.
#[derive(Default)]
pub(super) struct WarmStart {
    motions: Vec<HeldMotion>,
    pub(super) path: Predictor,
    /// Whether the last step converged.
    pub(super) converged: bool,
    /// Extrapolation factor of the last step, if it made no iteration.
    last_factor: Option<f64>,
}

struct HeldMotion {
    node: u32,
    at: Vec3,
    by: Vec3,
}

impl WarmStart {
    /// Reads the held nodes and their previous positions; returns γ.
    pub(super) fn extrapolation_factor(
        &mut self,
        held: &[u32],
        led: &BTreeMap<u32, Vec3>,
        u: &[Vec3],
    ) -> f64 {
        let (mut both, mut last, mut now) = (0.0, 0.0, 0.0);
        let motions: Vec<HeldMotion> = held
            .iter()
            .enumerate()
            .map(|(i, &node)| {
                let at = u[node as usize];
                let same = |d: &&HeldMotion| d.node == node;
                let known = self.motions.get(i).filter(same);
                let known = known.or_else(|| self.motions.iter().find(same));
                let from = known.map(|d| d.at).or_else(|| led.get(&node).copied());
                let by = from.map_or_else(Vec3::zeros, |from| at - from);
                if let Some(before) = known {
                    both += by.dot(&before.by);
                    last += before.by.norm_squared();
                    now += by.norm_squared();
                }
                HeldMotion { node, at, by }
            })
            .collect();
        self.motions = motions;
        if last == 0.0 || both.abs() < SAME_DIRECTION * (last * now).sqrt() {
            return 0.0;
        }
        both / last
    }
}

impl Solver {
    /// Stage: gathers contacts and applies the warm start with a factor of about `guess`. Returns whether a proxy lags.
    pub(super) fn apply_warm_start(
        &mut self,
        topology: &Topology,
        u: &mut [Vec3],
        guess: f64,
    ) -> bool {
        let led = self.contacts.proxies.is_empty();
        let share = if led { self.trusted_factor(guess) } else { 0.0 };
        self.warm_started = share != 0.0;
        if self.warm_started {
            self.reactivate(u);
        }
        self.coarse.clear_refined();
        let rim = self.uses(Mechanism::RimFollows);
        self.coarse.load_last_correction(&self.hierarchy, rim);
        if led && self.warm_started {
            self.extrapolate_path(u, share, (share - guess).abs() <= FACTOR_TOLERANCE);
            return self.gather(topology, u);
        }
        self.warm_start.path.discard();
        self.fine.mark_applied(&self.hierarchy, &self.coarse);
        let mut last = self.fine.take_increments(&self.hierarchy, &self.coarse, u);
        if led {
            self.fine.increments = last;
            return self.gather(topology, u);
        }
        // Under tools only the increment near the contacts is extrapolated: the rest costs more than it gains.
        let lags = self.gather(topology, u);
        if !self.uses(Mechanism::WarmStart) {
            last.clear();
        }
        let share = self.increment_line_search(u, &mut last);
        self.extrapolate(u, &last, share);
        // Contacts are gathered again if a tool lags, which updates their nodes.
        self.fine.mark_applied(&self.hierarchy, &self.coarse);
        if !last.is_empty() {
            self.fine.blend_forces(&self.hierarchy, share as f32);
        }
        self.fine.increments = last;
        lags
    }

    /// Extrapolates a led shape along its path by the factor `share`; `whole` if that is the full increment of the held
    /// nodes.
    fn extrapolate_path(&mut self, u: &mut [Vec3], share: f64, whole: bool) {
        let same = self.fine.since != SetChange::Replaced && !self.fine.outdated;
        let known = self.warm_start.last_factor.filter(|_| same);
        let mut increments = if known.is_some() {
            self.fine.keep_increments()
        } else {
            self.fine.mark_applied(&self.hierarchy, &self.coarse);
            self.fine.take_increments(&self.hierarchy, &self.coarse, u)
        };
        // Nodes that are not free follow level 1, which has no curvature.
        let (path, free) = (&mut self.warm_start.path, &self.fine.free);
        if !whole {
            path.discard();
        }
        let bends = |node: u32| free[node as usize];
        path.predict(&mut increments, known.unwrap_or(1.0), share, bends);
        if !whole {
            path.skip_correction();
        }
        self.warm_start.last_factor = Some(share);
        self.coarse.defer(&self.hierarchy);
        self.extrapolate(u, &increments, share);
        self.fine.increments = increments;
    }

    /// Last stage: records the step for the next warm start, given its initial residual.
    pub(super) fn record_step(&mut self, begun: f64) {
        let WarmStart {
            path, last_factor, ..
        } = &mut self.warm_start;
        if self.report.iterations > 0 && begun > 0.0 {
            path.record_solve(1.0 - self.report.residual / begun);
        }
        *last_factor = last_factor.filter(|_| self.warm_started && self.report.iterations == 0);
        // The same nodes become active again.
        let nodes = self.fine.moved_on.items.len();
        path.make_room(nodes);
        self.fine.make_room(nodes);
    }

    /// The extrapolation factor for held nodes that moved by `guess` times their last increment. It is reduced after a
    /// step that did not converge, so that errors decay even without time for more iterations.
    fn trusted_factor(&self, guess: f64) -> f64 {
        let residual = relative(self.fine.square_over_free(), self.reference);
        if residual >= RESIDUAL_MAX {
            return 0.0;
        }
        let most = if self.warm_start.converged {
            1.0
        } else {
            1.0 - residual
        };
        guess.clamp(-1.0, most)
    }

    /// Activates again all nodes that were active in the last step: nodes that only follow the coarse levels would lose
    /// their own part of the increment.
    fn reactivate(&mut self, u: &mut [Vec3]) {
        if self.coarse.reactivate(&self.hierarchy) {
            while self
                .coarse
                .prolongate_pending(&self.hierarchy, f32::INFINITY)
            {
                self.coarse.select(&self.hierarchy, true);
            }
            // Forces are computed after the extrapolation.
            self.fine.activate(&self.hierarchy, &self.coarse, u);
        }
    }

    /// Line search for the extrapolation factor: the work along the increment vanishes there.
    fn increment_line_search(&mut self, u: &mut [Vec3], last: &mut [(u32, Vec3)]) -> f64 {
        if last.is_empty() {
            return 0.0;
        }
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
        let share = self.line_search(u, last, &before, waiting, FACTORS);
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
