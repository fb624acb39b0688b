//! Lagrange multipliers of the contacts of one tool (augmented Lagrangian, Simo and Laursen 1992).
//!
//! Under a penalty alone the tool sinks into the surface until κ times its depth is the force of the tissue. Here a
//! multiplier λ takes over the force of each iteration, and the penalty adds the change (Uzawa's method):
//!
//! ```text
//! f = max(0, λ + κ depth)          λ ← f after each iteration
//! ```
//!
//! So the depth tends to zero for any κ. Multipliers belong to nodes and follow the mean over their samples: four samples
//! per triangle are more constraints than a flat triangle has freedoms under a round tool. They are stored as λ/κ, because
//! κ changes with the facing of a sample. They are bounded (safeguarded augmented Lagrangian, Birgin and Martínez 2014):
//! quick steps of tissue that is pressed flat do not converge, and would sum up their errors.

use crate::Topology;

/// Change of λ/κ in m at a node, and its weight in the mean: the share of κ.
pub(super) struct Change {
    pub(super) node: u32,
    pub(super) weight: f64,
    pub(super) by: f64,
}

/// λ/κ in m of the nodes under one tool, above zero, sorted by node.
#[derive(Clone, Default)]
pub(crate) struct Multipliers(Vec<(u32, f64)>);

impl Multipliers {
    fn of(&self, node: u32) -> f64 {
        let found = self.0.binary_search_by_key(&node, |m| m.0);
        found.map_or(0.0, |i| self.0[i].1)
    }

    /// λ/κ in m of a sample.
    pub(super) fn at(&self, nodes: &[u32; 3], weights: &[f64; 3]) -> f64 {
        (0..3).map(|k| weights[k] * self.of(nodes[k])).sum()
    }

    /// Adds the mean change to each node, up to `most` m. Other nodes lose their multiplier.
    pub(super) fn add(&mut self, mut changes: Vec<Change>, most: f64) {
        changes.sort_by_key(|change| change.node);
        let next = |of_node: &[Change]| {
            let sum: f64 = of_node.iter().map(|c| c.weight * c.by).sum();
            let weight: f64 = of_node.iter().map(|c| c.weight).sum();
            let node = of_node[0].node;
            (node, (self.of(node) + sum / weight).min(most))
        };
        let of_nodes = changes.chunk_by(|a, b| a.node == b.node).map(next);
        self.0 = of_nodes.filter(|m| m.1 > 0.0).collect();
    }

    /// Follows a cut or an undo that leaves the nodes below `kept` in place. Nodes split by a cut share the multiplier of their
    /// origin.
    pub(super) fn follow(&mut self, topology: &Topology, kept: usize) {
        self.0.retain(|m| (m.0 as usize) < kept);
        for node in kept as u32..topology.node_count() as u32 {
            let m = self.of(topology.origin(node));
            if m > 0.0 {
                self.0.push((node, m));
            }
        }
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::cut_history::CutHistory;
    use crate::{BladePoint, CutStroke, Material, Vec3, block};

    proptest! {
        #[test]
        fn uzawa_iterations_balance_the_force_without_depth(
            load in 0.1..5.0f64, penalty in 10.0..1e5f64, tissue in 10.0..1e4f64,
        ) {
            // One node on a spring: the tool stands `load / tissue` m deep in the undeformed tissue.
            let indentation = load / tissue;
            let mut multipliers = Multipliers::default();
            let mut depth = indentation;
            let rounds = 20.0 * (1.0 + tissue / penalty);
            for _ in 0..rounds as usize {
                // tissue (indentation - depth) = λ + κ depth
                let m = multipliers.of(7);
                depth = (tissue * indentation - penalty * m) / (tissue + penalty);
                let by = (m + depth).max(0.0) - m;
                let change = Change { node: 7, weight: 1.0, by };
                multipliers.add(vec![change], f64::MAX);
            }
            prop_assert!(depth.abs() < 1e-6 * indentation, "{depth} of {indentation} m");
            prop_assert!((penalty * multipliers.of(7) - load).abs() < 1e-6 * load);
        }
    }

    #[test]
    fn nodes_split_by_a_cut_share_the_multiplier_of_their_origin() {
        let cell = 4e-3;
        let model = block([6, 6, 4], cell, &Material::default(), 1);
        let mut topology = Arc::new(Topology::new(Arc::new(model)));
        let former = topology.node_count();
        let mut multipliers =
            Multipliers((0..former as u32).map(|n| (n, f64::from(n + 1))).collect());
        let point = |i: u32| BladePoint {
            tip: Vec3::new(3.4, 1.0 + f64::from(i), 1.1) * cell,
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: (0..5).map(point).collect(),
            width_m: 0.0,
        };
        let mut history = CutHistory::new(Arc::clone(&topology));
        history.cut(&mut topology, (&stroke).into()).expect("a cut");
        assert!(topology.node_count() > former);
        multipliers.follow(&topology, former);
        for node in 0..topology.node_count() as u32 {
            let origin = topology.origin(node);
            assert_eq!(multipliers.of(node), f64::from(origin + 1));
        }
    }
}
