//! A topology, one shape of it and the shape's solver, kept consistent.

use std::sync::Arc;

use crate::contact::Tool;
use crate::cut::{CutError, CutOutcome, CutStroke};
use crate::cut_history::CutHistory;
use crate::equilibrium::{
    Budget, CutPreparer, Mechanism, PreparedCut, Retired, Sag, Solver, StepReport,
};
use crate::{Model, Shape, Topology, Vec3};

/// Tissue in one shape. Topology, shape, solver and history change only together, so neither can miss a cut of another.
pub struct Tissue {
    topology: Arc<Topology>,
    shape: Shape,
    solver: Solver,
    history: CutHistory,
    /// Prepares own cuts, since the first of them.
    cutter: Option<Box<CutPreparer>>,
}

impl Tissue {
    /// The uncut, undeformed tissue. With gravity it first solves the equilibrium without tools, where the first step
    /// starts.
    pub fn new(model: Arc<Model>) -> Self {
        Self::at_rest(Topology::new(model))
    }

    /// The undeformed shape of a topology, whose cuts can not be undone; otherwise like [`new`](Self::new).
    pub fn at_rest(topology: impl Into<Arc<Topology>>) -> Self {
        let topology = topology.into();
        Self {
            shape: Shape::rest(&topology),
            solver: Solver::new(&topology),
            history: CutHistory::new(Arc::clone(&topology)),
            cutter: None,
            topology,
        }
    }

    /// The undeformed shape of a topology with the strokes of a history; otherwise like [`new`](Self::new).
    pub fn with_history(topology: Arc<Topology>, history: CutHistory) -> Self {
        Self {
            history,
            ..Self::at_rest(topology)
        }
    }

    /// An undeformed second shape on the same topology. Immutable data are shared.
    #[must_use]
    pub fn another(&self) -> Self {
        Self {
            topology: Arc::clone(&self.topology),
            shape: Shape::rest(&self.topology),
            solver: self.solver.another(&self.topology),
            history: self.history.clone(),
            cutter: None,
        }
    }

    /// Moves the shape towards equilibrium under the tools.
    pub fn step(&mut self, tools: &[Tool], budget: Budget<'_>) -> &StepReport {
        self.solver
            .step(&self.topology, &mut self.shape, tools, budget)
    }

    /// Cuts the tissue; the shape continues without a jump. On an error nothing changes.
    pub fn cut(&mut self, stroke: &CutStroke) -> Result<Arc<CutOutcome>, CutError> {
        let mut cutter = match self.cutter.take() {
            Some(cutter) => cutter,
            None => Box::new(self.preparer()),
        };
        let cut = cutter.prepare(stroke);
        let outcome = cut.map(|cut| {
            let outcome = Arc::clone(&cut.outcome);
            self.succeed(cut);
            outcome
        });
        self.cutter = Some(cutter);
        outcome
    }

    /// Adopts the next cut, which another thread has prepared.
    pub fn succeed(&mut self, cut: PreparedCut) -> Retired {
        debug_assert_eq!(cut.topology.version(), self.topology.version() + 1);
        self.cutter = None;
        let (topology, history) = (&mut self.topology, &mut self.history);
        self.solver.succeed(topology, history, &mut self.shape, cut)
    }

    /// Prepares later cuts of this topology.
    pub fn preparer(&self) -> CutPreparer {
        self.solver.preparer(&self.topology, self.history.clone())
    }

    /// The topology, with all cuts.
    pub fn topology(&self) -> &Arc<Topology> {
        &self.topology
    }

    /// The shape.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The strokes of the topology.
    pub fn history(&self) -> &CutHistory {
        &self.history
    }

    /// The model, as it was built.
    pub fn model(&self) -> &Arc<Model> {
        self.topology.model()
    }

    /// The report of the latest step.
    pub fn report(&self) -> &StepReport {
        &self.solver.report
    }

    /// Whether forces still change because of a cut.
    pub fn is_settling(&self) -> bool {
        self.solver.is_settling()
    }

    /// Moves a tool of the last step that touches nothing, without a step. Returns false, and leaves the tool in place,
    /// if the tool is unknown or touches the tissue at its new position.
    pub fn move_free(&mut self, tool: &Tool) -> bool {
        self.solver.move_free(&self.topology, &self.shape, tool)
    }

    /// Displaces nodes by vectors in m.
    pub fn displace(&mut self, by: &[(u32, Vec3)]) {
        for &(node, by) in by {
            self.shape.displacement[node as usize] += by;
        }
        self.solver.disturb(&self.shape, by.iter().map(|d| d.0));
    }

    /// Holds a node at a displacement in m. Returns false for a pinned node, a
    /// displacement that is not finite, or too many held nodes.
    pub fn hold(&mut self, node: u32, at: Vec3) -> bool {
        self.solver.hold(&self.topology, &mut self.shape, node, at)
    }

    /// Force of the springs on a node plus its weight in N (on a held or pinned node: the reaction).
    pub fn force_on(&self, node: u32) -> Vec3 {
        self.solver.force_on(&self.shape, node)
    }

    /// The relative residual over all nodes, active or not. It evaluates the whole model; meant for checks.
    pub fn residual_over_all(&mut self) -> f64 {
        self.solver.residual_over_all(&self.shape)
    }

    /// Displacement of the tissue by its own weight; `None` without gravity.
    pub fn sag(&self) -> Option<Sag> {
        self.solver.sag()
    }

    /// Displacement in m of a node by gravity alone.
    pub fn sag_of(&self, node: u32) -> Vec3 {
        self.solver.sag_of(node)
    }

    /// Switches a mechanism of the solver off for an ablation.
    pub fn disable(&mut self, mechanism: Mechanism) {
        self.solver.disable(mechanism);
    }
}
