//! Self-intersections of a surface.

use palpate_tissue::{Topology, Vec3};
use robust::{Coord3D, orient3d};

use super::triangle_grid::TriangleGrid;

/// Pairs of triangles of the outer surface of which an edge of one passes through the inside of the other. The walls of
/// a closed wound touch, which is no such pair; predicates are exact.
pub(super) fn self_intersections(topology: &Topology) -> usize {
    let triangles = &topology.boundary().triangles;
    let places = triangles.iter().map(|t| t.map(|n| topology.rest(n)));
    let grid = TriangleGrid::new(places.collect(), topology.model().spacing_m);
    let mut count = 0;
    for first in 0..triangles.len() {
        let (a, at_a) = (&triangles[first], grid.triangle(first));
        let later = grid.beside(first).into_iter().map(|t| t as usize);
        for second in later.filter(|&second| second > first) {
            let (b, at_b) = (&triangles[second], grid.triangle(second));
            let crossing = pierces(a, at_a, b, at_b) || pierces(b, at_b, a, at_a);
            count += usize::from(crossing);
        }
    }
    count
}

/// Whether an edge of the first triangle passes through the inside of the second.
fn pierces(a: &[u32; 3], at_a: &[Vec3; 3], b: &[u32; 3], at_b: &[Vec3; 3]) -> bool {
    let [p, q, r] = at_b.map(coordinates);
    let heights = at_a.map(|v| orient3d(p, q, r, coordinates(v)));
    (0..3).any(|i| {
        let j = (i + 1) % 3;
        if heights[i] * heights[j] >= 0.0 || b.contains(&a[i]) || b.contains(&a[j]) {
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
    use palpate_tissue::{BladePoint, CutStroke, Material, block, cut};

    fn slit(topology: &mut Topology) {
        let point = |y: f64| BladePoint {
            tip: Vec3::new(0.0131, y, 0.006),
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: vec![point(-0.01), point(0.05)],
            width_m: 0.0,
        };
        cut(topology, &stroke).unwrap();
    }

    #[test]
    fn walls_of_a_closed_wound_touch_without_crossing() {
        let mut topology = Topology::new(block([7, 6, 5], 4e-3, &Material::default(), 0).into());
        assert_eq!(self_intersections(&topology), 0);
        slit(&mut topology);
        assert_eq!(self_intersections(&topology), 0);
    }

    #[test]
    fn node_beyond_the_opposite_wall_is_found() {
        let mut model = block([7, 6, 5], 4e-3, &Material::default(), 0);
        let inside = |p: &Vec3| (p - Vec3::new(12e-3, 12e-3, 20e-3)).norm() < 1e-6;
        let node = model.nodes.iter().position(inside).unwrap();
        // Out through the bottom.
        model.nodes[node].z = -3e-3;
        assert!(self_intersections(&Topology::new(model.into())) > 0);
    }
}
