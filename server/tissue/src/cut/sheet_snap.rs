//! Snapping the nodes of a sheet onto the swept surface (Lin 2007, figs 5.3 to 5.6; reconstructed).
//!
//! With q the nearest point of the swept surface, n its normal there and d = (x - q)·n the height over it, a free
//! node goes to q. A node on a surface or an interface may only slide along it: with P the projector
//! onto the directions left to it, it goes
//!
//! ```text
//! x <- x - P n d / |P n|²
//! ```
//!
//! and back to its surface as built, a few times over for curved ones.
//!
//! Where the lattice makes a step, three edges of a cell would come to lie in the swept surface. Its nodes keep a small
//! part s of their heights, x = q + s d n: on a plane the lattice is then squashed by an affine map of determinant s, so
//! that no corner is inverted by this step.

use super::DRIFT_MAX;
use super::freedom::{Freedom, freedom};
use super::interface::Interfaces;
use super::patch::{Patch, corners_in_sheet, within_drift};
use super::ribbon::Ribbon;
use super::soundness::CORNER_FLOOR;
use crate::{FaceId, Topology, Vec3};

/// A snapped node is nearer to the swept surface than this, in spacings.
pub(crate) const ON_RIBBON: f64 = 1e-6;
/// Farthest a node of the sheet is meant to be from the swept surface where its cells need the room, in spacings.
const SLAB: f64 = 0.0495;
/// s: just above the smallest volume at a corner, in cubed spacings.
const SQUASH: f64 = 1.1 * CORNER_FLOOR;
/// A node slides to the swept surface only where it crosses its own at more than this (squared sine
/// of the angle); flatter than that it would have to go too far.
const CROSSING_MIN: f64 = 0.05;
/// Steps of the iteration on curved surfaces; flat ones need one.
const ITERATIONS: usize = 20;

/// A node of a sheet.
pub(crate) struct SheetNode {
    pub(crate) node: u32,
    pub(crate) freedom: Freedom,
    pub(crate) interfaces: Interfaces,
    /// Where it was built.
    original: Vec3,
    /// Point and normal of the swept surface near it, where it was moved last; none for pinned nodes.
    pub(crate) plane: Option<(Vec3, Vec3)>,
    /// How far from the plane it may be, in m.
    pub(crate) slab: f64,
    pub(crate) short: bool,
}

/// The nodes of a sheet, sorted.
pub(crate) fn sheet_nodes(topology: &Topology, sheet: &[FaceId]) -> Vec<SheetNode> {
    let faces = sheet.iter();
    let mut nodes: Vec<u32> = faces
        .flat_map(|&face| super::sheet::nodes_of(topology, face))
        .collect();
    nodes.sort_unstable();
    nodes.dedup();
    let node = |node: u32| {
        let freedom = freedom(topology, node);
        SheetNode {
            node,
            freedom,
            interfaces: match freedom {
                Freedom::Held(_) => Interfaces::at(topology, node),
                Freedom::Free | Freedom::Pinned => Interfaces::default(),
            },
            original: topology.original(node),
            plane: None,
            slab: 0.0,
            short: true,
        }
    };
    nodes.into_iter().map(node).collect()
}

/// Places the nodes of a sheet on the swept surface, as far as their surfaces lead there.
pub(crate) fn place(patch: &mut Patch, nodes: &mut [SheetNode], ribbon: &Ribbon) {
    let steps = at_steps(patch);
    for (i, node) in nodes.iter_mut().enumerate() {
        let squash = if steps[i] { SQUASH } else { 0.0 };
        if let Some(to) = node.place(patch.start[i], squash, ribbon, patch.spacing) {
            patch.at[i] = to;
        }
    }
}

/// Marks the nodes that are off the swept surface.
pub(crate) fn mark(patch: &Patch, nodes: &mut [SheetNode], ribbon: &Ribbon) {
    for (node, at) in nodes.iter_mut().zip(&patch.at) {
        let foot = ribbon.nearest(at);
        node.short = foot.is_none_or(|f| (f.point - at).norm() > ON_RIBBON * patch.spacing);
    }
}

/// Whether each node of the sheet is at a corner of a cell with all four nodes in the sheet.
fn at_steps(patch: &Patch) -> Vec<bool> {
    let mut steps = vec![false; patch.sheet];
    for corners in &patch.cells {
        for n in corners_in_sheet(corners, patch.sheet).flatten() {
            steps[n] = true;
        }
    }
    steps
}

impl SheetNode {
    /// Where it meets the swept surface, or comes nearest to it; none for pinned nodes.
    fn place(&mut self, from: Vec3, squash: f64, ribbon: &Ribbon, spacing: f64) -> Option<Vec3> {
        let foot = ribbon.nearest(&from)?;
        let height = squash * (from - foot.point).dot(&foot.normal);
        let mut x = from;
        match self.freedom {
            Freedom::Free => x = foot.point + foot.normal * height,
            Freedom::Pinned => return None,
            Freedom::Held(_) => {
                for _ in 0..ITERATIONS {
                    let foot = ribbon.nearest(&x)?;
                    let miss = height - (x - foot.point).dot(&foot.normal);
                    let Some(rise) = self.rise(&foot.normal) else {
                        break;
                    };
                    if miss.abs() < 1e-10 * spacing {
                        break;
                    }
                    x = self.interfaces.project(x + rise * miss);
                }
            }
        }
        let (way, limit) = (x - from, DRIFT_MAX * spacing);
        if way.norm() > limit {
            x = self.interfaces.project(from + way * (limit / way.norm()));
        }
        x = self.within_drift(x, spacing);
        let foot = ribbon.nearest(&x)?;
        self.plane = Some((foot.point, foot.normal));
        let off = (x - foot.point).dot(&foot.normal).abs();
        self.slab = off.max(SLAB * spacing);
        Some(x)
    }

    /// The nearest place to `x` that is within its slab.
    pub(crate) fn within_slab(&self, x: Vec3) -> Vec3 {
        let Some((point, normal)) = self.plane else {
            return x;
        };
        let height = (x - point).dot(&normal);
        let excess = height - height.clamp(-self.slab, self.slab);
        if excess == 0.0 {
            return x;
        }
        self.rise(&normal).map_or(x, |rise| x - rise * excess)
    }

    /// The shortest displacement in its free directions that raises it by one over a plane with a normal; none where these
    /// meet the plane too flatly.
    pub(crate) fn rise(&self, normal: &Vec3) -> Option<Vec3> {
        let across = match self.freedom {
            Freedom::Free => return Some(*normal),
            Freedom::Held(free) => free * normal,
            Freedom::Pinned => return None,
        };
        let share = across.norm_squared();
        (share >= CROSSING_MIN).then(|| across / share)
    }

    /// The nearest place to `x` to which cuts may move it from where it was built.
    pub(crate) fn within_drift(&self, x: Vec3, spacing: f64) -> Vec3 {
        within_drift(x, &self.original, spacing)
    }
}
