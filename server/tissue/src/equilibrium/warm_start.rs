//! Warm start: the displacement increment of the last step, extrapolated.
//!
//! A hand moves smoothly, and equilibrium follows it smoothly. If the held nodes moved by γ times their last increment,
//! the shape starts with γ times its last increment; the remaining error is of second order in the step. Under tools a
//! line search along the increment finds the factor, because the tool's path does not determine the contacts. The brick
//! forces are known at both ends of the increment and interpolated linearly.

use std::collections::BTreeMap;

use super::fine_level::Since;
use super::predictor::Predictor;
use super::solver::{Solver, relative};
use crate::{Topology, Vec3};

/// Cosine between two increments from which the second one continues the first.
const ALIKE: f64 = 0.7;
/// Residual of the last active set up to which its increment is extrapolated; its errors are extrapolated too.
const TRUSTED: f64 = 0.1;
/// Relative deviation of the extrapolation factor up to which the correction still updates the curvature.
const ASIDE: f64 = 1e-3;
/// Bounds of the extrapolation factor under tools, and the first trial value.
const CARRIED: [f64; 2] = [0.0, 1.0];

/// Positions of held nodes and their increments in the last step.
#[derive(Default)]
pub(super) struct WarmStart {
    drivers: Vec<Driver>,
    pub(super) path: Predictor,
    /// Whether the last step converged.
    pub(super) calm: bool,
    /// Extrapolation factor of the last step, if it made no iteration.
    steady: Option<f64>,
}

struct Driver {
    node: u32,
    at: Vec3,
    by: Vec3,
}

impl WarmStart {
    /// Reads the held nodes and their previous positions; returns γ.
    pub(super) fn look(&mut self, held: &[u32], led: &BTreeMap<u32, Vec3>, u: &[Vec3]) -> f64 {
        let (mut both, mut last, mut now) = (0.0, 0.0, 0.0);
        let drivers: Vec<Driver> = held
            .iter()
            .enumerate()
            .map(|(i, &node)| {
                let at = u[node as usize];
                let same = |d: &&Driver| d.node == node;
                let known = self.drivers.get(i).filter(same);
                let known = known.or_else(|| self.drivers.iter().find(same));
                let from = known.map(|d| d.at).or_else(|| led.get(&node).copied());
                let by = from.map_or_else(Vec3::zeros, |from| at - from);
                if let Some(before) = known {
                    both += by.dot(&before.by);
                    last += before.by.norm_squared();
                    now += by.norm_squared();
                }
                Driver { node, at, by }
            })
            .collect();
        self.drivers = drivers;
        if last == 0.0 || both.abs() < ALIKE * (last * now).sqrt() {
            return 0.0;
        }
        both / last
    }
}

impl Solver {
    /// Stage: gathers contacts and applies the warm start with a factor of about `guess`. Returns whether a proxy lags.
    pub(super) fn foresee(&mut self, topology: &Topology, u: &mut [Vec3], guess: f64) -> bool {
        let led = self.contacts.proxies.is_empty();
        let share = if led { self.trusted(guess) } else { 0.0 };
        self.carried = share != 0.0;
        if self.carried {
            self.stir(u);
        }
        self.coarse.calm();
        self.coarse.recall(&self.structure);
        if led && self.carried {
            self.go_on(u, share, (share - guess).abs() <= ASIDE);
            return self.gather(topology, u);
        }
        self.foresight.path.leave();
        self.field.note(&self.structure, &self.coarse);
        let mut last = self.field.take_moves(&self.structure, &self.coarse, u);
        if led {
            self.field.moves = last;
            return self.gather(topology, u);
        }
        // Under tools only the increment near the contacts is extrapolated: the rest costs more than it gains.
        let lags = self.gather(topology, u);
        let share = self.best_carry(u, &mut last);
        self.carry_on(u, &last, share);
        // Contacts are gathered again if a tool lags, which updates their nodes.
        self.field.note(&self.structure, &self.coarse);
        if !last.is_empty() {
            self.field.blend_forces(&self.structure, share as f32);
        }
        self.field.moves = last;
        lags
    }

    /// Extrapolates a led shape along its path by the factor `share`; `whole` if that is the full increment of the held
    /// nodes.
    fn go_on(&mut self, u: &mut [Vec3], share: f64, whole: bool) {
        let same = self.field.since != Since::Chosen && !self.field.outdated;
        let known = self.foresight.steady.filter(|_| same);
        let mut moves = if known.is_some() {
            self.field.keep_moves()
        } else {
            self.field.note(&self.structure, &self.coarse);
            self.field.take_moves(&self.structure, &self.coarse, u)
        };
        // Nodes that are not free follow level 1, which has no curvature.
        let (path, free) = (&mut self.foresight.path, &self.field.free);
        if !whole {
            path.leave();
        }
        let bends = |node: u32| free[node as usize];
        path.follow(&mut moves, known.unwrap_or(1.0), share, bends);
        if !whole {
            path.lose();
        }
        self.foresight.steady = Some(share);
        self.coarse.defer(&self.structure);
        self.carry_on(u, &moves, share);
        self.field.moves = moves;
    }

    /// Last stage: records the step for the next warm start, given its initial residual.
    pub(super) fn look_back(&mut self, begun: f64) {
        let WarmStart { path, steady, .. } = &mut self.foresight;
        if self.report.iterations > 0 && begun > 0.0 {
            path.solve(1.0 - self.report.residual / begun);
        }
        *steady = steady.filter(|_| self.carried && self.report.iterations == 0);
        // The same nodes become active again.
        let nodes = self.field.moved_on.items.len();
        path.make_room(nodes);
        self.field.make_room(nodes);
    }

    /// The extrapolation factor for held nodes that moved by `guess` times their last increment. It is reduced after a
    /// step that did not converge, so that errors decay even without time for more iterations.
    fn trusted(&self, guess: f64) -> f64 {
        let residual = relative(self.field.square_over_free(), self.reference);
        if residual >= TRUSTED {
            return 0.0;
        }
        let most = if self.foresight.calm {
            1.0
        } else {
            1.0 - residual
        };
        guess.clamp(-1.0, most)
    }

    /// Activates again all nodes that were active in the last step: nodes that only follow the coarse levels would lose
    /// their own part of the increment.
    fn stir(&mut self, u: &mut [Vec3]) {
        if self.coarse.stir(&self.structure) {
            while self.coarse.push(&self.structure, f32::INFINITY) {
                self.coarse.select(&self.structure, true);
            }
            // Forces are computed after the extrapolation.
            self.field.take_in(&self.structure, &self.coarse, u);
        }
    }

    /// Line search for the extrapolation factor: the work along the increment vanishes there.
    fn best_carry(&mut self, u: &mut [Vec3], last: &mut [(u32, Vec3)]) -> f64 {
        if last.is_empty() {
            return 0.0;
        }
        self.field.refresh(&self.structure, u);
        self.field.evaluate_bricks(&self.structure, u);
        self.field.keep_forces();
        self.coarse.defer(&self.structure);
        self.field
            .restrict_beyond(&self.structure, &mut self.coarse);
        let waiting = self.work_waiting();
        let r = &self.field.r;
        let before: Vec<_> = last.iter().map(|m| r[m.0 as usize]).collect();
        self.field.move_on(u, last, 1.0);
        self.field.evaluate_bricks(&self.structure, u);
        let share = self.share_of(u, last, &before, waiting, CARRIED);
        self.field.move_on(u, last, -1.0);
        share
    }

    /// Applies the last increment on all levels.
    fn carry_on(&mut self, u: &mut [Vec3], last: &[(u32, Vec3)], share: f64) {
        if share != 0.0 {
            self.coarse
                .commit(&self.structure, share as f32, f32::INFINITY);
            self.field
                .carry(&self.structure, &self.coarse, u, last, share);
        }
    }
}
