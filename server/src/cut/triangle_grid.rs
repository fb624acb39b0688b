//! Triangles by place, on a grid.

use std::collections::HashMap;

use palpate_tissue::Vec3;
use palpate_tissue::nearest::{Feature, nearest_feature};

type Key = [i32; 3];

/// Triangles with an index of the grid cells that their boxes meet.
pub(super) struct TriangleGrid {
    triangles: Vec<[Vec3; 3]>,
    side: f64,
    cells: HashMap<Key, Vec<u32>>,
}

/// The point of a triangle that is nearest to another point.
pub(super) struct Nearest {
    /// Its triangle, by number.
    pub(super) triangle: usize,
    /// Shares of the triangle's corners in it.
    pub(super) weights: [f64; 3],
    pub(super) distance_m: f64,
}

impl TriangleGrid {
    /// Sorts triangles in m into cubes of `side` m, about the size of a triangle.
    pub(super) fn new(triangles: Vec<[Vec3; 3]>, side: f64) -> Self {
        let mut grid = Self {
            cells: HashMap::with_capacity(triangles.len()),
            triangles: Vec::new(),
            side,
        };
        for (number, triangle) in triangles.iter().enumerate() {
            for key in grid.keys(triangle, 0.0) {
                grid.cells.entry(key).or_default().push(number as u32);
            }
        }
        grid.triangles = triangles;
        grid
    }

    /// The nearest triangle, not farther than `reach` m.
    pub(super) fn nearest(&self, p: &Vec3, reach: f64) -> Option<Nearest> {
        let mut best: Option<Nearest> = None;
        let mut radius = self.side;
        loop {
            let radius_here = radius.min(reach);
            for key in self.keys(&[*p; 3], radius_here) {
                for &number in self.cells.get(&key).into_iter().flatten() {
                    let found = nearest_of(p, &self.triangles[number as usize], number as usize);
                    let nearer = |b: &Nearest| {
                        (found.distance_m, found.triangle) < (b.distance_m, b.triangle)
                    };
                    if found.distance_m <= reach && best.as_ref().is_none_or(nearer) {
                        best = Some(found);
                    }
                }
            }
            // Nearer triangles would have been met by now.
            if best.as_ref().is_some_and(|b| b.distance_m <= radius_here) || radius >= reach {
                return best;
            }
            radius *= 2.0;
        }
    }

    /// The cubes that a box around three points, widened by a margin, meets.
    fn keys(&self, points: &[Vec3; 3], margin: f64) -> impl Iterator<Item = Key> + use<> {
        let bound = |axis: usize, pick: fn(f64, f64) -> f64, by: f64| {
            let values = points.map(|p| p[axis]);
            ((pick(pick(values[0], values[1]), values[2]) + by) / self.side).floor() as i32
        };
        let low: Key = std::array::from_fn(|a| bound(a, f64::min, -margin));
        let high: Key = std::array::from_fn(|a| bound(a, f64::max, margin));
        (low[0]..=high[0]).flat_map(move |x| {
            (low[1]..=high[1]).flat_map(move |y| (low[2]..=high[2]).map(move |z| [x, y, z]))
        })
    }
}

fn nearest_of(p: &Vec3, corners: &[Vec3; 3], triangle: usize) -> Nearest {
    let mut weights = [0.0; 3];
    match nearest_feature(p, corners) {
        Feature::Corner(i) => weights[i] = 1.0,
        Feature::Edge(i, j, part) => {
            weights[i] = 1.0 - part;
            weights[j] = part;
        }
        Feature::Face(shares) => {
            let sum: f64 = shares.iter().sum();
            weights = shares.map(|s| s / sum);
        }
    }
    let at: Vec3 = corners.iter().zip(weights).map(|(c, w)| c * w).sum();
    Nearest {
        triangle,
        weights,
        distance_m: (at - p).norm(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_triangle_is_that_of_a_search_through_all() {
        let point = |i: u32, k: f64| {
            let x = f64::from(i) * k;
            Vec3::new((x * 1.3).sin(), (x * 0.7).cos(), (x * 0.31).sin())
        };
        let triangles: Vec<[Vec3; 3]> = (0..200)
            .map(|i| {
                let at = point(i, 1.0);
                [at, at + point(i, 2.0) * 0.1, at + point(i, 3.0) * 0.1]
            })
            .collect();
        let grid = TriangleGrid::new(triangles.clone(), 0.15);
        for i in 0..100 {
            let p = point(i, 5.0) * 1.2;
            let all = (0..triangles.len()).map(|t| nearest_of(&p, &triangles[t], t).distance_m);
            let least = all.fold(f64::INFINITY, f64::min);
            let found = grid.nearest(&p, 10.0).unwrap();
            assert_eq!(found.distance_m, least, "point {i}");
            assert!(grid.nearest(&p, 0.9 * least).is_none());
        }
    }
}
