//! Figures of a wound.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;

use super::sweep::{Sweep, nearest_point};
use super::tetrahedra::volume;

/// Root mean square of the angle between walls that share an edge, in degrees. A path that turns has a share in it.
pub(super) fn rms_angle_deg(walls: &[[Vec3; 3]]) -> f64 {
    let key = |p: &Vec3| [p.x, p.y, p.z].map(f64::to_bits);
    let mut edges = BTreeMap::<[[u64; 3]; 2], Vec<Vec3>>::new();
    for [a, b, c] in walls {
        let normal = (b - a).cross(&(c - a));
        for [p, q] in [[a, b], [b, c], [c, a]] {
            let mut ends = [key(p), key(q)];
            ends.sort_unstable();
            edges.entry(ends).or_default().push(normal);
        }
    }
    let angles: Vec<f64> = edges
        .values()
        .filter_map(|normals| match normals[..] {
            [a, b] => Some(a.angle(&b)),
            _ => None,
        })
        .collect();
    let mean = angles.iter().map(|a| a * a).sum::<f64>() / angles.len().max(1) as f64;
    mean.sqrt().to_degrees()
}

/// Hausdorff distance of walls and swept surface in m, at corners, edges and middles of the walls and at samples of the
/// surface. `inside` are the tetrahedra that the surface crosses; samples outside of them do not count.
pub(super) fn hausdorff_m(
    walls: &[[Vec3; 3]],
    sweep: &Sweep,
    samples: &[Vec3],
    inside: &[[Vec3; 4]],
) -> f64 {
    let of_walls = walls.iter().flat_map(|[a, b, c]| {
        [
            *a,
            *b,
            *c,
            (a + b) / 2.0,
            (b + c) / 2.0,
            (c + a) / 2.0,
            (a + b + c) / 3.0,
        ]
    });
    let from_walls = of_walls.map(|p| sweep.height(&p).abs()).fold(0.0, f64::max);
    let in_tissue = samples
        .iter()
        .filter(|p| inside.iter().any(|t| contains(t, p)));
    let from_samples = in_tissue.map(|p| {
        let distances = walls.iter().map(|wall| (nearest_point(p, wall) - p).norm());
        distances.fold(f64::INFINITY, f64::min)
    });
    from_samples.fold(from_walls, f64::max)
}

fn contains(corners: &[Vec3; 4], p: &Vec3) -> bool {
    (0..4).all(|i| {
        let mut part = *corners;
        part[i] = *p;
        volume(&part) * volume(corners) >= 0.0
    })
}

#[cfg(test)]
mod tests {
    use palpate_tissue::{BladePoint, CutStroke};

    use super::*;

    fn wall(height: f64) -> Vec<[Vec3; 3]> {
        let p = |x: f64, y: f64, z: f64| Vec3::new(x, y, z);
        vec![
            [p(0.0, 0.0, 0.0), p(1.0, 0.0, 0.0), p(1.0, 1.0, height)],
            [p(0.0, 0.0, 0.0), p(1.0, 1.0, height), p(0.0, 1.0, height)],
        ]
    }

    #[test]
    fn flat_walls_on_the_surface_have_neither_angle_nor_distance() {
        let point = |x: f64| BladePoint {
            tip: Vec3::new(x, 0.0, 0.0),
            axis: Vec3::y(),
            depth_m: 1.0,
        };
        let stroke = CutStroke {
            points: vec![point(0.0), point(1.0)],
            width_m: 0.0,
        };
        let sweep = Sweep::of(&stroke, 0.5);
        assert!(rms_angle_deg(&wall(0.0)) < 1e-6);
        let all = [
            Vec3::new(-9.0, -9.0, -9.0),
            Vec3::x() * 50.0,
            Vec3::y() * 50.0,
            Vec3::z() * 50.0,
        ];
        let samples = sweep.samples(0.1, 0.1);
        assert!(samples.len() > 50);
        assert!(hausdorff_m(&wall(0.0), &sweep, &samples, &[all]) < 1e-12);
        assert!((hausdorff_m(&wall(0.3), &sweep, &samples, &[all]) - 0.3).abs() < 1e-9);
        // Half of the wall is missing.
        let half = hausdorff_m(&wall(0.0)[..1], &sweep, &samples, &[all]);
        assert!(half > 0.5, "{half}");
        let bent = [
            wall(0.0)[0],
            [Vec3::zeros(), Vec3::new(1.0, 1.0, 0.0), Vec3::z()],
        ];
        assert!((rms_angle_deg(&bent) - 90.0).abs() < 1e-6);
    }
}
