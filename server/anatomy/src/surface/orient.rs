//! Orientation of the surface: determination of the outside.
//!
//! Triangles that share an edge two by two agree on their winding when they run along it in
//! opposite directions. From one triangle this spreads over a *patch*, everything reachable
//! across edges with exactly two triangles. A patch that uses each of its other edges an even
//! number of times is closed by itself; patches that are not are taken together. Such a
//! *component* encloses a signed volume, and the sign says whether it is inside out. A component
//! inside another one that faces inward is a cavity and stays as it is.

use palpate_tissue::Vec3;

use super::edges::{EdgeUse, Edges, Sets, Tally, in_mm};
use super::{Aabb, Surface, signed_volume};
use crate::InputError;

/// Most triangles visited while computing the nesting of components. Reason: a second of work. Beyond the bound
/// the boxes around the components decide instead.
const NESTING_WORK_MAX: usize = 200_000_000;

/// Findings and repairs of the orientation.
#[derive(Debug, Default)]
pub(super) struct Orientation {
    /// Closed parts.
    pub(super) components: usize,
    /// Of these, cavities.
    pub(super) cavities: usize,
    /// Triangles turned to agree with their neighbours.
    pub(super) repaired: Tally,
    /// Components turned as a whole.
    pub(super) turned: Tally,
    /// Components that face outward inside another one.
    pub(super) nested: Tally,
    /// Edges of more than two triangles whose directions do not cancel.
    pub(super) unbalanced_edges: Tally,
}

/// A neighbour across an edge of two triangles.
#[derive(Clone, Copy)]
struct Across {
    triangle: u32,
    /// Whether both run along the edge in the same direction.
    clash: bool,
}

/// Turns triangles and components outward. The surface must be closed.
pub(super) fn orient(surface: &mut Surface, edges: &Edges) -> Result<Orientation, InputError> {
    let mut found = Orientation::default();
    let (patch_of, flips) = spread(surface, &neighbours(surface, edges))?;
    turn(surface, |t| flips[t]);
    let flipped = (0..flips.len()).filter(|t| flips[*t]);
    found.repaired = Tally::of(flipped.map(|t| surface.middle(t)));

    let members = components(&patch_of, edges);
    found.components = members.len();
    let turned = inside_out(surface, &members, &mut found);
    for (component, _) in members.iter().zip(&turned).filter(|(_, turned)| **turned) {
        for &t in component {
            surface.triangles[t].swap(1, 2);
        }
    }
    found.unbalanced_edges = if edges.each().any(|uses| uses.len() > 2) {
        let balance = |uses: &[EdgeUse]| {
            uses.iter()
                .map(|u| if u.forward { 1 } else { -1 })
                .sum::<i32>()
        };
        let edges = Edges::of(&surface.triangles);
        let odd = edges.each().filter(|uses| balance(uses) != 0);
        Tally::of(odd.map(|uses| surface.edge_middle(uses)))
    } else {
        Tally::default()
    };
    Ok(found)
}

fn turn(surface: &mut Surface, flip: impl Fn(usize) -> bool) {
    for (t, corners) in surface.triangles.iter_mut().enumerate() {
        if flip(t) {
            corners.swap(1, 2);
        }
    }
}

/// Up to three neighbours of each triangle.
fn neighbours(surface: &Surface, edges: &Edges) -> Vec<[Option<Across>; 3]> {
    let mut neighbours = vec![[None; 3]; surface.triangles.len()];
    let mut add = |from: u32, to: u32, clash| {
        let slots = &mut neighbours[from as usize];
        let free = slots.iter_mut().find(|slot| slot.is_none());
        *free.expect("a triangle has three edges") = Some(Across {
            triangle: to,
            clash,
        });
    };
    for uses in edges.each() {
        if let [a, b] = uses {
            let clash = a.forward == b.forward;
            add(a.triangle, b.triangle, clash);
            add(b.triangle, a.triangle, clash);
        }
    }
    neighbours
}

/// The patch of each triangle, and whether to turn it so that its patch agrees. The smaller part of a patch is
/// turned, so that a few bad triangles do not turn all the good ones.
fn spread(
    surface: &Surface,
    neighbours: &[[Option<Across>; 3]],
) -> Result<(Vec<u32>, Vec<bool>), InputError> {
    const NONE: u32 = u32::MAX;
    let mut patch_of = vec![NONE; neighbours.len()];
    let mut flips = vec![false; neighbours.len()];
    let mut patches = 0;
    for seed in 0..neighbours.len() {
        if patch_of[seed] != NONE {
            continue;
        }
        let mut patch = vec![seed];
        patch_of[seed] = patches;
        let mut next = 0;
        while let Some(&t) = patch.get(next) {
            next += 1;
            for across in neighbours[t].iter().flatten() {
                let n = across.triangle as usize;
                let flip = flips[t] ^ across.clash;
                if patch_of[n] == NONE {
                    patch_of[n] = patches;
                    flips[n] = flip;
                    patch.push(n);
                } else if flips[n] != flip {
                    return Err(InputError::new(format_args!(
                        "the surface is one-sided near {}: its triangles cannot all face outward; \
                         export the surface again",
                        in_mm(&surface.middle(n))
                    )));
                }
            }
        }
        if patch.iter().filter(|t| flips[**t]).count() * 2 > patch.len() {
            for &t in &patch {
                flips[t] = !flips[t];
            }
        }
        patches += 1;
    }
    Ok((patch_of, flips))
}

/// The triangles of each component, components in the order of their first triangle.
fn components(patch_of: &[u32], edges: &Edges) -> Vec<Vec<usize>> {
    let patches = patch_of.iter().max().map_or(0, |p| *p as usize + 1);
    let mut sets = Sets::new(patches);
    for uses in edges.each().filter(|uses| uses.len() > 2) {
        let mut on_edge: Vec<u32> = uses.iter().map(|u| patch_of[u.triangle as usize]).collect();
        on_edge.sort_unstable();
        let odd: Vec<u32> = on_edge
            .chunk_by(|a, b| a == b)
            .filter(|c| c.len() % 2 == 1)
            .map(|c| c[0])
            .collect();
        for pair in odd.windows(2) {
            sets.join(pair[0], pair[1]);
        }
    }
    let mut slot = vec![usize::MAX; patches];
    let mut members: Vec<Vec<usize>> = Vec::new();
    for (t, &patch) in patch_of.iter().enumerate() {
        let root = sets.find(patch) as usize;
        if slot[root] == usize::MAX {
            slot[root] = members.len();
            members.push(Vec::new());
        }
        members[slot[root]].push(t);
    }
    members
}

/// The components that must be turned; cavities and nested ones are counted.
fn inside_out(surface: &Surface, members: &[Vec<usize>], found: &mut Orientation) -> Vec<bool> {
    let volumes: Vec<f64> = members
        .iter()
        .map(|m| signed_volume(surface, m.iter().copied()))
        .collect();
    let holders = holders(surface, members);
    let middle = |c: usize| surface.middle(members[c][0]);
    let mut turned = vec![false; members.len()];
    let mut nested = Vec::new();
    let mut order: Vec<usize> = (0..members.len()).collect();
    order.sort_by_key(|c| holders[*c].len());
    for c in order {
        let depth = holders[c].len();
        // If the outermost part of a surface is inverted, the whole surface is inverted.
        let outermost = holders[c].iter().copied().min_by_key(|h| holders[*h].len());
        turned[c] = outermost.is_some_and(|o| turned[o]);
        let faces_inward = (volumes[c] < 0.0) != turned[c];
        if faces_inward && depth.is_multiple_of(2) {
            turned[c] = !turned[c];
        } else if faces_inward {
            found.cavities += 1;
        } else if depth % 2 == 1 {
            nested.push(c);
        }
    }
    found.nested = Tally::of(nested.into_iter().map(middle));
    found.turned = Tally::of((0..turned.len()).filter(|c| turned[*c]).map(middle));
    turned
}

/// For each component, the components that contain it.
fn holders(surface: &Surface, members: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let corners = |c: usize| members[c].iter().flat_map(|t| surface.triangles[*t]);
    let boxes: Vec<Option<Aabb>> = (0..members.len())
        .map(|c| Aabb::around(corners(c).map(|v| &surface.vertices[v as usize])))
        .collect();
    let mut work = 0;
    (0..members.len())
        .map(|c| {
            let Some(inner) = boxes[c] else {
                return Vec::new();
            };
            let point = surface.corners(members[c][0])[0];
            (0..members.len())
                .filter(|&h| {
                    let in_box = h != c
                        && boxes[h]
                            .is_some_and(|b| b.contains(&inner.min) && b.contains(&inner.max));
                    if !in_box {
                        return false;
                    }
                    work += members[h].len();
                    work > NESTING_WORK_MAX || winding(surface, &members[h], &point).abs() > 0.5
                })
                .collect()
        })
        .collect()
}

/// Winding number of some triangles about a point: the sum of their solid angles over 4π
/// (Van Oosterom and Strackee 1983, The solid angle of a plane triangle).
fn winding(surface: &Surface, triangles: &[usize], point: &Vec3) -> f64 {
    let half_angles: f64 = triangles
        .iter()
        .map(|&t| {
            let [a, b, c] = surface.corners(t).map(|p| p - point);
            let [la, lb, lc] = [a.norm(), b.norm(), c.norm()];
            let down = la * lb * lc + a.dot(&b) * lc + b.dot(&c) * la + c.dot(&a) * lb;
            a.dot(&b.cross(&c)).atan2(down)
        })
        .sum();
    half_angles / (2.0 * std::f64::consts::PI)
}
