//! The surface that a blade sweeps, for methods that know nothing of the lattice.

use palpate_tissue::nearest::{Feature, nearest_feature};
use palpate_tissue::{CutStroke, Vec3};

/// The swept surface as triangles.
pub(super) struct Sweep {
    own: Vec<[Vec3; 3]>,
    /// The same surface, continued beyond its rims.
    continued: Vec<[Vec3; 3]>,
    /// Corners of the box around its own part.
    bounds: [Vec3; 2],
}

impl Sweep {
    /// The surface of a stroke, continued by `beyond` m.
    pub(super) fn of(stroke: &CutStroke, beyond: f64) -> Self {
        let points = &stroke.points;
        let own: Vec<[Vec3; 2]> = points.iter().map(|p| [p.tip, p.top()]).collect();
        let mut wide: Vec<[Vec3; 2]> = points
            .iter()
            .map(|p| [p.tip - p.axis * beyond, p.top() + p.axis * beyond])
            .collect();
        let last = points.len() - 1;
        let way = |end: usize, before: usize| (points[end].tip - points[before].tip).normalize();
        let (back, ahead) = (way(0, 1) * beyond, way(last, last - 1) * beyond);
        wide.insert(0, wide[0].map(|p| p + back));
        wide.push(wide[last + 1].map(|p| p + ahead));
        let bound = |pick: fn(&Vec3, &Vec3) -> Vec3| {
            let corners = own.iter().flatten().copied();
            corners.reduce(|a, b| pick(&a, &b)).unwrap_or_default()
        };
        Self {
            bounds: [bound(Vec3::inf), bound(Vec3::sup)],
            own: between(&own),
            continued: between(&wide),
        }
    }

    /// Whether the boxes around the surface and around some points meet.
    pub(super) fn may_meet(&self, points: &[Vec3]) -> bool {
        (0..3).all(|a| {
            points.iter().any(|p| p[a] >= self.bounds[0][a])
                && points.iter().any(|p| p[a] <= self.bounds[1][a])
        })
    }

    /// The share of the way from `p` to `q` at which it crosses the surface (Möller and Trumbore 1997).
    pub(super) fn crossing(&self, p: &Vec3, q: &Vec3) -> Option<f64> {
        let way = q - p;
        self.own.iter().find_map(|[a, b, c]| {
            let (ab, ac) = (b - a, c - a);
            let across = way.cross(&ac);
            let determinant = ab.dot(&across);
            if determinant == 0.0 {
                return None;
            }
            let from = (p - a) / determinant;
            let u = from.dot(&across);
            let normal = from.cross(&ab);
            let (v, t) = (way.dot(&normal), ac.dot(&normal));
            (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && (0.0..=1.0).contains(&t)).then_some(t)
        })
    }

    /// Signed distance from the continued surface.
    pub(super) fn height(&self, p: &Vec3) -> f64 {
        let (mut best, mut height) = (f64::INFINITY, 0.0);
        for triangle in &self.continued {
            let [a, b, c] = triangle;
            let way = p - nearest_point(p, triangle);
            if way.norm_squared() < best {
                best = way.norm_squared();
                height = way.norm() * (b - a).cross(&(c - a)).dot(&way).signum();
            }
        }
        height
    }

    /// Points of the surface on a grid of `step` m, without a margin of `inset` m along its rims.
    pub(super) fn samples(&self, step: f64, inset: f64) -> Vec<Vec3> {
        let [first, last] = [self.own[0], self.own[self.own.len() - 1]];
        let (tips, tops) = (
            self.own.iter().step_by(2),
            self.own.iter().skip(1).step_by(2),
        );
        let mut found = Vec::new();
        // The first triangle of a step has both tips, the second both tops.
        for ([a, c, _], [_, d, b]) in tips.zip(tops) {
            let along = ((c - a).norm() / step).ceil() as usize;
            let up = ((b - a).norm() / step).ceil() as usize;
            for i in 0..along {
                let s = i as f64 / along as f64;
                let (tip, top) = (a + (c - a) * s, b + (d - b) * s);
                for j in 0..=up {
                    let p = tip + (top - tip) * (j as f64 / up as f64);
                    let is_inside = (p - tip).norm() > inset
                        && distance_to_line(&p, &first[0], &first[2]) > inset
                        && distance_to_line(&p, &last[0], &last[1]) > inset;
                    if is_inside {
                        found.push(p);
                    }
                }
            }
        }
        found
    }
}

fn between(columns: &[[Vec3; 2]]) -> Vec<[Vec3; 3]> {
    let pairs = columns.windows(2);
    pairs
        .flat_map(|pair| {
            let [[a, b], [c, d]] = [pair[0], pair[1]];
            [[a, c, d], [a, d, b]]
        })
        .collect()
}

/// The point of a triangle nearest to `p`.
pub(super) fn nearest_point(p: &Vec3, corners: &[Vec3; 3]) -> Vec3 {
    match nearest_feature(p, corners) {
        Feature::Corner(i) => corners[i],
        Feature::Edge(i, j, part) => corners[i] + (corners[j] - corners[i]) * part,
        Feature::Face(weights) => {
            let sum: f64 = weights.iter().sum();
            let weighted = corners.iter().zip(weights);
            weighted.map(|(c, w)| c * (w / sum)).sum()
        }
    }
}

fn distance_to_line(p: &Vec3, from: &Vec3, to: &Vec3) -> f64 {
    let way = (to - from).normalize();
    (p - from).cross(&way).norm()
}
