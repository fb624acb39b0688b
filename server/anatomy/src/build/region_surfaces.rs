//! Distance of a point from the surface of one region, in the input or in the model.
//!
//! The surface of a region consists of parts of several interfaces: its own, the outer one, and those of later regions
//! inside it. The triangles of all interfaces carry the regions on their sides.

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::bvh::Bvh;
use super::faces::{Face, OUTSIDE};
use super::interfaces::{Interface, Interfaces, sides_of, tag};

/// One tree per interface, the outer one first.
pub(super) struct RegionSurfaces<'a> {
    trees: Vec<&'a Bvh>,
    /// For each tree, bit `r`: it has triangles of region `r`.
    has: Vec<u64>,
}

/// The interfaces of the model, in the same order.
pub(super) struct ModelSurfaces(Vec<Bvh>);

impl ModelSurfaces {
    pub(super) fn new(
        interfaces: &Interfaces,
        faces: &[Face],
        positions: &[Vec3],
        middle: Vec3,
    ) -> Self {
        let all: Vec<Interface> = interfaces.all().collect();
        let tree = |interface: &Interface| {
            let own = faces.iter().filter(|f| f.interface() == *interface);
            let flat = own.flat_map(|f| {
                f.triangles(positions).map(|t| {
                    let corners = t.map(|n| positions[n as usize]);
                    Bvh::flat(&middle, &corners).tagged(tag([f.region, f.other]))
                })
            });
            Bvh::new(middle, flat.collect())
        };
        Self(all.par_iter().map(tree).collect())
    }

    /// The surface of one interface.
    pub(super) fn of(&self, interface: Interface) -> &Bvh {
        &self.0[index(interface)]
    }

    pub(super) fn by_region(&self) -> RegionSurfaces<'_> {
        RegionSurfaces::new(self.0.iter().collect())
    }
}

impl<'a> RegionSurfaces<'a> {
    /// The surfaces of the input's regions.
    pub(super) fn of_input(interfaces: &'a Interfaces) -> Self {
        Self::new(interfaces.all().map(|i| interfaces.bvh(i)).collect())
    }

    fn new(trees: Vec<&'a Bvh>) -> Self {
        let has = |tree: &&Bvh| {
            let sides = (0..tree.len()).flat_map(|t| sides_of(tree.tag(t)));
            sides
                .filter(|r| *r != OUTSIDE)
                .fold(0, |set, r| set | 1 << r)
        };
        Self {
            has: trees.par_iter().map(has).collect(),
            trees,
        }
    }

    /// Distance in m of a point from the surface of `region`, or infinity if it has none. The search begins at
    /// `first`, where the surface is most likely nearest.
    pub(super) fn distance(&self, point: &Vec3, region: u16, first: Interface) -> f64 {
        if region == OUTSIDE {
            return f64::INFINITY;
        }
        let first = index(first);
        let others = (0..self.trees.len()).filter(|t| *t != first);
        let mut least = f64::INFINITY;
        for tree in std::iter::once(first).chain(others) {
            if self.has[tree] >> region & 1 == 0 {
                continue;
            }
            let near =
                self.trees[tree].nearest_tagged(point, least, |t| sides_of(t).contains(&region));
            if let Some(near) = near {
                least = least.min((near - point).norm());
            }
        }
        least
    }
}

fn index(interface: Interface) -> usize {
    match interface {
        Interface::Outer => 0,
        Interface::Of(region) => region + 1,
    }
}
