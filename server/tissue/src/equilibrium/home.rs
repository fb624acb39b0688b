//! What nothing touches is at home: where tissue is in equilibrium by itself.
//!
//! With no tool on it and no node held, tissue that weighs nothing is in equilibrium where every spring is as long
//! as at rest: that need not be solved for. With gravity it is where the springs carry the weight, which is solved
//! for once per topology. What quick steps leave behind when a hand draws back is a shape a few tenths of a
//! millimetre off and forces all over the place where the press was, which cost the next press its accuracy, and at
//! 2 mm every later step 15 ms. So once all tools are clear of the tissue as it is at home, it is there; a tool still
//! within what will be tissue again waits for that to come to it, as always.

use std::sync::Arc;

use super::block::ZERO;
use super::brick::LOCALS;
use super::budget::Budget;
use super::cycle::Multigrid;
use super::field::{Beyond, Field, Since};
use super::foresight::Foresight;
use super::patch::Patch;
use super::relief::Relief;
use super::solver::Solver;
use super::structure::Structure;
use crate::{Shape, Topology, Vec3};

/// Residual relative to the weights at which the shape under gravity is found, and iterations for it at most.
const TOLERANCE: f64 = 1e-4;
const ITERATIONS: usize = 300;

/// How far tissue has come to the equilibrium with its own weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sag {
    /// Farthest that a node hangs from where it would be without gravity, in m.
    pub displaced_m: f64,
    /// Residual relative to the weights that is left.
    pub residual: f64,
    /// Iterations that were made.
    pub iterations: usize,
}

/// The shape under gravity, and the forces of its bricks.
pub(super) struct Home {
    pub(super) displacement: Vec<Vec3>,
    forces: Vec<[[f32; LOCALS]; 3]>,
    /// Root of the sum of squares of the weights, in N.
    weight: f64,
    sag: Sag,
}

impl Home {
    /// The one of a topology, looked for from where that of a former one stood; `None` where nothing weighs
    /// anything.
    pub(super) fn of(
        topology: &Topology,
        structure: &Arc<Structure>,
        own: &[f64],
        former: Option<&Self>,
    ) -> Option<Arc<Self>> {
        if topology.model().gravity == [0.0; 3] {
            return None;
        }
        let field = Field::new(topology, structure, own.to_vec());
        let mut solver = Solver::with(topology, Arc::clone(structure), field, None);
        let mut shape = Shape::rest(topology);
        if let Some(former) = former {
            for (node, u) in (0..).zip(&mut shape.displacement) {
                // A doubled node begins where the one was that it comes from.
                let known = former.displacement.get(node as usize);
                *u = *known.unwrap_or(&former.displacement[topology.origin(node) as usize]);
            }
        }
        solver.field.disturb_all();
        solver.dirty = true;
        let budget = Budget::new(ITERATIONS, TOLERANCE);
        let report = solver.step(topology, &mut shape, &[], budget);
        let (residual, iterations) = (report.residual, report.iterations);
        // Every brick, where it is now.
        solver.residual_over_all(&shape);
        let longest = shape.displacement.iter().map(Vec3::norm);
        Some(Arc::new(Self {
            sag: Sag {
                displaced_m: longest.fold(0.0, f64::max),
                residual,
                iterations,
            },
            displacement: shape.displacement,
            weight: solver.field.square_of_weights().sqrt(),
            forces: solver.field.forces,
        }))
    }
}

impl Solver {
    /// How far the tissue sags under its own weight; `None` without gravity.
    pub fn sag(&self) -> Option<Sag> {
        self.home.as_ref().map(|h| h.sag)
    }

    /// How far in m a node hangs from where it is at rest while nothing touches the tissue.
    pub fn sag_of(&self, node: u32) -> Vec3 {
        let known = self
            .home
            .as_ref()
            .and_then(|h| h.displacement.get(node as usize));
        known.copied().unwrap_or_else(Vec3::zeros)
    }

    /// What residuals are relative to where nothing touches the tissue, in N.
    pub(super) fn alone(&self) -> f64 {
        self.home.as_ref().map_or(0.0, |h| h.weight)
    }

    /// Before the first step: tissue that weighs something and has not been moved begins where it hangs.
    pub(super) fn move_in(&mut self, shape: &mut Shape) {
        let home = self.home.clone().filter(|_| !self.moved_in);
        let Some(home) = home else { return };
        self.moved_in = true;
        let u = &mut shape.displacement;
        let unmoved = |n: usize| self.field.fixed[n] || u[n] == Vec3::zeros();
        if !(0..u.len()).all(unmoved) {
            self.field.disturb_all();
            self.dirty = true;
            return;
        }
        for (n, u) in u.iter_mut().enumerate() {
            if !self.field.fixed[n] {
                *u = home.displacement[n];
            }
        }
        self.reference = self.alone();
        let held = self.held.clone();
        self.field.forces.clone_from(&home.forces);
        self.field.displaced = self.field.displaced.max(home.sag.displaced_m);
        for node in held {
            self.field.disturb(&self.structure, node);
        }
    }

    /// Puts the tissue to where it is by itself if nothing keeps it from there. Returns whether it moved.
    pub(super) fn go_home(&mut self, topology: &Topology, shape: &mut Shape) -> bool {
        let sag = self.sag().map_or(0.0, |s| s.displaced_m);
        let clear = || self.contacts.are_clear(topology, &shape.displacement, sag);
        if self.field.at_home || !self.held.is_empty() || !clear() {
            return false;
        }
        let home = self.home.as_deref();
        match home {
            Some(home) => shape.displacement.clone_from(&home.displacement),
            None => shape.displacement.fill(Vec3::zeros()),
        }
        self.field.rest(&self.structure, home);
        self.coarse.rest();
        self.contacts.rest();
        self.foresight = Foresight::default();
        self.led.clear();
        self.relief = Relief::NONE;
        self.reference = self.alone();
        self.report.reactions.clear();
        self.dirty = false;
        true
    }
}

impl Field {
    fn rest(&mut self, structure: &Structure, home: Option<&Home>) {
        let bricks = self.computed.take();
        for &brick in &bricks {
            let b = brick as usize;
            self.forces[b] = home.map_or([[0.0; LOCALS]; 3], |h| h.forces[b]);
            self.firm[b] = [0.0; 6];
        }
        for &brick in &bricks {
            for &node in &structure.bricks[brick as usize].nodes {
                self.r[node as usize] = match home {
                    Some(_) => self.sum(structure, node),
                    None => ZERO,
                };
            }
        }
        self.applied.fill([0.0; 3]);
        self.beyond = Beyond::Changed;
        for list in [
            &mut self.loud,
            &mut self.quiet,
            &mut self.disturbed,
            &mut self.stale,
            &mut self.moved_on,
            &mut self.settled,
        ] {
            list.clear();
        }
        self.since = Since::Chosen;
        self.current = false;
        self.outdated = true;
        self.at_home = true;
        self.displaced = home.map_or(0.0, |h| h.sag.displaced_m);
    }
}

impl Multigrid {
    fn rest(&mut self) {
        self.patches.iter_mut().for_each(Patch::rest);
    }
}
