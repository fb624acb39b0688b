//! What a step may begin with: the change of the last one, carried on.
//!
//! A hand that leads nodes moves on much as it moved before, and equilibrium follows it smoothly. So when
//! the held nodes have moved by γ times what they moved before, the shape begins with γ times its last
//! change; what remains to be solved is of second order in the step. Under tools the share is looked for
//! along the change itself: where a tool has gone does not tell where it still touches. The bricks' forces
//! are known at both its ends then, and taken for linear between.

use std::collections::BTreeMap;

use super::field::Since;
use super::path::Path;
use super::solver::{Solver, relative};
use crate::{Topology, Vec3};

/// Cosine between two moves from which on the second one continues the first.
const ALIKE: f64 = 0.7;
/// Residual of the last step's set up to which its change may be carried on: errors would be, too.
const TRUSTED: f64 = 0.1;
/// Part of a step by which it may be carried on too short and still tell of the curve.
const ASIDE: f64 = 1e-3;
/// Bounds of the share of the last change that is carried on under tools, and what is tried first where
/// tools do not tell.
const CARRIED: [f64; 2] = [0.0, 1.0];

/// Where held nodes were and how they moved in the last step.
#[derive(Default)]
pub(super) struct Foresight {
    drivers: Vec<Driver>,
    pub(super) path: Path,
    /// Whether the last step came as far as it was asked to.
    pub(super) calm: bool,
    /// Share over which the last step was carried on if it did nothing else.
    steady: Option<f64>,
}

struct Driver {
    node: u32,
    at: Vec3,
    by: Vec3,
}

impl Foresight {
    /// Takes in where held nodes are, and where they were led from; gives γ.
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
    /// Stage: contacts, and the last step's change carried on by about `guess` times. Returns whether
    /// a proxy lags.
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
        // Of a tool's press only what is near is kept going: the rest costs more than it brings.
        let lags = self.gather(topology, u);
        let share = self.best_carry(u, &mut last);
        self.carry_on(u, &last, share);
        // Contacts are gathered again when a tool lags, and bring their nodes up to date.
        self.field.note(&self.structure, &self.coarse);
        if !last.is_empty() {
            self.field.blend_forces(&self.structure, share as f32);
        }
        self.field.moves = last;
        lags
    }

    /// Carries a shape that is led on along its path, over a share that is the `whole` of what it was led on by or
    /// less.
    fn go_on(&mut self, u: &mut [Vec3], share: f64, whole: bool) {
        let same = self.field.since != Since::Chosen && !self.field.outdated;
        let known = self.foresight.steady.filter(|_| same);
        let mut moves = if known.is_some() {
            self.field.keep_moves()
        } else {
            self.field.note(&self.structure, &self.coarse);
            self.field.take_moves(&self.structure, &self.coarse, u)
        };
        // What is not free follows level 1, which knows of no curve.
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

    /// Last stage: what the next step needs to know of this one to carry it on, given the residual that it began with.
    pub(super) fn look_back(&mut self, begun: f64) {
        let Foresight { path, steady, .. } = &mut self.foresight;
        if self.report.iterations > 0 && begun > 0.0 {
            path.solve(1.0 - self.report.residual / begun);
        }
        *steady = steady.filter(|_| self.carried && self.report.iterations == 0);
        // All that took part will again.
        let nodes = self.field.moved_on.items.len();
        path.make_room(nodes);
        self.field.make_room(nodes);
    }

    /// How much of the last step's change is carried on under held nodes that moved by `guess` times as much:
    /// less than that after a step that had too little time, so that what it got wrong dies out even if this one has
    /// no more.
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

    /// Lets all take part again that has taken part in the last step: it was moved, too, and what only
    /// follows the coarse levels would lose its own part of that.
    fn stir(&mut self, u: &mut [Vec3]) {
        if self.coarse.stir(&self.structure) {
            while self.coarse.push(&self.structure, f32::INFINITY) {
                self.coarse.select(&self.structure, true);
            }
            // Forces are computed where it is carried to.
            self.field.take_in(&self.structure, &self.coarse, u);
        }
    }

    /// How much of the last step's change is best: where no work is left along it.
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

    /// Carries the last step's change on, on all levels.
    fn carry_on(&mut self, u: &mut [Vec3], last: &[(u32, Vec3)], share: f64) {
        if share != 0.0 {
            self.coarse
                .commit(&self.structure, share as f32, f32::INFINITY);
            self.field
                .carry(&self.structure, &self.coarse, u, last, share);
        }
    }
}
