//! Self-intersections of a surface.

use palpate_tissue::Vec3;
use rayon::prelude::*;
use robust::{Coord3D, orient3d};

use super::Aabb;

/// Pairs of triangles of which an edge of one passes through the inside of the other, sorted. Triangles that touch, as
/// the walls of a closed wound do, are no such pairs; predicates are exact. `side` is the size of a triangle in m.
pub fn crossings(
    triangles: &[[u32; 3]],
    place: impl Fn(u32) -> Vec3 + Sync,
    side: f64,
) -> Vec<[u32; 2]> {
    let places = |t: u32| triangles[t as usize].map(&place);
    let boxes: Vec<Aabb> = (0..triangles.len() as u32)
        .into_par_iter()
        .map(|t| {
            let [a, b, c] = places(t);
            Aabb {
                min: a.inf(&b).inf(&c),
                max: a.sup(&b).sup(&c),
            }
        })
        .collect();
    let cube = |p: Vec3| <[i32; 3]>::from(p.map(|x| (x / side).floor() as i32));
    // Every cube that the box of a triangle meets.
    let mut met: Vec<([i32; 3], u32)> = boxes
        .par_iter()
        .zip(0..triangles.len() as u32)
        .flat_map_iter(|(own, t)| {
            let (low, high) = (cube(own.min), cube(own.max));
            (low[0]..=high[0]).flat_map(move |x| {
                (low[1]..=high[1])
                    .flat_map(move |y| (low[2]..=high[2]).map(move |z| ([x, y, z], t)))
            })
        })
        .collect();
    met.par_sort_unstable();
    let found = met.par_chunk_by(|a, b| a.0 == b.0).flat_map_iter(|within| {
        let pairs = within.iter().enumerate().flat_map(move |(i, &(key, a))| {
            within[i + 1..].iter().map(move |&(_, b)| (key, [a, b]))
        });
        pairs.filter_map(|(key, pair)| {
            let [a, b] = pair.map(|t| &boxes[t as usize]);
            // The cube of the lowest point that two boxes share decides, so that a pair is tested once.
            let here = a.meets(b) && cube(a.min.sup(&b.min)) == key;
            (here && cross(pair.map(|t| (triangles[t as usize], places(t))))).then_some(pair)
        })
    });
    let mut found: Vec<[u32; 2]> = found.collect();
    found.par_sort_unstable();
    found
}

/// A triangle and the places of its corners.
type Placed = ([u32; 3], [Vec3; 3]);

fn cross([a, b]: [Placed; 2]) -> bool {
    let shared = a.0.iter().filter(|n| b.0.contains(n)).count();
    // Two triangles at one edge meet nowhere else, unless they lie in one plane.
    shared < 2 && (pierces(&a, &b) || pierces(&b, &a))
}

/// Whether an edge of the first triangle passes through the inside of the second.
fn pierces((a, at_a): &Placed, (b, at_b): &Placed) -> bool {
    let [p, q, r] = at_b.map(coordinates);
    let shared = a.map(|node| b.contains(&node));
    // A shared corner lies in the plane.
    let heights: [f64; 3] = std::array::from_fn(|i| {
        if shared[i] {
            0.0
        } else {
            orient3d(p, q, r, coordinates(at_a[i]))
        }
    });
    (0..3).any(|i| {
        let j = (i + 1) % 3;
        if heights[i] * heights[j] >= 0.0 {
            return false;
        }
        let [from, to] = [at_a[i], at_a[j]].map(coordinates);
        let sides = [[p, q], [q, r], [r, p]].map(|[u, v]| orient3d(from, to, u, v));
        sides.iter().all(|s| *s > 0.0) || sides.iter().all(|s| *s < 0.0)
    })
}

fn coordinates(v: Vec3) -> Coord3D<f64> {
    Coord3D {
        x: v.x,
        y: v.y,
        z: v.z,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{BladePoint, CutStroke, Material, Topology, block, cut};
    use proptest::prelude::*;

    fn of_boundary(topology: &Topology) -> Vec<[u32; 2]> {
        let triangles = &topology.boundary().triangles;
        crossings(triangles, |n| topology.rest(n), 4e-3)
    }

    #[test]
    fn walls_of_a_closed_wound_touch_without_crossing() {
        let mut topology = Topology::new(block([7, 6, 5], 4e-3, &Material::default(), 0).into());
        assert!(of_boundary(&topology).is_empty());
        let point = |y: f64| BladePoint {
            tip: Vec3::new(0.0131, y, 0.006),
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: vec![point(-0.01), point(0.05)],
            width_m: 0.0,
        };
        cut(&mut topology, &stroke).unwrap();
        assert!(of_boundary(&topology).is_empty());
    }

    #[test]
    fn node_beyond_the_opposite_wall_is_found() {
        let mut model = block([7, 6, 5], 4e-3, &Material::default(), 0);
        let inside = |p: &Vec3| (p - Vec3::new(12e-3, 12e-3, 20e-3)).norm() < 1e-6;
        let node = model.nodes.iter().position(inside).unwrap();
        // Out through the bottom.
        model.nodes[node].z = -3e-3;
        assert!(!of_boundary(&Topology::new(model.into())).is_empty());
    }

    proptest! {
        #[test]
        fn pairs_are_those_of_a_search_through_all(
            corners in prop::collection::vec(prop::array::uniform3(-3.0_f64..3.0), 60),
            size in 0.05_f64..1.0,
            side in 0.1_f64..2.0,
        ) {
            // Triangles of a random size, every third corner shared with the next one.
            let places: Vec<Vec3> = (0..60)
                .map(|i| Vec3::from(corners[i / 3 * 3]) + Vec3::from(corners[i]) * size)
                .collect();
            let triangles: Vec<[u32; 3]> = (0..58).map(|t| [t, t + 1, t + 2]).collect();
            let found = crossings(&triangles, |n| places[n as usize], side);
            let placed = |t: u32| {
                let own = triangles[t as usize];
                (own, own.map(|n| places[n as usize]))
            };
            let all = (0..58).flat_map(|a| (a + 1..58).map(move |b| [a, b]));
            let all: Vec<[u32; 2]> = all.filter(|pair| cross(pair.map(placed))).collect();
            prop_assert_eq!(found, all);
        }
    }
}
