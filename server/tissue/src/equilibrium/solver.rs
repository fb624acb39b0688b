//! One step of the equilibrium: its stages and its bookkeeping.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::active_set::{Criteria, Keeps};
use super::budget::{Budget, StepReport};
use super::coarse_level::hand_down;
use super::coarse_stiffening::HELD_STIFFNESS;
use super::contact_smoother::ContactSmoother;
use super::cycle::{Chebyshev, Effort, Multigrid};
use super::fine_level::{FineLevel, Since, own_stiffness};
use super::hierarchy::Hierarchy;
use super::reference_state::ReferenceState;
use super::warm_start::WarmStart;
use super::work_limit::WorkLimit;
use crate::contact::{Contacts, Tool};
use crate::{Shape, Topology, Vec3};

/// Chebyshev steps on the nodes after each coarse correction.
const SMOOTHING: usize = 3;
/// V-cycle parameters of a full solve and of a quick step, which converges faster with many cheap cycles.
const EFFORT: [Effort; 2] = [
    Effort {
        before: 3,
        after: 3,
        coarsest: 10,
        loaded: 1.0,
    },
    Effort {
        before: 1,
        after: 1,
        coarsest: 10,
        loaded: 8.0,
    },
];
/// Force on a corner of an element, in thresholds, from which its pending displacement has it refined; of a full solve
/// and of a quick step.
const PENDING: [f32; 2] = [4.0, 10.0];
/// Quick steps: relative change of size up to which an element stays deferred, with the coarse stiffness at rest (of
/// springs alone, and of tissue that bottoms out). `BENT` is the change that keeps a brick in the active set.
const STRAINED: [f32; 2] = [0.12, 0.1];
const BENT: [f32; 2] = [0.3, 0.2];
/// Stiffness of deferred elements in quick steps, relative to their matrix: of inhomogeneous or distorted elements, and
/// of homogeneous ones. A trilinear element is stiffer than its contents. With 1.0 the force on a slab is 1 to 4 % too
/// high during a press and the force on a real thigh 8 %; with 0.7 everywhere the force on a slab is 3 % too low.
const SLACK: [f32; 2] = [0.6, 0.87];
/// Smoothing steps around the contacts at the end of a quick step.
const LAST_STEPS: usize = 3;
/// Bounds of the step length along a coarse correction. Tissue that bottoms out is tens of times stiffer than its
/// coarse operator.
const SHARES: [f64; 2] = [0.01, 2.0];
/// Initial threshold of a single node, relative to the allowed residual. Once the active set has converged, the
/// threshold is lowered until all unbalanced nodes together can not exceed the allowed residual.
pub(super) const FIRST_SHARE: f64 = 0.25;
/// Lower bound of the reference residual, in spacings times the stiffness of a node; of full and of quick steps. It
/// keeps the relative residual defined after a release. No eye sees smaller forces; no hand feels a fifth of them.
const LEAST: [f64; 2] = [0.1, 0.02];
/// Tolerance below which the threshold is lowered that far. Above it, one reduction is enough: a thousand distant nodes
/// with a thousandth of the residual each do not change the force on a tool.
const PROVEN: f64 = 1e-3;
/// Tolerance from which a step is quick: the threshold is not lowered.
pub(super) const QUICK: f64 = 0.02;
/// Factor by which the threshold is lowered.
const DEEPEN: f64 = 0.25;
/// Minimum iterations after a jump or at first touch, where no warm start exists.
const DUE: usize = 3;
/// Relative change of a tool's force in the last iteration above which a quick step iterates again; see DECISIONS.md.
const STEADY: f64 = 5e-3;
/// Every N-th quick step refines an element with a large deferred force. Without this, forces depend on the path: on
/// the thigh they were 5 % off (rms) beside the dent of a released tool. With 4, 8 and 16 the error is 1.5, 1.9 and 3.2
/// %, at 1.5, 1.2 and 1.1 times the work.
const REFINED_EVERY: u32 = 2;
/// Displacement in spacings of the lattice above which an iterate counts as diverged.
const BLOWN_UP: f64 = 1e4;

/// Displacement in m that a step of low accuracy need not prolongate to distant nodes: the resolution of displacements
/// on the network.
const UNSEEN_M: f64 = 10e-6;

/// The solver of one shape of one topology, with its scratch memory.
pub struct Solver {
    pub(super) structure: Arc<Hierarchy>,
    pub(super) field: FineLevel,
    pub(super) coarse: Multigrid,
    pub(super) contacts: Contacts,
    pub(super) near: ContactSmoother,
    pub(super) held: Vec<u32>,
    pub(super) foresight: WarmStart,
    pub(super) relief: WorkLimit,
    pub(super) moved: Vec<Vec3>,
    pub(super) reference: f64,
    /// Equilibrium without tools, if it differs from the rest shape.
    pub(super) home: Option<Arc<ReferenceState>>,
    /// Whether the shape is known to have started from the reference state.
    pub(super) moved_in: bool,
    /// Force in N that moves a typical node by a spacing; see [`LEAST`].
    pub(super) least: f64,
    pub(super) report: StepReport,
    pub(super) dirty: bool,
    /// Whether this step started from a complete warm start.
    pub(super) carried: bool,
    /// Previous positions of the nodes that were held or moved since the last step.
    pub(super) led: BTreeMap<u32, Vec3>,
    /// Their displacements, until the coarse levels have followed.
    pub(super) drawn: Vec<(u32, Vec3)>,
    pub(super) last_forces: Vec<Vec3>,
    /// Quick steps since the topology changed or since a full solve; `None` once settled.
    pub(super) settling: Option<usize>,
    /// Quick steps since the tissue was at rest.
    pub(super) quick_steps: u32,
}

impl Solver {
    /// Creates a solver for shapes of this topology. With gravity it first solves the reference state, at the cost of a
    /// full solve; an undeformed shape starts there.
    pub fn new(topology: &Topology) -> Self {
        let structure = Arc::new(Hierarchy::new(topology));
        let all = 0..topology.node_count() as u32;
        let own: Vec<f64> = all.map(|n| own_stiffness(topology, n)).collect();
        let home = ReferenceState::of(topology, &structure, &own, None);
        let field = FineLevel::new(topology, &structure, own);
        Self::with(topology, structure, field, home)
    }

    /// Creates another solver of the same topology. Immutable data are shared.
    #[must_use]
    pub fn another(&self, topology: &Topology) -> Self {
        let structure = Arc::clone(&self.structure);
        let field = FineLevel::new(topology, &structure, self.field.own.clone());
        Self::with(topology, structure, field, self.home.clone())
    }

    pub(super) fn with(
        topology: &Topology,
        structure: Arc<Hierarchy>,
        field: FineLevel,
        home: Option<Arc<ReferenceState>>,
    ) -> Self {
        let coarse = Multigrid::new(&structure);
        let contacts = Contacts::new(topology);
        Self::assemble(topology, structure, (field, coarse), contacts, home)
    }

    /// Prolongates the accumulated displacements of the coarse levels to every node. Steps with [`Budget::near`] skip
    /// the nodes far from the tools.
    pub fn pour(&mut self, shape: &mut Shape) {
        self.hand_down(shape, 0.0);
    }

    /// Prolongates displacements of more than `least` m.
    fn hand_down(&mut self, shape: &mut Shape, least: f64) {
        for l in (0..self.coarse.patches.len()).rev() {
            hand_down(&self.structure, &mut self.coarse.patches, l, least);
        }
        self.field.pour(
            &self.structure,
            &mut self.coarse,
            &mut shape.displacement,
            least,
        );
    }

    /// Marks these nodes as changed from outside the solver.
    pub fn disturb(&mut self, shape: &Shape, nodes: &[u32]) {
        for &node in nodes {
            let Some(u) = shape.displacement.get(node as usize) else {
                continue;
            };
            self.field.displaced = self.field.displaced.max(u.norm());
            self.field.at_home = false;
            self.field.disturb(&self.structure, node);
        }
        self.dirty = true;
    }

    /// Force of the springs on a node plus its weight in N (on a held or pinned node: the reaction).
    pub fn force_on(&self, shape: &Shape, node: u32) -> Vec3 {
        self.field
            .force_on(&self.structure, &shape.displacement, node)
    }

    /// The report of the latest step.
    pub fn report(&self) -> &StepReport {
        &self.report
    }

    /// The relative residual over all nodes, active or not. It evaluates the whole model; meant for checks.
    pub fn residual_over_all(&mut self, shape: &Shape) -> f64 {
        let u = &shape.displacement;
        let sum = self
            .field
            .square_over_all(&self.structure, u, &self.contacts);
        relative(sum, self.reference)
    }

    /// Moves a tool of the last step that touches nothing, without a solver step. Returns false, and leaves the tool in
    /// place, if the tool is unknown or touches the tissue at its new position.
    pub fn move_free(&mut self, topology: &Topology, shape: &Shape, tool: &Tool) -> bool {
        let (u, displaced) = (&shape.displacement, self.field.displaced);
        u.len() == topology.node_count() && self.contacts.move_free(topology, u, displaced, tool)
    }

    /// Moves the shape towards equilibrium under the tools.
    pub fn step(
        &mut self,
        topology: &Topology,
        shape: &mut Shape,
        tools: &[Tool],
        mut budget: Budget<'_>,
    ) -> &StepReport {
        if topology.node_count() != self.field.fixed.len() {
            self.follow(topology, &[]);
        }
        shape
            .displacement
            .resize(topology.node_count(), Vec3::zeros());
        self.move_in(shape);
        let changed = self.contacts.begin(tools) || self.dirty;
        let changed = self.go_home(topology, shape) || changed;
        self.report.ignored_tools = self.contacts.ignored;
        self.report.iterations = 0;
        self.report.steady = true;
        self.report.visits = [0; 2];
        self.report.fell_back = false;
        if !changed && self.report.lag_m == 0.0 && self.report.residual <= budget.tolerance {
            self.settle(budget.tolerance);
            return &self.report;
        }
        self.dirty = false;
        let u = &mut shape.displacement;
        let carry = self.foresight.look(&self.held, &self.led, u);
        self.field.clamped = 0;
        self.field.visits = 0;
        self.coarse.visits = 0;
        let near = budget.near;
        if near {
            // A tighter tolerance would exceed the time limit within one iteration.
            budget.tolerance = budget.tolerance.max(QUICK);
        }
        let u = &mut shape.displacement;
        let by = |(&node, from): (&u32, &Vec3)| (node, u[node as usize] - from);
        self.drawn = self.led.iter().map(by).collect();
        self.led.clear();
        let lags = self.foresee(topology, u, carry);
        self.iterate(topology, u, lags, &mut budget);
        if !self.is_sane(topology, &shape.displacement) {
            self.field.undo(&self.structure, &mut shape.displacement);
            let own = std::mem::take(&mut self.field.own);
            self.restart(topology, own);
            self.report.fell_back = true;
        } else if !near {
            let is_quick = budget.tolerance >= QUICK;
            self.hand_down(shape, if is_quick { UNSEEN_M } else { 0.0 });
            if !is_quick {
                // The next quick step must not process the small residuals that a full solve leaves everywhere.
                self.settling = Some(0);
            }
        }
        self.close(topology, &shape.displacement);
        &self.report
    }

    fn iterate(
        &mut self,
        topology: &Topology,
        u: &mut [Vec3],
        mut lags: bool,
        budget: &mut Budget<'_>,
    ) {
        let quick = budget.near || budget.tolerance >= QUICK && self.held.is_empty();
        let relief = if quick {
            self.prepare_quick()
        } else {
            self.prepare_full()
        };
        self.coarse.follows = self.contacts.proxies.is_empty();
        self.field.limit_moves(&self.structure, quick);
        // With a warm start the last active set stays active, so the threshold starts low.
        let mut share = if self.carried { 0.0 } else { FIRST_SHARE };
        let jumped = lags;
        // The contact stiffness on the coarse levels belongs to earlier contacts.
        let mut outdated = true;
        let touched = self.report.reactions.iter().any(|r| r.contacts > 0);
        let touches = quick && !touched && !self.contacts.nodes.is_empty();
        // At least one iteration checks the warm start. After a jump the tissue needs more: after one iteration the
        // force is ten times too high.
        let due = if jumped || touches { DUE } else { 1 };
        let (mut begun, mut smoothing) = (0.0, None);
        loop {
            self.field.refresh(&self.structure, u);
            let allowed = self.bring(u, budget.tolerance, quick);
            let last = if budget.tolerance < PROVEN {
                0.5 / (self.field.stirred() as f64 + 1.0).sqrt()
            } else if budget.tolerance < QUICK {
                FIRST_SHARE * DEEPEN
            } else {
                FIRST_SHARE
            };
            share = share.max(last);
            let sum = self.take_part(u, share * allowed, quick);
            self.report.residual = relative(sum, self.reference);
            let whole = self
                .coarse
                .patches
                .iter()
                .all(|p| p.wanted.items.is_empty());
            let calm = sum.sqrt() <= allowed && !lags;
            let done = calm && share <= last && (whole || budget.tolerance >= PROVEN);
            if self.report.iterations == 0 {
                begun = self.report.residual;
            }
            self.foresight.calm = done;
            if done || self.is_over(budget, due, touches) {
                break;
            }
            // All active residuals are near the threshold: only a lower threshold reduces them further.
            let nodes = self.field.nodes.items.len() as f64;
            let flat = sum.sqrt() <= 1.5 * share * allowed * nodes.sqrt();
            if (calm || (flat && !quick)) && share > last {
                share = (share * DEEPEN).max(last);
            }
            self.report.iterations += 1;
            self.remember_forces(u);
            if !quick || outdated {
                self.stiffen(u, self.report.iterations == 1);
                outdated = false;
            }
            self.correct(u, share * allowed, relief, quick);
            smoothing = Some(self.smooth(u));
            if lags {
                lags = self.gather(topology, u);
                outdated = true;
            }
            // The next quick step chooses the active set of a further iteration.
            self.report.steady = quick && self.are_forces_steady(u);
            let steady = self.report.steady && self.report.iterations >= due;
            if quick && (steady || self.is_over(budget, due, touches)) {
                break;
            }
        }
        if quick {
            if self.report.iterations > 0 {
                self.finish(u);
            }
            self.settle(budget.tolerance);
        }
        if !self.held.is_empty() {
            // One more step with the forces of the residual check costs almost nothing. It halves the error of the
            // extrapolated path.
            let alone =
                !quick && self.contacts.proxies.is_empty() && self.field.since != Since::Chosen;
            if let Some(mut smoothing) = smoothing.filter(|_| alone) {
                self.field.relax_set(u, &mut smoothing);
            }
            self.look_back(begun);
        }
    }

    /// Whether the iteration ends. `due` iterations are always made; at first touch even beyond the budget.
    fn is_over(&self, budget: &mut Budget<'_>, due: usize, touches: bool) -> bool {
        let done = self.report.iterations;
        let more = done < due;
        done >= budget.iterations && !(more && touches) || !more && budget.is_over()
    }

    /// Stage: a last smoothing around the contacts, then the residual.
    fn finish(&mut self, u: &mut [Vec3]) {
        let (structure, field, contacts) = (&self.structure, &mut self.field, &self.contacts);
        if !contacts.nodes.is_empty() {
            field.smooth_near(structure, &mut self.near, u, contacts, LAST_STEPS);
        }
        field.evaluate_bricks(structure, u);
        field.add_contacts(u, contacts, 1.0);
        let sum = field.square_over_unfixed();
        // The next step starts from the forces of bricks alone.
        field.let_contacts_go(structure, &contacts.nodes);
        field.current = true;
        self.report.residual = relative(sum, self.reference);
    }

    /// Stage: chooses the active set and computes its forces. Returns their sum of squares.
    fn take_part(&mut self, u: &mut [Vec3], threshold: f64, quick: bool) -> f64 {
        let (structure, coarse) = (&self.structure, &mut self.coarse);
        let touched = self.contacts.nodes.iter().chain(&self.held).copied();
        let limit = threshold as f32;
        let keeps = match quick {
            true if self.report.iterations > 0 => Keeps::All,
            false if self.carried => Keeps::Most,
            _ => Keeps::Near,
        };
        let field = &mut self.field;
        // Nodes that leave the set keep their forces, which must match their final positions.
        field.evaluate_bricks(structure, u);
        field.add_contacts(u, &self.contacts, 1.0);
        let asked = Criteria {
            threshold: limit,
            quick,
            keeps,
        };
        if field.select(structure, coarse, touched, &asked, u) {
            coarse.select(structure, keeps == Keeps::Most);
            // Displacements that were prolongated may exceed the limits of the next level too.
            while coarse.push(structure, limit) {
                FineLevel::select_wanted(&mut coarse.patches[0]);
                coarse.select(structure, true);
            }
            field.enter(structure, coarse, u);
            field.add_contacts(u, &self.contacts, 1.0);
        }
        self.field.square_over_unfixed()
    }

    /// Sets the limits of a quick step: how much elements may defer. Returns the factor of these limits that bounds the
    /// work.
    fn prepare_quick(&mut self) -> f32 {
        let is_at_rest = self.field.at_home;
        self.quick_steps = if is_at_rest { 0 } else { self.quick_steps + 1 };
        if self.quick_steps % REFINED_EVERY == REFINED_EVERY - 1 {
            self.coarse.refine_next(&self.structure);
        }
        let elements = self.coarse.patches.iter().map(|p| p.set.items.len());
        let relief = self
            .relief
            .after(self.field.nodes.items.len(), elements.sum());
        let deep = usize::from(self.structure.bottoms_out);
        self.coarse.pending = relief * PENDING[1];
        self.coarse.strained = relief * STRAINED[deep];
        self.coarse.slack = SLACK;
        self.field.bent = relief * BENT[deep];
        relief
    }

    /// Sets the limits of a full solve.
    fn prepare_full(&mut self) -> f32 {
        self.relief = WorkLimit::NONE;
        self.coarse.pending = PENDING[0];
        self.coarse.strained = f32::INFINITY;
        self.coarse.slack = [1.0; 2];
        self.field.bent = f32::INFINITY;
        1.0
    }

    /// Stage: moves proxies and gathers contact samples.
    pub(super) fn gather(&mut self, topology: &Topology, u: &mut [Vec3]) -> bool {
        let (field, contacts) = (&mut self.field, &mut self.contacts);
        field.let_contacts_go(&self.structure, &contacts.nodes);
        let lags = contacts.gather(topology, u, field.displaced, &field.own);
        field.pour_at(&self.structure, &self.coarse, u, &contacts.nodes);
        lags
    }

    /// Stage: the residual in N that the tolerance allows, relative to the forces of tools and held nodes.
    fn bring(&mut self, u: &[Vec3], tolerance: f64, near: bool) -> f64 {
        let square = |n: u32| {
            let r = &self.field.r[n as usize];
            r.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>()
        };
        let mut sum: f64 = self.held.iter().map(|&n| square(n)).sum();
        sum += self.contacts.square(u);
        if self.held.is_empty() && self.contacts.proxies.is_empty() {
            sum += self.field.square_of_weights();
        }
        if sum > 0.0 {
            self.reference = sum.sqrt();
        }
        if tolerance >= PROVEN {
            self.reference = self.reference.max(LEAST[usize::from(near)] * self.least);
        }
        tolerance * self.reference
    }

    /// Stage: coarse-grid correction with a line search.
    fn correct(&mut self, u: &mut [Vec3], threshold: f64, relief: f32, quick: bool) {
        let mut effort = EFFORT[usize::from(quick)];
        effort.loaded *= relief;
        let draws = self.draws();
        let drawn = std::mem::take(&mut self.drawn);
        if draws {
            self.field
                .restrict_beyond(&self.structure, &mut self.coarse);
            // A single displaced node is a spike that no coarse level represents, so a load moves the levels after the
            // node.
            for (node, by) in drawn {
                let force = by * (HELD_STIFFNESS[1] * self.field.own[node as usize]);
                self.coarse.draw(&self.structure, node, &force);
            }
        } else {
            self.field.restrict(&self.structure, &mut self.coarse);
            if self.report.iterations == 1 {
                self.pull(u);
            }
        }
        let (structure, coarse, field) = (&self.structure, &mut self.coarse, &mut self.field);
        coarse.cycle(structure, threshold as f32, effort);
        field.add_contacts(u, &self.contacts, -1.0);
        field.keep_forces();
        field.correct(structure, coarse, u);
        field.evaluate_bricks(structure, u);
        coarse.defer(structure);
        // Held nodes: deferred work would shorten the step too much. A cube from rest then needs five iterations to 1 %
        // instead of four.
        let waiting = if self.contacts.proxies.is_empty() {
            [0.0; 2]
        } else {
            self.work_waiting()
        };
        let old = std::mem::take(&mut self.field.old);
        let mut moved = std::mem::take(&mut self.field.moved);
        let share = self.share_of(u, &mut moved, &old, waiting, SHARES);
        let (structure, coarse, field) = (&self.structure, &mut self.coarse, &mut self.field);
        (field.old, field.moved) = (old, moved);
        coarse.commit(structure, share as f32, threshold as f32);
        field.settle(structure, coarse, u, share);
        field.add_contacts(u, &self.contacts, 1.0);
    }

    /// Stage: smoothing on the nodes. All steps are made: they form one Chebyshev polynomial, and a part of it can
    /// amplify the residual.
    fn smooth(&mut self, u: &mut [Vec3]) -> Chebyshev {
        // The blocks must belong to the corrected displacements: older blocks overshoot where pressed tissue snaps
        // through.
        let (structure, contacts) = (&self.structure, &self.contacts);
        self.field.renew_blocks(structure, u, contacts);
        let mut factors = FineLevel::smoothing();
        for s in 0..SMOOTHING {
            if s > 0 {
                self.field.evaluate_bricks(&self.structure, u);
                self.field.press(u, &self.contacts);
            }
            self.field.relax_set(u, &mut factors);
        }
        factors
    }

    fn remember_forces(&mut self, u: &[Vec3]) {
        self.last_forces.clear();
        for i in 0..self.contacts.proxies.len() {
            let (force, _) = self.contacts.force(u, i);
            self.last_forces.push(force);
        }
    }

    /// Whether the last iteration changed every tool's force by at most [`STEADY`].
    fn are_forces_steady(&self, u: &[Vec3]) -> bool {
        self.last_forces.iter().enumerate().all(|(i, last)| {
            let (force, _) = self.contacts.force(u, i);
            (force - last).norm() <= STEADY * force.norm()
        })
    }

    fn is_sane(&self, topology: &Topology, u: &[Vec3]) -> bool {
        let limit = BLOWN_UP * topology.model().spacing_m;
        let is_finite = self.report.residual.is_finite();
        is_finite && self.field.is_within(u, limit) && self.coarse.is_within(limit)
    }

    /// Last stage: reactions and statistics.
    fn close(&mut self, topology: &Topology, u: &[Vec3]) {
        let spacing = topology.model().spacing_m;
        self.report.reactions.clear();
        self.report.lag_m = 0.0;
        let untouched = self.home.as_ref().map(|h| h.displacement.as_slice());
        for i in 0..self.contacts.proxies.len() {
            let mut reaction = self.contacts.reaction(topology, u, untouched, i);
            self.report.lag_m = self.report.lag_m.max(self.contacts.proxies[i].lag());
            if reaction.contacts > 0 {
                let own = self.field.own[self.contacts.nodes[0] as usize];
                reaction.stiffness = self.contacts.learn(u, i, &reaction, own, spacing);
                if let Some(last) = self.last_forces.get(i) {
                    reaction.force_error = (reaction.force - last).norm();
                }
            }
            self.report.reactions.push(reaction);
        }
        self.report.active_nodes = self.field.nodes.items.len();
        self.report.visits = [self.field.visits, self.coarse.visits];
        self.report.clamped = self.field.clamped;
        if self.report.active_nodes == 0 && self.contacts.nodes.is_empty() && self.held.is_empty() {
            self.reference = self.alone();
            self.report.residual = 0.0;
        }
    }
}

pub(super) fn relative(sum: f64, reference: f64) -> f64 {
    if sum == 0.0 {
        0.0
    } else if reference > 0.0 {
        sum.sqrt() / reference
    } else {
        1.0
    }
}
