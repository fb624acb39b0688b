//! The interfaces that each node between regions lies on.

use std::collections::BTreeSet;

use palpate_tissue::Vec3;
use palpate_tissue::cell::{FACES, NO_CELL};

use super::interfaces::Interface;
use super::lattice::{Lattice, outward};

/// Rings of nodes around a gap without an empty cell that face their own side too: the gap is still narrower than a
/// node's way to its surface.
const RINGS: usize = 2;

/// The interfaces that a node lies on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Constraint {
    /// The outer surface.
    pub(super) outer: bool,
    /// A rim of the outer surface, or of the only interface.
    pub(super) rim: bool,
    /// A corner of that rim.
    pub(super) corner: bool,
    /// Bit `f`: a cell face in direction `f` belongs to that rim; zero when any rim will do.
    pub(super) seen: u8,
    /// Bit `r`: the inner interface of region `r`, where it overrides others.
    pub(super) owners: u64,
    /// Sum of the outward directions of the opened faces of a node beside a gap, or of the outer faces of a node around
    /// it; zeros elsewhere. The node goes onto triangles that face this way, which are those on its own side.
    pub(super) facing: [i8; 3],
}

impl Constraint {
    /// Whether the node lies on no interface.
    pub(super) fn free(self) -> bool {
        !self.outer && self.owners == 0
    }

    /// The interfaces that two nodes have in common.
    pub(super) fn common(self, other: Self) -> Self {
        Self {
            outer: self.outer && other.outer,
            owners: self.owners & other.owners,
            ..Self::default()
        }
    }

    /// A part of this constraint: the interfaces of `kept` and one more.
    pub(super) fn kept_with(self, kept: Option<Self>, interface: Interface) -> Self {
        let kept = kept.unwrap_or(Self {
            facing: self.facing,
            ..Self::default()
        });
        match interface {
            // With several interfaces the rim is that of the outer surface.
            Interface::Outer => Self {
                owners: kept.owners,
                ..self
            },
            Interface::Of(region) => Self {
                owners: kept.owners | 1 << region,
                ..kept
            },
        }
    }

    /// The interfaces, the outer one first.
    pub(super) fn interfaces(self) -> impl Iterator<Item = Interface> + Clone {
        let outer = self.outer.then_some(Interface::Outer);
        let owners = (0..64).filter(move |r| self.owners >> r & 1 == 1);
        outer.into_iter().chain(owners.map(Interface::Of))
    }

    /// The interface whose rims the node may stand on, as an index into [`Interfaces::rims`].
    pub(super) fn rim_slot(self) -> Option<usize> {
        if self.outer {
            Some(0)
        } else {
            self.owners
                .is_power_of_two()
                .then(|| 1 + self.owners.trailing_zeros() as usize)
        }
    }

    /// Whether the node lies beside a gap that no cell is empty for.
    pub(super) fn beside_gap(self) -> bool {
        self.facing != [0; 3]
    }

    /// Whether a normal of the outer surface belongs to the node's own side of a gap.
    pub(super) fn faces(self, normal: &Vec3) -> bool {
        !(self.beside_gap() && self.outer) || self.facing().dot(normal) > 0.0
    }

    /// Adds the outward direction of a face.
    fn face(&mut self, face: usize) {
        self.facing[face / 2] += outward(face);
    }

    /// The direction in which a node beside a gap faces; zero elsewhere.
    pub(super) fn facing(self) -> Vec3 {
        Vec3::from(self.facing.map(f64::from))
    }

    pub(super) fn single(self) -> bool {
        !self.rim && u32::from(self.outer) + self.owners.count_ones() == 1
    }

    /// Whether a node under `self` may slide towards a node under `other`: the other lies on at least the same
    /// interfaces.
    pub(super) fn within(self, other: Self) -> bool {
        (!self.outer || other.outer)
            && (!self.rim || other.rim)
            && !self.corner
            && self.owners & other.owners == self.owners
    }
}

/// Reads off the labels around each node which interfaces it lies on.
pub(super) fn constraints(lattice: &Lattice) -> Vec<Constraint> {
    let mut constraints = vec![Constraint::default(); lattice.nodes.len()];
    for cell in &lattice.cells {
        for &node in &cell.corners {
            constraints[node as usize].owners |= 1 << cell.region.index();
        }
        for (face, corners) in FACES.iter().enumerate() {
            if cell.neighbours[face] == NO_CELL {
                for &c in corners {
                    constraints[cell.corners[c] as usize].outer = true;
                }
            }
        }
    }
    for constraint in &mut constraints {
        constraint.owners &= constraint.owners - 1;
    }
    mark_gaps(lattice, &mut constraints);
    constraints
}

/// Marks the nodes of opened faces and those around them with the direction in which they face: that of their opened
/// faces, if they have some, else that of their outer ones.
fn mark_gaps(lattice: &Lattice, constraints: &mut [Constraint]) {
    for (node, facing) in lattice.facing() {
        constraints[node as usize].facing = facing;
    }
    let opened = (0..)
        .zip(constraints.iter())
        .filter(|(_, c)| c.beside_gap());
    let opened: BTreeSet<u32> = opened.map(|(node, _)| node).collect();
    if opened.is_empty() {
        return;
    }
    let outer = || {
        lattice.cells.iter().flat_map(|cell| {
            let faces = (0..6).filter(|f| cell.neighbours[*f] == NO_CELL);
            faces.map(|face| (face, FACES[face].map(|c| cell.corners[c])))
        })
    };
    let mut around = opened.clone();
    for _ in 0..RINGS {
        let next = outer().filter(|(_, nodes)| nodes.iter().any(|n| around.contains(n)));
        let next: Vec<u32> = next.flat_map(|(_, nodes)| nodes).collect();
        around.extend(next);
    }
    around.retain(|node| !opened.contains(node));
    for (face, nodes) in outer() {
        for node in nodes.into_iter().filter(|n| around.contains(n)) {
            constraints[node as usize].face(face);
        }
    }
}
