//! One step of the equilibrium: its stages and its books.

use super::block::outer;
use super::field::Field;
use super::hierarchy::Hierarchy;
use super::jacobi;
use super::law::force_on;
use crate::contact::{Contacts, Reaction, Tool};
use crate::{Shape, Topology, Vec3};

/// Nodes held at once at most; [`Solver::hold`] refuses more. Four thousand nodes are a surface of
/// 25 cm square at 4 mm.
const HELD_MAX: usize = 4096;
/// Stiffness that stands for a held node on the coarse levels, in parts of its own.
const HELD_STIFFNESS: f64 = 20.0;
/// Correction worth less than this many thresholds waits on the coarse level.
const POUR: f64 = 0.1;
/// Sweeps over the active nodes after each coarse correction.
const SWEEPS: usize = 2;
/// Part of the allowed residual that a single node may keep at first. When what is active has
/// become calm the part is lowered, down to where all stirred nodes together can not exceed it.
const FIRST_SHARE: f64 = 0.25;
/// What tools bring in counts at least as this many spacings times the stiffness of a node: after a
/// release there is nothing to be relative to, and no hand or eye can tell less.
const LEAST: f64 = 0.1;
/// Only below this tolerance is it lowered as far as that. Above, one lowering is enough: the force on a tool does not feel a thousand
/// far nodes with a thousandth of it each, and visiting them all costs more than the press.
const PROVEN: f64 = 1e-3;
/// From this tolerance on it is not lowered: what a hand needs in a millisecond.
const QUICK: f64 = 0.025;
/// Factor by which the part is lowered.
const DEEPEN: f64 = 0.25;
/// Force that a kink of the poured correction is taken to leave at a node, in parts of the node's
/// stiffness times the kink. The kinks of the three axes mostly cancel.
const KINK: f32 = 0.5;
/// Displacement in spacings of the whole lattice beyond which an iterate counts as blown up.
const BLOWN_UP: f64 = 1e4;

/// What a step may cost.
pub struct Budget<'a> {
    /// Iterations at most; one iteration is a coarse correction and two sweeps over what is active.
    pub iterations: usize,
    /// Relative residual at which to stop; 1e-6 counts as converged.
    pub tolerance: f64,
    /// Asked between iterations and between the sweeps of one; `true` stops. A shell that owns a clock sets a time limit so.
    pub stop: Option<&'a mut dyn FnMut() -> bool>,
}

impl Budget<'_> {
    /// Up to `iterations` iterations or a relative residual of `tolerance`.
    pub fn new(iterations: usize, tolerance: f64) -> Self {
        Self {
            iterations,
            tolerance,
            stop: None,
        }
    }
}

/// What a step did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepReport {
    /// Norm of the forces left on nodes free to move, over the norm of the forces that tools and
    /// held nodes bring in.
    pub residual: f64,
    /// Iterations made.
    pub iterations: usize,
    /// Forces on nodes computed, and points of coarse levels visited: what the step cost, whatever
    /// the machine.
    pub visits: [usize; 2],
    /// Nodes still active.
    pub active_nodes: usize,
    /// Moves that were cut short: zero in moderate presses.
    pub clamped: usize,
    /// Tools ignored: not finite, no radius, an id twice, or beyond the number looked at.
    pub ignored_tools: usize,
    /// Farthest that a proxy is behind its tool, in m; zero unless a tool jumped.
    pub lag_m: f64,
    /// Whether an iterate was thrown away and the shape before the step put back.
    pub fell_back: bool,
    /// One per tool, in the order in which tools first appeared.
    pub reactions: Vec<Reaction>,
}

/// Scratch memory of the equilibrium of one shape of one topology.
pub struct Solver {
    field: Field,
    coarse: Hierarchy,
    contacts: Contacts,
    held: Vec<u32>,
    moved: Vec<Vec3>,
    reference: f64,
    /// What counts as nothing, in N; see [`LEAST`].
    least: f64,
    report: StepReport,
    dirty: bool,
    last_forces: Vec<Vec3>,
}

impl Solver {
    /// A solver for shapes of this topology.
    pub fn new(topology: &Topology) -> Self {
        let field = Field::new(topology);
        let mut own: Vec<f64> = field.own.iter().copied().filter(|&k| k > 0.0).collect();
        let middle = own.len() / 2;
        let typical = match own.get(middle) {
            Some(_) => *own.select_nth_unstable_by(middle, f64::total_cmp).1,
            None => 0.0,
        };
        Self {
            least: LEAST * typical * topology.model().spacing_m,
            field,
            coarse: Hierarchy::new(topology),
            contacts: Contacts::new(topology),
            held: Vec::new(),
            moved: Vec::new(),
            reference: 0.0,
            report: StepReport::default(),
            dirty: false,
            last_forces: Vec::new(),
        }
    }

    /// Follows a change of the topology. `touched` are the nodes whose springs, pinning or rest
    /// position changed; new nodes at the end need not be listed.
    pub fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        self.field.follow(topology, touched);
        for &node in &self.held {
            self.field.fixed[node as usize] = true;
        }
        self.coarse.follow(topology, touched);
        self.contacts.follow(topology);
        self.dirty = true;
    }

    /// Tells the solver that the shape was changed from outside around these nodes.
    pub fn disturb(&mut self, topology: &Topology, shape: &Shape, nodes: &[u32]) {
        for &node in nodes {
            let Some(u) = shape.displacement.get(node as usize) else {
                continue;
            };
            self.field.displaced = self.field.displaced.max(u.norm());
            self.field.wake(node);
            for spring in topology.springs().row(node) {
                self.field.wake(spring.to);
            }
        }
        self.dirty = true;
    }

    /// Holds a node at a displacement in m until it is let go. Returns whether it could: not a
    /// pinned node, not a displacement that is no number, not more than 4096 nodes.
    pub fn hold(&mut self, topology: &Topology, shape: &mut Shape, node: u32, at: Vec3) -> bool {
        let n = node as usize;
        if n >= shape.displacement.len() || topology.is_pinned(node) || !at.norm().is_finite() {
            return false;
        }
        if !self.held.contains(&node) {
            if self.held.len() >= HELD_MAX {
                return false;
            }
            self.held.push(node);
        }
        self.field.fixed[n] = true;
        shape.displacement[n] = at;
        self.disturb(topology, shape, &[node]);
        true
    }

    /// Lets go of a held node.
    pub fn let_go(&mut self, topology: &Topology, node: u32) {
        if let Some(i) = self.held.iter().position(|&n| n == node) {
            self.held.swap_remove(i);
            self.field.fixed[node as usize] = topology.is_pinned(node);
            self.field.wake(node);
            self.dirty = true;
        }
    }

    /// Force of the springs on a node in N (on a held or pinned node: what it carries).
    pub fn force_on(&self, topology: &Topology, shape: &Shape, node: u32) -> Vec3 {
        force_on(topology, &shape.displacement, node)
    }

    /// The report of the latest step.
    pub fn report(&self) -> &StepReport {
        &self.report
    }

    /// The relative residual with every node looked at, active or not: a check, at the price of the
    /// whole model.
    pub fn residual_over_all(&mut self, topology: &Topology, shape: &Shape) -> f64 {
        let u = &shape.displacement;
        let sum = self.field.square_over_all(topology, u, &self.contacts);
        relative(sum, self.reference)
    }

    /// Brings the shape towards equilibrium under the tools.
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
        let changed = self.contacts.begin(tools) || self.dirty;
        self.report.ignored_tools = self.contacts.ignored;
        self.report.iterations = 0;
        self.report.visits = [0; 2];
        self.report.fell_back = false;
        if !changed && self.report.lag_m == 0.0 && self.report.residual <= budget.tolerance {
            return &self.report;
        }
        self.dirty = false;
        self.field.begin();
        self.iterate(topology, &mut shape.displacement, &mut budget);
        if !self.is_sane(topology) {
            self.field.undo(&mut shape.displacement);
            self.coarse.forget();
            self.report.fell_back = true;
            self.dirty = true;
        }
        self.close(topology, &shape.displacement);
        &self.report
    }

    fn iterate(&mut self, topology: &Topology, u: &mut [Vec3], budget: &mut Budget<'_>) {
        let mut lags = self.gather(topology, u);
        let mut share = FIRST_SHARE;
        let mut threshold = share * self.bring(topology, u, budget.tolerance);
        self.field
            .sweep(topology, u, &self.contacts, threshold, false);
        loop {
            let coarse = Some(&mut self.coarse);
            let sum = self
                .field
                .residual(topology, u, &self.contacts, coarse, threshold);
            let allowed = self.bring(topology, u, budget.tolerance);
            self.report.residual = relative(sum, self.reference);
            let calm = sum.sqrt() <= allowed && !lags;
            let last = if budget.tolerance < PROVEN {
                0.5 / (self.field.stirred() as f64 + 1.0).sqrt()
            } else if budget.tolerance < QUICK {
                FIRST_SHARE * DEEPEN
            } else {
                FIRST_SHARE
            };
            // All that is active is near the threshold: only a lower one can make it calmer.
            let active = self.field.active.items.len() as f64;
            let flat = sum.sqrt() <= 1.5 * share * allowed * active.sqrt();
            let enough = calm || (flat && budget.tolerance >= PROVEN && !lags);
            let done = enough && share <= last;
            if (calm || flat) && share > last {
                share = (share * DEEPEN).max(last);
                self.field.deepen(share * allowed);
            }
            threshold = share * allowed;
            let spent = self.report.iterations >= budget.iterations;
            if done || spent || budget.stop.as_mut().is_some_and(|stop| stop()) {
                self.coarse.unload();
                break;
            }
            self.report.iterations += 1;
            self.remember_forces(topology, u);
            self.correct(topology, u, threshold);
            for s in 0..SWEEPS {
                // Time may run out in the middle: what was gained so far is kept.
                if s > 0 && budget.stop.as_mut().is_some_and(|stop| stop()) {
                    break;
                }
                self.field
                    .sweep(topology, u, &self.contacts, threshold, s % 2 == 0);
            }
            if lags {
                lags = self.gather(topology, u);
            }
        }
    }

    /// Stage: proxies and samples.
    fn gather(&mut self, topology: &Topology, u: &[Vec3]) -> bool {
        let (field, contacts) = (&mut self.field, &mut self.contacts);
        // Nodes that are let go of now stay active until their force is gone.
        let lags = contacts.gather(topology, u, field.displaced, &field.own);
        for &node in &contacts.nodes {
            field.wake(node);
        }
        lags
    }

    /// Stage: the residual in N that the tolerance allows for what tools and held nodes bring in.
    fn bring(&mut self, topology: &Topology, u: &[Vec3], tolerance: f64) -> f64 {
        let held = self.held.iter();
        let mut sum: f64 = held.map(|&n| force_on(topology, u, n).norm_squared()).sum();
        for &node in &self.contacts.nodes {
            let mut force = Vec3::zeros();
            self.contacts
                .add(topology, u, node, &mut force, &mut [0.0; 6]);
            sum += force.norm_squared();
        }
        if sum > 0.0 {
            self.reference = sum.sqrt();
        }
        if tolerance >= PROVEN {
            self.reference = self.reference.max(self.least);
        }
        tolerance * self.reference
    }

    /// Stage: coarse correction.
    fn correct(&mut self, topology: &Topology, u: &mut [Vec3], threshold: f64) {
        self.stiffen(topology, u);
        self.report.visits[1] += self.coarse.cycle(threshold);
        let field = &mut self.field;
        self.coarse.pour(POUR * threshold, |children, e, kink| {
            for &(node, w) in children {
                let n = node as usize;
                if !field.fixed[n] {
                    let by = Vec3::new(f64::from(e[0]), f64::from(e[1]), f64::from(e[2]));
                    field.shift(u, node, by * f64::from(w));
                    field.disturb(node, KINK * w * kink * field.own[n] as f32, threshold);
                }
            }
        });
    }

    /// Stage: what contacts and held nodes add to the coarse levels; kept while it is the same.
    fn stiffen(&mut self, topology: &Topology, u: &[Vec3]) {
        self.coarse.clear_extra();
        let coarse = &mut self.coarse;
        self.contacts.pressed(topology, u, |sample, kappa, n| {
            let n = [n.x as f32, n.y as f32, n.z as f32];
            for a in 0..3 {
                for b in 0..3 {
                    let w = sample.weights[a] * sample.weights[b];
                    if w != 0.0 {
                        let block = outer(n, (w * kappa) as f32);
                        coarse.add_extra(sample.nodes[a], sample.nodes[b], &block);
                    }
                }
            }
        });
        for &node in &self.held {
            let k = (HELD_STIFFNESS * self.field.own[node as usize]) as f32;
            let block = [[k, 0.0, 0.0, 0.0], [0.0, k, 0.0, 0.0], [0.0, 0.0, k, 0.0]];
            coarse.add_extra(node, node, &block);
        }
        coarse.spread_extra();
    }

    fn remember_forces(&mut self, topology: &Topology, u: &[Vec3]) {
        self.last_forces.clear();
        for i in 0..self.contacts.proxies.len() {
            let (force, _) = self.contacts.force(topology, u, i);
            self.last_forces.push(force);
        }
    }

    fn is_sane(&self, topology: &Topology) -> bool {
        let limit = BLOWN_UP * topology.model().spacing_m;
        self.report.residual.is_finite() && self.field.displaced < limit
    }

    /// Last stage: reactions and figures.
    fn close(&mut self, topology: &Topology, u: &[Vec3]) {
        let spacing = topology.model().spacing_m;
        self.report.reactions.clear();
        self.report.lag_m = 0.0;
        for i in 0..self.contacts.proxies.len() {
            let mut reaction = self.contacts.reaction(topology, u, i);
            let proxy = &mut self.contacts.proxies[i];
            if reaction.contacts > 0 {
                self.report.lag_m = self.report.lag_m.max(proxy.lag());
                if !proxy.secant.is_known() {
                    let own = self.field.own[self.contacts.nodes[0] as usize];
                    let wide = (proxy.radius / spacing).max(0.5);
                    proxy.secant.start(&reaction.normal, 0.5 * own * wide, 0.3);
                }
                proxy.secant.learn(proxy.at, reaction.force, 0.01 * spacing);
                reaction.stiffness = proxy.secant.stiffness();
                if let Some(last) = self.last_forces.get(i) {
                    reaction.force_error = (reaction.force - last).norm();
                }
            }
            self.report.reactions.push(reaction);
        }
        self.report.active_nodes = self.field.active.items.len();
        self.report.visits[0] = self.field.visits;
        self.report.clamped = self.field.clamped;
        if self.report.active_nodes == 0 && self.contacts.nodes.is_empty() && self.held.is_empty() {
            self.reference = 0.0;
            self.report.residual = 0.0;
        }
    }

    /// The seed's iteration (eq. 3.10) for the offset law, `sweeps` times or until the relative
    /// residual of that law is below `tolerance`, with the held nodes as the prescribed ones. Tools
    /// take no part. Returns the sweeps made and the residual.
    pub fn jacobi(
        &mut self,
        topology: &Topology,
        shape: &mut Shape,
        sweeps: usize,
        tolerance: f64,
    ) -> (usize, f64) {
        let u = &mut shape.displacement;
        let fixed = &self.field.fixed;
        self.field.active.retain(|node| !fixed[node as usize]);
        let mut reference = 0.0;
        for &node in &self.held {
            let own = u[node as usize];
            let mut force = Vec3::zeros();
            for spring in topology.springs().row(node) {
                force += (u[spring.to as usize] - own) * f64::from(spring.stiffness);
            }
            reference += force.norm_squared();
        }
        let reference = jacobi::OFFSET_SHARE * reference.sqrt();
        let mut residual = 1.0;
        for sweep in 0..sweeps {
            let active = &mut self.field.active;
            let threshold =
                tolerance * reference / (2.0 * (active.items.len() as f64 + 64.0).sqrt());
            let sum = jacobi::sweep(
                topology,
                u,
                &self.field.fixed,
                active,
                &mut self.moved,
                threshold,
            );
            residual = relative(sum, reference);
            if residual <= tolerance {
                return (sweep, residual);
            }
        }
        (sweeps, residual)
    }
}

fn relative(sum: f64, reference: f64) -> f64 {
    if sum == 0.0 {
        0.0
    } else if reference > 0.0 {
        sum.sqrt() / reference
    } else {
        1.0
    }
}
