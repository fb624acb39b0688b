//! Putting the nodes between regions onto the interfaces.
//!
//! Snapping along the three rays (Lin 2007, eqs. 3.1-3.3, figs. 3.5-3.7) comes first: along Z, then along X and
//! Y for nodes not yet placed. On its own it loses several percent of the volume and leaves two nodes in five
//! off the surface, so the completion (reconstructed) follows. Every node between cells of different regions
//! that no ray has placed is projected onto the nearest point of that interface. Nodes on a rim of the lattice
//! go onto the rim.

use std::collections::{BTreeMap, BTreeSet};

use palpate_tissue::Vec3;
use palpate_tissue::cell::{FACES, NO_CELL};
use rayon::prelude::*;

use super::constraint::Constraint;
use super::grid::Grid;
use super::interfaces::{Interface, Interfaces};
use super::lattice::Lattice;
use super::rays::{Hits, Rays, cast};
use super::rim::{CORNER_REACH, Segment};
use crate::Surface;

/// Most alternating projections of a node that lies on several interfaces. Each round shortens the distance to
/// their common curve by the cosine of the angle between them.
const ALTERNATIONS: usize = 6;

/// The projections have converged when a round moves the node by no more than this, in spacings; less is
/// rounding.
const ARRIVED: f64 = 1e-9;

/// A node is put onto a rim when each face of the rim agrees with a cell face of the node within this cosine
/// (63°). An oblique side has two kinds of cell faces, each at most 55° away.
const RIM_FACE_COSINE: f64 = 0.45;

/// Positions on a rim closer together than this, in spacings, are one.
const CLAIM_REACH: f64 = 0.5;

/// A node counts as on an interface when it is at most this far away, in spacings; interfaces are kept
/// in single precision.
pub(super) const ON_SURFACE: f64 = 1e-4;

/// Farthest projection of a node, in spacings; its own interface is never beyond it.
const REACH: f64 = 4.0;

/// Interfaces meet if a point is found within this distance of all of them, in spacings, ...
const MEETING: f64 = 0.1;
/// ... and this near to the lattice point.
const MEETING_REACH: f64 = 1.25;

/// Marks the nodes on a rim of their interface, and for each corner the nearest of these.
pub(super) fn mark_rims(
    grid: &Grid,
    lattice: &Lattice,
    interfaces: &Interfaces,
    constraints: &mut [Constraint],
) {
    // Directions of the faces of the outside, and of inner interfaces, around each node.
    let mut seen: Vec<[u8; 2]> = vec![[0; 2]; lattice.nodes.len()];
    for cell in &lattice.cells {
        for face in 0..6 {
            let across = cell.neighbours[face];
            let inner = across != NO_CELL;
            if inner && lattice.cells[across as usize].region >= cell.region {
                continue;
            }
            for c in FACES[face] {
                seen[cell.corners[c] as usize][usize::from(inner)] |= 1 << face;
            }
        }
    }
    let mut claims: Vec<Claim> = Vec::new();
    let mut candidates: Vec<Candidate> = Vec::new();
    // A corner that points along an axis of the lattice may end in a flat of several cells, whose nodes do not
    // look like a corner.
    let mut blunt: Vec<Candidate> = Vec::new();
    for (node, constraint) in constraints.iter_mut().enumerate() {
        let Some(slot) = constraint.rim_slot() else {
            continue;
        };
        let seen = seen[node][usize::from(!constraint.outer)];
        let at = grid.point(lattice.nodes[node]);
        let rims = &interfaces.rims[slot];
        let own = *constraint;
        let corner = rims.nearest_corner(&at, |normals| own.faces(normals));
        if let Some((corner, distance)) = corner {
            blunt.push((slot, corner, distance, node as u32));
        }
        if seen.count_ones() < 2 {
            continue;
        }
        let shown = |s: &Segment| shows(seen, s.normals) && own.faces(&s.facing());
        let Some(point) = rims.nearest(&at, shown) else {
            continue;
        };
        constraint.rim = true;
        constraint.seen = seen;
        claims.push(Claim {
            slot,
            node: node as u32,
            point,
            distance: (point - at).norm(),
        });
        if seen.count_ones() >= 3
            && let Some((corner, distance)) = corner
            && distance <= CORNER_REACH * grid.spacing
        {
            candidates.push((slot, corner, distance, node as u32));
        }
    }
    sort_candidates(&mut candidates);
    sort_candidates(&mut blunt);
    settle_claims(
        &mut claims,
        &cells_inside(lattice, constraints),
        grid.spacing,
        constraints,
    );
    let mut taken: BTreeSet<(usize, u32)> = BTreeSet::new();
    for of_corner in candidates.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let (slot, corner, _, node) = of_corner[0];
        let constraint = &mut constraints[node as usize];
        constraint.rim = true;
        constraint.corner = true;
        taken.insert((slot, corner));
    }
    for of_corner in blunt.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        // The corner is not needed if a node already stands on the rim nearby.
        if of_corner.iter().all(|c| !constraints[c.3 as usize].rim) {
            let constraint = &mut constraints[of_corner[0].3 as usize];
            constraint.rim = true;
            constraint.corner = true;
        }
    }
    // The node at the end of a rim may be beyond the corner: it accepts any rim.
    for claim in &claims {
        let own = constraints[claim.node as usize];
        let rims = &interfaces.rims[claim.slot];
        let end = rims.nearest_corner(&claim.point, |normals| own.faces(normals));
        let held = end.is_some_and(|(corner, distance)| {
            distance < CLAIM_REACH * grid.spacing && taken.contains(&(claim.slot, corner))
        });
        if held {
            constraints[claim.node as usize].seen = 0;
        }
    }
}

/// A node that may go onto a corner: slot, number of the corner, distance, node.
type Candidate = (usize, u32, f64, u32);

/// Groups the candidates of each corner, the nearest first.
fn sort_candidates(candidates: &mut [Candidate]) {
    candidates.sort_by(|a, b| {
        let place = (a.0, a.1).cmp(&(b.0, b.1));
        place.then(a.2.total_cmp(&b.2)).then(a.3.cmp(&b.3))
    });
}

/// A node that would stand on a rim, and its position.
struct Claim {
    slot: usize,
    node: u32,
    point: Vec3,
    distance: f64,
}

/// Leaves one node at each position of a rim. A cell at a rim that is less than half full is missing, and three
/// nodes around the notch claim the same position. The hollow one is between the other two on the surface, so
/// it gets the position; otherwise the nearest one does.
fn settle_claims(
    claims: &mut [Claim],
    cells_inside: &[u8],
    spacing: f64,
    constraints: &mut [Constraint],
) {
    let hollow = |claim: &Claim| cells_inside[claim.node as usize] > 4;
    claims.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.node.cmp(&b.node)));
    let reach = CLAIM_REACH * spacing;
    let cube = |p: &Vec3| [p.x, p.y, p.z].map(|x| (x / reach).floor() as i64);
    let mut places: BTreeMap<(usize, [i64; 3]), Vec<usize>> = BTreeMap::new();
    for (index, claim) in claims.iter().enumerate() {
        let place = (claim.slot, cube(&claim.point));
        places.entry(place).or_default().push(index);
    }
    let mut settled = vec![false; claims.len()];
    for index in 0..claims.len() {
        if settled[index] {
            continue;
        }
        let claim = &claims[index];
        let centre = cube(&claim.point);
        let mut rivals: Vec<usize> = (0..27)
            .map(|n| [n % 3, n / 3 % 3, n / 9].map(|i| i - 1))
            .map(|step| std::array::from_fn(|a| centre[a] + step[a]))
            .flat_map(|at| places.get(&(claim.slot, at)).into_iter().flatten().copied())
            .filter(|&r| !settled[r] && (claims[r].point - claim.point).norm() < reach)
            .filter(|&r| !across_gap(claim, &claims[r], constraints, spacing))
            .collect();
        rivals.sort_unstable();
        let middle = rivals.iter().copied().find(|&r| hollow(&claims[r]));
        let winner = middle.filter(|_| rivals.len() >= 3).unwrap_or(index);
        for rival in rivals {
            settled[rival] = true;
            constraints[claims[rival].node as usize].rim = rival == winner;
        }
    }
}

/// Whether two positions are on the two sides of a gap: each lies where the other faces.
fn across_gap(a: &Claim, b: &Claim, constraints: &[Constraint], spacing: f64) -> bool {
    let faced = |from: &Claim, to: &Claim| {
        let facing = constraints[from.node as usize].facing();
        facing.dot(&(to.point - from.point)) > ON_SURFACE * spacing
    };
    faced(a, b) && faced(b, a)
}

/// Number of the eight cells around each node that lie on the inner side of its interface.
fn cells_inside(lattice: &Lattice, constraints: &[Constraint]) -> Vec<u8> {
    let mut inside = vec![0; lattice.nodes.len()];
    for cell in &lattice.cells {
        for &node in &cell.corners {
            let constraint = constraints[node as usize];
            let own = constraint.outer || constraint.owners >> cell.region.index() & 1 == 1;
            inside[node as usize] += u8::from(own);
        }
    }
    inside
}

/// Whether two different cell faces of the node agree with the two faces of a rim.
fn shows(faces: u8, normals: [Vec3; 2]) -> bool {
    let looking = |normal: Vec3| {
        let mut mask = 0_u8;
        for face in 0..6 {
            let along = normal[face / 2] * if face % 2 == 1 { 1.0 } else { -1.0 };
            if faces >> face & 1 == 1 && along > RIM_FACE_COSINE {
                mask |= 1 << face;
            }
        }
        mask
    };
    let [a, b] = normals.map(looking);
    a != 0 && b != 0 && (a | b).count_ones() >= 2
}

/// [`project`] for a point that is no farther than `reach` from one that satisfies the constraint.
pub(super) fn project_near(
    interfaces: &Interfaces,
    constraint: Constraint,
    from: Vec3,
    reach: f64,
) -> Vec3 {
    // A small margin, because the tree keeps single precision.
    let reach = reach + ON_SURFACE * interfaces.spacing;
    let mut own = constraint.interfaces().filter(|_| constraint.single());
    let near = own
        .next()
        .and_then(|i| nearest_within(interfaces, constraint, i, &from, reach));
    near.unwrap_or_else(|| project(interfaces, constraint, from))
}

/// The nearest point that satisfies a constraint, by alternating projections.
pub(super) fn project(interfaces: &Interfaces, constraint: Constraint, from: Vec3) -> Vec3 {
    let mut at = from;
    let rounds = if constraint.single() { 1 } else { ALTERNATIONS };
    for _ in 0..rounds {
        let before = at;
        let mut owners = constraint.owners;
        while owners != 0 {
            let region = owners.trailing_zeros() as usize;
            owners &= owners - 1;
            at = nearest(interfaces, constraint, Interface::Of(region), &at).unwrap_or(at);
        }
        let rims = constraint.rim_slot().filter(|_| constraint.rim);
        if let Some(rims) = rims.map(|slot| &interfaces.rims[slot]) {
            let faces = |normals: &Vec3| constraint.faces(normals);
            let corner = constraint.corner.then(|| rims.corner_near(&at, faces));
            let corner = corner.flatten();
            // Rims lie side by side where steps are as large as cells; the node's own rim agrees with its cell
            // faces.
            let own = || {
                rims.nearest(&at, |s| {
                    let shown = constraint.seen == 0 || shows(constraint.seen, s.normals);
                    shown && faces(&s.facing())
                })
            };
            at = corner
                .or_else(own)
                .or_else(|| rims.nearest(&at, |s| faces(&s.facing())))
                .unwrap_or(at);
        } else if constraint.outer {
            at = nearest(interfaces, constraint, Interface::Outer, &at).unwrap_or(at);
        }
        if (at - before).norm_squared() <= (ARRIVED * interfaces.spacing).powi(2) {
            break;
        }
    }
    at
}

fn nearest(
    interfaces: &Interfaces,
    constraint: Constraint,
    interface: Interface,
    at: &Vec3,
) -> Option<Vec3> {
    let reach = REACH * interfaces.spacing;
    nearest_within(interfaces, constraint, interface, at, reach)
}

/// The nearest point of an interface on the node's own side of a gap.
fn nearest_within(
    interfaces: &Interfaces,
    constraint: Constraint,
    interface: Interface,
    at: &Vec3,
    reach: f64,
) -> Option<Vec3> {
    let bvh = interfaces.bvh(interface);
    if constraint.beside_gap() && interface == Interface::Outer {
        return bvh.nearest_facing(at, reach, &constraint.facing());
    }
    bvh.nearest(at, reach)
}

/// Whether the interfaces of a constraint meet near a lattice point.
fn meets(grid: &Grid, interfaces: &Interfaces, constraint: Constraint, from: &Vec3) -> bool {
    let at = project(interfaces, constraint, *from);
    let mut all = constraint.interfaces();
    all.all(|interface| {
        nearest(interfaces, constraint, interface, &at)
            .is_some_and(|p| (p - at).norm() <= MEETING * grid.spacing)
    }) && (at - from).norm() <= MEETING_REACH * grid.spacing
}

/// The tie rule (reconstructed): where interfaces are closer together than a spacing and do not meet, the
/// interface nearest to a node's lattice point gets the node, and the node stays on the others that meet it there.
/// So the end of a thin layer remains on the outer surface. Returns the number of such nodes, and changes their
/// constraints accordingly.
pub(super) fn settle_ties(
    grid: &Grid,
    lattice: &Lattice,
    interfaces: &Interfaces,
    constraints: &mut [Constraint],
) -> usize {
    constraints
        .par_iter_mut()
        .enumerate()
        .filter(|(_, c)| c.interfaces().nth(1).is_some())
        .map(|(node, constraint)| {
            let from = grid.point(lattice.nodes[node]);
            if meets(grid, interfaces, *constraint, &from) {
                return 0;
            }
            let mut claimants: Vec<(f64, Interface)> = constraint
                .interfaces()
                .filter_map(|interface| {
                    let at = nearest(interfaces, *constraint, interface, &from)?;
                    Some(((at - from).norm(), interface))
                })
                .collect();
            claimants.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut kept: Option<Constraint> = None;
            for (_, interface) in claimants {
                let with = constraint.kept_with(kept, interface);
                if kept.is_none() || meets(grid, interfaces, with, &from) {
                    kept = Some(with);
                }
            }
            *constraint = kept.unwrap_or(*constraint);
            1
        })
        .sum()
}

/// Positions of all nodes, those between regions on their interfaces.
pub(super) fn snap(
    grid: &Grid,
    lattice: &Lattice,
    surfaces: &[&Surface],
    interfaces: &Interfaces,
    constraints: &[Constraint],
) -> Vec<Vec3> {
    let hits: Vec<[Hits; 3]> = surfaces
        .iter()
        .map(|surface| [2, 0, 1].map(|axis| cast(surface, &lattice_rays(grid, axis))))
        .collect();
    let mut positions: Vec<Vec3> = lattice.nodes.iter().map(|&at| grid.point(at)).collect();
    positions
        .par_iter_mut()
        .enumerate()
        .for_each(|(node, position)| {
            let constraint = constraints[node];
            if constraint.free() {
                return;
            }
            let by_ray = if constraint.single() && !constraint.beside_gap() {
                let at = lattice.nodes[node].map(|i| i as usize);
                snap_along_rays(grid, at, &hits, interfaces, constraint)
            } else {
                None
            };
            *position = by_ray.unwrap_or_else(|| project(interfaces, constraint, *position));
        });
    positions
}

fn lattice_rays(grid: &Grid, axis: usize) -> Rays {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let points = grid.points();
    Rays {
        axis,
        first: [grid.origin[u], grid.origin[v]],
        step: grid.spacing,
        count: [points[u], points[v]],
    }
}

/// The crossing of the node's own interface within half a spacing along Z, else X, else Y (eq. 3.3).
fn snap_along_rays(
    grid: &Grid,
    at: [usize; 3],
    hits: &[[Hits; 3]],
    interfaces: &Interfaces,
    constraint: Constraint,
) -> Option<Vec3> {
    let point = grid.point(at.map(|i| i as i32));
    let bvh = if constraint.outer {
        &interfaces.outer
    } else {
        &interfaces.inner[constraint.owners.trailing_zeros() as usize]
    };
    for (order, axis) in [2, 0, 1].into_iter().enumerate() {
        let rays = lattice_rays(grid, axis);
        let ray = rays.index([at[(axis + 1) % 3], at[(axis + 2) % 3]]);
        let mut best: Option<(f64, Vec3)> = None;
        for (region, hits) in hits.iter().enumerate() {
            if !constraint.outer && constraint.owners >> region & 1 == 0 {
                continue;
            }
            for hit in hits[order].of(ray) {
                let distance = (hit.depth - point[axis]).abs();
                if distance <= grid.spacing / 2.0 && best.is_none_or(|b| distance < b.0) {
                    let mut crossing = point;
                    crossing[axis] = hit.depth;
                    if bvh.nearest(&crossing, ON_SURFACE * grid.spacing).is_some() {
                        best = Some((distance, crossing));
                    }
                }
            }
        }
        if let Some((_, crossing)) = best {
            return Some(crossing);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::super::bvh::Bvh;
    use super::super::rim::{Rims, sharp_edges};
    use super::*;

    /// The lower end of a wall of 0.6 spacings: its left side, its underside and its right side.
    fn end_of_a_wall() -> Interfaces {
        let mut surface = Surface::default();
        for [x, z] in [[0.0, 1.0], [0.0, 0.0], [0.6, 0.0], [0.6, 1.0]] {
            let ends = [-5.0, 5.0].map(|y| Vec3::new(x, y, z));
            surface.vertices.extend(ends);
        }
        for a in [0, 2, 4] {
            let quad = [[a, a + 3, a + 2], [a, a + 1, a + 3]];
            surface.triangles.extend(quad);
        }
        let mut rims = Rims::default();
        for (_, segment) in sharp_edges(&surface, [&[true; 6], &[false; 6]], &[false; 6]) {
            rims.add(segment);
        }
        rims.index(1.0);
        Interfaces {
            outer: Bvh::default(),
            inner: Vec::new(),
            rims: vec![rims],
            spacing: 1.0,
        }
    }

    #[test]
    fn rim_node_goes_to_a_rim_matching_its_cell_faces() {
        let interfaces = end_of_a_wall();
        let from = Vec3::new(0.4, 0.0, -0.1);
        let rim_of = |faces| {
            let constraint = Constraint {
                outer: true,
                rim: true,
                seen: faces,
                ..Constraint::default()
            };
            project(&interfaces, constraint, from)
        };
        let [left, right] = [0.0, 0.6].map(|x| Vec3::new(x, 0.0, 0.0));
        // Its cells have left and lower faces, right and lower ones, or any.
        assert_eq!(rim_of(0b01_00_01), left);
        assert_eq!(rim_of(0b01_00_10), right);
        assert_eq!(rim_of(0), right);
        // Without a rim of matching direction the nearest rim is used.
        assert_eq!(rim_of(0b10_01_00), right);
    }
}
