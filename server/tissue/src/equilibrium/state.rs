//! The state of a solver and its shape, copied out so that another thread can continue it on a changed topology.
//!
//! A cut changes the bricks and levels of a solver and outdates all forces: some 30 ms on 57,000 nodes, while the
//! haptic loop has 2 ms. So its thread only [captures](Solver::capture) the state, 60 bytes per node. Another thread
//! [resumes](SolverState::resume) from the copy on the new topology, solves, and returns the solver.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::coarse_level::update_total;
use super::contact_smoother::ContactSmoother;
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, OuterForces, square};
use super::follower::{Follower, Successor};
use super::hierarchy::Hierarchy;
use super::mechanism::{Disabled, Mechanism};
use super::quad::laid_out;
use super::reference_state::ReferenceState;
use super::solver::{INITIAL_THRESHOLD, QUICK, Solver};
use super::work_limit::WorkLimit;
use crate::contact::{Contacts, Proxy};
use crate::{CutOutcome, Shape, StepReport, Topology, Vec3};

/// Minimum and maximum number of steps of settling on a changed topology. The forces of a press are within tolerance
/// after two or three.
const SETTLING: [usize; 2] = [3, 8];

/// Displacements of one coarse level: totals, and the part applied from the coarser level.
#[derive(Default)]
struct Totals {
    total: Vec<[f64; 3]>,
    applied: Vec<[f64; 3]>,
}

/// State of a solver for its continuation on a changed topology.
pub struct SolverState {
    /// Hierarchy of the captured solver; `None` before a capture.
    hierarchy: Option<Arc<Hierarchy>>,
    displacement: Vec<Vec3>,
    applied: Vec<[f64; 3]>,
    levels: Vec<Totals>,
    held: Vec<u32>,
    proxies: Vec<Proxy>,
    displaced: f64,
    is_at_reference: bool,
    has_started: bool,
    reference: f64,
    work_limit: WorkLimit,
    report: StepReport,
}

impl Follower {
    /// An empty state with memory for a capture of this topology, so that [`Solver::capture`] does not allocate.
    pub fn room(&self) -> SolverState {
        fn room<T: Clone>(value: T, len: usize) -> Vec<T> {
            let mut values = laid_out(value, len);
            values.clear();
            values
        }
        let hierarchy = self.hierarchy();
        let nodes = hierarchy.prolongation.len();
        let totals = |points: usize| Totals {
            total: room([0.0; 3], points),
            applied: room([0.0; 3], points),
        };
        SolverState {
            hierarchy: None,
            displacement: room(Vec3::zeros(), nodes),
            applied: room([0.0; 3], nodes),
            levels: hierarchy
                .levels
                .iter()
                .map(|l| totals(l.points()))
                .collect(),
            held: Vec::new(),
            proxies: Vec::new(),
            displaced: 0.0,
            is_at_reference: true,
            has_started: false,
            reference: 0.0,
            work_limit: WorkLimit::NONE,
            report: StepReport::default(),
        }
    }
}

impl Solver {
    /// Copies the state of this solver and its shape. The solver itself continues unchanged.
    pub fn capture(&mut self, shape: &Shape, to: &mut SolverState) {
        fn copy<T: Clone>(from: &[T], to: &mut Vec<T>) {
            to.clear();
            to.extend_from_slice(from);
        }
        self.fine.mark_applied(&self.hierarchy, &self.coarse);
        copy(&shape.displacement, &mut to.displacement);
        copy(&self.fine.applied, &mut to.applied);
        to.levels
            .resize_with(self.coarse.grids.len(), Totals::default);
        for (grid, level) in self.coarse.grids.iter().zip(&mut to.levels) {
            copy(&grid.total, &mut level.total);
            copy(&grid.applied, &mut level.applied);
        }
        copy(&self.held, &mut to.held);
        copy(&self.contacts.proxies, &mut to.proxies);
        to.displaced = self.fine.displaced;
        to.is_at_reference = self.fine.at_reference;
        to.has_started = self.has_started;
        to.reference = self.reference;
        to.work_limit = self.work_limit;
        to.report.clone_from(&self.report);
        to.hierarchy = Some(Arc::clone(&self.hierarchy));
    }

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
    pub fn is_settling(&self) -> bool {
        self.settling.is_some()
    }

    /// Assembles a solver from its parts.
    pub(super) fn assemble(
        topology: &Topology,
        hierarchy: Arc<Hierarchy>,
        (fine, coarse): (FineLevel, Multigrid),
        contacts: Contacts,
        reference_state: Option<Arc<ReferenceState>>,
    ) -> Self {
        let mut own: Vec<f64> = fine.own.iter().copied().filter(|&k| k > 0.0).collect();
        let middle = own.len() / 2;
        let typical = match own.get(middle) {
            Some(_) => *own.select_nth_unstable_by(middle, f64::total_cmp).1,
            None => 0.0,
        };
        Self {
            least: typical * topology.model().spacing_m,
            contact_smoother: ContactSmoother::new(&hierarchy),
            fine,
            coarse,
            hierarchy,
            contacts,
            held: Vec::new(),
            work_limit: WorkLimit::NONE,
            reference: 0.0,
            reference_state,
            has_started: false,
            report: StepReport::default(),
            dirty: false,
            prescribed_from: BTreeMap::new(),
            prescribed_displacements: Vec::new(),
            last_forces: Vec::new(),
            settling: None,
            quick_steps: 0,
            disabled: Disabled::default(),
        }
    }
}

impl SolverState {
    /// A solver and a shape that continue this state on the cut topology. `successor` comes from a [`Follower`] of that
    /// topology. Without a capture the shape is at rest.
    pub fn resume(
        mut self,
        topology: &Topology,
        outcome: &CutOutcome,
        successor: Successor,
    ) -> (Solver, Shape) {
        self.prolongate_all();
        let mut shape = Shape {
            displacement: self.displacement,
        };
        shape.follow(topology, outcome);
        let Successor {
            hierarchy,
            fine,
            coarse,
            index,
            reference_state,
        } = successor;
        let contacts = Contacts::with(topology, index, self.proxies);
        let mut solver = Solver::assemble(
            topology,
            hierarchy,
            (fine, coarse),
            contacts,
            reference_state,
        );
        solver.held = self.held;
        solver.has_started = self.has_started;
        solver.reference = self.reference;
        solver.work_limit = self.work_limit;
        solver.report = self.report;
        solver.restore_state(self.displaced, self.is_at_reference);
        (solver, shape)
    }

    /// Prolongates the coarse displacements to every node, as [`Solver::prolongate_all`] does.
    fn prolongate_all(&mut self) {
        let Some(hierarchy) = self.hierarchy.take() else {
            return;
        };
        for l in (0..self.levels.len()).rev() {
            let (finer, coarser) = self.levels.split_at_mut(l + 1);
            let (Some(level), Some(above)) = (finer.last_mut(), coarser.first()) else {
                continue;
            };
            let prolongation = &hierarchy.levels[l].prolongation;
            let points = level.total.iter_mut().zip(&mut level.applied);
            for (p, (total, applied)) in points.enumerate() {
                let now = prolongation.interpolate_exactly(p, &above.total);
                update_total(now, total, applied);
            }
        }
        let Some(first) = self.levels.first() else {
            return;
        };
        let held: Vec<_> = self
            .held
            .iter()
            .map(|&n| (n, self.displacement[n as usize]))
            .collect();
        let nodes = self.displacement.iter_mut().zip(&self.applied);
        for (n, (u, applied)) in nodes.enumerate() {
            let now = hierarchy.prolongation.interpolate_exactly(n, &first.total);
            *u += Vec3::from(now) - Vec3::from(*applied);
        }
        for (node, at) in held {
            self.displacement[node as usize] = at;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::solver::REFINED_EVERY;
    use super::*;
    use crate::{BladePoint, Budget, CutStroke, Material, Tool, block, cut};

    const CELL: f64 = 4e-3;

    fn topology() -> Topology {
        let material = Material {
            young_pa: 10e3,
            density_kg_m3: 1000.0,
            ..Material::default()
        };
        Topology::new(Arc::new(block([32, 16, 8], CELL, &material, 1)))
    }

    /// A press that slides along the block, at step `k`.
    fn tool(k: usize) -> Tool {
        let depth = (0.3e-3 * k as f64).min(6e-3);
        let x = 7.0 * CELL + 0.05e-3 * k as f64;
        Tool::ball(1, Vec3::new(x, 8.0 * CELL, 8.0 * CELL + 8e-3 - depth), 8e-3)
    }

    fn slit(topology: &mut Topology) -> CutOutcome {
        let point = |i: u32| BladePoint {
            tip: Vec3::new(22.4 * CELL, CELL * (4.0 + f64::from(i)), 4.1 * CELL),
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: (0..9).map(point).collect(),
            width_m: 0.0,
        };
        cut(topology, &stroke).unwrap()
    }

    fn hand() -> Budget<'static> {
        Budget {
            near: true,
            ..Budget::new(2, QUICK)
        }
    }

    /// A press, then a cut beside it; the state is resumed on another solver.
    fn resumed() -> (Topology, Solver, Shape) {
        let mut topology = topology();
        let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
        let mut follower = solver.follower();
        for k in 0..40 {
            solver.step(&topology, &mut shape, &[tool(k)], hand());
        }
        let mut state = follower.room();
        solver.capture(&shape, &mut state);
        let outcome = slit(&mut topology);
        follower.follow(&topology, &outcome.touched);
        let (solver, shape) = state.resume(&topology, &outcome, follower.successor(&topology));
        (topology, solver, shape)
    }

    #[test]
    fn capture_does_not_change_later_steps() {
        let topology = topology();
        let run = |captures: bool| {
            let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
            let mut state = solver.follower().room();
            for k in 0..40 {
                solver.step(&topology, &mut shape, &[tool(k)], hand());
                if captures {
                    solver.capture(&shape, &mut state);
                }
            }
            shape.hash()
        };
        assert_eq!(run(true), run(false));
    }

    #[test]
    fn captured_shape_equals_the_prolongated_shape() {
        let topology = topology();
        let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
        for k in 0..40 {
            solver.step(&topology, &mut shape, &[tool(k)], hand());
        }
        let mut state = solver.follower().room();
        solver.capture(&shape, &mut state);
        state.prolongate_all();
        solver.prolongate_all(&mut shape);
        let apart = state.displacement.iter().zip(&shape.displacement);
        let most = apart.map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        assert!(most < 1e-12, "{most} m");
    }

    /// Nodes of the elements that a deferred force refines at once: three elements along each axis.
    const BLOCK: usize = 7 * 7 * 7;

    #[test]
    fn settled_solver_does_not_refine_for_small_distant_forces() {
        let (topology, mut solver, mut shape) = resumed();
        let mut steps = 0;
        while solver.is_settling() {
            solver.step(&topology, &mut shape, &[tool(40)], hand());
            steps += 1;
            assert!(steps <= SETTLING[1], "{steps} steps");
        }
        let counts = |solver: &Solver| {
            let far = solver.fine.unbalanced_outer().count();
            (far, solver.fine.nodes.items.len())
        };
        let (far, near) = counts(&solver);
        assert!(far <= near, "{far} far nodes, {near} near ones");
        let turns = |solver: &Solver| (solver.quick_steps / REFINED_EVERY) as usize;
        let settled = turns(&solver);
        for k in 40..60 {
            solver.step(&topology, &mut shape, &[tool(k)], hand());
            let (far, near) = counts(&solver);
            // A block that was refined leaves the known forces of its nodes.
            let refined = BLOCK * (turns(&solver) - settled);
            assert!(far <= near + refined, "{far} far nodes, {near} near ones");
        }
    }
}
