//! The fine level: nonlinear Gauss-Seidel over the active nodes.
//!
//! A node moves by the inverse of its tangent block times the force on it. Only active nodes are
//! visited. A node that is not active has a bound on its force: the force when it was last looked
//! at, plus k|δ| for every neighbour that moved by δ since; when the bound passes the threshold it
//! becomes active. So the set follows the press, and what was left alone is known to be quiet.

use super::hierarchy::{Hierarchy, List};
use super::law::{Lanes, Symmetric, apply, invert};
use crate::contact::Contacts;
use crate::{Topology, Vec3};

/// Longest move of a node in one visit, in spacings; longer ones are cut and counted.
const MOVE_MAX: f64 = 0.5;
/// Visits of a node between two computations of its tangent block.
const REFRESH: u8 = 3;
/// A node leaves the active set when its force is below this part of the threshold.
const LEAVE: f64 = 0.5;

/// Everything the solver knows about single nodes.
pub(super) struct Field {
    /// Pinned or held.
    pub(super) fixed: Vec<bool>,
    /// Mean stiffness of the node at rest in N/m.
    pub(super) own: Vec<f64>,
    inverse: Vec<Symmetric>,
    /// Visits until the inverse is computed again.
    age: Vec<u8>,
    /// Bound on the force of nodes that are not active, in N.
    bound: Vec<f32>,
    pub(super) active: List,
    /// Nodes that are not active but have a bound above zero.
    waiting: List,
    lanes: Lanes,
    /// Displacements before this step of all nodes that moved in it.
    undo: Vec<(u32, Vec3)>,
    saved: Vec<u32>,
    step: u32,
    /// Largest displacement of any node so far in m.
    pub(super) displaced: f64,
    move_max: f64,
    pub(super) clamped: usize,
    /// Forces computed in this step.
    pub(super) visits: usize,
}

impl Field {
    pub(super) fn new(topology: &Topology) -> Self {
        let mut field = Self {
            fixed: Vec::new(),
            own: Vec::new(),
            inverse: Vec::new(),
            age: Vec::new(),
            bound: Vec::new(),
            active: List::default(),
            waiting: List::default(),
            lanes: Lanes::new(topology.model().spacing_m),
            undo: Vec::new(),
            saved: Vec::new(),
            step: 0,
            displaced: 0.0,
            move_max: MOVE_MAX * topology.model().spacing_m,
            clamped: 0,
            visits: 0,
        };
        field.follow(topology, &[]);
        field
    }

    pub(super) fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let known = self.fixed.len();
        let count = topology.node_count();
        self.fixed.resize(count, false);
        self.own.resize(count, 0.0);
        self.inverse.resize(count, [0.0; 6]);
        self.age.resize(count, 0);
        self.bound.resize(count, 0.0);
        self.saved.resize(count, 0);
        self.active.grow(count);
        self.waiting.grow(count);
        self.undo.reserve(count.saturating_sub(self.undo.len()));
        let derive = |field: &mut Self, node: u32| {
            let n = node as usize;
            field.fixed[n] = topology.is_pinned(node);
            let row = topology.springs().row(node);
            field.own[n] = row.iter().map(|s| f64::from(s.stiffness)).sum::<f64>() / 3.0;
            field.age[n] = 0;
        };
        for node in known as u32..count as u32 {
            derive(self, node);
            if known > 0 {
                self.wake(node);
            }
        }
        for &node in touched {
            if (node as usize) < count {
                derive(self, node);
                self.wake(node);
                for spring in topology.springs().row(node) {
                    self.wake(spring.to);
                }
            }
        }
    }

    /// Makes a node active.
    pub(super) fn wake(&mut self, node: u32) {
        if !self.fixed[node as usize] {
            self.active.insert(node);
        }
    }

    pub(super) fn begin(&mut self) {
        self.step = self.step.wrapping_add(1);
        if self.step == 0 {
            self.saved.fill(0);
            self.step = 1;
        }
        self.undo.clear();
        self.clamped = 0;
        self.visits = 0;
    }

    /// Puts back every node that this step moved.
    pub(super) fn undo(&mut self, u: &mut [Vec3]) {
        for (node, before) in self.undo.drain(..) {
            u[node as usize] = before;
        }
        self.step = self.step.wrapping_add(1).max(1);
        self.age.fill(0);
        self.displaced = u.iter().map(Vec3::norm).fold(0.0, f64::max);
    }

    #[inline]
    pub(super) fn shift(&mut self, u: &mut [Vec3], node: u32, by: Vec3) {
        let n = node as usize;
        if self.saved[n] != self.step {
            self.saved[n] = self.step;
            self.undo.push((node, u[n]));
        }
        u[n] += by;
        let square = u[n].norm_squared();
        if square > self.displaced * self.displaced {
            self.displaced = square.sqrt();
        }
    }

    /// Raises the bound of a quiet node and wakes it beyond the threshold.
    #[inline]
    pub(super) fn disturb(&mut self, node: u32, by: f32, threshold: f64) {
        let n = node as usize;
        if self.active.contains(node) || self.fixed[n] {
            return;
        }
        self.bound[n] += by;
        if f64::from(self.bound[n]) > threshold {
            self.active.insert(node);
        } else {
            self.waiting.insert(node);
        }
    }

    /// Wakes every waiting node whose bound passes a lowered threshold; forgets those that woke.
    pub(super) fn deepen(&mut self, threshold: f64) {
        let (active, bound) = (&mut self.active, &self.bound);
        self.waiting.retain(|node| {
            if f64::from(bound[node as usize]) > threshold {
                active.insert(node);
            }
            !active.contains(node)
        });
    }

    /// Nodes whose force is not known to be zero.
    pub(super) fn stirred(&self) -> usize {
        self.active.items.len() + self.waiting.items.len()
    }

    /// One sweep over the nodes that are active now, forward or backward.
    pub(super) fn sweep(
        &mut self,
        topology: &Topology,
        u: &mut [Vec3],
        contacts: &Contacts,
        threshold: f64,
        backward: bool,
    ) {
        let count = self.active.items.len();
        self.visits += count;
        for i in 0..count {
            let node = self.active.items[if backward { count - 1 - i } else { i }];
            self.relax(topology, u, contacts, node, threshold);
        }
    }

    #[inline]
    pub(super) fn relax(
        &mut self,
        topology: &Topology,
        u: &mut [Vec3],
        contacts: &Contacts,
        node: u32,
        threshold: f64,
    ) {
        let n = node as usize;
        if self.fixed[n] {
            return;
        }
        self.lanes.load(topology, u, node);
        let mut force = self.lanes.force();
        let step = if contacts.touches(node) {
            let mut block = self.lanes.tangent();
            contacts.add(topology, u, node, &mut force, &mut block);
            self.age[n] = 0;
            apply(&invert(&block), &force)
        } else {
            if force.norm_squared() < threshold * threshold {
                return;
            }
            if self.age[n] == 0 {
                self.inverse[n] = invert(&self.lanes.tangent());
                self.age[n] = REFRESH;
            }
            self.age[n] -= 1;
            apply(&self.inverse[n], &force)
        };
        let mut length = step.norm();
        if !length.is_finite() {
            self.clamped += 1;
            return;
        }
        let mut step = step;
        if length > self.move_max {
            step *= self.move_max / length;
            length = self.move_max;
            self.clamped += 1;
        }
        self.shift(u, node, step);
        let length = length as f32;
        for spring in topology.springs().row(node) {
            self.disturb(spring.to, spring.stiffness * length, threshold);
        }
    }

    /// Force on every active node, handed to the coarse levels; quiet nodes leave the set. Returns
    /// the sum of squares.
    pub(super) fn residual(
        &mut self,
        topology: &Topology,
        u: &[Vec3],
        contacts: &Contacts,
        coarse: Option<&mut Hierarchy>,
        threshold: f64,
    ) -> f64 {
        let mut sum = 0.0;
        let mut coarse = coarse;
        let (lanes, fixed, bound) = (&mut self.lanes, &self.fixed, &mut self.bound);
        let waiting = &mut self.waiting;
        let leave = LEAVE * threshold;
        self.visits += self.active.items.len();
        self.active.sort();
        self.active.retain(|node| {
            if fixed[node as usize] {
                return false;
            }
            lanes.load(topology, u, node);
            let mut force = lanes.force();
            let touches = contacts.touches(node);
            if touches {
                contacts.add(topology, u, node, &mut force, &mut [0.0; 6]);
            }
            let square = force.norm_squared();
            sum += square;
            if let Some(coarse) = coarse.as_deref_mut() {
                let f = [force.x as f32, force.y as f32, force.z as f32, 0.0];
                let level = &mut coarse.levels[0];
                for &(point, w) in coarse.parents[node as usize].iter() {
                    level.load(point, &f.map(|v| v * w));
                }
            }
            bound[node as usize] = square.sqrt() as f32;
            let stays = touches || square > leave * leave;
            if !stays && square > 0.0 {
                waiting.insert(node);
            }
            stays
        });
        sum
    }

    /// Every node's force, looked at afresh: the sum of squares over all nodes free to move.
    pub(super) fn square_over_all(
        &mut self,
        topology: &Topology,
        u: &[Vec3],
        contacts: &Contacts,
    ) -> f64 {
        let mut sum = 0.0;
        for node in 0..topology.node_count() as u32 {
            if !self.fixed[node as usize] {
                self.lanes.load(topology, u, node);
                let mut force = self.lanes.force();
                contacts.add(topology, u, node, &mut force, &mut [0.0; 6]);
                sum += force.norm_squared();
            }
        }
        sum
    }
}
