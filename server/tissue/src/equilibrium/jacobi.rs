//! The seed's own iteration (Lin 2007, eq. 3.10), kept as the named baseline.
//!
//! The offset law (eq. 3.8) is linear: `f_i = Σ K_ij (u_j - u_i)` in displacements, one graph
//! Laplacian per axis. Its iteration moves every active node to the weighted mean of its
//! neighbours. It has no Poisson effect, its modulus on this lattice is (k1 + 4 k2)/Δd = 2 E and its
//! shear is 2.5 times too stiff beside it, so spring constants are halved here to show E. It
//! converges slowly: stopping it early overstates the force.

use super::budget::relative;
use super::coarse_level::List;
use super::solver::Solver;
use crate::{Shape, Topology, Vec3};

/// The modulus of the offset law is twice that of the length law with the same springs.
const OFFSET_SHARE: f64 = 0.5;

impl Solver {
    /// The seed's iteration (eq. 3.10) for the offset law: `sweeps` times, or until its relative residual is below
    /// `tolerance`. Held nodes are prescribed; tools are ignored. Returns the sweeps made and the residual.
    pub fn jacobi(
        &mut self,
        topology: &Topology,
        shape: &mut Shape,
        sweeps: usize,
        tolerance: f64,
    ) -> (usize, f64) {
        let u = &mut shape.displacement;
        let fixed = &self.fine.fixed;
        let mut active = List::new(topology.node_count());
        for &node in &self.held {
            for spring in topology.springs().row(node) {
                if !fixed[spring.to as usize] {
                    active.insert(spring.to);
                }
            }
        }
        let mut reference = 0.0;
        for &node in &self.held {
            let own = u[node as usize];
            let mut force = Vec3::zeros();
            for spring in topology.springs().row(node) {
                force += (u[spring.to as usize] - own) * f64::from(spring.stiffness);
            }
            reference += force.norm_squared();
        }
        let reference = OFFSET_SHARE * reference.sqrt();
        let mut residual = 1.0;
        for done in 0..sweeps {
            let threshold =
                tolerance * reference / (2.0 * (active.items.len() as f64 + 64.0).sqrt());
            let sum = sweep(topology, u, fixed, &mut active, &mut self.moved, threshold);
            residual = relative(sum, reference);
            if residual <= tolerance {
                return (done, residual);
            }
        }
        (sweeps, residual)
    }
}

/// One sweep of eq. 3.10 over the active nodes, from the displacements before the sweep; activates the neighbours of
/// nodes that moved. Returns the sum of squares of the forces before it.
fn sweep(
    topology: &Topology,
    u: &mut [Vec3],
    fixed: &[bool],
    active: &mut List,
    next: &mut Vec<Vec3>,
    threshold: f64,
) -> f64 {
    let mut sum = 0.0;
    next.clear();
    for &node in &active.items {
        let own = u[node as usize];
        let (mut force, mut stiffness) = (Vec3::zeros(), 0.0);
        for spring in topology.springs().row(node) {
            let k = OFFSET_SHARE * f64::from(spring.stiffness);
            force += (u[spring.to as usize] - own) * k;
            stiffness += k;
        }
        sum += force.norm_squared();
        let increments = force.norm() > threshold && stiffness > 0.0;
        next.push(if increments {
            own + force / stiffness
        } else {
            own
        });
    }
    for (i, value) in next.iter().enumerate() {
        let node = active.items[i];
        let moved = u[node as usize] != *value;
        u[node as usize] = *value;
        if moved {
            for spring in topology.springs().row(node) {
                if !fixed[spring.to as usize] {
                    active.insert(spring.to);
                }
            }
        }
    }
    sum
}
