//! One step of the equilibrium: its stages and its bookkeeping.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::active_set::Criteria;
use super::budget::{Budget, StepReport, relative};
use super::coarse_level::prolongate_changes;
use super::coarse_stiffening::PRESCRIBED_STIFFNESS;
use super::conjugate::ConjugateDirections;
use super::contact_smoother::ContactSmoother;
use super::cut_preparer::all_own_stiffness;
use super::cycle::{Chebyshev, Multigrid};
use super::fine_level::{FineLevel, SetChange};
use super::hierarchy::Hierarchy;
use super::mechanism::{Disabled, Mechanism};
use super::quad::reserve;
use super::reference_state::ReferenceState;
use super::smoothing::EigenvalueBound;
use super::work_limit::WorkLimit;
use crate::contact::{Contacts, Tool};
use crate::{Shape, Topology, Vec3};

/// Full solves: force on a corner of a deferred element, in thresholds, above which it is refined.
const PENDING: f32 = 4.0;
/// Quick steps: relative change of size up to which an element stays deferred, with the coarse stiffness at rest (of
/// springs alone, and of tissue that bottoms out). `KEEP_STRAINED` is the change that keeps a brick in the active set, as
/// far as the work limit has room.
const STRAINED: [f32; 2] = [0.12, 0.1];
const KEEP_STRAINED: [f32; 2] = [0.3, 0.2];
/// Smoothing steps around the contacts at the end of a quick step.
const LAST_STEPS: usize = 3;
/// Bounds of the step length along a coarse correction. Tissue that bottoms out may accept none of it: with a lower bound
/// of 0.01 full solves of deep jumps diverge.
const SHARES: [f64; 2] = [0.0, 2.0];
/// Longest coarse correction of a point, in spacings. Without it a flap on one edge of a wound, which is nearly a mechanism, makes
/// the line search shorten the correction of all tissue to nothing.
const CORRECTION_MAX: f32 = 1.0;
/// Initial threshold of a single node, relative to the allowed residual. Once the active set has converged, the
/// threshold is lowered until all unbalanced nodes together can not exceed the allowed residual.
pub(super) const INITIAL_THRESHOLD: f64 = 0.25;
/// Lower bound of the reference residual, in spacings times the stiffness of a node; of full and of quick steps. It
/// keeps the relative residual defined after a release. No eye sees smaller forces; no hand feels a fifth of them.
const LEAST: [f64; 2] = [0.1, 0.02];
/// Quick steps: part of the reference residual that a step keeps when the forces fall. Relative to the current force,
/// residuals of a deep press exceed the threshold everywhere: a withdrawal refined up to half of a thigh.
const FADE: f64 = 0.9;
/// Tolerance below which the threshold is lowered that far. Above it, one reduction is enough: a thousand distant nodes
/// with a thousandth of the residual each do not change the force on a tool.
const PROVEN: f64 = 1e-3;
/// Tolerance from which a step is quick: the threshold is not lowered.
pub(super) const QUICK: f64 = 0.02;
/// Factor by which the threshold is lowered.
const DEEPEN: f64 = 0.25;
/// Iterations at first touch, where no warm start exists; a time limit may leave one.
const DUE: usize = 3;
/// Full solves: move of a contact node in spacings after which contacts are searched again. With the contacts of its
/// start, one in seventeen solves of a sphere put into a wound did not converge.
const SEARCH_AGAIN: f64 = 0.5;
/// Displacement in m that a step of low accuracy need not prolongate to distant nodes: the resolution of displacements
/// on the network.
const UNSEEN_M: f64 = 10e-6;

/// The solver of one shape of one topology, with its scratch memory.
pub(crate) struct Solver {
    pub(super) hierarchy: Hierarchy,
    pub(super) fine: FineLevel,
    pub(super) coarse: Multigrid,
    pub(super) contacts: Contacts,
    pub(super) contact_smoother: ContactSmoother,
    pub(super) held: Vec<u32>,
    pub(super) work_limit: WorkLimit,
    pub(super) reference: f64,
    /// Equilibrium without tools, if it differs from the rest shape.
    pub(super) reference_state: Option<Arc<ReferenceState>>,
    /// Whether the shape is known to have started from the reference state.
    pub(super) has_started: bool,
    /// Force in N that moves a typical node by a spacing; see [`LEAST`].
    pub(super) least: f64,
    pub(crate) report: StepReport,
    pub(super) dirty: bool,
    /// Previous positions of the nodes that were held or moved since the last step.
    pub(super) prescribed_from: BTreeMap<u32, Vec3>,
    /// Their displacements, until the coarse levels have followed.
    pub(super) prescribed_displacements: Vec<(u32, Vec3)>,
    pub(super) last_forces: Vec<Vec3>,
    /// Quick steps since the topology changed or since a full solve; `None` once settled.
    pub(super) settling: Option<usize>,
    /// Mechanisms that an ablation has switched off.
    pub(super) disabled: Disabled,
    /// Conjugate directions of a full solve.
    pub(super) conjugate: ConjugateDirections,
}

/// Relative residual at which a step ends. Quick steps leave forces below their threshold at single nodes, but not over all
/// nodes together: light contacts of soft tissue would stay 15 % off.
fn accepted_residual(tolerance: f64, quick: bool) -> f64 {
    if quick {
        INITIAL_THRESHOLD * tolerance
    } else {
        tolerance
    }
}

impl Solver {
    /// Creates a solver for shapes of this topology. With gravity it first solves the reference state, at the cost of a
    /// full solve; an undeformed shape starts there.
    pub(crate) fn new(topology: &Topology) -> Self {
        let hierarchy = Hierarchy::new(topology);
        let own = all_own_stiffness(topology);
        let reference_state = ReferenceState::of(topology, &hierarchy, own.clone(), None);
        let fine = FineLevel::new(topology, &hierarchy, own);
        Self::with(topology, hierarchy, fine, reference_state)
    }

    /// Creates another solver of the same topology.
    #[must_use]
    pub(crate) fn another(&self, topology: &Topology) -> Self {
        let hierarchy = self.hierarchy.clone();
        let fine = FineLevel::new(topology, &hierarchy, self.fine.own.clone());
        Self::with(topology, hierarchy, fine, self.reference_state.clone())
    }

    pub(super) fn with(
        topology: &Topology,
        mut hierarchy: Hierarchy,
        mut fine: FineLevel,
        reference_state: Option<Arc<ReferenceState>>,
    ) -> Self {
        hierarchy.reserve();
        reserve(&mut fine.own);
        reserve(&mut fine.fixed);
        let mut own: Vec<f64> = fine.own.iter().copied().filter(|&k| k > 0.0).collect();
        let middle = own.len() / 2;
        let typical = match own.get(middle) {
            Some(_) => *own.select_nth_unstable_by(middle, f64::total_cmp).1,
            None => 0.0,
        };
        Self {
            least: typical * topology.model().spacing_m,
            contact_smoother: ContactSmoother::new(&hierarchy),
            coarse: Multigrid::new(&hierarchy),
            fine,
            hierarchy,
            contacts: Contacts::new(topology),
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
            disabled: Disabled::default(),
            conjugate: ConjugateDirections::default(),
        }
    }

    /// Prolongates the accumulated displacements of the coarse levels to every node. Steps with [`Budget::near`] skip
    /// the nodes far from the tools.
    pub(crate) fn prolongate_all(&mut self, shape: &mut Shape) {
        self.prolongate_changes(shape, 0.0);
    }

    /// Prolongates displacements of more than `least` m.
    fn prolongate_changes(&mut self, shape: &mut Shape, least: f64) {
        for l in (0..self.coarse.grids.len()).rev() {
            prolongate_changes(&self.hierarchy, &mut self.coarse.grids, l, least);
        }
        self.fine.prolongate(
            &self.hierarchy,
            &mut self.coarse,
            &mut shape.displacement,
            least,
        );
    }

    /// Marks these nodes as changed from outside the solver.
    pub(crate) fn disturb(&mut self, shape: &Shape, nodes: impl IntoIterator<Item = u32>) {
        for node in nodes {
            let Some(u) = shape.displacement.get(node as usize) else {
                continue;
            };
            self.fine.displaced = self.fine.displaced.max(u.norm());
            self.fine.at_reference = false;
            self.coarse.grids[0].starts_at_reference = false;
            self.fine.disturb(&self.hierarchy, node);
        }
        self.dirty = true;
    }

    pub(crate) fn force_on(&self, shape: &Shape, node: u32) -> Vec3 {
        self.fine
            .force_on(&self.hierarchy, &shape.displacement, node)
    }

    pub(crate) fn residual_over_all(&mut self, shape: &Shape) -> f64 {
        let u = &shape.displacement;
        let sum = self
            .fine
            .square_over_all(&self.hierarchy, u, &self.contacts);
        relative(sum, self.reference)
    }

    pub(crate) fn move_free(&mut self, topology: &Topology, shape: &Shape, tool: &Tool) -> bool {
        let (u, displaced) = (&shape.displacement, self.fine.displaced);
        self.contacts.move_free(topology, u, displaced, tool)
    }

    pub(crate) fn step(
        &mut self,
        topology: &Topology,
        shape: &mut Shape,
        tools: &[Tool],
        mut budget: Budget<'_>,
    ) -> &StepReport {
        self.start_at_reference_state(shape);
        let changed = self.contacts.begin(tools) || self.dirty;
        let changed = self.restore_reference_state(topology, shape) || changed;
        self.report.ignored_tools = self.contacts.ignored;
        self.report.iterations = 0;
        self.report.steady = true;
        self.report.visits = [0; 2];
        self.report.rolled_back = false;
        // A proxy that waited may move on when the tissue has yielded.
        let may_move = self.contacts.is_solved && self.report.lag_m > 0.0;
        let is_settled =
            !self.contacts.are_proxies_following() && !self.contacts.is_apart && !may_move;
        if budget.near {
            // A tighter tolerance would exceed the time limit within one iteration.
            budget.tolerance = budget.tolerance.max(QUICK);
        }
        let quick = budget.near || budget.tolerance >= QUICK && self.held.is_empty();
        if !changed
            && is_settled
            && self.report.residual <= accepted_residual(budget.tolerance, quick)
        {
            self.settle(budget.tolerance);
            return &self.report;
        }
        self.dirty = false;
        self.fine.clamped = 0;
        self.fine.visits = 0;
        self.coarse.visits = 0;
        let u = &mut shape.displacement;
        let by = |(&node, from): (&u32, &Vec3)| (node, u[node as usize] - from);
        self.prescribed_displacements = self.prescribed_from.iter().map(by).collect();
        self.prescribed_from.clear();
        let multipliers = self.contacts.multipliers();
        let lags = self.apply_warm_start(topology, u);
        self.iterate(topology, u, lags, quick, &mut budget);
        if !self.is_sane(topology, &shape.displacement) {
            self.fine.undo(&self.hierarchy, &mut shape.displacement);
            let own = std::mem::take(&mut self.fine.own);
            self.restart(topology, own);
            self.contacts.restore(multipliers);
            self.report.rolled_back = true;
        } else if !budget.near {
            self.prolongate_changes(shape, if quick { UNSEEN_M } else { 0.0 });
            if !quick {
                // The next quick step must not process the small residuals that a full solve leaves everywhere.
                self.settling = Some(0);
            }
        }
        self.report_reactions(topology, &shape.displacement);
        &self.report
    }

    fn iterate(
        &mut self,
        topology: &Topology,
        u: &mut [Vec3],
        mut lags: bool,
        quick: bool,
        budget: &mut Budget<'_>,
    ) {
        if quick {
            self.prepare_quick();
        } else {
            self.prepare_full();
        }
        self.coarse.follows = self.contacts.proxies.is_empty();
        self.fine.limit_moves(&self.hierarchy, quick);
        let mut share = INITIAL_THRESHOLD;
        // The contact stiffness on the coarse levels belongs to earlier contacts.
        let mut outdated = true;
        let touched = self.report.reactions.iter().any(|r| r.contacts > 0);
        let touches = quick && !touched && !self.contacts.nodes.is_empty();
        let due = if touches && self.uses(Mechanism::FirstTouch) {
            DUE
        } else {
            1
        };
        let mut smoothing = None;
        let mut bound = EigenvalueBound::BLOCKS;
        let fades = quick && self.uses(Mechanism::FadingReference);
        let recent = if fades { FADE * self.reference } else { 0.0 };
        loop {
            if !quick {
                let spacing = topology.model().spacing_m;
                self.contacts.augment(u, &self.fine.fixed, spacing);
            }
            self.fine.refresh(&self.hierarchy, u);
            let allowed = self.allowed_residual(u, budget.tolerance, quick, recent);
            let last = if budget.tolerance < PROVEN {
                0.5 / (self.fine.unbalanced_count() as f64 + 1.0).sqrt()
            } else if budget.tolerance < QUICK {
                INITIAL_THRESHOLD * DEEPEN
            } else {
                INITIAL_THRESHOLD
            };
            share = share.max(last);
            let sum = self.choose_active_set(u, share * allowed, quick);
            self.report.residual = relative(sum, self.reference);
            let whole = self
                .coarse
                .grids
                .iter()
                .all(|p| p.to_refine.items.is_empty());
            let is_apart = quick && self.contacts.is_apart;
            let follows = lags && self.contacts.are_proxies_following();
            let is_accepted = self.report.residual <= accepted_residual(budget.tolerance, quick);
            let converged = is_accepted && !follows && !is_apart;
            let done = converged && share <= last && (whole || budget.tolerance >= PROVEN);
            // A quick step has asked before its proxies moved: what has yet to yield would be felt as a force.
            let asks = !quick || self.report.iterations == 0;
            if done || asks && self.is_over(budget, due) {
                break;
            }
            // All active residuals are near the threshold: only a lower threshold reduces them further.
            let nodes = self.fine.nodes.items.len() as f64;
            let flat = sum.sqrt() <= 1.5 * share * allowed * nodes.sqrt();
            if (converged || (flat && !quick)) && share > last {
                share = (share * DEEPEN).max(last);
            }
            self.report.iterations += 1;
            self.contacts.is_solved = true;
            self.remember_forces(u);
            if !quick || outdated {
                self.stiffen_levels(u);
                outdated = false;
            }
            if !quick {
                self.conjugate(u);
            }
            self.correct(u, share * allowed, quick);
            smoothing = Some(self.smooth(u, (!quick).then_some(&mut bound)));
            // The next quick step chooses the active set of a further iteration.
            let repeats = self.uses(Mechanism::SteadyForce);
            self.report.steady = quick && (!repeats || self.are_forces_steady(u));
            let moves_on = lags && self.contacts.are_proxies_following();
            if quick && (self.report.steady && !moves_on || self.is_over(budget, due)) {
                break;
            }
            let limit = SEARCH_AGAIN * topology.model().spacing_m;
            if lags || !quick && self.contacts.have_moved(u, limit) {
                lags = self.gather(topology, u);
                outdated = true;
            }
        }
        self.conjugate = ConjugateDirections::default();
        if quick {
            if self.report.iterations > 0 {
                self.finish(u);
            }
            let elements = self.coarse.grids.iter().map(|p| p.set.items.len());
            let nodes = self.fine.nodes.items.len();
            self.work_limit.update(nodes, elements.sum());
            self.settle(budget.tolerance);
        }
        if !self.held.is_empty() {
            // One more step with the forces of the residual check costs almost nothing.
            let alone = !quick
                && self.contacts.proxies.is_empty()
                && self.fine.since != SetChange::Replaced;
            if let Some(mut smoothing) = smoothing.filter(|_| alone) {
                self.fine.relax_set(u, &mut smoothing);
            }
        }
    }

    /// Whether the iteration ends: at the limit of the budget, or after `due` iterations if those are more, or in time. At least
    /// one iteration checks the warm start.
    fn is_over(&self, budget: &mut Budget<'_>, due: usize) -> bool {
        let done = self.report.iterations;
        let is_due = due > 1 && done < due;
        done >= budget.iterations && !is_due || done > 0 && budget.is_over()
    }

    /// Stage: a last smoothing around the contacts, then the residual.
    fn finish(&mut self, u: &mut [Vec3]) {
        let (hierarchy, fine, contacts) = (&self.hierarchy, &mut self.fine, &self.contacts);
        if !contacts.nodes.is_empty() && self.disabled.allows(Mechanism::ContactSmoothing) {
            fine.smooth_contacts(
                hierarchy,
                &mut self.contact_smoother,
                u,
                contacts,
                LAST_STEPS,
            );
        }
        fine.evaluate_bricks(hierarchy, u);
        fine.add_contacts(u, contacts, 1.0);
        let sum = fine.square_over_unfixed();
        // The next step starts from the forces of bricks alone.
        fine.remove_contacts(hierarchy, &contacts.nodes);
        fine.current = true;
        self.report.residual = relative(sum, self.reference);
    }

    /// Stage: chooses the active set and computes its forces. Returns their sum of squares.
    fn choose_active_set(&mut self, u: &mut [Vec3], threshold: f64, quick: bool) -> f64 {
        let (hierarchy, coarse) = (&self.hierarchy, &mut self.coarse);
        let touched = self.contacts.nodes.iter().chain(&self.held).copied();
        let limit = threshold as f32;
        let fine = &mut self.fine;
        // Nodes that leave the set keep their forces, which must match their final positions.
        fine.evaluate_bricks(hierarchy, u);
        if quick && self.report.iterations == 0 && self.disabled.allows(Mechanism::SecantStiffness)
        {
            let reference = self.reference_state.as_deref();
            fine.update_secants(hierarchy, &mut coarse.grids[0], reference);
        }
        fine.add_contacts(u, &self.contacts, 1.0);
        let criteria = Criteria {
            threshold: limit,
            quick,
            keeps_all: quick && self.report.iterations > 0,
            fitting: self.work_limit.fitting(),
        };
        if fine.select(hierarchy, coarse, touched, &criteria, u) {
            coarse.select(hierarchy, false);
            // Displacements that were prolongated may exceed the limits of the next level too.
            while coarse.prolongate_pending(hierarchy, limit) {
                FineLevel::refine_marked(&mut coarse.grids[0]);
                coarse.select(hierarchy, true);
            }
            fine.enter(hierarchy, coarse, u);
            fine.add_contacts(u, &self.contacts, 1.0);
            self.conjugate = ConjugateDirections::default();
        }
        self.fine.square_over_unfixed()
    }

    /// Sets the limits of a quick step: how much elements may defer.
    fn prepare_quick(&mut self) {
        if self.work_limit.leaves_room() && self.uses(Mechanism::Rotation) {
            self.coarse.refine_next(&self.hierarchy);
        }
        if !self.uses(Mechanism::WorkLimit) {
            self.work_limit = WorkLimit::NONE;
        }
        let deep = usize::from(self.hierarchy.bottoms_out);
        let limit = |mechanism, limit: [f32; 2]| {
            if self.uses(mechanism) {
                limit[deep]
            } else {
                f32::INFINITY
            }
        };
        let strained = self.work_limit.factor() * limit(Mechanism::StrainLimit, STRAINED);
        let keep_strained = limit(Mechanism::StrainedStay, KEEP_STRAINED);
        (self.coarse.pending, self.coarse.strained) = (f32::INFINITY, strained);
        self.coarse.is_effective = self.uses(Mechanism::EffectiveStiffness);
        self.fine.keep_strained = keep_strained;
    }

    /// Sets the limits of a full solve.
    fn prepare_full(&mut self) {
        self.work_limit = WorkLimit::NONE;
        self.coarse.pending = PENDING;
        self.coarse.strained = f32::INFINITY;
        self.coarse.is_effective = false;
        self.fine.keep_strained = f32::INFINITY;
    }

    /// Stage: moves proxies and gathers contact samples.
    pub(super) fn gather(&mut self, topology: &Topology, u: &mut [Vec3]) -> bool {
        let (fine, contacts) = (&mut self.fine, &mut self.contacts);
        fine.remove_contacts(&self.hierarchy, &contacts.nodes);
        let lags = contacts.gather(topology, u, fine.displaced, &fine.own, &fine.fixed);
        fine.prolongate_at(&self.hierarchy, &self.coarse, u, &contacts.nodes);
        lags
    }

    /// Stage: the residual in N that the tolerance allows, relative to the forces of tools and held nodes, or to `recent` N.
    fn allowed_residual(&mut self, u: &[Vec3], tolerance: f64, near: bool, recent: f64) -> f64 {
        let square = |n: u32| {
            let r = &self.fine.r[n as usize];
            r.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>()
        };
        let mut sum: f64 = self.held.iter().map(|&n| square(n)).sum();
        sum += self.contacts.square(u);
        if self.held.is_empty() && self.contacts.proxies.is_empty() {
            sum += self.fine.square_of_weights();
        }
        let reference = recent.max(sum.sqrt());
        if reference > 0.0 {
            self.reference = reference;
        }
        if tolerance >= PROVEN && self.uses(Mechanism::LeastReference) {
            let least = LEAST[usize::from(near)] * self.least;
            self.reference = self.reference.max(least);
        }
        tolerance * self.reference
    }

    /// Stage: coarse-grid correction with a line search.
    fn correct(&mut self, u: &mut [Vec3], threshold: f64, quick: bool) {
        let smooths_before = !quick || self.uses(Mechanism::PreSmoothing);
        let follows_prescribed_nodes = self.follows_prescribed_nodes();
        let prescribed_displacements = std::mem::take(&mut self.prescribed_displacements);
        if follows_prescribed_nodes {
            self.fine.restrict_outer(&self.hierarchy, &mut self.coarse);
            // A single displaced node is a spike that no coarse level represents, so a load moves the levels after the
            // node.
            for (node, by) in prescribed_displacements {
                let force = by * (PRESCRIBED_STIFFNESS[1] * self.fine.own[node as usize]);
                self.coarse.load_node(&self.hierarchy, node, &force);
            }
        } else {
            self.fine.restrict(&self.hierarchy, &mut self.coarse);
        }
        let (hierarchy, coarse, fine) = (&self.hierarchy, &mut self.coarse, &mut self.fine);
        coarse.cycle(hierarchy, smooths_before);
        fine.add_contacts(u, &self.contacts, -1.0);
        coarse.limit_corrections(hierarchy, CORRECTION_MAX / hierarchy.per_spacing);
        fine.correct(hierarchy, coarse, u);
        fine.evaluate_bricks(hierarchy, u);
        coarse.defer(hierarchy);
        // Held nodes: deferred work would shorten the step too much. A cube from rest then needs five iterations to 1 %
        // instead of four.
        let waiting = if self.contacts.proxies.is_empty() {
            [0.0; 2]
        } else {
            self.deferred_work()
        };
        let (moved, old) = (&self.fine.moved, &self.fine.old);
        let share = self.line_search(u, moved, old, waiting, SHARES);
        let (hierarchy, coarse, fine) = (&self.hierarchy, &mut self.coarse, &mut self.fine);
        coarse.commit(hierarchy, share as f32, threshold as f32);
        fine.settle(hierarchy, coarse, u, share);
        fine.add_contacts(u, &self.contacts, 1.0);
    }

    /// Stage: smoothing on the nodes. All steps are made: they form one Chebyshev polynomial, and a part of it can
    /// amplify the residual. Adapts the bound, if there is one.
    fn smooth(&mut self, u: &mut [Vec3], bound: Option<&mut EigenvalueBound>) -> Chebyshev {
        // The blocks must belong to the corrected displacements: older blocks overshoot where pressed tissue snaps
        // through.
        let (hierarchy, contacts) = (&self.hierarchy, &self.contacts);
        self.fine.update_blocks(hierarchy, u, contacts);
        let range = bound.as_deref().copied();
        let range = range.unwrap_or(EigenvalueBound::BLOCKS);
        let mut factors = self.hierarchy.smoothing.factors(range);
        let mut residuals = [0.0; 2];
        for s in 0..self.hierarchy.smoothing.steps {
            if s > 0 {
                self.fine.evaluate_bricks(&self.hierarchy, u);
                self.fine.add_contacts_and_blocks(u, &self.contacts);
                if bound.is_some() {
                    residuals[usize::from(s > 1)] = self.fine.square_over_unfixed();
                }
            }
            self.fine.relax_set(u, &mut factors);
        }
        if let Some(bound) = bound {
            bound.follow(residuals);
        }
        factors
    }
}
